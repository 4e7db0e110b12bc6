"""Simulated experiments with known truth, as in the paper's section IV."""

import dataclasses
from typing import NamedTuple


import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from .data import Dataset
from .gaussian import Gaussian
from .law import StribeckLaw
from .model import StateSpaceModel
from .systems.acrobot import Acrobot, drives, table_i


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
    """Logs of `model` as the truth, integrated with `substeps` Runge-Kutta steps per sample and both noises added."""
    truth = dataclasses.replace(model, substeps=substeps)
    key_process, key_reading = jax.random.split(key)
    w = jax.random.normal(key_process, (*u.shape[:2], x0.shape[1]), x0.dtype) * jnp.exp(0.5 * model.log_q)[None, None]
    v = jax.random.normal(key_reading, (*u.shape[:2], len(model.measured)), x0.dtype) * jnp.exp(0.5 * model.log_r)[None, None]

    def one(x0, u, w, v):
        def step(x, inputs):
            u, w = inputs
            return truth.transition(x, u) + w, x

        _, x = jax.lax.scan(step, x0, (u, w))
        return x, jax.vmap(truth.emission)(x) + v

    x, y = jax.jit(jax.vmap(one))(x0, u, w, v)
    t = jnp.broadcast_to(model.dt * jnp.arange(u.shape[1], dtype=u.dtype), u.shape[:2])
    return Experiment(Dataset(t, u, y, jnp.ones(u.shape[:2], bool)), x)


def paper_friction(dtype=float) -> StribeckLaw:
    """Coulomb, viscous and Stribeck friction of a size with the paper's figure 2b."""
    a = lambda *values: jnp.asarray(values, dtype)  # noqa: E731
    return StribeckLaw(a(0.030, 0.017), a(0.045, 0.027), a(0.35, 0.40), a(0.0070, 0.0035), a(0.1, 0.1))


def paper_model(*, q_std=(2e-4, 1e-2), r_std=(0.01, 0.05), start_std: float = 0.5, dtype=float) -> StateSpaceModel:
    """The true acrobot of the paper: Table I, friction in both joints, only joint 1 read at 100 Hz.

    `q_std` is the process noise of angles [rad] and rates [rad/s] per step, `r_std` that of the readings,
    `start_std` that of theta2 in the first row [rad].
    """
    a = lambda *values: jnp.asarray(values, dtype)  # noqa: E731
    system = Acrobot(**{k: a(v)[0] for k, v in {**Acrobot.optional, **table_i}.items()}, joints=drives)
    cov = jnp.diag(a(0.9, start_std, 0.02, 0.02) ** 2)
    return StateSpaceModel(
        system,
        paper_friction(dtype),
        Gaussian(jnp.asarray([jnp.pi, 0.0, 0.0, 0.0], dtype), cov),
        2 * jnp.log(a(q_std[0], q_std[0], q_std[1], q_std[1])),
        2 * jnp.log(a(*r_std)),
        measured=(0, 2),
        dt=0.01,
    )


def paper_experiment(
    model: StateSpaceModel, sequences: int = 20, steps: int = 500, *, key: PRNGKeyArray
) -> Experiment:
    """Sinusoidal torques of another amplitude and period in each sequence, starts in the upper half plane."""
    key_start, key_angle, key_phase, key_amplitude, key_period, key_noise = jax.random.split(key, 6)
    dtype = model.log_q.dtype
    draw = lambda key, low, high: jax.random.uniform(key, (sequences,), dtype, low, high)  # noqa: E731
    spread = jnp.sqrt(jnp.diag(model.start.cov))
    x0 = model.start.mean[None] + spread[None] * jax.random.normal(key_start, (sequences, spread.shape[0]), dtype)
    x0 = x0.at[:, 0].set(draw(key_angle, jnp.pi / 2, 3 * jnp.pi / 2))
    amplitude, period = draw(key_amplitude, 0.05, 0.3), draw(key_period, 0.5, 3.0)
    phase = draw(key_phase, 0.0, 2 * jnp.pi)
    t = model.dt * jnp.arange(steps + 1, dtype=dtype)
    u = amplitude[:, None] * jnp.sin(2 * jnp.pi * t[None, :] / period[:, None] + phase[:, None])
    return simulate(model, x0, u[..., None], key=key_noise)
