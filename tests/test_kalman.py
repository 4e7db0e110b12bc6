"""Filter and smoother against the joint normal distribution of all states and readings, written out and conditioned."""

import itertools
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import block_diag
from statsmodels.tsa.statespace.kalman_smoother import KalmanSmoother

from nnap_em.base.gaussian import Gaussian
from nnap_em.estimate.em.loop import e_step
from nnap_em.estimate.smoother.gaussian import CubatureSmoother, GaussianSmoother
from nnap_em.estimate.smoother.kalman import Affine, Cubature, Reading, Tangent, kalman_filter, rts
from nnap_em.estimate.smoother.start import StartBank
from nnap_em.logs.dataset import Dataset
from nnap_em.model.base import AbstractModel, Prepared, prepare

LOG_2PI = np.log(2 * np.pi)


class _Linear(AbstractModel):
    """x' = a x + b u + w, y = c x + v."""

    a: jax.Array
    b: jax.Array
    c: jax.Array
    log_q: jax.Array
    log_r: jax.Array
    start: Gaussian
    measured: tuple[int, ...] = eqx.field(static=True, default=())
    dt: float = eqx.field(static=True, default=1.0)

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
    parts = a, rng.normal(size=(state, 1)), rng.normal(size=(obs, state)), rng.normal(size=state), rng.normal(size=obs)
    root = rng.normal(size=(state, state))
    start = Gaussian(jnp.asarray(rng.normal(size=state)), jnp.asarray(root @ root.T + 0.1 * np.eye(state)))
    b, c, log_q, log_r = (jnp.asarray(part - shift) for part, shift in zip(parts[1:], (0, 0, 1, 1), strict=True))
    model = _Linear(jnp.asarray(a), b, c, log_q, log_r, start)
    u, y = rng.normal(size=(time, 1)), 2 * rng.normal(size=(time, obs))
    matrix = np.tile(a, (time, 1, 1)) + varying * 0.3 * rng.normal(size=(time, state, state))
    offset = u @ np.asarray(model.b).T + varying * rng.normal(size=(time, state))
    half = varying * rng.normal(size=(time, state, state))
    affine = Affine(*map(jnp.asarray, (matrix, offset, half @ half.swapaxes(1, 2))))
    # NumPy's, since every index into an array of JAX is a program
    return jax.tree.map(np.asarray, _Problem(model, start, affine, jnp.asarray(u), jnp.asarray(y)))


class _Dense(NamedTuple):
    mean: np.ndarray
    cov: np.ndarray
    loglik: float


def _dense(p: _Problem, observed: np.ndarray) -> _Dense:
    """All states given the readings, through their joint covariance."""
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
    prior_cov = big @ block_diag(*noise) @ big.T
    prior = np.concatenate(mean)
    seen = np.asarray(observed).ravel()
    c = np.kron(np.eye(time), np.asarray(p.model.c))[seen]
    r = np.tile(np.exp(np.asarray(p.model.log_r)), time)[seen]
    e = np.asarray(p.y).ravel()[seen] - c @ prior
    s = c @ prior_cov @ c.T + np.diag(r)
    gain = np.linalg.solve(s, c @ prior_cov).T
    loglik = -0.5 * (e @ np.linalg.solve(s, e) + np.linalg.slogdet(s)[1] + len(e) * LOG_2PI) if len(e) else 0.0
    return _Dense(prior + gain @ e, prior_cov - gain @ c @ prior_cov, float(loglik))


def _active(time: int) -> np.ndarray:
    return np.arange(time) < time - 1


@jax.jit
def _run(p: _Problem, observed, active):
    seq = Prepared(p.u, p.y, observed, active)
    reading = Reading(jnp.broadcast_to(p.model.c, (p.y.shape[0], *p.model.c.shape)), jnp.zeros_like(p.y))
    filtered = kalman_filter(p.model.log_q, p.model.log_r, p.start, p.affine, reading, seq)
    return filtered, rts(filtered)


