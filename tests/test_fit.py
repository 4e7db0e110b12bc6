"""What a fit accepts, refuses and goes back from, by numbers: nothing is smoothed here."""

from types import SimpleNamespace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import slide

from nnap_em.base.gaussian import Gaussian
from nnap_em.estimate import identify
from nnap_em.estimate.em import loop, multistep, stated
from nnap_em.estimate.em.loop import EMState, Schedule
from nnap_em.estimate.em.mstep import MStepInfo, ScoringMStep
from nnap_em.estimate.em.multistep import Followed, Linear, OpenLoop
from nnap_em.estimate.identify import Identified
from nnap_em.estimate.smoother.gaussian import CubatureSmoother
from nnap_em.estimate.smoother.start import StartBank
from nnap_em.explain.diagnosis import refit as refits
from nnap_em.logs.dataset import Dataset

MODEL, RULE = slide()
DATA = Dataset(*(np.zeros((4, 9, *shape)) for shape in ((), (1,), (2,))), np.ones((4, 9), bool))
PATH = Gaussian(jnp.zeros((4, 9, 2)), jnp.zeros((4, 9, 2, 2)))


def _fake(monkeypatch, module, **values) -> None:
    """Stand-ins of some names of a module."""
    for name, value in values.items():
        monkeypatch.setattr(module, name, value)


def _heavy(mass: float):
    return eqx.tree_at(lambda m: m.system.m, MODEL, jnp.asarray(mass))


def _mass(model) -> float:
    return float(model.system.m)


def _followed(model, *_) -> Followed:
    """`model` along no path."""
    return Followed(model, *(5 * [None]))


def _state(top, stride: float = 0.6, **changes) -> EMState:
    """After an epoch that tried a mass of 1.5, the best being 1 and the M-step's wish 4."""
    state = EMState(
        3, _heavy(1.5), _heavy(1.0), _heavy(4.0), jnp.zeros((1, 1)), np.asarray(top), stride, jax.random.key(0),
        np.zeros(3), np.inf,
    )  # fmt: skip
    return state._replace(**changes)


JUDGED = {  # likelihood of 1.5, use of the sequences, what is best then, the next stride, what is tried next
    "likelier": ([1.0, 3.0], [1, 1], 1.5, 1.0, 2.5),
    "half a nat is noise": ([0.0, 1.1], [1, 1], 1.5, 1.0, 2.5),
    "worse: back, and a third of the way from the best": ([0.0, 0.9], [1, 1], 1.0, 0.2, 1.0 + 0.2 * 3.0),
    "worse where it was left out": ([1.0, -1e9], [1, 0], 1.5, 1.0, 2.5),
}


@pytest.mark.parametrize(("loglik", "used", "best", "stride", "tried"), JUDGED.values(), ids=JUDGED)
def test_a_model_is_judged_by_its_likelihood(loglik, used, best, stride, tried):
    used = np.array(used) > 0
    begun = _state(np.where(used, [0.0, 2.0], np.nan))
    after = loop._judge(begun, _heavy(2.5), jnp.ones((1, 1)), np.array(loglik), used)
    assert (_mass(after.best), after.epoch) == (best, 4)
    assert (after.stride, _mass(after.model)) == (pytest.approx(stride), pytest.approx(tried))
    assert _mass(after.proposal) == (2.5 if best == 1.5 else 4.0)
    np.testing.assert_array_equal(after.top, np.where(used, loglik, np.nan) if best == 1.5 else begun.top)
    np.testing.assert_array_equal(after.loglik, [0, 0, 0, np.mean(np.array(loglik)[used])])


class _Along(NamedTuple):
    """An M-step whose likelihood of a mass is that along the path of the best."""

    best: float
    tried: float

    def loglik(self, model, path, data):
        assert path is PATH
        return np.array({1.0: self.best, 1.5: self.tried}[_mass(model)] + np.array([0.0, 2.0, np.nan]))


PATHS = [  # likelihoods of the best and of the tried along one path, use, effective sample size, whether it is taken
    (-40.0, 1.0, [1, 1, 0], np.inf, True),  # rises by 41, known to 40
    (40.0, 79.0, [1, 1, 0], np.inf, False),
    (-40.0, 1.0, [1, 0, 0], np.inf, False),  # a sequence is lost
    (-40.0, 1.0, [1, 1, 0], 100.0, False),  # of samples it would be chance
]


