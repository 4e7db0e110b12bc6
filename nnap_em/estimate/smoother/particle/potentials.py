"""Gaussian potentials of readings to come, the proposals, and how particles move under them: a twisted transition.

Arrays of particles have the particle axis last.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ....base.gaussian import Gaussian, cholesky, lower, symmetric, upper_solve
from ....model.base import Prepared
from ..kalman import Filtered, Smoothed

Rows = list[Float[Array, " particle"]]
"""The entries of a vector per particle: a list, because what is stacked does not fuse with what stands around it."""


class Potentials(NamedTuple):
    """log psi_k = linear_k' d - d' precision_k d / 2 with d = (x - origin_k) / sqrt(diag Q)."""

    origin: Float[Array, "time state"]
    precision: Float[Array, "time state state"]
    linear: Float[Array, "time state"]


def twisted(
    factor: Float[Array, "state state"], precision: Float[Array, "state state"]
) -> tuple[Float[Array, "state state"], Float[Array, ""]]:
    """S with S S' = ((L L')^-1 + precision)^-1, and log det(I + L' precision L) / 2, for a lower factor L."""
    eye = jnp.eye(factor.shape[0], dtype=factor.dtype)
    rows = cholesky(eye + factor.T @ precision @ factor)
    return factor @ upper_solve(rows, eye), jnp.sum(jnp.log(jnp.diag(lower(rows))))


def dot(row: Float[Array, " n"] | Rows, x: Rows) -> Float[Array, " particle"]:
    """Sum of row[j] x[j], unrolled."""
    s = row[0] * x[0]
    for j in range(1, len(x)):
        s = s + row[j] * x[j]
    return s


def apply(matrix: Float[Array, "row column"], x: Rows) -> Rows:
    """matrix @ x, unrolled: it fuses with what stands around it, a batched matrix product does not."""
    return [dot(row, x) for row in matrix]


class LogQuadratic(NamedTuple):
    """linear' x - x' precision x / 2 + constant, with a leading time axis."""

    precision: Float[Array, "*time state state"]
    linear: Float[Array, "*time state"]
    constant: Float[Array, "*time"]

    def __call__(self, x: Rows) -> Float[Array, " particle"]:
        """Its value at every particle."""
        pull = [a - 0.5 * b for a, b in zip(self.linear, apply(self.precision, x), strict=True)]
        return dot(pull, x) + self.constant


class Move(NamedTuple):
    """A particle of mean m moves to N(keep m + shift, S S') with the spread S, S S' = (V^-1 + precision)^-1, where V is
    the covariance of what moves it; the fields carry a leading time axis.
    """

    log_psi: LogQuadratic
    log_ahead: LogQuadratic
    """Log of the integral of N(x; m, V) psi(x), of m."""
    keep: Float[Array, "*time state state"]
    shift: Float[Array, "*time state"]
    spread: Float[Array, "*time state state"]

    def move(self, mean: Rows, noise: Rows) -> Rows:
        """Positions of particles of some mean with standard normal noise."""
        kept, kicked = apply(self.keep, mean), apply(self.spread, noise)
        return [a + b + c for a, b, c in zip(kept, self.shift, kicked, strict=True)]


def moves(potentials: Potentials, start: Gaussian) -> Move:
    """The steps of all times; the first from the scaled prior, the others from noise of covariance I."""
    time, n = potentials.linear.shape
    factor, eye = lower(cholesky(start.cov)), jnp.eye(n, dtype=start.cov.dtype)
    factors = jnp.concatenate([factor[None], jnp.tile(eye[None], (time - 1, 1, 1))])

    def one(factor, precision, linear):
        spread, logdet = twisted(factor, precision)
        cov = spread @ spread.T
        keep = eye - cov @ precision
        ahead = LogQuadratic(symmetric(precision @ keep), keep.T @ linear, 0.5 * linear @ cov @ linear - logdet)
        return Move(LogQuadratic(precision, linear, jnp.zeros_like(logdet)), ahead, keep, cov @ linear, spread)

    return jax.vmap(one)(factors, potentials.precision, potentials.linear)


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


class Bootstrap(eqx.Module):
    """Blind: the transition itself [Gordon, Salmond & Smith 1993]."""

    def __call__(self, model, seq: Prepared, filtered: Filtered, smoothed: Smoothed) -> Potentials:
        """Constant potentials."""
        path, cov = smoothed.state
        return Potentials(path, jnp.zeros_like(cov), jnp.zeros_like(path))


class Guided(eqx.Module):
    """Sees the reading of the arriving time: the optimal proposal of one step for a linear emission [Doucet 2000]."""

    def __call__(self, model, seq: Prepared, filtered: Filtered, smoothed: Smoothed) -> Potentials:
        """Potentials of the readings of a time."""
        path = smoothed.state.mean
        return Potentials(path, *_readings(model, seq, path))


class Lookahead(eqx.Module):
    """Sees all readings to come: psi_k = p(y_{k:T} | x_k)^temper of the model linearised about the smoothed path."""

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
