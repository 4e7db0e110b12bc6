import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from jaxtyping import Array, Float

from nnap_em.data.dataset import Dataset, fill_missing, stepped
from nnap_em.model.base import AbstractModel, prepare
from nnap_em.model.simulate import examples, sweep_experiment
from nnap_em.model.state_space import Inputs
from nnap_em.numerics.gaussian import Gaussian
from nnap_em.smoother.gaussian import ExtendedKalmanSmoother
from nnap_em.smoother.kalman import Reading, Tangent, kalman_filter
from nnap_em.smoother.particle import (
    Bootstrap,
    ExactBackward,
    Guided,
    Lookahead,
    ParticleSmoother,
    Potentials,
    ffbs,
    particle_filter,
)
from nnap_em.smoother.particle.resampling import systematic
from nnap_em.smoother.start import StartBank

PROPOSALS = {"bootstrap": Bootstrap(), "guided": Guided(), "lookahead": Lookahead(1.0), "tempered": Lookahead(0.8)}
SEEDS, PARTICLES = 100, 200


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


def _guide(dim):
    return ExtendedKalmanSmoother(StartBank((1,) * dim), iterations=1)


@eqx.filter_jit
def _run_linear(model, seq, potentials, keys, dtype):
    def run(key):
        key_filter, key_paths = jax.random.split(key)
        history = particle_filter(model, potentials, seq, num_particles=PARTICLES, key=key_filter, dtype=dtype)
        return history.loglik, history.ess, ffbs(history, ExactBackward(), num_paths=40, key=key_paths)

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
        path = _guide(2).path(model, prepare(model, seq))
        potentials = {name: proposal(model, prepare(model, seq), *path) for name, proposal in PROPOSALS.items()}
        return *path, potentials, jax.grad(loglik, argnums=(0, 1, 2))(model.log_q, model.log_r, jnp.zeros(2))

    return run()


@functools.cache
def _linear_runs(name):
    """SEEDS independent runs of a proposal: log-likelihoods, effective sample sizes, and the trajectories."""
    model, seq = _linear()
    proposal, _, double = name.partition(", ")
    keys = jax.random.split(jax.random.key(5), SEEDS)
    return _run_linear(model, prepare(model, seq), _exact()[2][proposal], keys, float if double else jnp.float32)


def _within(samples, known, sigmas=4.5):
    """Means over runs equal `known` within standard errors: 4.5 leaves 1 in 1000 for the 180 numbers of a test."""
    error = np.std(samples, axis=0, ddof=1) / np.sqrt(len(samples))
    assert np.all(np.abs(np.mean(samples, axis=0) - known) < sigmas * error)


RUNS = pytest.mark.parametrize("run", [*PROPOSALS, "guided, double"])


@RUNS
def test_trajectories_have_the_moments_of_the_exact_smoother(run):
    (model, seq), (_, smoothed, _, score), (_, _, paths) = _linear(), _exact(), _linear_runs(run)
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


@RUNS
def test_likelihood_is_unbiased(run):
    loglik, _, paths = _linear_runs(run)
    assert loglik.dtype == paths.x.dtype == jnp.float64  # whatever the type of the particles
    ratio = np.exp(np.asarray(loglik - _exact()[0].loglik))
    error = 4 * np.std(ratio, ddof=1) / np.sqrt(SEEDS) + 1e-5  # the last for single precision
    assert abs(np.mean(ratio) - 1) < error


def test_full_lookahead_is_perfect_on_a_linear_system():
    loglik, ess, _ = _linear_runs("lookahead")
    # single precision: 31 steps of log weights of size 10, eps 6e-8 each
    np.testing.assert_allclose(loglik, _exact()[0].loglik, atol=2e-4)
    np.testing.assert_allclose(ess, PARTICLES, rtol=1e-4)


def test_sight_saves_particles():
    ess = [np.mean(np.asarray(_linear_runs(p)[1])) for p in ("bootstrap", "guided", "lookahead")]
    assert ess[0] < ess[1] < ess[2]


@eqx.filter_jit
def _smooth(model, seq, key):
    return ParticleSmoother(_guide(2), num_particles=50, num_paths=20)(model, prepare(model, seq), key=key)


