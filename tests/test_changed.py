"""Searches that begin from a fit: its posterior is the prior, a change is found alone."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rigs import slide_logs, slide_rig

from nnap_em import diagnose, findings, identify
from nnap_em.errors import DataError
from nnap_em.estimate.em.multistep import Linear
from nnap_em.estimate.em.recorded import Risen, level, risen
from nnap_em.estimate.identify import begin
from nnap_em.estimate.known import differences, known
from nnap_em.estimate.store import load, save
from nnap_em.explain.diagnosis.findings import changes
from nnap_em.explain.diagnosis.outcome import Diagnosis
from nnap_em.explain.diagnosis.verdict import KEEP, RISEN, veto
from nnap_em.machines.rig import Declared
from nnap_em.model.effects.position import TorsionalSpring

GROWN = 0.2
"""Growth of the Coulomb friction of a slide [N]; it is 1."""
LONG = {"steps": 200}
"""Recordings in which the change is found with its size: 95 steps are too few."""


# --- the posterior of a fit as a prior


def test_a_fit_from_a_fit_is_that_of_all_logs():
    """Precisions add, and the mean is weighted by them, as Bayes' rule has it: exact for likelihoods that are quadratic
    in the friction and the mass.
    """
    rig, data = slide_rig(friction=False), slide_logs(0, frictionless=True)
    declared = begin(rig, data, key=jax.random.key(0))
    size = declared.state.hessian.shape[0]
    half, score = (np.random.default_rng(0).normal(size=(2, *shape)) for shape in ((size, size), (size,)))
    information, still = half @ np.swapaxes(half, 1, 2), jnp.zeros(size)

    def fitted(fit, score, information):
        """Mass and posterior precision after an M-step from a likelihood expanded about `fit`."""
        weights = fit.m_step.weights(fit.model)
        w = weights.fit(fit.model.unknown, weights.read(fit.model), score, information, 200)
        model = weights.write(fit.model, w)
        hessian = information + weights.prior_precision(model.unknown)
        return fit._replace(state=fit.state._replace(model=model, best=model, hessian=hessian))

    one = fitted(declared, score[0], information[0])
    moved = still.at[-1].set((one.model.system.m - declared.model.system.m) / declared.m_step.prior.std[0])
    two = fitted(known(one, rig, data, key=jax.random.key(0)), score[1] - information[1] @ moved, information[1])
    both = fitted(declared, score.sum(axis=0), information.sum(axis=0))
    assert abs(moved[-1]) > 0.01
    np.testing.assert_allclose(two.model.system.m, both.model.system.m, rtol=1e-6)
    np.testing.assert_allclose(two.state.hessian, both.state.hessian, rtol=1e-9)


def test_rigs_that_differ_are_named_key_by_key():
    rig = slide_rig()
    assert differences(rig, dataclasses.replace(rig, name="another")) == []
    heavier = dataclasses.replace(rig, parameters={"m": Declared(1.3, 0.1)})
    assert differences(rig, heavier) == ["m of parameters is 1.1 +- 0.1 in the fit and 1.3 +- 0.1 here"]
    with pytest.raises(DataError, match=r"is not that of the fit: dt is 0.01 in the fit and 0.02 here"):
        differences(rig, dataclasses.replace(rig, dt=0.02))
    with pytest.raises(DataError, match="written as equations"):
        differences(rig, dataclasses.replace(rig, equations="x' = -x"))


# --- the search


@pytest.mark.slow  # fast: test_a_machine_that_did_not_change_is_said_to_be_the_same
def test_friction_that_grew_is_named_with_its_size(tmp_path):
    """Inside two of its standard deviations, alone; stored with the machine as it is now, and there no finding."""
    before = identify(slide_rig(), slide_logs(0, **LONG), key=jax.random.key(0))
    new, old = slide_logs(1, GROWN, **LONG), slide_logs(0, **LONG)
    closed = diagnose(slide_rig(), new, key=jax.random.key(0), start=before, own=old)
    (found,) = findings(closed)
    change = found.parameters["change"]
    assert found.effect.name == "coulomb_change"
    assert abs(change.value - GROWN) < 2 * change.std < 0.1 * GROWN
    said = changes(closed, [found])  # a drift that is over within a recording explains the same
    assert said.startswith("Changed since the fit: ") and "the Coulomb friction of joint 1 by 0." in said
    save(tmp_path / "after.npz", closed.after)
    assert float(load(tmp_path / "after.npz").model.effects[0].change) == float(found.effect.change)
    new, own = slide_logs(3, GROWN, **LONG), slide_logs(1, GROWN, **LONG)
    again = diagnose(slide_rig(), new, key=jax.random.key(0), start=closed.after, own=own)
    assert not findings(again) and changes(again, []).startswith("Nothing changed since the fit")
    assert [effect.name for effect in again.after.model.effects] == ["coulomb_change"]


def test_a_machine_that_did_not_change_is_said_to_be_the_same(slide_fit):
    closed = diagnose(slide_rig(), slide_logs(2), key=jax.random.key(0), start=slide_fit, own=slide_logs(0))
    assert not findings(closed) and closed.risen.p_value > RISEN
    assert changes(closed, []).startswith("Nothing changed since the fit that these recordings could show: errors")


@pytest.mark.slow  # fast: test_a_machine_that_did_not_change_is_said_to_be_the_same
def test_a_law_that_was_missing_before_is_no_change():
    """A spring that neither the rig nor the fit knows, in all recordings: 2 N/m."""
    spring, said = TorsionalSpring.of(2.0, 0.0, 0.0, 0.0, joint=1), []
    first, second = (slide_logs(seed, laws=(spring,), **LONG) for seed in (0, 1))
    before = identify(slide_rig(), first, key=jax.random.key(0))
    closed = diagnose(slide_rig(), second, key=jax.random.key(0), start=before, own=first, log=said.append)
    assert not findings(closed), said
    assert any("spring" in line and "missing there, and no change" in line for line in said), said


def test_a_law_that_the_recordings_of_the_fit_show_as_well_is_no_change():
    assert veto(True, 0.5, 0.15) is veto(True, 0.5, 0.15, KEEP * 0.15 - 0.01) is None
    assert "no change" in veto(True, 0.5, 0.15, KEEP * 0.15 + 0.01)


def test_where_nothing_explains_it_the_errors_decide():
    for p, least, text in (
        (0.9 * RISEN, 1e-3, "Something changed"),
        (1.1 * RISEN, 0.9 * RISEN, "Nothing changed"),
        (1.1 * RISEN, 1.1 * RISEN, "Nothing is certain to have changed"),
    ):
        outcome = Diagnosis(None, None, (), (), change=True, risen=Risen(2.0, p, least))  # type: ignore[arg-type]
        assert changes(outcome, []).startswith(text) and "errors are 2.0 times" in changes(outcome, [])
    assert "not at hand" in changes(outcome._replace(risen=None), [])


# --- errors by recording


def test_errors_left_out_are_those_of_a_fit_without_the_recording():
    """A linear problem: one step is exact."""
    rng = np.random.default_rng(0)
    columns, weight = rng.normal(size=(5, 30, 1, 1, 4)), rng.uniform(0.5, 2, (5, 30, 1, 1))
    prior, y = np.diag([1.0, 2.0, 0.5, 0.1]), rng.normal(size=(5, 30, 1, 1))

    def solved(some):
        c, w, e = columns[some].reshape(-1, 4), weight[some].ravel(), y[some].ravel()
        return np.linalg.solve(prior + c.T @ (w[:, None] * c), c.T @ (w * e))

    error = y - columns @ solved(np.arange(5))
    out = Linear(error, columns, weight, np.ones(1)).left_out(prior)
    for i in range(5):
        np.testing.assert_allclose(out[i], y[i] - columns[i] @ solved(np.arange(5) != i), rtol=1e-9)


def test_the_level_of_a_recording_is_the_log_of_its_rms_and_larger_ones_are_seen():
    rng = np.random.default_rng(1)
    error = rng.normal(size=(3, 4000, 1, 1)) * np.array([1.0, 2.0, 4.0])[:, None, None, None]
    np.testing.assert_allclose(level(1e-3 * error, np.ones((1, 1))), np.log(1e-3 * np.array([1, 2, 4])), atol=0.05)
    now, before = np.log([3.0, 2.5, 4.0, 3.5]), np.log([1.0, 1.2, 0.9, 1.1])
    assert risen(before, now).p_value == risen(before, now).least == pytest.approx(1 / math.comb(8, 4))
    assert risen(before, now).ratio == pytest.approx(math.exp(np.median(now) - np.median(before)))
