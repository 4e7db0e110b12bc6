"""Filter and smoother against the joint normal distribution of all states and readings, written out and conditioned."""

import itertools
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nnap_em.gaussian import Gaussian
from nnap_em.kalman import Affine, Cubature, Reading, Tangent, ekf, kalman_filter, rts

LOG_2PI = np.log(2 * np.pi)


class _Linear(eqx.Module):
    """x' = a x + b u + w, y = c x + v, as the filters want a model."""

    a: jax.Array
    b: jax.Array
    c: jax.Array
    log_q: jax.Array
    log_r: jax.Array

    def transition(self, x, u, force=None):
        return self.a @ x + self.b @ u

    def emission(self, x, u=None):
        return self.c @ x


class _Problem(NamedTuple):
    model: _Linear
    start: Gaussian
    affine: Affine
    u: jax.Array
    y: jax.Array


def _problem(seed: int, time: int = 6, state: int = 3, obs: int = 2, *, varying: bool = False) -> _Problem:
    rng = np.random.default_rng(seed)
    a = np.linalg.qr(rng.normal(size=(state, state)))[0] * rng.uniform(0.6, 1.1, state)
    model = _Linear(
        *map(jnp.asarray, (a, rng.normal(size=(state, 1)), rng.normal(size=(obs, state)))),
        *map(jnp.asarray, (rng.normal(size=state) - 1, rng.normal(size=obs) - 1)),
    )
    root = rng.normal(size=(state, state))
    start = Gaussian(jnp.asarray(rng.normal(size=state)), jnp.asarray(root @ root.T + 0.1 * np.eye(state)))
    u, y = rng.normal(size=(time, 1)), 2 * rng.normal(size=(time, obs))
    matrix = np.tile(a, (time, 1, 1)) + varying * 0.3 * rng.normal(size=(time, state, state))
    offset = u @ np.asarray(model.b).T + varying * rng.normal(size=(time, state))
    half = varying * rng.normal(size=(time, state, state))
    affine = Affine(*map(jnp.asarray, (matrix, offset, half @ half.swapaxes(1, 2))))
    return _Problem(model, start, affine, jnp.asarray(u), jnp.asarray(y))


class _Dense(NamedTuple):
    mean: np.ndarray
    cov: np.ndarray
    loglik: float


def _dense(p: _Problem, observed: np.ndarray, upto: int | None = None) -> _Dense:
    """All states given the readings of the rows before `upto`, through their joint covariance."""
    time = p.y.shape[0]
    n = p.start.mean.shape[0]
    mean, transfer = [np.asarray(p.start.mean)], [[np.eye(n)]]
    extra = np.asarray(p.affine.noise[: time - 1])
    noise = [np.asarray(p.start.cov), *(np.diag(np.exp(np.asarray(p.model.log_q))) + extra)]
    for k in range(time - 1):
        f = np.asarray(p.affine.matrix[k])
        mean.append(f @ mean[-1] + np.asarray(p.affine.offset[k]))
        transfer.append([f @ g for g in transfer[-1]] + [np.eye(n)])
    big = np.zeros((time * n, time * n))  # all states as a linear map of start and process noise
    for k, row in enumerate(transfer):
        for j, g in enumerate(row):
            big[k * n : (k + 1) * n, j * n : (j + 1) * n] = g
    prior_cov = big @ _blocks(noise) @ big.T
    prior = np.concatenate(mean)
    seen = np.asarray(observed) & (np.arange(time) < (time if upto is None else upto))[:, None]
    c = np.kron(np.eye(time), np.asarray(p.model.c))[seen.ravel()]
    r = np.tile(np.exp(np.asarray(p.model.log_r)), time)[seen.ravel()]
    e = np.asarray(p.y).ravel()[seen.ravel()] - c @ prior
    s = c @ prior_cov @ c.T + np.diag(r)
    gain = np.linalg.solve(s, c @ prior_cov).T
    loglik = -0.5 * (e @ np.linalg.solve(s, e) + np.linalg.slogdet(s)[1] + len(e) * LOG_2PI) if len(e) else 0.0
    return _Dense(prior + gain @ e, prior_cov - gain @ c @ prior_cov, float(loglik))


def _blocks(matrices) -> np.ndarray:
    n = len(matrices[0])
    out = np.zeros((len(matrices) * n,) * 2)
    for k, m in enumerate(matrices):
        out[k * n : (k + 1) * n, k * n : (k + 1) * n] = m
    return out


def _active(time: int) -> jax.Array:
    return jnp.arange(time) < time - 1


def _reading(p: _Problem) -> Reading:
    rows = jnp.broadcast_to(p.model.c, (p.y.shape[0], *p.model.c.shape))
    return Reading(rows, jnp.zeros_like(p.y))


@jax.jit
def _run(p: _Problem, observed, active):
    filtered = kalman_filter(p.model.log_q, p.model.log_r, p.start, p.affine, _reading(p), p.y, observed, active)
    return filtered, rts(filtered)


