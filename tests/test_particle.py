"""The particle smoother: against the exact smoother of a linear model, a grid, and laws of its draws."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from jaxtyping import Array, Float

from nnap_em.base.gaussian import Gaussian
from nnap_em.estimate.smoother import particle
from nnap_em.estimate.smoother.gaussian import ExtendedKalmanSmoother
from nnap_em.estimate.smoother.kalman import Reading, Tangent, kalman_filter
from nnap_em.estimate.smoother.particle import ExactBackward, Guided, ParticleSmoother, ffbs, particle_filter
from nnap_em.estimate.smoother.particle.filter import systematic
from nnap_em.estimate.smoother.start import StartBank
from nnap_em.logs.dataset import Dataset, fill_missing, stepped
from nnap_em.model.base import AbstractModel, prepare

PROPOSALS = {"bootstrap": particle.Bootstrap(), "guided": Guided(), "lookahead": particle.Lookahead(1.0)}
SEEDS, PARTICLES, PATHS = 100, 200, 40
KEY = jax.random.key(5)


class _Oscillator(AbstractModel):
    """A damped mass on a spring, position read: the Kalman smoother is exact."""

    matrix: Float[Array, "state state"]
    drive: Float[Array, " state"]
    start: Gaussian
    log_q: Float[Array, " state"]
    log_r: Float[Array, " obs"]
    measured: tuple[int, ...] = eqx.field(static=True, default=(0,))
    dt: float = eqx.field(static=True, default=0.1)

    def transition(self, x, u):
        rows = [self.matrix[i, 0] * x[0] + self.matrix[i, 1] * x[1] + self.drive[i] * u[0] for i in range(2)]
        return jnp.stack(rows)

    def emission(self, x, u=None):
        return x[:1]


@functools.cache
def _linear():
    """An oscillator, and one sequence of it with a gap, whose second half ends nowhere near a reading."""
    steps = 30
    model = _Oscillator(
        jnp.array([[0.98, 0.1], [-0.3, 0.9]]),
        jnp.array([0.0, 0.1]),
        Gaussian(jnp.array([1.0, 0.0]), jnp.array([[0.3, 0.1], [0.1, 0.5]])),
        2 * jnp.log(jnp.array([0.02, 0.1])),
        2 * jnp.log(jnp.array([0.1])),
    )
    rng = np.random.default_rng(3)
    u = np.sin(0.4 * np.arange(steps + 1))[:, None]
    x, y = np.array([1.3, -0.4]), []
    for k in range(steps + 1):
        y.append(x[:1] + 0.1 * rng.standard_normal(1))
        x = np.asarray(model.matrix) @ x + np.asarray(model.drive) * u[k, 0] + [0.02, 0.1] * rng.standard_normal(2)
    y = np.array(y)
    y[[4, 12, 13, 14, 15]] = np.nan
    return model, Dataset(*map(jnp.asarray, (0.1 * np.arange(steps + 1), u, y, np.ones(steps + 1, bool))))


GUIDE = ExtendedKalmanSmoother(StartBank((1, 1)))


@eqx.filter_jit
def _run_linear(model, seq, potentials, keys):
    def run(key):
        key_filter, key_paths = jax.random.split(key)
        history = particle_filter(model, potentials, seq, num_particles=PARTICLES, key=key_filter)
        return history.loglik, history.ess, ffbs(history, ExactBackward(), num_paths=PATHS, key=key_paths)

    return jax.vmap(run)(keys)


@functools.cache
def _exact():
    """The exact answer, the potentials of every proposal, and Fisher's score of all noises and of a constant push."""
    model, seq = _linear()
    y = fill_missing(seq.y)[0]

    def loglik(log_q, log_r, push):
        moved = eqx.tree_at(lambda m: m.drive, model, model.drive + push)
        affine = jax.vmap(lambda u: Tangent()(moved, Gaussian(jnp.zeros(2), jnp.eye(2)), u))(seq.u)
        reading = Reading(jnp.tile(jnp.asarray([[[1.0, 0.0]]]), (*y.shape, 1)), jnp.zeros_like(y))
        return kalman_filter(log_q, log_r, model.start, affine, reading, prepare(model, seq)).loglik

    @jax.jit
    def run():
        path = GUIDE.path(model, prepare(model, seq))
        potentials = {name: proposal(model, prepare(model, seq), *path) for name, proposal in PROPOSALS.items()}
        return *path, potentials, jax.grad(loglik, argnums=(0, 1, 2))(model.log_q, model.log_r, jnp.zeros(2))

    return run()


