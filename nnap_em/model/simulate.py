"""Simulated experiments with known truth, as in the paper's section IV."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from ..base.gaussian import Gaussian
from ..logs.dataset import Dataset
from ..machines.rig import Declared, Rig
from ..machines.systems import specs
from ..machines.systems.acrobot import Acrobot, drives, table_i
from ..machines.systems.base import AbstractSystem
from ..machines.systems.pendulum import Pendulum
from ..machines.systems.slide import Slide
from .law import StribeckLaw
from .state_space import StateSpaceModel


class Experiment(NamedTuple):
    """Logs and the states behind them."""

    data: Dataset
    x: Float[Array, "seq time state"]


def simulate(
    model: StateSpaceModel,
    x0: Float[Array, "seq state"],
    u: Float[Array, "seq time input"],
    *,
    key: PRNGKeyArray,
    substeps: int = 10,
) -> Experiment:
    """Logs of a model as the truth, both noises added.

    Args:
        model: the truth, such as `fit.model`.
        x0: first states (sequence, state) [rad, rad/s, or m, m/s].
        u: inputs (sequence, row, input) [N m, or N].
        key: random key of both noises.
        substeps: Runge-Kutta steps a sample.

    Returns:
        The Dataset and the states behind it.

    Example:
        >>> nnap_em.simulate(fit.model, jnp.zeros((3, 2)), jnp.ones((3, 10, 1)), key=key).data.y.shape
        (3, 10, 1)
    """
    truth = dataclasses.replace(model, substeps=substeps)
    key_process, key_reading = jax.random.split(key)
    normal = lambda key, count: jax.random.normal(key, (*u.shape[:2], count), x0.dtype)  # noqa: E731
    w = normal(key_process, x0.shape[1]) * jnp.exp(0.5 * model.log_q)[None, None]
    v = normal(key_reading, len(model.measured)) * jnp.exp(0.5 * model.log_r)[None, None]
    t = jnp.broadcast_to(model.dt * jnp.arange(u.shape[1], dtype=u.dtype), u.shape[:2])
    blank = Dataset(t, u, v, jnp.ones(u.shape[:2], bool))

    def one(x0, seq, w, v):
        inputs = truth.inputs(seq)

        def step(x, slices):
            u, w = slices
            return truth.transition(x, u) + w, x

        _, x = jax.lax.scan(step, x0, (inputs, w))
        return x, jax.vmap(truth.emission)(x, inputs) + v

    x, y = jax.jit(jax.vmap(one))(x0, blank, w, v)
    return Experiment(blank._replace(y=y), x)


def paper_friction(dtype=float) -> StribeckLaw:
    """Coulomb, viscous and Stribeck friction of a size with the paper's figure 2b."""
    a = lambda *values: jnp.asarray(values, dtype)  # noqa: E731
    return StribeckLaw(a(0.030, 0.017), a(0.045, 0.027), a(0.35, 0.40), a(0.0070, 0.0035), a(0.1, 0.1))


def paper_model(*, start_std: float = 0.5, dtype=float) -> StateSpaceModel:
    """The true acrobot of the paper: Table I, friction in both joints, only joint 1 read at 100 Hz.

    Args:
        start_std: standard deviation of theta2 in the first row [rad].
        dtype: of all numbers.

    Returns:
        The model.

    Example:
        >>> paper_model().system.coordinates
        ('theta1', 'theta2')
    """
    a = lambda *values: jnp.asarray(values, dtype)  # noqa: E731
    system = Acrobot(**{k: a(v)[0] for k, v in {**Acrobot.optional, **table_i}.items()}, joints=drives)
    cov = jnp.diag(a(0.9, start_std, 0.02, 0.02) ** 2)
    return StateSpaceModel(
        system=system,
        unknown=paper_friction(dtype),
        start=Gaussian(jnp.asarray([jnp.pi, 0.0, 0.0, 0.0], dtype), cov),
        log_q=2 * jnp.log(a(2e-4, 2e-4, 1e-2, 1e-2)),
        log_r=2 * jnp.log(a(0.01, 0.05)),
        measured=(0, 2),
        dt=0.01,
    )


class Sweep(NamedTuple):
    """Ranges from which each sequence draws its sinusoid and its start."""

    amplitude: tuple[float, float]
    """[N m, or N on a slide]"""
    period: tuple[float, float]
    """[s]"""
    first: tuple[float, float]
    """Range of the first coordinate in the first row [rad or m]; the other states follow the model's prior."""


paper_sweep = Sweep((0.05, 0.3), (0.5, 3.0), (math.pi / 2, 3 * math.pi / 2))


def paper_experiment(model: StateSpaceModel, sequences: int = 20, steps: int = 500, *, key: PRNGKeyArray) -> Experiment:
    """The paper's experiment: sinusoidal torques of another amplitude and period in each sequence.

    Starts are in the upper half plane.

    Args:
        model: the truth, such as `paper_model()`.
        sequences: their number.
        steps: samples of each after the first row.
        key: random key of starts, inputs and noise.

    Returns:
        The Dataset and the states behind it.

    Example:
        >>> paper_experiment(paper_model(), 2, 5, key=key).data.u.shape
        (2, 6, 1)
    """
    return sweep_experiment(model, paper_sweep, sequences, steps, key=key)