def test_a_fall_along_its_own_path_is_judged_along_the_path_of_the_step():
    """Likelihoods along different paths differ by what is known of neither."""
    for best, tried, mask, ess, taken in PATHS:
        state, used = _state([0.0, 2.0, np.nan], ess=ess), np.array(mask) > 0
        same = lambda: loop._rise(state, PATH, DATA, _Along(best, tried), used)  # noqa: B023, E731
        after = loop._judge(state, _heavy(2.5), jnp.ones((1, 1)), np.array([-9.0, -7.0, -9.0]), used, same)
        assert (_mass(after.best), after.top[0]) == ((1.5, -9.0) if taken else (1.0, 0.0))
        assert after.stride == pytest.approx(0.6 if taken else 0.2)


def test_a_fall_is_judged_once_more_with_all_rows_in_sight_only(monkeypatch):
    horizons, judged, kept_paths = [], [], []

    def em_step(model, data, *_, kept, **__):
        horizons.append(int(data.valid[0].sum()))
        kept_paths.append(kept is PATH)
        info, fall = MStepInfo(jnp.ones((1, 1)), np.ones(4, bool)), -10.0 * len(horizons) * np.ones(4)
        return model, info, fall, np.full(4, np.inf), PATH

    _fake(monkeypatch, loop, em_step=em_step, _rise=lambda *_: judged.append(horizons[-1]) or 1.0)
    state = _state(np.full(4, -np.inf), epoch=1)
    loop.fit(state, DATA, CubatureSmoother(StartBank((1, 1))), RULE, epochs=6, schedule=Schedule(first=4, growth=3.0))
    assert horizons == [4, 4, 9, 9, 9] and judged == [9, 9]
    assert kept_paths == [False, False, False, True, True]


def test_a_step_after_which_all_sequences_are_lost_is_refused(monkeypatch):
    """From a mass of 1.5 on towards 9; beyond 4 nothing can be followed."""
    tried = []

    def em_step(model, data, *_, **__):
        tried.append(_mass(model))
        lost = tried[-1] > 4.0
        info = MStepInfo(jnp.ones((1, 1)), np.full(4, not lost))
        return _heavy(9.0), info, np.full(4, np.nan if lost else 10.0 + tried[-1]), np.full(4, np.inf), PATH

    monkeypatch.setattr(loop, "em_step", em_step)
    state = _state(np.full(4, -np.inf), epoch=1, stride=1.0)
    whole = Schedule(first=9)
    end = loop.fit(state, DATA, CubatureSmoother(StartBank((1, 1))), RULE, epochs=4, schedule=whole)
    np.testing.assert_allclose(tried, [1.5, 9.0, 1.5 + 7.5 / 3])
    assert _mass(end.best) == pytest.approx(4.0)
    monkeypatch.setattr(loop, "em_step", lambda *args, **_: em_step(_heavy(9.0), DATA))
    with pytest.raises(loop.FitError, match="all 4 sequences diverge"):
        loop.fit(state, DATA, CubatureSmoother(StartBank((1, 1))), RULE, epochs=4, schedule=whole)


def test_a_horizon_is_held_and_grows():
    assert [Schedule().horizon(epoch, 200) for epoch in range(9)] == [60, 60, 60, 96, 96, 154, 154, 200, 200]


RESTS = [
    ({"loglik": np.array([5.0, 5.04, 5.0])}, loop.RESTED),
    ({"loglik": np.array([5.0, 5.06, 5.06])}, ""),  # still moved an epoch ago
    ({"epoch": 2, "loglik": np.array([5.0, 5.0])}, ""),
    ({"loglik": np.array([5.0, 4.0, 5.0]), "stride": 0.1}, loop.STEP_REFUSED),
    ({"loglik": np.array([5.0, 4.0, 5.0]), "stride": 0.1, "ess": 100.0}, ""),  # by chance, of a sample
]


def test_em_rests_where_nothing_moves():
    for changes, reason in RESTS:
        assert loop._ended(_state([0.0], **changes), Schedule(first=9), 9, 0.05) == reason
        assert not loop._ended(_state([0.0], **changes), Schedule(first=4, hold=1), 9, 0.05)  # not yet the whole