def _close(a, b) -> None:
    np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9 * max(1.0, np.abs(b).max()))


ROUTES = {
    "tangent": GaussianSmoother(StartBank((1, 1, 1)), Tangent(), iterations=0),
    "cubature, again": GaussianSmoother(StartBank((1, 1, 1)), Cubature(), iterations=2, inflations=(1.0, 9.0)),
}


@pytest.mark.parametrize("route", ROUTES)
def test_smoothers_equal_the_dense_joint_for_every_pattern_of_missing_readings(route):
    """All that an M-step is handed on a linear system: likelihood, marginals, and pairs through their nodes.

    A horizon cuts by `valid` alone: the readings behind it stay where they are, and count for nothing.
    """
    time, n, more = 4, 3, 2
    p = _problem(5, time=time + more)
    patterns = np.reshape(list(itertools.product([False, True], repeat=2 * time)), (-1, time, 2))
    y = jnp.where(jnp.asarray(np.pad(patterns, ((0, 0), (0, more), (0, 0)), constant_values=True)), p.y[None], jnp.nan)
    rows = jnp.arange(float(time + more)), p.u, jnp.arange(time + more) < time
    one = lambda y: ROUTES[route](p.model, prepare(p.model, Dataset(rows[0], rows[1], y, rows[2])))  # noqa: E731
    paths = jax.jit(jax.vmap(one))(y)
    short = p._replace(y=p.y[:time])
    dense = [_dense(short, observed) for observed in patterns]
    cov = np.stack([d.cov.reshape(time, n, time, n) for d in dense])
    mean = np.stack([d.mean.reshape(time, n) for d in dense])
    _close(paths.loglik, np.asarray([d.loglik for d in dense]))
    _close(paths.state.mean, np.concatenate([mean, *[mean[:, -1:]] * more], axis=1))  # it rests over padding
    _close(paths.state.cov[:, :time], np.einsum("pkikj->pkij", cov))
    prev, after, kick = (np.asarray(a)[:, : time - 1] for a in (paths.prev, paths.next, paths.kick))
    pair = np.concatenate([prev, after], axis=-1)
    _close(pair.mean(axis=2), np.concatenate([mean[:, :-1], mean[:, 1:]], axis=-1))
    away = pair - pair.mean(axis=2, keepdims=True)
    second = np.einsum("pkni,pknj->pkij", away, away) / pair.shape[2]
    blocks = [cov[:, k : k + 2, :, k : k + 2, :].reshape(-1, 2 * n, 2 * n) for k in range(time - 1)]
    _close(second, np.stack(blocks, axis=1))
    driven = np.asarray(p.u @ p.model.b.T)[: time - 1]
    _close(kick, after - np.einsum("ij,pknj->pkni", p.model.a, prev) - driven[None, :, None])


def test_likeliest_start_weighs_prior_and_readings():
    """The hypothesis with the largest prior times likelihood, by the dense joint."""
    bank, away, seen = StartBank((9, 1, 1)), np.linspace(-2.5, 2.5, 9), np.ones((4, 2))
    problems = [_problem(seed, time=4) for seed in range(6)]
    problems = [p._replace(model=eqx.tree_at(lambda m: m.log_r, p.model, p.model.log_r + 1)) for p in problems]

    @jax.jit
    @jax.vmap
    def run(p):
        seq = Prepared(p.u, p.y, jnp.ones((4, 2), bool), _active(4))
        return bank.hypotheses(p.start)[0], bank.likeliest(p.model, seq, Tangent(), 60).mean

    starts, chosen = run(jax.tree.map(lambda *a: jnp.stack(a), *problems))
    best = []
    for i, p in enumerate(problems):
        each = [Gaussian(mean, cov) for mean, cov in zip(starts.mean[i], starts.cov[i], strict=True)]
        loglik = np.asarray([_dense(p._replace(start=start), seen > 0).loglik for start in each])
        best.append((int(np.argmax(loglik - 0.5 * away**2)), int(np.argmax(loglik))))
        np.testing.assert_allclose(chosen[i], starts.mean[i, best[i][0]], rtol=1e-14)
    assert any(one != 4 for one, _ in best) and any(one != likeliest for one, likeliest in best)  # both weigh


