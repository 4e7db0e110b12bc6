"""Gaussian potentials, and how particles move under them: the algebra of a twisted transition.

Arrays of particles have the particle axis last.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ...numerics.gaussian import Gaussian, cholesky, lower, symmetric

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
    n = factor.shape[0]
    rows = cholesky(jnp.eye(n, dtype=factor.dtype) + factor.T @ precision @ factor)
    inverse = jnp.eye(n, dtype=factor.dtype)
    solved: list = []
    for i in range(n):
        row = inverse[i]
        for m in range(i):
            row = row - rows[i][m] * solved[m]
        solved.append(row / rows[i][i])
    logdet = jnp.log(rows[0][0])
    for i in range(1, n):
        logdet = logdet + jnp.log(rows[i][i])
    return factor @ jnp.stack(solved).T, logdet


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
    """Quantities of the potential psi at one time that particles use; the fields carry a leading time axis.

    With spread S, S S' = (V^-1 + precision)^-1 where V is the covariance of what moves the particles:
    a particle of mean m moves to N(keep m + shift, S S').
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