def _check(p: _Problem, observed: np.ndarray):
    """All that the two passes give, to 1e-9 of its size: rounding times the condition of some hundred."""
    time, n = p.y.shape[0], p.start.mean.shape[0]
    filtered, smoothed = _run(p, jnp.asarray(observed), _active(time))
    dense = _dense(p, observed)
    close = lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9 * max(1.0, np.abs(b).max()))  # noqa: E731
    close(filtered.loglik, dense.loglik)
    cov = dense.cov.reshape(time, n, time, n)
    close(smoothed.state.mean, dense.mean.reshape(time, n))
    close(smoothed.state.cov, np.stack([cov[k, :, k] for k in range(time)]))
    lag_one = np.einsum("kij,kjl->kil", smoothed.gain, smoothed.state.cov[1:])
    close(lag_one, np.stack([cov[k, :, k + 1] for k in range(time - 1)]))
    for k in (0, time // 2, time - 1):
        before, after = _dense(p, observed, k), _dense(p, observed, k + 1)
        block = slice(k * n, (k + 1) * n)
        close(filtered.predicted.mean[k], before.mean[block])
        close(filtered.predicted.cov[k], before.cov[block, block])
        close(filtered.state.mean[k], after.mean[block])
        close(filtered.state.cov[k], after.cov[block, block])


@settings(max_examples=10, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10**6), varying=st.booleans())
def test_passes_equal_the_dense_joint(seed, varying):
    observed = np.random.default_rng(seed).uniform(size=(6, 2)) < 0.7
    _check(_problem(seed, varying=varying), observed)


def test_every_pattern_of_missing_readings():
    """Short enough for all 2^6 of them."""
    p = _problem(3, time=3, varying=True)
    for pattern in itertools.product([False, True], repeat=6):
        _check(p, np.reshape(pattern, (3, 2)))


