"""Gain of each function that is written by hand for speed over the usual one: the table of docs/results/elementary.csv.

    JAX_NUM_CPU_DEVICES=1 taskset -c 0 python benchmarks/elementary.py [--rounds 30]

Both run compiled, in turn; the ratio is the median of those of the rounds, so that a busy machine slows both alike.
"""

import argparse
import os
import platform
import statistics
import time
from collections.abc import Callable
from datetime import date
from typing import NamedTuple

import jax
import jax.numpy as jnp

from nnap_em.numerics.elementary import asinh, sincos
from nnap_em.numerics.gaussian import cholesky, lower, product, spd_solve
from nnap_em.numerics.random import normals
from nnap_em.smoother.particle.resampling import systematic

jax.config.update("jax_enable_x64", True)
MANY, FEW, SEQUENCES = 2**16, 1000, 20
"""Numbers of an elementary function; matrices or particles; sequences at a time."""


class Row(NamedTuple):
    """A function by hand, the usual one, and what both are given."""

    name: str
    own: Callable
    usual: Callable
    given: tuple[jax.Array, ...]
    types: tuple[str, ...] = ("float32", "float64")


def usual_systematic(log_w: jax.Array, offset: jax.Array) -> jax.Array:
    """Systematic draws by a search in the cumulative weights."""
    reach = jnp.cumsum(jnp.exp(log_w - jnp.max(log_w)))
    count = log_w.shape[0]
    return jnp.searchsorted(reach, reach[-1] * (jnp.arange(count) + offset) / count)


def rows() -> list[Row]:
    """What is compared: sizes of the acrobot, four states."""
    key = jax.random.key(0)
    keys = jax.random.split(key, SEQUENCES)
    angle = 6.0 * jax.random.normal(key, (MANY,))
    factor = jax.random.normal(key, (FEW, 4, 4))
    cov = jnp.matmul(factor, jnp.swapaxes(factor, 1, 2)) + jnp.eye(4)[None]
    solve = jax.vmap(jnp.linalg.solve)
    return [
        Row("sine and cosine", sincos, lambda x: (jnp.sin(x), jnp.cos(x)), (angle,)),
        Row("asinh", asinh, jnp.arcsinh, (angle,)),
        Row("4 x 4 product A P A'", jax.vmap(_congruent), lambda a, p: a @ p @ jnp.swapaxes(a, 1, 2), (factor, cov)),
        Row("4 x 4 Cholesky factor", jax.vmap(lambda p: lower(cholesky(p))), jnp.linalg.cholesky, (cov,)),
        Row("4 x 4 solution, positive definite", jax.vmap(spd_solve), solve, (cov, factor)),
        Row(
            f"{SEQUENCES} x 4 x {FEW} normal numbers",
            lambda t: jax.vmap(lambda key: jnp.stack(normals(key, t, 4, FEW)))(keys),
            lambda t: jax.vmap(lambda key: jax.random.normal(jax.random.fold_in(key, t), (4, FEW), jnp.float32))(keys),
            (jnp.asarray(3),),
            ("int32",),
        ),
        Row(
            f"{SEQUENCES} systematic draws of {FEW}",
            jax.vmap(lambda w, offset: systematic(w, offset, FEW)),
            jax.vmap(usual_systematic),
            (jax.random.normal(key, (SEQUENCES, FEW)), jnp.linspace(0.0, 1.0, SEQUENCES, endpoint=False)),
        ),
    ]


def _congruent(a: jax.Array, p: jax.Array) -> jax.Array:
    return product(product(a, p), a.T)


def seconds(function: Callable, arguments: tuple[jax.Array, ...], calls: int) -> float:
    """Time of one call, mean over several."""
    start = time.perf_counter()
    for _ in range(calls):
        result = function(*arguments)
    jax.block_until_ready(result)
    return (time.perf_counter() - start) / calls


def main() -> None:
    """Time every row, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=30, help="timings of each (30)")
    rounds = parser.parse_args().rounds
    print(
        f"{date.today()}, {platform.machine()}, {len(os.sched_getaffinity(0))} cores, load {os.getloadavg()[0]:.1f}, "
        f"Python {platform.python_version()}, jax {jax.__version__}\n"
    )
    print("| by hand | type | own [us] | usual [us] | gains |\n| --- | --- | --- | --- | --- |")
    for row in rows():
        for dtype in row.types:
            arguments = tuple(x.astype(dtype) for x in row.given)
            own, usual = jax.jit(row.own), jax.jit(row.usual)
            calls = max(1, int(2e-3 / max(seconds(f, arguments, 3) for f in (own, usual, own, usual)[2:])))
            pairs = [(seconds(own, arguments, calls), seconds(usual, arguments, calls)) for _ in range(rounds)]
            mine, theirs = (1e6 * statistics.median(each) for each in zip(*pairs, strict=True))
            gain = statistics.median(b / a for a, b in pairs)
            print(f"| {row.name} | {dtype} | {mine:.3g} | {theirs:.3g} | {gain:.2g} |", flush=True)


if __name__ == "__main__":
    main()