WHOLE = [0.0, 90.0, 6.0, 6.0]
RISES = [
    ([*WHOLE, 6.04, 6.08], {}, 0.0),
    ([*WHOLE, 6.04, 6.11], {}, 0.11),
    ([*WHOLE, 6.5, 6.2], {}, 0.5),  # the last step was tried, and refused
    ([*WHOLE, 5.0, 6.9], {"ess": 100.0}, 0.0),  # by chance, of a sample
    ([*WHOLE, 5.0, loop.DIVERGED, 7.1], {"ess": 100.0}, 1.1),  # a refused step says nothing of chance
    (WHOLE, {}, np.inf),
    ([*WHOLE[1:], 6.0], {"epoch": 5}, 0.0),  # begun from another fit, whose first epoch counts
]


def test_a_fit_that_its_epochs_end_has_the_rise_of_its_likelihood():
    """Two epochs see 4 of 9 samples; what they reached is no measure of the others, and two others are too few."""
    for loglik, changes, rise in RISES:
        state = _state([0.0], **{"epoch": len(loglik), "ess": np.inf, "loglik": np.array(loglik), **changes})
        assert loop.unsettled(state, Schedule(first=4, growth=3.0, hold=1), 9) == pytest.approx(rise)


def test_the_likeliest_process_noise_is_where_it_begins(monkeypatch):
    tried = []

    def e_step(model, *_, key):
        tried.append(float(model.log_q[0]))
        return SimpleNamespace(loglik=np.array([-abs(tried[-1] - 2 * np.log(0.1)), 1e3 * len(tried)]))

    _fake(monkeypatch, loop, _alone=e_step, not_diverged=lambda *_: np.array([True, False]))
    settled = loop._settle_noise(MODEL, DATA, None, jax.random.key(0))
    np.testing.assert_allclose(tried, 2 * np.log([1.0, 0.3, 0.1, 0.03, 0.01]))
    np.testing.assert_allclose(settled.log_q, 2 * np.log(0.1))


# --- a refit: the same decisions along one path


def test_a_refit_goes_back_a_third_of_the_way_and_keeps_the_best(monkeypatch):
    """Steps of 3 in a log variance whose likelihood is best at 1; a sequence without use wants the contrary."""
    tried, strides = [], []

    def smoothed(_, common, one):
        x = float(common[0][0])
        tried.append(x)
        return SimpleNamespace(loglik=-100 * (x - 1) ** 2 * np.array([1.0, 1.0, -5.0])), None, one[1]

    def advance(rule, core, *_):
        strides.append(float(rule.max_log_step))
        return core._replace(log_q=core.log_q + 3.0), jnp.asarray(tried[-1]), None

    _fake(monkeypatch, refits, locals_along=lambda *_: SimpleNamespace(filtered_from=None), each=smoothed)
    monkeypatch.setattr(ScoringMStep, "advance", advance)
    model, _ = refits.refit(MODEL, RULE, PATH, DATA, np.array([True, True, False]), passes=5)
    # 3 is worse than 0: a third of it; from 1 on with twice the share, and a third of that
    np.testing.assert_allclose(tried, [0.0, 3.0, 1.0, 3.0, 1.0 + 2 / 3], atol=1e-12)
    np.testing.assert_allclose(model.log_q, 1.0)
    assert strides == [0.0, 0.0, 0.0, 1.5, 1.5]  # the noise is held until the path has found its place


# --- the finish on multi-step errors


FINISHED = {  # errors at 0.25, 0.5 and 1 s of a parameter z whose step is always 1, and where it ends
    "a step is halved until the errors fall": (lambda z: 0.01 + abs(z - 0.5) * np.ones(3), 0.5),
    "one that only bends the first half second": (lambda z: 1 + z * np.array([-0.5, -0.5, 1.5]), 0.0),
}