def test_what_is_not_measured_may_hold_any_number():
    p = _problem(4)
    observed = np.random.default_rng(0).uniform(size=p.y.shape) < 0.5
    other = p._replace(y=jnp.where(observed, p.y, 1e6))
    for a, b in zip(*(jax.tree.leaves(_run(q, jnp.asarray(observed), _active(6))) for q in (p, other)), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("linearise", [Tangent(), Cubature()], ids=["tangent", "cubature"])
def test_extended_filter_is_kalmans_on_a_linear_system(linearise):
    p = _problem(1)
    observed = jnp.ones(p.y.shape, bool)
    extended = ekf(p.model, p.start, p.u, p.y, observed, _active(6), linearise)
    plain = kalman_filter(p.model.log_q, p.model.log_r, p.start, p.affine, _reading(p), p.y, observed, _active(6))
    for a, b in zip(jax.tree.leaves(extended), jax.tree.leaves(plain), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-11)  # matrix, offset and noise are rounded, nothing else


class _Bent(NamedTuple):
    f: Callable

    def transition(self, x, u):
        return self.f(x)


def test_tangent_touches_the_curve():
    a = _problem(0).model.a
    x = jnp.asarray([0.3, -0.2, 0.9])
    affine = Tangent()(_Bent(lambda x: jnp.sin(a @ x)), Gaussian(x, jnp.eye(3)), jnp.zeros(1))
    np.testing.assert_allclose(affine.matrix, np.cos(a @ x)[:, None] * np.asarray(a), rtol=1e-14)
    np.testing.assert_allclose(affine.matrix @ x + affine.offset, np.sin(a @ x), rtol=1e-14)
    assert np.all(np.asarray(affine.noise) == 0)


def test_cubature_has_the_slope_and_mean_of_a_polynomial():
    """Exact to third order: E f = m^2 + s^2 and slope E f' = 2 m for f = x^2; E f = m^3 + 3 m s^2 for f = x^3."""
    m, s = 0.7, 0.4
    about = Gaussian(jnp.asarray([m, 0.0]), jnp.diag(jnp.asarray([s**2, 1.0])))
    affine = Cubature()(_Bent(lambda x: jnp.stack([x[0] ** 2, x[0] ** 3])), about, jnp.zeros(1))
    mean = affine.matrix @ about.mean + affine.offset
    np.testing.assert_allclose(mean, [m**2 + s**2, m**3 + 3 * m * s**2], rtol=1e-13)
    np.testing.assert_allclose(affine.matrix[0], [2 * m, 0.0], rtol=1e-13, atol=1e-13)
    assert np.all(np.linalg.eigvalsh(affine.noise) > -1e-15)


def test_cubature_is_the_tangent_where_the_state_is_sure():
    model = _Bent(lambda x: jnp.stack([jnp.sin(x[0] * x[1]), jnp.exp(x[1])]))
    about = Gaussian(jnp.asarray([0.3, -0.8]), 1e-8 * jnp.eye(2))
    wide, narrow = (rule(model, about, jnp.zeros(1)) for rule in (Cubature(), Tangent()))
    for a, b in zip(wide, narrow, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)  # differences go with the variance, 1e-8, times curvature


def test_padding_changes_no_digit():
    p = _problem(7, time=6)
    observed = np.random.default_rng(7).uniform(size=(6, 2)) < 0.7
    longer = jax.tree.map(lambda a: jnp.concatenate([a, jnp.full((4, *a.shape[1:]), 3.3)]), (p.affine, p.y))
    padded = p._replace(affine=longer[0], y=longer[1])
    wide = np.concatenate([observed, np.zeros((4, 2), bool)])
    short = _run(p, jnp.asarray(observed), _active(6))
    long = _run(padded, jnp.asarray(wide), jnp.arange(10) < 5)
    np.testing.assert_array_equal(short[0].loglik, long[0].loglik)
    np.testing.assert_array_equal(short[0].state.mean, long[0].state.mean[:6])
    # the smoother passes the padding by solving with the state's own covariance: rounding, and no more
    np.testing.assert_allclose(short[1].state.mean, long[1].state.mean[:6], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(short[1].state.cov, long[1].state.cov[:6], rtol=1e-12, atol=1e-12)


def test_innovations_are_white_with_unit_variance():
    """Readings drawn from the model itself."""
    p = _problem(11, time=2000)
    rng = np.random.default_rng(5)
    x = rng.multivariate_normal(p.start.mean, p.start.cov)
    y = []
    for k in range(2000):
        y.append(np.asarray(p.model.c) @ x + rng.normal(size=2) * np.exp(0.5 * np.asarray(p.model.log_r)))
        x = np.asarray(p.affine.matrix[k]) @ x + np.asarray(p.affine.offset[k])
        x = x + rng.normal(size=3) * np.exp(0.5 * np.asarray(p.model.log_q))
    filtered, _ = _run(p._replace(y=jnp.asarray(y)), jnp.ones((2000, 2), bool), _active(2000))
    e = np.asarray(filtered.innovation)
    bound = 4 / np.sqrt(2000)  # four standard errors
    assert np.all(np.abs(e.mean(0)) < bound)
    assert np.all(np.abs((e**2).mean(0) - 1) < np.sqrt(2) * bound)
    assert np.all(np.abs(e[1:].T @ e[:-1] / 2000) < bound)
    assert abs(np.mean(e[:, 0] * e[:, 1])) < bound


def _nile() -> tuple[_Problem, np.ndarray]:
    statsmodels = pytest.importorskip("statsmodels.datasets")
    y = statsmodels.nile.load_pandas().data["volume"].to_numpy(float)
    one = jnp.ones((1, 1))
    model = _Linear(one, 0 * one, one, jnp.log(jnp.asarray([1469.1])), jnp.log(jnp.asarray([15099.0])))
    start = Gaussian(jnp.asarray([y[0]]), jnp.asarray([[15099.0 + 1e-7]]))
    n = len(y)
    return _Problem(
        model,
        start,
        Affine(jnp.ones((n, 1, 1)), jnp.zeros((n, 1)), jnp.zeros((n, 1, 1))),
        jnp.zeros((n, 1)),
        jnp.asarray(y)[:, None],
    ), y


def test_nile_has_the_published_likelihood():
    """Local level, variances 15099 and 1469.1, log-likelihood -492.07 [Durbin & Koopman 2012, sec. 2.10, table 2.1]."""
    p, _ = _nile()
    # a diffuse start conditioned on y_1 is N(y_1, sigma_eps^2), and y_1 itself is no reading any more; the table leaves
    # out the constants n log(2 pi) / 2 and (n - 1) / 2 of the concentrated likelihood (eq. 2.63)
    filtered, _ = _run(p, jnp.ones(p.y.shape, bool).at[0].set(False), _active(len(p.y)))
    assert float(filtered.loglik) + 99 / 2 * (LOG_2PI + 1) == pytest.approx(-492.07, abs=0.01)
    assert float(jnp.sum(filtered.innovation**2)) == pytest.approx(
        99, rel=1e-4
    )  # sigma_eps^2 is its estimate, eq. 2.62
    # the steady state of the book's recursion: P = (q + sqrt(q^2 + 4 q)) / 2 of sigma_eps^2
    ratio = 1469.1 / 15099.0
    steady = 15099.0 * (ratio + np.sqrt(ratio**2 + 4 * ratio)) / 2
    assert float(filtered.predicted.cov[60, 0, 0]) == pytest.approx(steady, rel=1e-6)


def test_nile_agrees_with_statsmodels():
    structural = pytest.importorskip("statsmodels.tsa.statespace.structural")
    p, y = _nile()
    reference = structural.UnobservedComponents(y, "local level")
    reference.ssm.initialize_known(np.asarray([y[0]]), np.asarray(p.start.cov))
    expected = reference.smooth([15099.0, 1469.1])
    filtered, smoothed = _run(p, jnp.ones(p.y.shape, bool), _active(len(y)))
    np.testing.assert_allclose(filtered.loglik, expected.llf_obs.sum(), rtol=1e-9)
    np.testing.assert_allclose(smoothed.state.mean[:, 0], expected.smoothed_state[0], rtol=1e-9)
    np.testing.assert_allclose(smoothed.state.cov[:, 0, 0], expected.smoothed_state_cov[0, 0], rtol=1e-9)
