"""The paper's purely data-driven model: a network is the whole transition, and EM fits it by gradient steps.

Without physics the latent space is unique only up to an invertible map [paper, sec. II]: the states that nobody reads
may be anything that helps to predict the others.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PRNGKeyArray

from nnap_em.base.gaussian import Gaussian, cholesky, lower
from nnap_em.estimate.em.build import reading_noise
from nnap_em.estimate.em.mstep import AbstractMStep, MStepInfo, not_diverged
from nnap_em.estimate.smoother.posterior import Posterior
from nnap_em.logs.dataset import Dataset, active_steps, fill_missing
from nnap_em.model.base import AbstractModel


class NetworkModel(AbstractModel):
    """x_{k+1} = x_k + step * mlp(([x_k, u_k] - centre) / spread) + w_k, y_k = some entries of x_k + v_k."""

    mlp: eqx.nn.MLP
    centre: Float[Array, " feature"]
    """Typical value of each state and input."""
    spread: Float[Array, " feature"]
    """Typical size of their variation."""
    step: Float[Array, " state"]
    """Typical change of each state from one sample to the next."""
    start: Gaussian
    """Prior of the state in the first row."""
    log_q: Float[Array, " state"]
    """Log of the process-noise variance per step."""
    log_r: Float[Array, " obs"]
    """Log of the measurement variance."""
    measured: tuple[int, ...] = eqx.field(static=True)
    """Which states are read, in the order of y."""
    dt: float = eqx.field(static=True)
    """Sample interval [s]."""

    def transition(self, x: Float[Array, " state"], u: Float[Array, " input"]) -> Float[Array, " state"]:
        """Mean of the state one sample later."""
        return x + self.step * self.mlp((jnp.concatenate([x, u]) - self.centre) / self.spread)

    def emission(self, x: Float[Array, " state"], u: Float[Array, " input"]) -> Float[Array, " obs"]:
        """Mean of the reading."""
        return jnp.stack([x[i] for i in self.measured])


def build_network(
    data: Dataset,
    measured: Sequence[int],
    states: int,
    dt: float,
    *,
    key: PRNGKeyArray,
    width: int = 64,
    depth: int = 2,
) -> NetworkModel:
    """A random network with every scale from the logs; unread states are of size 1 and as quick as those read."""
    y, u = np.asarray(data.y), np.asarray(data.u)[np.asarray(data.valid)]
    change = np.diff(y, axis=1)
    noise = np.asarray(
        [max(reading_noise(y[..., i]), 1e-6 * np.nanstd(y[..., i]) + 1e-12) for i in range(len(measured))]
    )
    size, moves = np.nanstd(y, axis=(0, 1)), np.sqrt(np.nanmean(change**2, axis=(0, 1)))
    centre, spread = np.zeros(states), np.ones(states)
    centre[list(measured)], spread[list(measured)] = np.nanmean(y, axis=(0, 1)), np.maximum(size, noise)
    step = np.full(states, np.median(moves / np.maximum(size, noise)))
    step[list(measured)] = np.maximum(moves, noise)
    mean, std = np.zeros(states), np.ones(states)
    mean[list(measured)], std[list(measured)] = np.nanmean(y[:, 0], axis=0), np.nanstd(y[:, 0], axis=0) + noise
    a = lambda values: jnp.asarray(values, data.y.dtype)  # noqa: E731
    return NetworkModel(
        mlp=eqx.nn.MLP(states + u.shape[-1], states, width, depth, jnp.tanh, dtype=data.y.dtype, key=key),
        centre=a(np.concatenate([centre, np.mean(u, axis=0)])),
        spread=a(np.concatenate([spread, np.std(u, axis=0) + 1e-9])),
        step=a(step),
        start=Gaussian(a(mean), jnp.diag(a(std**2))),
        log_q=a(2 * np.log(step)),
        log_r=a(2 * np.log(noise)),
        measured=tuple(measured),
        dt=dt,
    )


class Pairs(NamedTuple):
    """Draws of (x_k, u_k, x_{k+1}) given y, of all sequences in one row."""

    prev: Float[Array, "pair state"]
    u: Float[Array, "pair input"]
    next: Float[Array, "pair state"]
    weight: Float[Array, " pair"]
    """1, or 0 for padding and lost tracks."""


def squared_error(model, pairs: Pairs) -> Float[Array, " state"]:
    """Mean square of x_{k+1} - f(x_k, u_k) under the posterior; the Q that maximises eq. 11."""
    e = pairs.next - jax.vmap(model.transition)(pairs.prev, pairs.u)
    return jnp.sum(pairs.weight[:, None] * e**2, axis=0) / jnp.maximum(jnp.sum(pairs.weight), 1.0)


class GradientMStep(AbstractMStep):
    """Adam on the expected complete-data log-likelihood of the transition; Q, R and the start in closed form.

    Every gradient takes other `batch` draws of the posterior nodes, so that the loss is unbiased [paper, eq. 11].
    """

    key: PRNGKeyArray
    """Of the draws, the same in every epoch."""
    steps: int = eqx.field(static=True, default=300)
    batch: int = eqx.field(static=True, default=1024)
    rate: float = eqx.field(static=True, default=3e-3)
    """First learning rate of an epoch; falls to a tenth along a cosine."""

    def while_growing(self) -> "GradientMStep":
        return self

    def no_hessian(self, model) -> Float[Array, "weight weight"]:
        return jnp.zeros((0, 0), model.log_q.dtype)

    @eqx.filter_jit
    def __call__(self, model, posterior: Posterior, data: Dataset) -> tuple[NetworkModel, MStepInfo]:
        finite = jnp.all(jnp.isfinite(posterior.prev) & jnp.isfinite(posterior.next), axis=(1, 2, 3))
        used = not_diverged(posterior, data) & finite
        pairs = gather_pairs(posterior, data, used)
        mlp = self.descend(model, pairs)
        fitted = eqx.tree_at(lambda m: m.mlp, model, mlp)
        log_q = jnp.log(squared_error(fitted, pairs))
        log_r = jnp.log(_reading_error(model, posterior, data, used))
        start = _start(posterior, used)
        fitted = eqx.tree_at(lambda m: (m.log_q, m.log_r, m.start), fitted, (log_q, log_r, start))
        return fitted, MStepInfo(self.no_hessian(model), used)

    def descend(self, model, pairs: Pairs) -> eqx.nn.MLP:
        """The network after this epoch's gradient steps, with the noise as it was."""
        optimiser = optax.adam(optax.cosine_decay_schedule(self.rate, self.steps, alpha=0.1))
        arrays, static = eqx.partition(model.mlp, eqx.is_inexact_array)
        flat, unravel = ravel_pytree(arrays)

        def network(flat) -> eqx.nn.MLP:
            return eqx.combine(unravel(flat), static)

        def loss(flat, batch: Pairs):
            trial = eqx.tree_at(lambda m: m.mlp, model, network(flat))
            return 0.5 * jnp.sum(squared_error(trial, batch) / jnp.exp(model.log_q))

        def step(carry, key):
            flat, state = carry
            chosen = jax.random.randint(key, (self.batch,), 0, pairs.weight.shape[0])
            gradient = jax.grad(loss)(flat, jax.tree.map(lambda a: a[chosen], pairs))
            with jax.numpy_dtype_promotion("standard"):
                change, state = optimiser.update(gradient, state)
            return (flat + change, state), None

        (flat, _), _ = jax.lax.scan(step, (flat, optimiser.init(flat)), jax.random.split(self.key, self.steps))
        return network(flat)