@functools.cache
def _linear_runs(name):
    """SEEDS independent runs of a proposal: log-likelihoods, effective sample sizes, and the trajectories."""
    model, seq = _linear()
    return _run_linear(model, prepare(model, seq), _exact()[2][name], jax.random.split(KEY, SEEDS))


def _within(samples, known, sigmas=4.5):
    """Means over runs equal `known` within standard errors: 4.5 leaves 1 in 1000 for the 180 numbers of a test."""
    error = np.std(samples, axis=0, ddof=1) / np.sqrt(len(samples))
    assert np.all(np.abs(np.mean(samples, axis=0) - known) < sigmas * error)


@pytest.mark.parametrize("run", ["bootstrap", "guided"])
def test_trajectories_and_likelihood_are_those_of_the_exact_smoother(run):
    (model, seq), (filtered, smoothed, _, score), (loglik, _, paths) = _linear(), _exact(), _linear_runs(run)
    assert loglik.dtype == paths.x.dtype == jnp.float64  # whatever the type of the particles
    ratio = np.exp(np.asarray(loglik - filtered.loglik))  # the estimate of p(y) is unbiased
    assert abs(np.mean(ratio) - 1) < 4 * np.std(ratio, ddof=1) / np.sqrt(SEEDS) + 1e-5  # the last for single precision
    mean, cov = map(np.asarray, smoothed.state)
    x, kick = map(np.asarray, paths)
    _within(x.mean(axis=2), mean)
    _within(((x - mean[:, None]) ** 2).mean(axis=2), np.diagonal(cov, axis1=1, axis2=2))
    # cov of x_{k+1} - A x_k from the lag-one gains; its mean is that of the smoothed path
    a, u = np.asarray(model.matrix), np.asarray(seq.u)[:-1]
    expected = mean[1:] - mean[:-1] @ a.T - u * np.asarray(model.drive)
    lag = np.asarray(smoothed.gain) @ cov[1:]
    spread = cov[1:] - a @ lag - np.swapaxes(a @ lag, 1, 2) + a @ cov[:-1] @ a.T
    _within(kick.mean(axis=2), expected)
    _within(((kick - expected[:, None]) ** 2).mean(axis=2), np.diagonal(spread, axis1=1, axis2=2))
    # Fisher's identity: the expected score of states and readings together is the gradient of log p(y)
    y, observed = map(np.asarray, fill_missing(seq.y))
    push = kick / np.exp(model.log_q)
    miss = np.where(observed[:, None], y[:, None] - x[..., :1], 0.0)
    of_q = 0.5 * (kick * push - 1).sum(axis=1)
    of_r = 0.5 * (miss**2 / np.exp(model.log_r) - observed[:, None]).sum(axis=1)
    of_push = (push * u[None, :, None]).sum(axis=1)
    _within(np.concatenate([of_q, of_r, of_push], axis=-1).mean(axis=1), np.concatenate(score), 4)


def test_full_lookahead_is_perfect_on_a_linear_system():
    loglik, ess, _ = _linear_runs("lookahead")
    # single precision: 31 steps of log weights of size 10, eps 6e-8 each
    np.testing.assert_allclose(loglik, _exact()[0].loglik, atol=2e-4)
    np.testing.assert_allclose(ess, PARTICLES, rtol=1e-4)


@jax.jit
def _smooth(model, seq, key):
    smoother = ParticleSmoother(GUIDE, Guided(), num_particles=PARTICLES, num_paths=PATHS)
    return smoother(model, prepare(model, seq), key=key)