def sweep_experiment(
    model: StateSpaceModel, sweep: Sweep, sequences: int, steps: int, *, key: PRNGKeyArray
) -> Experiment:
    """Logs of `steps` intervals; the sinusoid drives the first input."""
    key_start, key_angle, key_phase, key_amplitude, key_period, key_noise = jax.random.split(key, 6)
    dtype = model.log_q.dtype
    draw = lambda key, low, high: jax.random.uniform(key, (sequences,), dtype, low, high)  # noqa: E731
    spread = jnp.sqrt(jnp.diag(model.start.cov))
    x0 = model.start.mean[None] + spread[None] * jax.random.normal(key_start, (sequences, spread.shape[0]), dtype)
    x0 = x0.at[:, 0].set(draw(key_angle, *sweep.first))
    amplitude, period = draw(key_amplitude, *sweep.amplitude), draw(key_period, *sweep.period)
    phase = draw(key_phase, 0.0, 2 * jnp.pi)
    t = model.dt * jnp.arange(steps + 1, dtype=dtype)
    u = amplitude[:, None] * jnp.sin(2 * jnp.pi * t[None, :] / period[:, None] + phase[:, None])
    return simulate(model, x0, u[..., None], key=key_noise)


def sensed(
    model: StateSpaceModel,
    measured: Sequence[str] | None,
    process: Sequence[float] | None,
    reading: Sequence[float] | None,
) -> StateSpaceModel:
    """`model` with other readings and noise (of positions, of rates); None: as it is.

    A rate that is read for the first time is five times as noisy as a position.
    """
    states, dof = model.system.coordinates + model.system.rates, len(model.system.rates)
    std = dict(zip(model.measured, np.exp(0.5 * np.asarray(model.log_r)), strict=True))
    first = std[model.measured[0]]
    position, rate = reading or (first, next((s for i, s in std.items() if i >= dof), 5 * first))
    index = tuple(states.index(name) for name in measured) if measured else model.measured
    log_q = model.log_q if process is None else 2 * jnp.log(jnp.repeat(jnp.asarray(process), dof))
    log_r = 2 * jnp.log(jnp.asarray([rate if i >= dof else position for i in index]))
    return dataclasses.replace(model, log_q=log_q, log_r=log_r, measured=index)


def declared(name: str, model: StateSpaceModel) -> Rig:
    """The truth as a rig of the system `name`: all known save friction and process noise."""
    spec, system, std = specs[name], model.system, np.sqrt(np.diag(np.asarray(model.start.cov)))
    values = {n: float(getattr(system, n)) for n in (*spec.parameters, *spec.optional)}
    measured = tuple(spec.states[i] for i in model.measured)
    noise = np.exp(0.5 * np.asarray(model.log_r))
    start = zip(spec.states, np.asarray(model.start.mean), std, strict=True)
    return Rig(
        name=f"simulated {name}",
        system=name,
        parameters={n: Declared(v, 0.0) for n, v in values.items() if n not in spec.optional or v != spec.optional[n]},
        friction=True,
        input_columns=tuple(f"u{j}" if len(system.joints) > 1 else "u" for j in system.joints),
        input_joints=system.joints,
        dt=model.dt,
        clock="sequence",
        measured=measured,
        noise_std={n: _short(s) for n, s in zip(measured, noise, strict=True)},
        start={n: Declared(_short(mean), _short(s)) for n, mean, s in start if n not in measured},
    )


def _short(value: float) -> float:
    """A number without the last digits of a logarithm and back."""
    return float(f"{value:.12g}")


class Example(NamedTuple):
    """A machine with known truth and the experiment that is made on it."""

    model: StateSpaceModel
    sweep: Sweep


def _pendubot() -> Example:
    model = paper_model()
    system = dataclasses.replace(model.system, joints=(1,))
    return Example(dataclasses.replace(model, system=system), paper_sweep._replace(amplitude=(0.2, 1.0)))


def _one_joint(
    system: AbstractSystem, friction: Sequence[float], spread: Sequence[float], q_std: Sequence[float], r_std: float
) -> StateSpaceModel:
    """A machine with one joint, at rest on average, whose position is read."""
    start = Gaussian(jnp.zeros(2), jnp.diag(jnp.asarray(spread) ** 2))
    law, log_q = StribeckLaw(*(jnp.asarray([value]) for value in friction)), 2 * jnp.log(jnp.asarray(q_std))
    return StateSpaceModel(
        system=system,
        unknown=law,
        start=start,
        log_q=log_q,
        log_r=2 * jnp.log(jnp.asarray([r_std])),
        measured=(0,),
        dt=0.01,
    )


def _pendulum() -> Example:
    parameters = {"m": 0.5, "lc": 0.2, "I": 0.002, "g": 9.81}
    system = Pendulum(**{name: jnp.asarray(value) for name, value in parameters.items()}, joints=(1,))
    model = _one_joint(system, (0.03, 0.05, 0.4, 0.01, 0.1), (1.0, 1.0), (1e-4, 1e-2), 0.01)
    return Example(model, Sweep((0.1, 0.8), (0.5, 3.0), (-math.pi / 2, math.pi / 2)))


def _slide() -> Example:
    system = Slide(m=jnp.asarray(1.0), joints=(1,))
    model = _one_joint(system, (1.0, 1.5, 0.05, 2.0, 0.02), (0.1, 0.1), (1e-5, 2e-3), 1e-3)
    return Example(model, Sweep((2.0, 8.0), (0.5, 2.0), (-0.1, 0.1)))


examples: dict[str, Callable[[], Example]] = {
    "acrobot": lambda: Example(paper_model(), paper_sweep),
    "pendubot": _pendubot,
    "pendulum": _pendulum,
    "slide": _slide,
}
"""The machines that can be simulated as they stand, by the name of the system; the acrobot is the paper's."""
