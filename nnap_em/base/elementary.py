"""Elementary functions of the hot path, a few products each, that vectorise on a CPU.

`jax.numpy`'s own sine and cosine take more than half of a transition of the acrobot.
"""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

TERMS = {jnp.dtype(jnp.float32): 5, jnp.dtype(jnp.float64): 8}
"""Terms of the Taylor series on [-pi/4, pi/4] that leave less than the rounding error."""


@jax.custom_jvp
def sincos(x: Float[Array, "*shape"]) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"]]:
    """Sine and cosine together, to 2 units in the last place of 1, for |x| up to 1e4 (float32) or 1e6 (float64) [rad].

    To 2e-5 up to 1e7 (float32), to 2 units in the last place up to 1e9 (float64); NaN beyond.  Other types fall back
    on `jax.numpy`.
    """
    return _pair(x) if x.dtype in TERMS else (jnp.sin(x), jnp.cos(x))


@jax.jit  # traced once, not for every sine of a model
def _pair(x):
    # Beyond these [rad] a type has no digits left for the angle, or the sum above not enough
    farthest = {jnp.dtype(jnp.float32): 1e7, jnp.dtype(jnp.float64): 1e9}
    far = jnp.abs(x) > farthest[x.dtype]
    quarter = jnp.round(x * (2 / math.pi))
    # Pi / 2 as a sum; the first part has so few digits that a quadrant's number times it is exact [Cody & Waite 1980]
    half_pi = {
        jnp.dtype(jnp.float32): (1.5703125, 0.00048382679),
        jnp.dtype(jnp.float64): (1.5707963267341256, 6.077100506506192e-11),
    }
    for part in half_pi[x.dtype]:
        x = x - quarter * part
    square = jnp.where(far, jnp.nan, x * x)
    sine, cosine = jnp.zeros_like(x), jnp.zeros_like(x)
    for n in reversed(range(TERMS[x.dtype])):
        sine = sine * square + (-1) ** n / math.factorial(2 * n + 1)
        cosine = cosine * square + (-1) ** (n + 1) / math.factorial(2 * n + 2)
    sine, cosine = x * sine, 1 + square * cosine
    turns = quarter.astype(jnp.int32)
    swap = (turns & 1) == 1
    first, second = jnp.where(swap, cosine, sine), jnp.where(swap, sine, cosine)
    return jnp.where((turns & 2) == 2, -first, first), jnp.where(((turns + 1) & 2) == 2, -second, second)


@sincos.defjvp
def _sincos_jvp(primals, tangents):
    (x,), (dx,) = primals, tangents
    sine, cosine = sincos(x)
    return (sine, cosine), (cosine * dx, -sine * dx)


def sin(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Sine of x [rad]."""
    return sincos(x)[0]


def cos(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Cosine of x [rad]."""
    return sincos(x)[1]


@jax.custom_jvp
def asinh(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Area hyperbolic sine of |x| < 1e18, to a few units in the last place of 1 + |result|, not of the result."""
    size = jnp.abs(x)
    return jnp.sign(x) * jnp.log(size + jnp.sqrt(1 + size * size))


@asinh.defjvp
def _asinh_jvp(primals, tangents):
    (x,), (dx,) = primals, tangents
    return asinh(x), dx * jax.lax.rsqrt(1 + x * x)


@jax.custom_jvp
def reciprocal(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """1 / x, whose derivative divides no second time."""
    return 1 / x


@reciprocal.defjvp
def _reciprocal_jvp(primals, tangents):
    (x,), (dx,) = primals, tangents
    inverse = reciprocal(x)
    return inverse, -inverse * inverse * dx


def exp2(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """2^x, in single precision to 4e-6 and at least 2^-126: a Taylor series times a power of two."""
    if x.dtype != jnp.float32:
        return jnp.exp2(x)
    x = jnp.maximum(x, -126.0)
    integer = jnp.round(x)
    z = (x - integer) * math.log(2)
    power = 1 + z * (1 + z * (1 / 2 + z * (1 / 6 + z * (1 / 24 + z / 120))))
    shift = integer.astype(jnp.int32) << 23
    return jax.lax.bitcast_convert_type(jax.lax.bitcast_convert_type(power, jnp.int32) + shift, jnp.float32)
