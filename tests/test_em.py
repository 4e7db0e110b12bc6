"""EM as a whole: against the direct maximum of the likelihood, invariances, and the recovery of known friction."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

from nnap_em.data.dataset import Dataset
from nnap_em.data.rig import Declared, Rig
from nnap_em.em.loop import FitError, Schedule
from nnap_em.fit.identify import Identified, begin, friction_table, identify
from nnap_em.model.base import prepare
from nnap_em.model.simulate import Experiment, examples, simulate, sweep_experiment
from nnap_em.model.state_space import StateSpaceModel
from nnap_em.numerics.gaussian import Gaussian
from nnap_em.smoother.kalman import ekf
from nnap_em.systems import specs, systems
from nnap_em.systems.slide import Slide


class _Viscous(eqx.Module):
    damping: jax.Array

    def __call__(self, v):
        return -self.damping * v


def _rig(kind: str, model: StateSpaceModel) -> Rig:
    """What the owner of `model` declares: its physics; friction and noises are unknown."""
    names = [n for n in (*specs[kind].parameters, *specs[kind].optional)]
    parameters = {n: Declared(float(getattr(model.system, n)), 0.0) for n in names}
    measured = tuple(specs[kind].states[i] for i in model.measured)
    return Rig(kind, kind, parameters, True, ("u",), model.system.joints, model.dt, "sequence", measured, {}, {})


def _slide(damping: float = 0.8) -> StateSpaceModel:
    start = Gaussian(jnp.zeros(2), jnp.diag(jnp.asarray([0.1, 0.3]) ** 2))
    log_q = 2 * jnp.log(jnp.asarray([0.02 * 5e-3, 5e-3]))  # a kick of the rate moves the position over one step
    system = Slide(m=jnp.asarray(1.3), joints=(1,))
    return StateSpaceModel(
        system, _Viscous(jnp.asarray([damping])), start, log_q, jnp.log(jnp.asarray([1e-6])), (0,), 0.02
    )


def _slide_logs(model: StateSpaceModel) -> Experiment:
    key_start, key_run = jax.random.split(jax.random.key(5))
    x0 = jax.random.normal(key_start, (6, 2)) * jnp.sqrt(jnp.diag(model.start.cov))[None]
    t = model.dt * jnp.arange(120.0)[None]
    amplitude, period = (jnp.linspace(*ends, 6)[:, None] for ends in ((1.0, 4.0), (1.5, 0.7)))
    return simulate(model, x0, (amplitude * jnp.sin(2 * jnp.pi * t / period))[..., None], key=key_run)


class _Run(NamedTuple):
    truth: StateSpaceModel
    rig: Rig
    logs: Experiment
    fitted: Identified
    seen: list[int]
    used: list[np.ndarray]


def _identify(rig: Rig, data: Dataset, **options):
    seen, used = [], []

    def watch(state, samples, kept):
        seen.append(samples)
        used.append(kept)

    return identify(rig, data, key=jax.random.key(1), watch=watch, **options), seen, used


@pytest.fixture(scope="module")
def run() -> _Run:
    truth = _slide()
    logs, rig = _slide_logs(truth), _rig("slide", truth)
    return _Run(truth, rig, logs, *_identify(rig, logs.data))


def _curve(model: StateSpaceModel, v) -> np.ndarray:
    return np.asarray(jax.vmap(model.unknown)(jnp.asarray(v).reshape(-1, 1)))[:, 0]


def _error(model: StateSpaceModel, truth: StateSpaceModel, x) -> float:
    """RMS(learned - true) / RMS(true) over all velocities as often as they were visited."""
    v = np.asarray(x)[..., 1].ravel()
    wanted = _curve(truth, v)
    return float(np.sqrt(np.mean((_curve(model, v) - wanted) ** 2) / np.mean(wanted**2)))


@eqx.filter_jit
def _loglik(model: StateSpaceModel, data: Dataset):
    def one(seq):
        return ekf(model, model.start, prepare(model, seq)).loglik

    return jnp.sum(jax.vmap(one)(data))


def test_fit_is_the_maximum_likelihood_estimate(run):
    """The same slide with its friction as one number, its Kalman likelihood climbed by another optimiser."""
    best = run.fitted.model
    system = eqx.tree_at(lambda m: m.unknown, best, _Viscous(jnp.ones(1)))  # the same start prior

    def model(p):
        log_q = jnp.asarray([2 * p[1] + 2 * np.log(run.truth.dt), 2 * p[1]])
        parts = (_Viscous(jnp.asarray([p[0]])), log_q, jnp.asarray([2 * p[2]]))
        return eqx.tree_at(lambda m: (m.unknown, m.log_q, m.log_r), system, parts)

    loss = lambda p: -float(_loglik(model(p), run.logs.data))  # noqa: E731
    peak = minimize(
        loss, [0.5, np.log(1e-2), np.log(2e-3)], method="Nelder-Mead", options={"fatol": 1e-4, "xatol": 1e-5}
    )
    h = 1e-2 * np.eye(3)
    hessian = [
        [loss(peak.x + a + b) - loss(peak.x + a - b) - loss(peak.x - a + b) + loss(peak.x - a - b) for a in h]
        for b in h
    ]
    std = np.sqrt(np.diag(np.linalg.inv(np.asarray(hessian) / 4e-4)))
    v = np.asarray(run.logs.x)[..., 1].ravel()
    slope = -float(v @ _curve(best, v) / (v @ v))
    fitted = np.asarray([slope, 0.5 * float(best.log_q[1]), 0.5 * float(best.log_r[0])])
    # a network is a richer model than a line, and its weights have a prior: half a standard deviation
    np.testing.assert_array_less(np.abs(fitted - peak.x) / std, 0.5)
    assert -peak.fun - 1.0 < float(_loglik(best, run.logs.data))  # richer, so no less likely; a nat for the priors
    truth = np.asarray([0.8, np.log(5e-3), np.log(1e-3)])
    assert np.all(np.abs(peak.x - truth) < 4 * std)


def test_likelihood_rises_at_the_full_horizon(run):
    full = np.asarray(run.seen) == run.logs.data.t.shape[1]
    loglik = run.fitted.state.loglik[full]
    assert len(loglik) >= 3

    # the smoother draws nothing: what an epoch loses is the error of its linearisation, of some 600 nats
    assert np.all(np.diff(loglik) > -0.01)
    assert loglik[-1] > loglik[0] + 0.1


def test_same_seed_same_numbers(run):
    again, *_ = _identify(run.rig, run.logs.data)
    for a, b in zip(jax.tree.leaves(run.fitted.model), jax.tree.leaves(again.model), strict=True):
        np.testing.assert_array_equal(a, b)


FEW = {"epochs": 3, "schedule": Schedule(first=10**6)}


def test_order_of_sequences_does_not_matter(run):
    v = np.linspace(-1.5, 1.5, 31)
    plain, *_ = _identify(run.rig, run.logs.data, **FEW)
    order = np.asarray([3, 1, 5, 0, 2, 4])
    other, *_ = _identify(run.rig, jax.tree.map(lambda a: a[order], run.logs.data), **FEW)
    # sums in another order: rounding, made larger by the fit of the weights, which stops 1e-3 nats from its optimum
    np.testing.assert_allclose(_curve(other.model, v), _curve(plain.model, v), atol=1e-6)
    np.testing.assert_allclose(other.state.loglik, plain.state.loglik, rtol=1e-9)


def _padded(data: Dataset) -> Dataset:
    """30 rows more, as `pad` writes them."""
    t, u, y, valid = (np.concatenate([a, np.repeat(a[:, -1:], 30, axis=1)], axis=1) for a in data)
    u[:, 120:], y[:, 120:], valid[:, 120:] = 0.0, np.nan, False
    return jax.tree.map(jnp.asarray, Dataset(t, u, y, valid))


def test_padding_does_not_matter(run):
    v = np.linspace(-1.5, 1.5, 31)
    start = begin(run.rig, run.logs.data, key=jax.random.key(1))
    plain, *_ = _identify(run.rig, run.logs.data, **FEW, start=start)
    padded, *_ = _identify(run.rig, _padded(run.logs.data), **FEW, start=start)
    np.testing.assert_allclose(padded.state.loglik, plain.state.loglik, rtol=1e-9)
    np.testing.assert_allclose(_curve(padded.model, v), _curve(plain.model, v), atol=1e-6)


def test_padding_does_not_change_the_first_model(run):
    plain, padded = (begin(run.rig, d, key=jax.random.key(1)).model for d in (run.logs.data, _padded(run.logs.data)))
    plain, padded = (jax.tree.leaves(eqx.filter(m, eqx.is_array)) for m in (plain, padded))
    for a, b in zip(plain, padded, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12)


def test_garbage_is_left_out(run):
    """Readings of one sequence drawn at random over the range of the others, against that sequence not read at all."""
    y = np.array(run.logs.data.y)
    y[2] = np.random.default_rng(0).uniform(y.min(), y.max(), y[2].shape)
    start = begin(run.rig, run.logs.data, key=jax.random.key(1))
    fitted, _, used = _identify(run.rig, run.logs.data._replace(y=jnp.asarray(y)), start=start)
    missing, *_ = _identify(run.rig, run.logs.data._replace(y=run.logs.data.y.at[2].set(jnp.nan)), start=start)
    np.testing.assert_array_equal(used[-1], [True, True, False, True, True, True])
    v = np.sort(np.asarray(run.logs.x)[[0, 1, 3, 4, 5], :, 1].ravel())[::20]
    table = friction_table(missing, jnp.asarray(v)[None])
    z = (_curve(fitted.model, v) - np.asarray(table.torque[0])) / np.asarray(table.std[0])
    # the same data counts; both stop within a fraction of a nat of the optimum
    assert np.sqrt(np.mean(z**2)) < 0.5


def test_all_lost_is_said(run):
    data = run.logs.data._replace(y=jnp.full(run.logs.data.y.shape, jnp.inf))
    state = begin(run.rig, run.logs.data, key=jax.random.key(0))
    with pytest.raises(FitError, match="epoch 1: all 6 sequences diverge"):
        identify(run.rig, data, key=jax.random.key(0), start=state)


@pytest.mark.slow  # fast: test_fit_is_the_maximum_likelihood_estimate
@pytest.mark.parametrize("kind", ["slide", "pendulum"])
def test_friction_curve_is_recovered(kind):
    """Position read only, Stribeck friction: NRMSE below 3 %, the demand of the project."""
    example = examples[kind]()
    logs = sweep_experiment(example.model, example.sweep, 20, 300, key=jax.random.key(0))
    assert kind in systems and example.model.measured == (0,)
    fitted, _, used = _identify(_rig(kind, example.model), logs.data)
    assert used[-1].all()
    assert _error(fitted.model, example.model, logs.x) < 0.03
