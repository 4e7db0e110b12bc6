"""Elementary functions of the hot path against numpy in extended precision, with their derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nnap_em.numerics.elementary import asinh, cos, reciprocal, sin, sincos


@pytest.mark.parametrize("turns", [1.0, 1e3])
@pytest.mark.parametrize(("dtype", "top"), [(jnp.float32, 10.0), (jnp.float64, 1e3)])
def test_sine_and_cosine_to_the_last_place(dtype, top, turns):
    x = jnp.asarray(np.random.default_rng(0).uniform(-top * turns, top * turns, 100_000), dtype)
    wide = np.asarray(x, np.longdouble)
    for mine, truth in zip(jax.jit(sincos)(x), (np.sin(wide), np.cos(wide)), strict=True):
        assert mine.dtype == dtype
        assert np.max(np.abs(np.asarray(mine, np.longdouble) - truth)) < 1.0 * jnp.finfo(dtype).eps


def test_quadrants_and_what_is_no_number():
    x = jnp.asarray([0.0, 0.5, 1.0, 1.5, 2.0, -0.5, -1.0, -1.5]) * jnp.pi
    np.testing.assert_allclose(sin(x), np.sin(np.asarray(x)), rtol=0, atol=2e-16)
    np.testing.assert_allclose(cos(x), np.cos(np.asarray(x)), rtol=0, atol=2e-16)
    assert np.all(np.isnan(np.asarray(sin(jnp.asarray([jnp.nan, jnp.inf])))))


@pytest.mark.parametrize(("dtype", "top", "error"), [(jnp.float32, 1e7, 2e-5), (jnp.float64, 1e9, 2.3e-16)])
def test_large_angles_are_as_good_as_stated_or_no_number(dtype, top, error):
    x = jnp.asarray(np.random.default_rng(0).uniform(-top, top, 100_000), dtype)
    wide = np.asarray(x, np.longdouble)
    for mine, truth in zip(jax.jit(sincos)(x), (np.sin(wide), np.cos(wide)), strict=True):
        assert np.max(np.abs(np.asarray(mine, np.longdouble) - truth)) < error
    beyond = jnp.asarray([1.001 * top, -1e3 * top, 1e18, -1e30], dtype)
    assert all(np.all(np.isnan(a)) for a in (*jax.jit(sincos)(beyond), jax.vmap(jax.grad(sin))(beyond)))


def test_asinh():
    x = jnp.asarray(np.random.default_rng(0).standard_cauchy(10_000) * 10)
    truth = np.arcsinh(np.asarray(x, np.longdouble))
    assert np.max(np.abs(np.asarray(asinh(x), np.longdouble) - truth) / (1 + np.abs(truth))) < 3 * np.finfo(float).eps
    np.testing.assert_array_equal(asinh(-x), -asinh(x))


@pytest.mark.parametrize(
    ("mine", "reference"), [(sin, jnp.sin), (cos, jnp.cos), (asinh, jnp.arcsinh), (reciprocal, jnp.reciprocal)]
)
def test_derivatives_both_ways_and_twice(mine, reference):
    for x in jnp.linspace(-5.0, 5.0, 8):
        for derive in (jax.jacfwd, jax.grad, lambda f: jax.grad(jax.jacfwd(f))):
            np.testing.assert_allclose(derive(mine)(x), derive(reference)(x), rtol=1e-13, atol=1e-15)