class _Fold(_Linear):
    """x' = x + dt (x - x^3 / 4): from upright to either side; x is read."""

    def transition(self, x, u, force=None):
        return x + self.dt * (x - x**3 / 4)


def test_loosened_passes_one_by_one_give_what_they_give_together():
    """Every sequence keeps its own likeliest try; two start on the side that the prior speaks against."""
    one, time = jnp.ones((1, 1)), 60
    start, log = Gaussian(jnp.asarray([0.3]), 0.01 * one), lambda std: 2 * jnp.log(jnp.asarray([std]))
    model = _Fold(one, one, one, log(0.02), log(0.1), start, dt=0.05)
    x = np.zeros((4, time))
    x[:, 0] = 0.3, -0.1, 0.2, -0.2
    for k in range(1, time):
        x[:, k] = x[:, k - 1] + 0.05 * (x[:, k - 1] - x[:, k - 1] ** 3 / 4)
    y = np.where(np.arange(time) < 30, np.nan, x + 0.1 * np.random.default_rng(0).normal(size=x.shape))
    t = np.broadcast_to(0.05 * np.arange(time), x.shape)
    data = Dataset(*map(jnp.asarray, (t, 0.0 * x[..., None], y[..., None], np.ones(x.shape, bool))))
    smoother = CubatureSmoother(StartBank((1,)), iterations=1, inflations=(1.0, 30.0, 1000.0))
    together = eqx.filter_jit(jax.vmap(lambda seq: smoother(model, prepare(model, seq))))(data)
    apart = e_step(model, data, smoother, key=jax.random.key(0))
    # rounding, in other programs: errors grow by e over a second at most, which upright is 1 of its 3 seconds
    np.testing.assert_allclose(apart.loglik, together.loglik, rtol=1e-9)
    np.testing.assert_allclose(apart.state.mean, together.state.mean, rtol=1e-9, atol=1e-9)
    first = e_step(model, data, CubatureSmoother(smoother.bank), key=jax.random.key(0))
    gain = np.asarray(apart.loglik - first.loglik)
    assert np.max(gain) > 0.01 and np.min(gain) == 0.0  # or there was nothing to choose


def test_time_varying_system_agrees_with_statsmodels():
    """Marginals, lag-one covariances and likelihood of 60 rows, a third of the readings missing; then in 32 bits."""
    time, n = 60, 3
    p = _problem(8, time=time, varying=True)
    observed = np.random.default_rng(8).uniform(size=p.y.shape) < 0.67
    peer = KalmanSmoother(k_endog=2, k_states=n)
    peer.bind(np.where(observed, p.y, np.nan))
    peer["design"], peer["obs_cov"] = np.asarray(p.model.c), np.diag(np.exp(p.model.log_r))
    peer["transition"] = np.moveaxis(np.asarray(p.affine.matrix), 0, 2)
    peer["state_intercept"] = np.asarray(p.affine.offset).T
    peer["selection"] = np.eye(n)
    peer["state_cov"] = np.moveaxis(np.diag(np.exp(p.model.log_q)) + np.asarray(p.affine.noise), 0, 2)
    peer.initialize_known(np.asarray(p.start.mean), np.asarray(p.start.cov))
    expected = peer.smooth()
    filtered, smoothed = jax.tree.map(np.asarray, _run(p, observed, _active(time)))
    # some hundred products of matrices of condition 1e3 or less, each to 1e-16
    _close(filtered.loglik, expected.llf_obs.sum())
    _close(filtered.predicted.mean, expected.predicted_state.T[:time])
    _close(filtered.predicted.cov, np.moveaxis(expected.predicted_state_cov, 2, 0)[:time])
    _close(filtered.state.mean, expected.filtered_state.T)
    _close(filtered.state.cov, np.moveaxis(expected.filtered_state_cov, 2, 0))
    _close(smoothed.state.mean, expected.smoothed_state.T)
    _close(smoothed.state.cov, np.moveaxis(expected.smoothed_state_cov, 2, 0))
    lag_one = np.einsum("kij,kjl->kil", smoothed.gain, smoothed.state.cov[1:])
    # theirs: cov(x_{k+1}, x_k)
    _close(lag_one, np.moveaxis(expected.smoothed_state_autocov, 2, 0)[: time - 1].swapaxes(1, 2))
    rounded = jax.tree.map(lambda a: np.asarray(a, np.float32), p)
    mean, cov = map(np.asarray, _run(rounded, observed, _active(time))[1].state)
    std = np.sqrt(np.diagonal(smoothed.state.cov, axis1=1, axis2=2))
    # single rounding, 6e-8, times the condition of the covariances, some 1e3, over 60 steps
    assert mean.dtype == np.float32 and np.max(np.abs(mean - smoothed.state.mean) / std) < 0.01
    np.testing.assert_allclose(np.sqrt(np.diagonal(cov, axis1=1, axis2=2)), std, rtol=0.005)


