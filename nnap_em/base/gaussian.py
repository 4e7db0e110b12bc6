"""Small dense Gaussian algebra that vectorises over sequences and particles: unrolled, or in loops if it is large.

Not by LAPACK: two batches of `jnp.linalg.cholesky` at once wait for ever for each other's threads on a machine of two
cores (jaxlib 0.10), and each matrix by itself is slow.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .elementary import reciprocal


class Gaussian(NamedTuple):
    """A normal distribution; both fields may carry leading batch axes."""

    mean: Float[Array, "*batch dim"]
    cov: Float[Array, "*batch dim dim"]


MOST_UNROLLED = 8
"""States beyond which nothing is unrolled: a loop over the columns compiles in seconds, not in minutes."""
Factor = list[list[Float[Array, ""]]] | Float[Array, "dim dim"]
"""Rows of scalars, or beyond `MOST_UNROLLED` states a matrix."""


def cholesky(a: Float[Array, "dim dim"]) -> Factor:
    """Lower factor L of a = L L' (`dim` is static)."""
    n = a.shape[0]
    if n > MOST_UNROLLED:
        return _factor(a)
    rows: list[list[Float[Array, ""]]] = []
    for i in range(n):
        row = []
        for j in range(i + 1):
            s = a[i, j]
            for m in range(j):
                s = s - row[m] * (row if i == j else rows[j])[m]
            row.append(jnp.sqrt(s) if i == j else s / rows[j][j])
        rows.append(row)
    return rows


def lower(rows: Factor) -> Float[Array, "dim dim"]:
    """The factor of `cholesky` as a matrix."""
    if not isinstance(rows, list):
        return rows
    n, zero = len(rows), jnp.zeros_like(rows[0][0])
    return jnp.stack([jnp.stack(row + [zero] * (n - len(row))) for row in rows])


def product(a: Float[Array, "row inner"], b: Float[Array, "inner *column"]) -> Float[Array, "row *column"]:
    """a @ b as a sum over the inner axis: it fuses with what stands around it, a small batched matrix product does not
    and takes some 5 times as long on a CPU.
    """
    if b.shape[0] > MOST_UNROLLED:
        return a @ b
    out = a[:, 0, None] * b[0][None] if b.ndim == 2 else a[:, 0] * b[0]
    for k in range(1, b.shape[0]):
        out = out + (a[:, k, None] * b[k][None] if b.ndim == 2 else a[:, k] * b[k])
    return out


def upper_solve(rows: Factor, b: Float[Array, "dim *columns"]) -> Float[Array, "dim *columns"]:
    """Solution x of L' x = b for the factor of `cholesky`."""
    if not isinstance(rows, list):
        return _backward(rows, b)
    n = len(rows)
    x: list = [None] * n
    for i in reversed(range(n)):
        s = b[i]
        for m in range(i + 1, n):
            s = s - rows[m][i] * x[m]
        x[i] = s / rows[i][i]
    return jnp.stack(x)


def spd_solve(a: Float[Array, "dim dim"], b: Float[Array, "dim *columns"]) -> Float[Array, "dim *columns"]:
    """Solution x of a x = b for a symmetric positive definite a.

    By a = L D L' with ones on the diagonal of L: one reciprocal a row and no root [Golub & Van Loan 2013, sec. 4.1].
    """
    n = a.shape[0]
    if n > MOST_UNROLLED:
        return _eliminated(a, b)
    factor: list[list] = []  # L D by rows
    inverse: list = []  # of D
    z: list = []
    for i in range(n):
        row = []
        for j in range(i + 1):
            s = a[i, j]
            for m in range(j):
                s = s - row[m] * inverse[m] * (row if i == j else factor[j])[m]
            row.append(s)
        factor.append(row)
        inverse.append(reciprocal(row[i]))
        s = b[i]
        for m in range(i):
            s = s - row[m] * z[m]
        z.append(inverse[i] * s)
    for i in reversed(range(n)):
        for m in range(i + 1, n):
            z[i] = z[i] - inverse[i] * factor[m][i] * z[m]
    return jnp.stack(z)


def _factor(a: Float[Array, "dim dim"]) -> Float[Array, "dim dim"]:
    """`cholesky`, right-looking, unrolled by columns."""
    place = jnp.arange(a.shape[0])

    def step(left, k):
        column = jnp.where(place < k, 0.0, left[:, k] / jnp.sqrt(left[k, k]))
        return left - column[:, None] * column[None, :], column

    return jax.lax.scan(step, a, place)[1].T


def _backward(factor: Float[Array, "dim dim"], b: Float[Array, "dim *columns"]) -> Float[Array, "dim *columns"]:
    """`upper_solve`, an entry at a time off what is left."""
    wide = b.reshape(b.shape[0], -1)

    def step(left, slices):
        row, k = slices
        x = left[k] / row[k]
        return left - row[:, None] * x[None, :], x

    return jax.lax.scan(step, wide, (factor, jnp.arange(b.shape[0])), reverse=True)[1].reshape(b.shape)


def _eliminated(a: Float[Array, "dim dim"], b: Float[Array, "dim *columns"]) -> Float[Array, "dim *columns"]:
    """`spd_solve` by Gauss-Jordan elimination, which needs no pivots here [Higham 2002, sec. 14.4]."""
    place = jnp.arange(a.shape[0])

    def step(both, k):
        row = both[k] / both[k, k]
        eliminated = both - both[:, k][:, None] * row[None, :]
        return jnp.where((place == k)[:, None], row[None, :], eliminated), None

    both = jnp.concatenate([a, b.reshape(b.shape[0], -1)], axis=1)
    return jax.lax.scan(step, both, place)[0][:, a.shape[0] :].reshape(b.shape)


def symmetric(a: Float[Array, "*batch dim dim"]) -> Float[Array, "*batch dim dim"]:
    """The symmetric part of a."""
    return 0.5 * (a + jnp.swapaxes(a, -1, -2))
