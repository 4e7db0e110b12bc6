"""Elementary functions of the hot path against numpy in extended precision, with their derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nnap_em.base.elementary import asinh, cos, exp2, reciprocal, sin, sincos


@pytest.mark.parametrize(
    ("dtype", "top", "error"),
    [
        (jnp.float32, 1e4, jnp.finfo(jnp.float32).eps), (jnp.float64, 1e6, jnp.finfo(jnp.float64).eps),
        (jnp.float32, 1e7, 2e-5), (jnp.float64, 1e9, 2.3e-16),
    ],
)  # fmt: skip
def test_sine_and_cosine_are_as_good_as_stated_and_no_number_beyond(dtype, top, error):
    x = np.append(np.random.default_rng(0).uniform(-top, top, 100_000), np.pi / 2 * np.arange(-3, 5))
    x = jnp.asarray(x, dtype)
    wide = np.asarray(x, np.longdouble)
    for mine, truth in zip(jax.jit(sincos)(x), (np.sin(wide), np.cos(wide)), strict=True):
        assert mine.dtype == dtype
        assert np.max(np.abs(np.asarray(mine, np.longdouble) - truth)) < error
    beyond = jnp.asarray([1.001e9, -1e12, 1e18, -1e30, jnp.nan, jnp.inf], dtype)
    assert all(np.all(np.isnan(a)) for a in (*jax.jit(sincos)(beyond), jax.jit(jax.vmap(jax.grad(sin)))(beyond)))


def test_asinh_and_powers_of_two():
    x = jnp.asarray(np.random.default_rng(0).standard_cauchy(10_000) * 10)
    truth = np.arcsinh(np.asarray(x, np.longdouble))
    assert np.max(np.abs(np.asarray(asinh(x), np.longdouble) - truth) / (1 + np.abs(truth))) < 3 * np.finfo(float).eps
    np.testing.assert_array_equal(asinh(-x), -asinh(x))
    x = np.linspace(-126, 60, 10_001, dtype=np.float32)
    powers = np.asarray(jax.jit(exp2)(jnp.append(jnp.asarray(x), -jnp.inf)))
    np.testing.assert_allclose(powers[:-1], 2.0 ** x.astype(float), rtol=4e-6)
    assert 0 <= powers[-1] < 1e-37


def test_derivatives_both_ways_and_twice():
    pairs = (sin, jnp.sin), (cos, jnp.cos), (asinh, jnp.arcsinh), (reciprocal, jnp.reciprocal)
    derive = jax.jacfwd, jax.grad, lambda f: jax.grad(jax.jacfwd(f))
    both = jax.jit(lambda x: [[[jax.vmap(d(f))(x) for d in derive] for f in pair] for pair in pairs])
    for mine, reference in both(jnp.linspace(-5.0, 5.0, 8)):
        np.testing.assert_allclose(mine, reference, rtol=1e-13, atol=1e-15)