@pytest.mark.parametrize(("size", "end"), FINISHED.values(), ids=FINISHED)
def test_a_gauss_newton_step(monkeypatch, size, end):
    def errors(along, horizons):
        scale = size(float(RULE.prior.read(along.model)[0]))[: len(horizons)]
        return np.broadcast_to(scale[:, None], (4, 3, len(horizons), 1))

    one = np.ones((4, 3, 2, 1, RULE.weights(MODEL).nodes.size + 1))
    prediction = lambda along, *_: OpenLoop(errors(along, (0, 0)), one, np.ones(2))  # noqa: E731
    goal = lambda weights, unknown, start, *_: start + 1.0  # noqa: E731
    _fake(monkeypatch, multistep, followed=_followed, open_loop=prediction, errors=errors, _goal=goal)
    done = multistep.finish(RULE.prior.write(MODEL, jnp.zeros(1)), RULE, PATH, DATA, np.ones(4, bool)).model
    assert float(RULE.prior.read(done)[0]) == pytest.approx(end)


@pytest.mark.parametrize("shaped", [False, True])
def test_a_shaped_finish_adds_the_prior_of_friction_and_nothing_to_parameters(monkeypatch, shaped):
    nodes, asked = RULE.weights(MODEL).nodes.size, []
    prediction = OpenLoop(np.ones((4, 3, 2, 1)), np.ones((4, 3, 2, 1, nodes + 1)), np.ones(2))
    prior = np.full((nodes + 1,) * 2, 7.0), np.full(nodes + 1, 3.0)
    goal = lambda *arguments: asked.append(arguments[-2:]) or arguments[2]  # noqa: E731
    given = {"open_loop": lambda *_: prediction, "errors": lambda *_: prediction.error, "_goal": goal}
    _fake(monkeypatch, multistep, followed=_followed, friction_prior=lambda *_: prior, **given)
    multistep.finish(MODEL, RULE, PATH, DATA, np.ones(4, bool), shaped=shaped)
    ((score, information),) = asked
    weight = multistep.weighed(prediction, np.ones(4, bool)).sum()
    friction = np.arange(nodes + 1) < nodes
    np.testing.assert_allclose(score, weight - 3.0 * shaped * friction)
    np.testing.assert_allclose(information, weight + 7.0 * shaped * np.outer(friction, friction))


@pytest.mark.parametrize(("apart", "slope", "force"), [(0.0, 1.0, 0.0), (0.5, 0.1, 0.0), (2.0, 30.0, 0.3)])
def test_recordings_that_disagree_and_forces_unsaid_widen_a_posterior_but_not_its_prior(
    monkeypatch, apart, slope, force
):
    """One parameter of prior precision 1 and likelihood precision L: H = 1 + 1 / (1 / L + V), in closed form."""
    errors = apart * np.array([1.0, -1.0, 2.0, -2.0])[:, None, None, None] * np.ones((4, 3, 2, 1))
    nodes = RULE.weights(MODEL).nodes.size
    columns = slope * np.concatenate([np.zeros((*errors.shape, nodes)), np.ones((*errors.shape, 1))], axis=-1)
    pushed = np.broadcast_to([1.0, 0.0, 2.0], (*errors.shape, 3))
    prediction = OpenLoop(errors, np.concatenate([columns, pushed], axis=-1), np.ones(2))
    every, likelihood = np.ones(4, bool), 50
    _fake(monkeypatch, multistep, open_loop=lambda *_: prediction)
    given = {"discrepancy_columns": lambda *_, **__: None, "followed": lambda *_: None}
    _fake(monkeypatch, stated, size=lambda *_: force, **given)
    hessian = RULE.weights(MODEL).prior_precision(MODEL.unknown).at[-1, -1].add(likelihood)
    precision, size = stated.widened(MODEL, RULE, PATH, DATA, every, hessian, key=jax.random.key(0))
    assert size == force
    weight = multistep.weighed(prediction, every)
    scores = slope * np.sum(weight * errors, axis=(1, 2, 3))
    disagree = np.sum((scores - scores.mean()) ** 2) * 4 / 3
    shared = force**2 * (1 + 4) * (slope * weight.sum()) ** 2
    spread = (disagree + shared) / (1.0 + slope**2 * weight.sum()) ** 2
    assert float(precision[-1, -1]) == pytest.approx(1.0 + 1.0 / (1.0 / likelihood + spread), rel=1e-6)
    assert 1.0 <= float(precision[-1, -1]) <= 1.0 + likelihood + 1e-9


