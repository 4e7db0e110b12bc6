"""The common work of benchmarks/throughput.py: one model, one data set, and this library's smoothers on it.

The acrobot of the paper with a 1-16-16-1 tanh network of friction in each joint, one Runge-Kutta step per 10 ms, all in
32 bits.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from nnap_em.base.gaussian import Gaussian
from nnap_em.estimate.em.loop import e_step
from nnap_em.estimate.smoother.gaussian import ExtendedKalmanSmoother
from nnap_em.estimate.smoother.particle import ffbs, particle_filter
from nnap_em.estimate.smoother.start import StartBank
from nnap_em.logs.dataset import Dataset
from nnap_em.model.base import prepare
from nnap_em.model.friction import AbstractJointMap
from nnap_em.model.simulate import Experiment, paper_friction, paper_model, paper_sweep, sweep_experiment
from nnap_em.model.state_space import StateSpaceModel

START, START_STD = (math.pi / 2, 0.0, 0.0, 0.0), (0.05, 0.05, 0.05, 0.05)
"""Prior of the first row: the arm held out level, at rest [rad, rad/s]."""
WIDTH = 16
one_start = StartBank((1, 1, 1, 1))
"""The bank that `nnap-em identify` builds for this start."""
wide_bank = StartBank((1, 13, 1, 1))
"""The bank that it builds for the paper's acrobot, whose joint 2 is known to 0.5 rad."""


class Network(NamedTuple):
    """One joint's weights, hidden units first."""

    first: Any
    first_bias: Any
    second: Any
    second_bias: Any
    last: Any
    last_bias: Any

    def __call__(self, v):
        """Torque [N m] at a joint velocity [rad/s]."""
        hidden = jnp.tanh(self.first * v + self.first_bias)
        return self.last @ jnp.tanh(self.second @ hidden + self.second_bias) + self.last_bias


class Networks(AbstractJointMap):
    """Torques of both joints."""

    stacked: Network
    """Weights with a leading joint axis."""

    @property
    def joints(self) -> tuple[Network, Network]:
        """The networks one by one."""
        return tuple(jax.tree.map(lambda a, j=j: a[j], self.stacked) for j in range(2))

    def torque(self, v):
        return jax.vmap(lambda net, v: net(v))(self.stacked, v)


def friction_networks() -> Networks:
    """Random hidden layers; the output layer fitted to the paper's friction by least squares."""
    rng = np.random.default_rng(0)
    velocity = np.linspace(-30.0, 30.0, 601, dtype=np.float32)
    torque = np.asarray(jax.vmap(paper_friction(jnp.float32))(jnp.stack([velocity, velocity], axis=1)))

    def fit(torque):
        first, first_bias = 0.5 * rng.normal(size=WIDTH), rng.normal(size=WIDTH)
        second, second_bias = rng.normal(size=(WIDTH, WIDTH)) / math.sqrt(WIDTH), 0.3 * rng.normal(size=WIDTH)
        hidden = np.tanh(np.tanh(np.outer(velocity, first) + first_bias) @ second.T + second_bias)
        columns = np.concatenate([hidden, np.ones((velocity.size, 1))], axis=1)
        last = np.linalg.solve(columns.T @ columns + 0.1 * np.eye(WIDTH + 1), columns.T @ torque)
        weights = (first, first_bias, second, second_bias, last[:-1], last[-1])
        return Network(*(jnp.asarray(w, jnp.float32) for w in weights))

    return Networks(jax.tree.map(lambda *a: jnp.stack(a), fit(torque[:, 0]), fit(torque[:, 1])))


@functools.cache
def common_model() -> StateSpaceModel:
    """The truth, which every smoother is given."""
    cov = jnp.diag(jnp.asarray(START_STD, jnp.float32) ** 2)
    start = Gaussian(jnp.asarray(START, jnp.float32), cov)
    return dataclasses.replace(paper_model(dtype=jnp.float32), unknown=friction_networks(), start=start, substeps=1)


class Size(NamedTuple):
    """How much is smoothed."""

    sequences: int = 20
    steps: int = 500
    particles: int = 0


@functools.cache
def _all_logs(sequences: int, steps: int) -> Experiment:
    spread = math.sqrt(3) * START_STD[0]  # uniform, with the prior's standard deviation
    sweep = paper_sweep._replace(first=(START[0] - spread, START[0] + spread))
    return sweep_experiment(common_model(), sweep, sequences, steps, key=jax.random.key(1))


def common_logs(size: Size) -> Experiment:
    """Logs of the model itself under sinusoidal torques; fewer than 20 sequences are the first of the 20."""
    return jax.tree.map(lambda a: a[: size.sequences], _all_logs(max(20, size.sequences), size.steps))


class Case(NamedTuple):
    """One row: a smoother on the common work."""

    who: str
    """`nnap_em`, or the peer."""
    what: str
    size: Size
    prepare: Callable[[], Callable[[], Any]]
    """Compiles, and gives what is timed."""
    states: Callable[[Any], Any]
    """Estimated states (seq, time, state) of a result."""


def compiled(function, *args) -> Callable[[], Any]:
    """`function(*args)`, compiled for these arguments."""
    program = eqx.filter_jit(function).lower(*args).compile()
    return lambda: program(*args)


def smoother_case(what: str, smoother, size: Size) -> Case:
    """`e_step` with any smoother."""

    def prepare():
        run = lambda model, data, key: e_step(model, data, smoother, key=key)  # noqa: E731
        return compiled(run, common_model(), common_logs(size).data, jax.random.key(2))

    return Case("nnap_em", what, size, prepare, lambda posterior: posterior.state.mean)


def _each(one: Callable, size: Size) -> Callable[[], Any]:
    """`one(model, seq, key)` over all sequences, compiled."""
    keys = jax.random.split(jax.random.key(2), size.sequences)

    def every(model, data, keys):
        return jax.vmap(lambda seq, key: one(model, seq, key))(data, keys)

    return compiled(every, common_model(), common_logs(size).data, keys)


def particle_history(model, seq: Dataset, proposal, particles: int, key):
    """The particle filter about the path of the extended smoother, as `ParticleSmoother` runs it."""
    prepared = prepare(model, seq)
    potentials = proposal(model, prepared, *ExtendedKalmanSmoother(one_start, iterations=0).path(model, prepared))
    return particle_filter(model, potentials, prepared, num_particles=particles, key=key)


def filter_case(name: str, proposal, size: Size) -> Case:
    """The particle filter with its whole history."""

    def one(model, seq, key):
        return particle_history(model, seq, proposal, size.particles, key)

    def states(history):
        mean = jnp.einsum("stxp,stp->stx", history.x, jax.nn.softmax(history.log_w, axis=-1))
        return history.origin + history.scale[:, None] * mean

    return Case("nnap_em", f"{name} filter, {size.particles}", size, lambda: _each(one, size), states)


def paths_case(name: str, proposal, backward, size: Size) -> Case:
    """The particle filter and as many backward trajectories as particles."""

    def one(model, seq, key):
        key_filter, key_paths = jax.random.split(key)
        history = particle_history(model, seq, proposal, size.particles, key_filter)
        return ffbs(history, backward, num_paths=size.particles, key=key_paths).x

    return Case("nnap_em", name, size, lambda: _each(one, size), lambda x: jnp.mean(x, axis=2))
