"""One sample interval: the order of the method, a reference integrator, and derivatives both ways."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from nnap_em.base.ode import integrate

X0 = jnp.asarray([1.2, -0.7])


def _swing(x):
    """A pendulum with quadratic drag: nonlinear, smooth."""
    q, v = x
    return jnp.stack([v, -9.81 * jnp.sin(q) - 0.3 * v * jnp.sqrt(1 + v**2)])


def test_order_is_four_towards_the_motion_of_scipy():
    rate = jax.jit(_swing)
    motion = solve_ivp(lambda t, x: np.asarray(rate(jnp.asarray(x))), (0.0, 0.4), X0, "DOP853", rtol=1e-12, atol=1e-12)
    errors = [np.linalg.norm(np.asarray(integrate(_swing, X0, 0.4, n)) - motion.y[:, -1]) for n in (8, 16, 32)]
    # halving the step: 2^4 = 16, up to the next term of the error's series, of relative size h
    assert errors[0] / errors[1] == pytest.approx(16, rel=0.2)
    assert errors[1] / errors[2] == pytest.approx(16, rel=0.1)


def test_linear_system_is_the_taylor_series_to_fourth_order():
    a = jnp.asarray([[0.0, 1.0], [-4.0, -0.5]])
    h = 0.1
    step, term = np.eye(2), np.eye(2)
    for k in range(1, 5):
        term = term @ np.asarray(a) * h / k
        step = step + term
    np.testing.assert_allclose(integrate(lambda x: a @ x, X0, h, 1), step @ np.asarray(X0), rtol=1e-14)


def test_a_rate_that_changes_in_time_is_integrated_over_all_substeps():
    """x' = 3 s^2 + x with s from 0 to 1: e^s (x + 6) - 3 s^2 - 6 s - 6, to the order of the method."""
    found = integrate(lambda x, s: 3 * s[None] ** 2 + x, X0, 1.0, 50, timed=True)
    np.testing.assert_allclose(found, np.e * (np.asarray(X0) + 6) - 15, rtol=1e-8)


def test_derivatives_agree():
    """Forward, backward, and backward of forward, as the M-step takes them, beside central differences."""
    f, h = jax.jit(lambda x: integrate(_swing, x, 0.05, 2)), 1e-5
    jac = jax.jit(jax.jacfwd(f))
    size = lambda x: jnp.sum(jac(x) ** 2)  # noqa: E731
    np.testing.assert_allclose(jac(X0), jax.jacrev(f)(X0), rtol=1e-13, atol=1e-15)
    slope = lambda f: jnp.stack([(f(X0 + h * e) - f(X0 - h * e)) / (2 * h) for e in jnp.eye(2)], -1)  # noqa: E731
    # h^2 f''' / 6 and eps / h, both 1e-11
    np.testing.assert_allclose(jac(X0), slope(f), atol=1e-9)
    np.testing.assert_allclose(jax.grad(size)(X0), slope(size), atol=1e-8)
