"""Random numbers of the hot path: counters in, numbers out, so that they fuse with their use."""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key, PRNGKeyArray, UInt

from .parallel import few_sizes


def keys_of(key: PRNGKeyArray, count: int) -> Key[Array, " key"]:
    """`count` keys and perhaps more, in one of few shapes; the first are the same for every count."""
    return jax.random.split(key, few_sizes(count))


def threefry(key: UInt[Array, "2"], a: UInt[Array, "*counter"], b: UInt[Array, ""]) -> tuple[Array, Array]:
    """Two random words per counter (a, b): Threefry-2x32 with 20 rounds [Salmon et al. 2011, sec. 4.1].

    `jax.extend.random.threefry_2x32` unrolled, so that it fuses with the use of the words.
    """
    keys = (key[0], key[1], key[0] ^ key[1] ^ jnp.uint32(0x1BD11BDA))
    a, b = a + keys[0], b + keys[1]
    for group in range(5):
        for turn in ((13, 15, 26, 6), (17, 29, 16, 24))[group % 2]:
            a = a + b
            b = a ^ ((b << jnp.uint32(turn)) | (b >> jnp.uint32(32 - turn)))
        a, b = a + keys[(group + 1) % 3], b + keys[(group + 2) % 3] + jnp.uint32(group + 1)
    return a, b


def uniforms(
    key: PRNGKeyArray, time: Int[Array, ""], rows: int, count: int, dtype=jnp.float32
) -> Float[Array, "{rows} {count}"]:
    """Uniform numbers of one time in [0, 1), multiples of 2^-24; they do not depend on how many times there are."""
    counter = jnp.arange(rows * count, dtype=jnp.uint32).reshape(rows, count)
    word, _ = threefry(jax.random.bits(key, (2,), jnp.uint32), counter, time.astype(jnp.uint32))
    return (word >> jnp.uint32(8)).astype(dtype) * 2**-24


def normals(
    key: PRNGKeyArray, time: Int[Array, ""], rows: int, count: int, dtype=jnp.float32
) -> list[Float[Array, " {count}"]]:
    """Standard normal numbers of one time, in single precision by the method of Box & Muller [1958].

    The angle is half a turn, t in [-pi/2, pi/2] with sin t and cos t as Taylor series good to 4e-6, and a sign.
    """
    if dtype != jnp.float32:
        return list(jax.random.normal(jax.random.fold_in(key, time), (rows, count), dtype))
    words = jax.random.bits(key, (2,), jnp.uint32)

    def two_rows(_, pair):
        a, b = threefry(words, pair * count + jnp.arange(count, dtype=jnp.uint32), time.astype(jnp.uint32))
        radius = jnp.sqrt(-2 * jnp.log((a.astype(dtype) + 0.5) * 2**-32))
        t = jax.lax.bitcast_convert_type(b, jnp.int32).astype(dtype) * (math.pi * 2**-32)
        z = t * t
        sine = t * (1 + z * (-1 / 6 + z * (1 / 120 + z * (-1 / 5040 + z / 362880))))
        cosine = 1 + z * (-1 / 2 + z * (1 / 24 + z * (-1 / 720 + z * (1 / 40320 - z / 3628800))))
        return None, (radius * sine, jnp.where(b & jnp.uint32(1), radius, -radius) * cosine)

    # a loop, or XLA would draw the numbers anew wherever they are used
    _, drawn = jax.lax.scan(two_rows, None, jnp.arange((rows + 1) // 2, dtype=jnp.uint32))
    return [row for pair in zip(*drawn, strict=True) for row in pair][:rows]
