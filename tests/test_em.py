"""EM as a whole: against the direct maximum of the likelihood, invariances, and the recovery of known friction."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

from nnap_em.estimate.em.loop import em_step
from nnap_em.estimate.identify import Identified, begin, identify
from nnap_em.estimate.smoother.kalman import ekf
from nnap_em.logs.dataset import Dataset, stepped
from nnap_em.machines.rig import Rig
from nnap_em.model.base import prepare
from nnap_em.model.simulate import Experiment, declared, examples, sweep_experiment
from nnap_em.model.state_space import StateSpaceModel

KEY = jax.random.key(1)
SPEEDS = np.linspace(-1.5, 1.5, 31)


class _Viscous(eqx.Module):
    damping: jax.Array

    def __call__(self, v):
        return -self.damping * v


def _rig(kind: str, model: StateSpaceModel) -> Rig:
    """The declaration of the physics of `model`; its friction, start and noises are unknown."""
    return dataclasses.replace(declared(kind, model), noise_std={}, start={})


class _Run(NamedTuple):
    truth: StateSpaceModel
    rig: Rig
    logs: Experiment
    fitted: Identified
    seen: list[int]


@pytest.fixture(scope="module")
def run() -> _Run:
    """A fit to eight sequences of a slide with viscous friction."""
    model, sweep = examples["slide"]()
    log_q = 2 * jnp.log(jnp.asarray([0.01 * 5e-3, 5e-3]))  # a kick of the rate moves the position over one step
    parts = _Viscous(jnp.asarray([0.8])), log_q, 2 * jnp.log(jnp.asarray([2e-4]))
    truth = eqx.tree_at(lambda m: (m.unknown, m.log_q, m.log_r), model, parts)
    logs, rig, seen = sweep_experiment(truth, sweep, 8, 95, key=jax.random.key(5)), _rig("slide", truth), []
    fitted = identify(rig, logs.data, key=KEY, watch=lambda state, rows, used: seen.append(rows))
    return _Run(truth, rig, logs, fitted, seen)


def _curve(model: StateSpaceModel, v=SPEEDS) -> np.ndarray:
    return np.asarray(jax.vmap(model.unknown)(jnp.asarray(v).reshape(-1, 1)))[:, 0]


@eqx.filter_jit
def _loglik(model: StateSpaceModel, data: Dataset):
    return jnp.sum(jax.vmap(lambda seq: ekf(model, model.start, prepare(model, seq)).loglik)(data))


def test_fit_is_the_maximum_likelihood_estimate(run):
    """The same slide with its friction as one number, its Kalman likelihood climbed by another optimiser."""
    best = run.fitted.model
    system = eqx.tree_at(lambda m: m.unknown, best, _Viscous(jnp.ones(1)))  # the same start prior

    def loss(p):
        log_q = jnp.asarray([2 * p[1] + 2 * np.log(run.truth.dt), 2 * p[1]])
        parts = _Viscous(jnp.asarray([p[0]])), log_q, jnp.asarray([2 * p[2]])
        return -float(_loglik(eqx.tree_at(lambda m: (m.unknown, m.log_q, m.log_r), system, parts), run.logs.data))

    start, options = [0.5, np.log(1e-2), np.log(1e-3)], {"fatol": 1e-4, "xatol": 1e-5}
    peak = minimize(loss, start, method="Nelder-Mead", options=options)
    h = 1e-2 * np.eye(3)
    bent = lambda a, b: loss(peak.x + a + b) - loss(peak.x + a - b) - loss(peak.x - a + b) + loss(peak.x - a - b)  # noqa: E731
    hessian = [[bent(a, b) for a in h] for b in h]
    std = np.sqrt(np.diag(np.linalg.inv(np.asarray(hessian) / 4e-4)))
    v = np.asarray(run.logs.x)[..., 1].ravel()
    slope = -float(v @ _curve(best, v) / (v @ v))
    fitted = np.asarray([slope, 0.5 * float(best.log_q[1]), 0.5 * float(best.log_r[0])])
    # a network is a richer model than a line, and its weights have a prior: half a standard deviation
    np.testing.assert_array_less(np.abs(fitted - peak.x) / std, 0.5)
    assert -peak.fun - 1.0 < float(_loglik(best, run.logs.data))  # richer, so no less likely; a nat for the priors
    assert np.all(np.abs(peak.x - [0.8, np.log(5e-3), np.log(2e-4)]) < 4 * std)
    loglik = run.fitted.state.loglik[np.asarray(run.seen) == run.logs.data.t.shape[1]]
    # the smoother draws nothing: what an epoch loses is the error of its linearisation
    assert len(loglik) >= 3 and np.all(np.diff(loglik) > -0.01) and loglik[-1] > loglik[0] + 0.1


def test_order_of_sequences_does_not_matter_and_garbage_is_left_out(run):
    """Readings of one sequence drawn at random over the range of the others, against none, which say nothing either."""
    fitted, data = run.fitted, run.logs.data
    y = np.array(data.y)
    y[2] = np.random.default_rng(0).uniform(y.min(), y.max(), y[2].shape)
    spoilt, missing = data._replace(y=jnp.asarray(y)), data._replace(y=data.y.at[2].set(jnp.nan))
    order = np.asarray([3, 1, 5, 0, 2, 7, 6, 4])

    def step(data, used):
        model, info, *_ = em_step(fitted.model, data, fitted.smoother, fitted.m_step, KEY)
        np.testing.assert_array_equal(info.used, used)
        return _curve(model), model.log_q, model.log_r, info.hessian

    expected = step(missing, np.arange(8) != 2)
    for one, place in ((spoilt, 2), (jax.tree.map(lambda a: a[order], spoilt), 4)):
        for a, b in zip(step(one, np.arange(8) != place), expected, strict=True):
            # sums in another order: rounding, made larger by the fit of the weights, which stops 1e-3 nats from its
            # optimum
            np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-6)


def test_padding_does_not_change_the_first_model(run):
    data = run.logs.data
    plain, padded = (begin(run.rig, d, key=KEY).model for d in (data, stepped(data, 126)))
    plain, padded = (jax.tree.leaves(eqx.filter(m, eqx.is_array)) for m in (plain, padded))
    for a, b in zip(plain, padded, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12)


@pytest.mark.slow  # fast: test_fit_is_the_maximum_likelihood_estimate
def test_friction_curve_is_recovered(kind="slide"):
    """Position read only, Stribeck friction: NRMSE over all velocities as often as they were visited, below 3 %."""
    example = examples[kind]()
    logs, used = sweep_experiment(example.model, example.sweep, 20, 300, key=jax.random.key(0)), []
    rig = _rig(kind, example.model)
    fitted = identify(rig, logs.data, key=KEY, watch=lambda state, rows, one: used.append(one))
    assert used[-1].all()
    learned, wanted = (_curve(m, np.asarray(logs.x)[..., 1].ravel()) for m in (fitted.model, example.model))
    assert np.sqrt(np.mean((learned - wanted) ** 2) / np.mean(wanted**2)) < 0.03
