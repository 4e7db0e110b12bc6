"""Look-ahead of particles: the potentials of a model linearised about its smoothed path."""

from abc import abstractmethod
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ...model.base import Prepared
from ...numerics.gaussian import cholesky, lower, symmetric
from ..kalman import Filtered, Smoothed
from .potentials import Potentials, twisted


class AbstractProposal(eqx.Module):
    """Look-ahead of a particle when it is moved."""

    @abstractmethod
    def __call__(self, model, seq: Prepared, filtered: Filtered, smoothed: Smoothed) -> Potentials:
        """Potentials about the smoothed path, from the model linearised there."""


class _Readings(NamedTuple):
    """The readings of every time as Gaussian potentials about a path."""

    precision: Float[Array, "time state state"]
    linear: Float[Array, "time state"]


def _readings(model, seq: Prepared, path: Float[Array, "time state"]) -> _Readings:
    """C'R^-1 C and C'R^-1 (y - g(path)), in units of the process noise."""
    weight = jnp.where(seq.observed, jnp.exp(-model.log_r)[None], 0.0)
    rows = jax.vmap(jax.jacfwd(model.emission))(path, seq.inputs) * jnp.exp(0.5 * model.log_q)[None, None]
    pull = jnp.swapaxes(rows * weight[..., None], -1, -2)
    misfit = seq.y - jax.vmap(model.emission)(path, seq.inputs)
    return _Readings(pull @ rows, jnp.squeeze(pull @ misfit[..., None], -1))


class Bootstrap(AbstractProposal):
    """Blind: the transition itself [Gordon, Salmond & Smith 1993]."""

    def __call__(self, model, seq: Prepared, filtered: Filtered, smoothed: Smoothed) -> Potentials:
        """Constant potentials."""
        path, cov = smoothed.state
        return Potentials(path, jnp.zeros_like(cov), jnp.zeros_like(path))


class Guided(AbstractProposal):
    """Sees the reading of the arriving time: the optimal proposal of one step for a linear emission [Doucet 2000]."""

    def __call__(self, model, seq: Prepared, filtered: Filtered, smoothed: Smoothed) -> Potentials:
        """Potentials of the readings of a time."""
        path = smoothed.state.mean
        return Potentials(path, *_readings(model, seq, path))


class Lookahead(AbstractProposal):
    """Sees all readings to come: psi_k = p(y_{k:T} | x_k)^temper of the model linearised about the smoothed path.

    On a linear system at temper = 1 every weight is equal.
    """

    temper: float = eqx.field(static=True, default=0.98)
    """Below 1 the potentials are wider than the linearised ones, for heavier tails of the proposal."""

    def __call__(self, model, seq: Prepared, filtered: Filtered, smoothed: Smoothed) -> Potentials:
        """Potentials of all readings to come."""
        path, scale = smoothed.state.mean, jnp.exp(0.5 * model.log_q)
        affine = filtered.affine
        following = jnp.concatenate([path[1:], path[-1:]])
        miss = (jnp.squeeze(affine.matrix @ path[..., None], -1) + affine.offset - following) / scale[None]
        matrix = affine.matrix * scale[None, None] / scale[None, :, None]
        noise = affine.noise / (scale[:, None] * scale[None])[None] + jnp.eye(scale.shape[0], dtype=scale.dtype)[None]

        def step(later, slices):
            active, matrix, miss, noise, reading = slices
            spread, _ = twisted(lower(cholesky(noise)), later.precision)
            seen = spread @ (spread.T @ later.precision)
            ahead = symmetric(later.precision - later.precision @ seen)  # (precision^-1 + noise)^-1
            linear = matrix.T @ (later.linear - seen.T @ later.linear - ahead @ miss)
            combined = _Readings(
                reading.precision + jnp.where(active, symmetric(matrix.T @ ahead @ matrix), 0.0),
                reading.linear + jnp.where(active, linear, 0.0),
            )
            return combined, combined

        readings = _readings(model, seq, path)
        blank = jax.tree.map(lambda a: jnp.zeros_like(a[0]), readings)
        _, (precision, linear) = jax.lax.scan(step, blank, (seq.active, matrix, miss, noise, readings), reverse=True)
        return Potentials(path, self.temper * precision, self.temper * linear)