def test_a_single_recording_counts_as_blocks_longer_than_its_errors_correlate():
    """Horizons of one and two starts, so that a block has eight of them; no score is lost."""
    for rows, blocks in ((24, 3), (7, 1)):
        scores = np.random.default_rng(0).normal(size=(1, rows, 2))
        cut = [part.sum(axis=0) for part in np.array_split(scores[0], blocks)]
        np.testing.assert_allclose(stated.clustered(scores, np.array([1.0, 2.0])), cut)


def test_the_size_of_forces_unsaid_is_that_which_made_the_errors():
    """Errors of one parameter, forces of a size, and noise of weight 4; noise alone tells of no forces."""
    rng = np.random.default_rng(0)
    for tau in (0.0, 0.03, 0.3):
        sizes = []
        for _ in range(8):
            own, other = rng.normal(size=(2000, 1)), rng.normal(size=(2000, 60)) / np.sqrt(np.arange(1, 61))
            error = own[:, 0] + tau * other @ rng.normal(size=60) + 0.5 * rng.normal(size=2000)
            rows = error, np.concatenate([own, other], axis=1), np.full(2000, 4.0)
            left = Linear(*(a[None, :, None, None] for a in rows), np.ones(1))
            sizes.append(stated.size(left, 1.0 + 4.0 * own.T @ own))
        if tau:
            assert np.mean(sizes) == pytest.approx(tau, rel=0.1)
        else:  # in half of the cases some is likelier by chance; how well the size of one force is told
            assert min(sizes) == 0.0 and max(sizes) < 3 * 0.5 / np.sqrt(2000)


class _CurvatureRule(NamedTuple):
    """An M-step whose curvature is the mass of the model that it was given."""

    prior: object

    def __call__(self, model, posterior, data):
        return None, SimpleNamespace(hessian=jnp.full((1, 1), _mass(model)), used=np.arange(4) < 3)


FINISHES = {  # errors of what was fitted and of what was left out, and whether readings are white
    "that only the fitted sequences like": (0.1, 1.2, False),
    "that only they like, and white readings": (0.1, 1.2, True),
    "that helps what is left out": (0.5, 0.5, False),
}


@pytest.mark.parametrize(("inside", "outside", "white"), FINISHES.values(), ids=FINISHES)
def test_a_finish(monkeypatch, inside, outside, white):
    """It is left alone or done on all.  White readings prove the sensor, not the physics: only where no finish helps is
    likelihood efficient, and its posterior not widened.
    """
    used, masks = np.array([True, True, True, False]), []  # the last one is lost

    def finish(model, m_step, path, data, mask, shaped):
        masks.append(mask)
        return _followed(_heavy(10.0 + len(masks)))

    def errors(along, *_):
        place = round(_mass(along.model)) - 11
        each = np.ones(4) if place < 0 else np.where(masks[place], inside, outside)
        return each[:, None, None, None] * np.array([0.9, 1.0, 1.1])[None, :, None, None]

    fakes = {"white_readings": lambda *_: white, "not_diverged": lambda *_: used, "finish": finish, "errors": errors}
    fakes |= {"followed": _followed, "ahead": lambda *_: ()}
    fakes["e_step"] = lambda model, *_, **__: SimpleNamespace(state=PATH, loglik=np.full(4, _mass(model)))
    fakes["widened"] = lambda *args, key: (2 * args[-1], 0.7)
    _fake(monkeypatch, identify, **fakes)
    rule, smoother = _CurvatureRule(RULE.prior), SimpleNamespace(tolerant=lambda: None)
    fitted = Identified(None, _state([0.0])._replace(hessian=jnp.ones((1, 1))), rule, None, smoother)
    after = identify.finished(fitted, DATA)
    if outside < 1:
        np.testing.assert_array_equal(masks[-1], used)
        assert _mass(after.model) == 10.0 + len(masks)
        assert float(after.state.hessian[0, 0]) == 2 * _mass(after.model), "the curvature is that of other weights"
        np.testing.assert_array_equal(after.state.top, 3 * [_mass(after.model)] + [np.nan])  # the likelihood, too
        return
    np.testing.assert_array_equal(np.sum(masks, axis=0), [1, 1, 1, 0])  # each left out once
    assert after.model is fitted.model and (after.state is fitted.state) == white
    assert after.discrepancy == (fitted.discrepancy if white else 0.7)
    assert float(after.state.hessian[0, 0]) == (1.0 if white else 2.0)
