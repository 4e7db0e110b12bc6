"""Systematic draws, and cumulative sums as matrix products, which are faster."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int


def cumsum(x: Float[Array, "*batch n"], block: int = 32) -> Float[Array, "*batch n"]:
    """`jnp.cumsum` along the last axis as triangular matrix products, within blocks and over them: faster."""
    n = x.shape[-1]
    padded = jnp.pad(x, [(0, 0)] * (x.ndim - 1) + [(0, -n % block)])
    within = upto(padded.reshape(*x.shape[:-1], -1, block), 0)
    total = within + upto(within[..., -1], 1)[..., None]
    return total.reshape(padded.shape)[..., :n]


def upto(x: Float[Array, "*batch n"], k: int) -> Float[Array, "*batch n"]:
    """Sums of x over all places up to k before each."""
    square = jnp.ones((x.shape[-1], x.shape[-1]), x.dtype)
    return jnp.matmul(x, jnp.triu(square, k), precision=jax.lax.Precision.HIGHEST)


def systematic(log_w: Float[Array, " particle"], offset: Float[Array, ""], count: int) -> Int[Array, " {count}"]:
    """Sorted indices of `count` draws by one uniform `offset` [Kitagawa 1996]."""
    reach = cumsum(jnp.exp(log_w - jnp.max(log_w)))
    before = jnp.ceil(reach * (count / reach[-1]) - offset).astype(jnp.int32)  # draws among the particles up to here
    drops = jnp.zeros(count + 1, reach.dtype).at[jnp.clip(before, 0, count)].add(1, mode="promise_in_bounds")
    return jnp.minimum(cumsum(drops[:count]).astype(jnp.int32), reach.shape[0] - 1)
