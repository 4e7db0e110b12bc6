"""The same work for every row along a path, a few rows at a time: what is at hand then stays in a core's cache."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from .gaussian import MOST_UNROLLED, Gaussian

ROWS_AT_ONCE = 32
"""Rows at a time; with the sequences beside them some thousand points."""


def rows(function: Callable, path: Gaussian, *trees: Any) -> Any:
    """`jax.vmap(function)(path, *trees)` along the first axis, in blocks of nearly `ROWS_AT_ONCE`.

    All at once beyond `MOST_UNROLLED` states, where little is gained: at six joints with a body on top a program in
    blocks took 22 GB and a quarter of an hour to compile.
    """
    length, states = path.mean.shape
    if states > MOST_UNROLLED:
        return jax.vmap(function)(path, *trees)
    count = -(-length // ROWS_AT_ONCE)
    size = -(-length // count)

    def cut(a):
        last = jnp.broadcast_to(a[-1:], (count * size - length, *a.shape[1:]))  # what is over does the last row again
        return jnp.concatenate([a, last]).reshape(count, size, *a.shape[1:])

    out = jax.lax.map(lambda block: jax.vmap(function)(*block), jax.tree.map(cut, (path, *trees)))
    return jax.tree.map(lambda a: a.reshape(count * size, *a.shape[2:])[:length], out)
