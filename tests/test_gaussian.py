"""The unrolled small-matrix algebra against numpy and against exact moments."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nnap_em.numerics.gaussian import cholesky, lower, product, spd_solve, symmetric, upper_solve

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
    a, da, b = _spd(3, 0), symmetric(jnp.asarray(_spd(3, 1))), np.ones(3)
    _, tangent = jax.jvp(lambda a: spd_solve(a, jnp.asarray(b)), (jnp.asarray(a),), (da,))
    x = np.linalg.solve(a, b)
    np.testing.assert_allclose(
        tangent, -np.linalg.solve(a, np.asarray(da) @ x), rtol=1e-9
    )  # condition 1e3, squared, eps


def test_symmetric_keeps_the_quadratic_form():
    a = np.random.default_rng(0).normal(size=(2, 3, 3))
    s = np.asarray(symmetric(jnp.asarray(a)))
    x = np.random.default_rng(1).normal(size=3)
    assert np.all(s == np.swapaxes(s, 1, 2))
    np.testing.assert_allclose(np.einsum("i,bij,j->b", x, s, x), np.einsum("i,bij,j->b", x, a, x), rtol=1e-12)


@pytest.mark.parametrize("dim", [4, 12])
def test_nothing_asks_lapack(dim):
    """Two batches of its Cholesky factors at once hang on two cores (jaxlib 0.10)."""

    def all_of_it(a):
        factor = cholesky(a)
        return lower(factor), upper_solve(factor, a), spd_solve(a, a)

    program = str(jax.make_jaxpr(jax.vmap(all_of_it))(jnp.zeros((3, dim, dim))))
    assert "cholesky[" not in program and "triangular_solve[" not in program