def test_the_smoother_is_filter_and_draws_and_padding_changes_no_number():
    """The first of the runs, in another program and with nine rows behind its end."""
    model, seq = _linear()
    loglik, ess, paths = (jax.tree.map(lambda a: np.asarray(a[0]), part) for part in _linear_runs("guided"))
    padded = jax.tree.map(lambda a: jnp.asarray(a[0]), stepped(jax.tree.map(lambda a: a[None], seq), 40))
    long, n = jax.tree.map(np.asarray, _smooth(model, padded, jax.random.split(KEY, SEEDS)[0])), len(paths.x)
    # two compiled programs may round differently in the last single digit
    for a, b in ((long.prev, paths.x[:-1]), (long.next, paths.x[1:]), (long.kick, paths.kick)):
        np.testing.assert_allclose(a[: n - 1], b, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(long.state.mean[:n], paths.x.mean(axis=1), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(long.state.cov[:n, 0, 1], [np.cov(x.T, ddof=0)[0, 1] for x in paths.x], atol=1e-5)
    np.testing.assert_allclose([long.loglik, long.ess], [loglik, np.mean(ess)], rtol=1e-4)
    assert np.all(long.kick[n - 1 :] == 0) and np.all(long.next[n - 1 :] == long.prev[n - 1 :])


def test_backward_step_draws_from_its_law():
    """37 particles in blocks of 5, the last of which is not full."""
    draws = 20_000
    key_f, key_w, key = jax.random.split(jax.random.key(11), 3)
    f, log_w = jax.random.normal(key_f, (3, 37)), jax.random.normal(key_w, (37,))
    target = jnp.array([0.3, -0.5, 0.1])
    uniforms = jax.random.uniform(key, (draws,))
    index = jax.jit(ExactBackward(5))(jnp.tile(target[:, None], (1, draws)), f, log_w, uniforms)
    p = np.asarray(jax.nn.softmax(log_w - 0.5 * jnp.sum((target[:, None] - f) ** 2, axis=0)))
    share = np.bincount(np.asarray(index), minlength=37) / draws
    assert np.all(np.abs(share - p) < 4 * np.sqrt(p * (1 - p) / draws) + 1e-6)


def test_systematic_draws_are_unbiased():
    """Each particle is drawn its share, to less than one [Kitagawa 1996]; over all offsets, as often as it weighs."""
    log_w = 2 * jax.random.normal(jax.random.key(1), (50,), jnp.float32)
    offsets = (jnp.arange(400, dtype=jnp.float32) + jnp.float32(0.5)) / jnp.float32(400)  # in even steps
    index = np.asarray(jax.jit(jax.vmap(lambda offset: systematic(log_w, offset, 80)))(offsets))
    share = 80 * np.asarray(jax.nn.softmax(log_w))
    counts = np.stack([np.bincount(drawn, minlength=50) for drawn in index])
    assert np.all(counts.sum(axis=1) == 80) and np.all(np.abs(counts - share) < 1 + 1e-4)
    # either end of a share falls between two offsets
    np.testing.assert_allclose(counts.mean(axis=0), share, atol=2.5 / 400)


def test_weights_of_the_blind_filter_by_hand():
    """Every weight is the old one, or 1 / N after a resampling, times the density of the reading."""
    model, seq = _linear()
    n, rows = 40, seq.t.shape[0]
    blind = particle.Potentials(jnp.zeros((rows, 2)), jnp.zeros((rows, 2, 2)), jnp.zeros((rows, 2)))
    run = eqx.filter_jit(lambda m, s, key: particle_filter(m, blind, s, num_particles=n, key=key, dtype=float))
    h = run(model, prepare(model, seq), jax.random.key(6))
    x, f = (np.asarray(h.scale)[:, None] * np.asarray(a) for a in (h.x, h.f))
    a, b, u = np.asarray(model.matrix), np.asarray(model.drive), np.asarray(seq.u)
    np.testing.assert_allclose(f[:-1], (a @ x + (b * u)[:, :, None])[:-1], rtol=1e-9, atol=1e-12)
    w, total, resampled = np.full(n, 1 / n), 0.0, 0
    for k in range(rows):
        if np.any(np.asarray(h.ancestors[k]) != np.arange(n)):
            w, resampled = np.full(n, 1 / n), resampled + 1
        if not np.isnan(seq.y[k, 0]):
            w = w * scipy.stats.norm.pdf(seq.y[k, 0], x[k, 0], 0.1)
        total += np.log(w.sum())
        w = w / w.sum()
        np.testing.assert_allclose(np.exp(h.log_w[k]), w, rtol=1e-9)
    assert 2 < resampled < rows - 2
    assert float(h.loglik) == pytest.approx(total, rel=1e-9)


class _Escape(_Oscillator):
    """A walk whose drift doubles back near 0 and runs away beyond 1: x + x^3 dt."""

    def transition(self, x, u):
        return x + 2.0 * x**3


def _escape(start):
    """A gap of 10 rows between readings near 0: who leaves [-1, 1] in it is no number at its end."""
    model = _Escape(
        jnp.zeros((1, 1)), jnp.zeros(1), Gaussian(jnp.reshape(start, 1), jnp.array([[0.01]])),
        2 * jnp.log(jnp.array([0.08])), 2 * jnp.log(jnp.array([0.1])),
    )  # fmt: skip
    t = 0.1 * np.arange(16)
    y = np.where((t > 0.25) & (t < 1.25), np.nan, 0.0)[:, None]
    seq = Dataset(*map(jnp.asarray, (t, np.zeros((16, 1)), y, np.ones(16, bool))))
    path, zero = jnp.zeros((16, 1)), jnp.zeros((16, 1, 1))
    return model, seq, particle.Potentials(path, zero, path)


@eqx.filter_jit
def _escaped(start):
    model, seq, potentials = _escape(start)

    def run(key):
        history = particle_filter(model, potentials, prepare(model, seq), num_particles=300, key=key)
        return history, ffbs(history, ExactBackward(), num_paths=50, key=key)

    return jax.vmap(run)(jax.random.split(jax.random.key(2), 20))


def _density_on_a_grid(start):
    """log p(y) of `_escape`, by sums over 2001 states; beyond 3 nothing comes back."""
    model, seq, _ = _escape(start)
    grid = np.linspace(-3, 3, 2001)
    (q, r), y = (float(jnp.exp(a[0])) for a in (model.log_q, model.log_r)), np.asarray(seq.y)[:, 0]
    gauss = lambda e, v: np.exp(-0.5 * e**2 / v) / np.sqrt(2 * np.pi * v)  # noqa: E731
    move = gauss(grid[:, None] - (grid + 2 * grid**3)[None], q) * (grid[1] - grid[0])
    p, loglik = gauss(grid - start, 0.01), 0.0
    for k in range(16):
        p = move @ p if k else p
        p = p if np.isnan(y[k]) else p * gauss(y[k] - grid, r)
        mass = p.sum() * (grid[1] - grid[0])
        loglik, p = loglik + np.log(mass), p / mass
    return loglik


def test_a_particle_that_runs_away_leaves_the_others_alone():
    history, paths = _escaped(jnp.asarray(0.0))
    assert np.any(np.isneginf(history.log_w))  # there are some
    loglik = np.asarray(history.loglik)
    error = 4 * np.std(loglik, ddof=1) / np.sqrt(20)
    # the log of an unbiased estimate is low by half its variance
    assert abs(np.mean(loglik) + 0.5 * np.var(loglik) - _density_on_a_grid(0.0)) < error
    assert np.max(np.abs(paths.x)) < 1.5 and np.max(np.abs(paths.kick)) < 1.0
    # where no particle is left the likelihood is nothing
    history, paths = _escaped(jnp.asarray(5.0))
    assert np.all(np.isneginf(history.loglik))
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves((paths, history.ess)))