def test_padding_changes_no_number_and_one_key_gives_one_result():
    model, seq = _linear()
    short, same, other = (_smooth(model, seq, key=jax.random.key(k)) for k in (2, 2, 8))
    assert all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(short), jax.tree.leaves(same), strict=True))
    assert not np.array_equal(short.prev, other.prev)
    padded = stepped(jax.tree.map(lambda a: a[None], seq), 40)
    long = _smooth(model, jax.tree.map(lambda a: jnp.asarray(a[0]), padded), key=jax.random.key(2))
    n = seq.y.shape[0]
    # the random numbers are the same; the two compiled programs may round differently in the last single digit
    for a, b in ((long.prev, short.prev), (long.next, short.next), (long.kick, short.kick)):
        np.testing.assert_allclose(a[: n - 1], b, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(long.loglik, short.loglik, atol=1e-5)
    assert np.all(np.asarray(long.kick[n - 1 :]) == 0)
    assert np.all(np.asarray(long.next[n - 1 :] - long.prev[n - 1 :]) == 0)


@pytest.mark.parametrize("rule", (ExactBackward(), ExactBackward(5)), ids=repr)
def test_backward_step_draws_from_its_law(rule):
    draws = 20_000
    key_f, key_w, key = jax.random.split(jax.random.key(11), 3)
    f, log_w = jax.random.normal(key_f, (3, 37)), jax.random.normal(key_w, (37,))
    target = jnp.array([0.3, -0.5, 0.1])
    index = jax.jit(rule)(jnp.tile(target[:, None], (1, draws)), f, log_w, jax.random.uniform(key, (draws,)))
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
    blind = Potentials(jnp.zeros((rows, 2)), jnp.zeros((rows, 2, 2)), jnp.zeros((rows, 2)))
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
    return model, seq, Potentials(path, zero, path)


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


# fast: the same of a pendulum
@pytest.mark.parametrize("name", ["pendulum", pytest.param("acrobot", marks=pytest.mark.slow)])
def test_a_machine_agrees_with_the_kalman_smoother(name):
    """Part of the state is read, in some of the rows; the kick of a path is its process noise."""
    model, sweep = examples[name]()
    std = jnp.asarray([0.9, 0.05, 0.02, 0.02][: len(model.log_q)])  # of the first row, small beside the motion
    model = eqx.tree_at(lambda m: m.start.cov, model, jnp.diag(std**2))
    seq = jax.tree.map(lambda a: a[0], sweep_experiment(model, sweep, 1, 80, key=jax.random.key(4)).data)
    seq = seq._replace(y=seq.y.at[30:40].set(jnp.nan).at[60, -1].set(jnp.nan))

    @jax.jit
    def run(key):
        key_filter, key_paths = jax.random.split(key)
        prepared = prepare(model, seq)
        filtered, smoothed = _guide(len(std)).path(model, prepared)
        potentials = Lookahead()(model, prepared, filtered, smoothed)
        history = particle_filter(model, potentials, prepared, num_particles=300, key=key_filter)
        paths = ffbs(history, ExactBackward(), num_paths=400, key=key_paths)
        step = jax.vmap(jax.vmap(model.transition, in_axes=(0, None)))
        kick = paths.x[1:] - step(paths.x[:-1], jax.vmap(Inputs.held)(seq.u[:-1]))
        return filtered.loglik, smoothed, history.ess, history.loglik, paths, kick

    loglik_kalman, smoothed, ess, loglik, exact, kick = run(jax.random.key(9))
    mean, cov = map(np.asarray, smoothed.state)
    std = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    x = np.asarray(exact.x)
    # mean of 400 paths through 300 particles: error std sqrt(1/400 + 1/300) = 0.08 std, the curvature of f on top
    assert np.sqrt(np.mean(((x.mean(axis=1) - mean) / std) ** 2)) < 0.2
    assert abs(np.mean(np.log(x.std(axis=1) / std))) < 0.1
    assert np.min(ess) > 150
    assert abs(float(loglik - loglik_kalman)) < 0.5
    # the cached f is good to single rounding of the state: some eps * |x| = 6e-7, against a process noise of 2e-4
    np.testing.assert_allclose(exact.kick, kick, atol=1e-5)