def test_covariances_stay_symmetric_and_positive():
    """A start of condition 1e12, a reading of 1e-6 of its size: what is not kept symmetric drifts apart."""
    p = _problem(2, time=60)
    wide = p.start._replace(cov=jnp.diag(jnp.asarray([1e6, 1.0, 1e-6])))
    sharp = eqx.tree_at(lambda m: m.log_r, p.model, jnp.full(2, np.log(1e-6)))
    filtered, smoothed = _run(p._replace(start=wide, model=sharp), jnp.ones(p.y.shape, bool), _active(60))
    for cov in (filtered.state.cov, filtered.predicted.cov, smoothed.state.cov):
        cov = np.asarray(cov)
        np.testing.assert_array_equal(cov, cov.swapaxes(1, 2))
        size = np.linalg.eigvalsh(cov)
        assert np.all(size[1:, 0] > 0)  # the first row's: rounding of 1e6
        assert size[0, 0] > -1e6 * np.finfo(float).eps


class _Bent(NamedTuple):
    f: Callable

    def transition(self, x, u):
        return self.f(x)


def _bent(rule, f: Callable, about: Gaussian) -> Affine:
    return jax.jit(lambda about: rule(_Bent(f), about, jnp.zeros(1)))(about)


def test_tangent_touches_the_curve():
    a = _problem(0).model.a
    x = jnp.asarray([0.3, -0.2, 0.9])
    affine = _bent(Tangent(), lambda x: jnp.sin(a @ x), Gaussian(x, jnp.eye(3)))
    np.testing.assert_allclose(affine.matrix, np.cos(a @ x)[:, None] * np.asarray(a), rtol=1e-14)
    np.testing.assert_allclose(affine.matrix @ x + affine.offset, np.sin(a @ x), rtol=1e-14)
    assert np.all(np.asarray(affine.noise) == 0)


def test_cubature_has_the_slope_and_mean_of_a_polynomial():
    """Exact to third order: E f = m^2 + s^2 and slope E f' = 2 m for f = x^2; E f = m^3 + 3 m s^2 for f = x^3."""
    m, s = 0.7, 0.4
    about = Gaussian(jnp.asarray([m, 0.0]), jnp.diag(jnp.asarray([s**2, 1.0])))
    affine = _bent(Cubature(), lambda x: jnp.stack([x[0] ** 2, x[0] ** 3]), about)
    mean = affine.matrix @ about.mean + affine.offset
    np.testing.assert_allclose(mean, [m**2 + s**2, m**3 + 3 * m * s**2], rtol=1e-13)
    np.testing.assert_allclose(affine.matrix[0], [2 * m, 0.0], rtol=1e-13, atol=1e-13)
    assert np.all(np.linalg.eigvalsh(affine.noise) > -1e-15)
