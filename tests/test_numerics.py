"""Small numerics against NumPy and closed forms: matrices unrolled, rows in blocks, random words and normal numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from jax.extend.random import threefry_2x32

from nnap_em.base.gaussian import MOST_UNROLLED, Gaussian, cholesky, lower, product, spd_solve, symmetric, upper_solve
from nnap_em.base.random import normals, threefry
from nnap_em.base.rows import ROWS_AT_ONCE, rows
from nnap_em.estimate.smoother.particle.filter import cumsum

EPS = np.finfo(float).eps


def _spd(dim: int, seed: int, condition: float = 1e3) -> np.ndarray:
    """A random symmetric positive definite matrix of known condition number."""
    rng = np.random.default_rng(seed)
    basis, _ = np.linalg.qr(rng.normal(size=(dim, dim)))
    return (basis * np.geomspace(1.0, condition, dim)) @ basis.T


@pytest.mark.parametrize("dim", [1, 2, 4, 8, 12])
def test_spd_solve_is_numpys(dim):
    """With its factor and its product; unrolled, and beyond `WIDE` in loops."""
    a, b = _spd(dim, dim), np.random.default_rng(9).normal(size=(dim, 3))

    @jax.jit
    def run(a, b):
        factor, one = cholesky(a), b[:, 0]
        solved = spd_solve(a, b), spd_solve(a, one), upper_solve(factor, b)
        return lower(factor), solved, (product(a, b), product(a, one))

    factor, solved, products = run(a, b)
    # backward error (dim + 1) eps |a|, forward error that times the condition number [Higham 2002, thm 10.3]
    np.testing.assert_allclose(factor @ factor.T, a, atol=(dim + 1) * EPS * np.linalg.norm(a))
    np.testing.assert_allclose(factor, np.linalg.cholesky(a), atol=(dim + 1) * EPS * 1e3 * np.linalg.norm(a) ** 0.5)
    assert np.all(np.triu(factor, 1) == 0)
    exact = np.linalg.solve(a, b)
    tolerance = 10 * dim * EPS * 1e3 * np.abs(exact).max()  # condition number 1e3
    np.testing.assert_allclose(solved[0], exact, rtol=0.0, atol=tolerance)
    np.testing.assert_allclose(solved[1], exact[:, 0], rtol=0.0, atol=tolerance)
    upper = np.linalg.solve(np.linalg.cholesky(a).T, b)
    np.testing.assert_allclose(solved[2], upper, rtol=0.0, atol=10 * dim * EPS * 1e3 * np.abs(upper).max())
    rounding = 10 * dim * EPS * np.abs(a).max() * np.abs(b).max()
    np.testing.assert_allclose(products[0], a @ b, rtol=0.0, atol=rounding)
    np.testing.assert_allclose(products[1], a @ b[:, 0], rtol=0.0, atol=rounding)


def test_spd_solve_has_the_derivative_of_the_inverse():
    a, da, b = _spd(3, 0), _spd(3, 1), np.ones(3)
    _, tangent = jax.jvp(lambda a: spd_solve(a, jnp.asarray(b)), (jnp.asarray(a),), (symmetric(jnp.asarray(da)),))
    # condition 1e3, squared, eps
    np.testing.assert_allclose(tangent, -np.linalg.solve(a, da @ np.linalg.solve(a, b)), rtol=1e-9)


@pytest.mark.parametrize("dim", [4, 12])
def test_nothing_asks_lapack(dim):
    """Two batches of its Cholesky factors at once hang on two cores (jaxlib 0.10)."""
    all_of_it = lambda a: (lower(cholesky(a)), upper_solve(cholesky(a), a), spd_solve(a, a))  # noqa: E731
    program = str(jax.make_jaxpr(jax.vmap(all_of_it))(jnp.zeros((3, dim, dim))))
    assert "cholesky[" not in program and "triangular_solve[" not in program


def _path(mean):
    return Gaussian(mean, jnp.broadcast_to(jnp.eye(mean.shape[-1]), (*mean.shape, mean.shape[-1])))


def _one(state, scale):
    return {"wave": jnp.sin(scale * state.mean), "sum": jnp.sum(state.cov @ state.mean * scale)}


@pytest.mark.parametrize("length, states", [(1, 3), (ROWS_AT_ONCE, 3), (ROWS_AT_ONCE + 1, 3), (70, MOST_UNROLLED + 1)])
def test_rows_in_blocks_are_the_rows_all_at_once(length, states):
    rng = np.random.default_rng(length)
    x, scale = jnp.asarray(rng.normal(size=(length, states))), jnp.asarray(rng.normal(size=length))
    same = lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-13)  # noqa: E731
    every = lambda function, *trees: jax.vmap(function)(*trees)  # noqa: E731
    jax.tree.map(same, *jax.jit(lambda x, s: [over(_one, _path(x), s) for over in (rows, every)])(x, scale))


def test_only_few_states_are_cut_in_blocks():
    """Programs of many states in blocks take gigabytes to compile."""
    for states, loops in ((MOST_UNROLLED, 1), (MOST_UNROLLED + 1, 0)):
        x, scale = jnp.ones((70, states)), jnp.ones(70)
        program = str(jax.make_jaxpr(lambda x, scale: rows(_one, _path(x), scale))(x, scale))
        assert program.count("scan[") == loops


def test_random_words_are_those_of_threefry():
    key, counter = jnp.array([0x13198A2E, 0x03707344], jnp.uint32), jnp.array([0x243F6A88, 5], jnp.uint32)
    a, b = threefry(key, counter, jnp.uint32(7))
    known = threefry_2x32(key, jnp.concatenate([counter, jnp.full(2, 7, jnp.uint32)]))
    np.testing.assert_array_equal(jnp.concatenate([a, b]), known)


def test_normals_are_normal_and_independent():
    """Three rows at 10 times of 20 keys; those of other rows, times and keys are independent."""
    draw = jax.vmap(lambda k, t: jnp.stack(normals(k, t, 3, 1001)), in_axes=(None, 0))
    keys = jax.random.split(jax.random.key(21), 20)
    z = jax.jit(jax.vmap(draw, in_axes=(0, None)))(keys, jnp.arange(10))
    assert z.dtype == jnp.float32
    z = np.asarray(z, float)  # key, time, row, particle
    assert scipy.stats.kstest(z.ravel(), "norm").pvalue > 1e-3
    error = 4 / np.sqrt(z.size)
    # E z^2n = 1, 3, 15 with variances 2, 96, 10170
    assert abs(np.mean(z)) < error and abs(np.mean(z**3)) < np.sqrt(15) * error
    for power, mean, variance in ((2, 1, 2), (4, 3, 96), (6, 15, 10170)):
        assert abs(np.mean(z**power) - mean) < np.sqrt(variance) * error
    assert -6.5 < np.min(z) < -4 and 4 < np.max(z) < 6.5  # of 600 000
    for a, b in ((z[:-1], z[1:]), (z[:, :-1], z[:, 1:]), (z[..., :-1], z[..., 1:]), (z[:, :, 0], z[:, :, 1])):
        for f in (lambda x: x, lambda x: x**2 - 1, np.abs):
            p, q = f(a) - np.mean(f(a)), f(b) - np.mean(f(b))
            assert abs(np.mean(p * q)) < 4.5 * np.std(p) * np.std(q) / np.sqrt(p.size)


def test_cumulative_sum_of_blocks_is_the_plain_one():
    x = jax.random.uniform(jax.random.key(2), (3, 1001), jnp.float32)
    x = jnp.where(x < 0.3, 0.0, x)
    ours = np.asarray(cumsum(x))
    np.testing.assert_allclose(ours, np.cumsum(np.asarray(x, float), axis=1), rtol=1e-6)
    # no rounding gives a share to a weight of 0
    assert np.all((np.diff(ours) == 0) == (np.asarray(x)[:, 1:] == 0))