def gather_pairs(posterior: Posterior, data: Dataset, used: Array) -> Pairs:
    """The nodes of all steps that lie inside the data of the sequences in use."""
    shape = posterior.prev.shape[:3]
    inside = jax.vmap(active_steps)(jnp.asarray(data.valid))[:, :-1] & used[:, None]
    inside = jnp.broadcast_to(inside[..., None], shape)
    u = jnp.broadcast_to(data.u[:, :-1, None], (*shape, data.u.shape[-1]))
    rows = lambda a: jnp.where(inside[..., None], a, 0.0).reshape(-1, a.shape[-1])  # noqa: E731
    return Pairs(rows(posterior.prev), rows(u), rows(posterior.next), inside.ravel().astype(u.dtype))


def _reading_error(model, posterior: Posterior, data: Dataset, used) -> Float[Array, " obs"]:
    """Mean square of y - g(x) under the posterior; the R that maximises eq. 11."""
    y, observed = fill_missing(data.y)
    observed = observed & (data.valid & used[:, None])[..., None]
    nodes = jnp.concatenate([posterior.prev, posterior.next[:, -1:]], axis=1)
    emission = jax.vmap(jax.vmap(jax.vmap(model.emission, in_axes=(0, None))))
    square = jnp.mean((y[:, :, None] - emission(nodes, jnp.asarray(data.u))) ** 2, axis=2)
    count = jnp.maximum(jnp.sum(observed, axis=(0, 1)), 1).astype(y.dtype)
    return jnp.sum(jnp.where(observed, square, 0.0), axis=(0, 1)) / count


def _start(posterior: Posterior, used) -> Gaussian:
    """Mean and diagonal covariance of the first states."""
    first = jax.tree.map(lambda a: a[:, 0], posterior.state)
    weight = used.astype(first.mean.dtype)[:, None] / jnp.maximum(jnp.sum(used), 1).astype(first.mean.dtype)
    pick = lambda a: jnp.where(used[:, None], a, 0.0)  # noqa: E731
    mean = jnp.sum(weight * pick(first.mean), axis=0)
    square = (first.mean - mean[None]) ** 2 + jnp.diagonal(first.cov, axis1=1, axis2=2)
    return Gaussian(mean, jnp.diag(jnp.sum(weight * pick(square), axis=0)))


def forecast(
    model, state: Gaussian, u: Any, *, samples: int = 100, key: PRNGKeyArray
) -> Float[Array, "sample time state"]:
    """Paths of any model's state, process noise included, from draws of `state` on: row 0 is the state itself.

    `u` are rows of `model.inputs`, one a step.
    """
    key_start, key_noise = jax.random.split(key)
    shape = (samples, state.mean.shape[0])
    spread = lower(cholesky(state.cov + 1e-16 * jnp.eye(shape[1], dtype=state.cov.dtype)))
    x = state.mean[None] + jax.random.normal(key_start, shape, state.mean.dtype) @ spread.T
    steps = jax.tree.leaves(u)[0].shape[0]
    kicks = jax.random.normal(key_noise, (steps, *shape), x.dtype) * jnp.exp(0.5 * model.log_q)[None, None]

    def step(x, slices):
        u, kick = slices
        x = jax.vmap(model.transition, in_axes=(0, None))(x, u) + kick
        return x, x

    _, path = jax.lax.scan(step, x, (u, kicks))
    return jnp.swapaxes(jnp.concatenate([x[None], path]), 0, 1)
