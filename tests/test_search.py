"""Decisions of the search on numbers: laws that are refitted, enter a model or leave it, and what a failure leaves."""

import dataclasses
import functools
import math
import time
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import plant
import pytest
from helpers import around, declared_model, slide

from nnap_em.base.deadline import TimeUp, until
from nnap_em.base.journal import HERE, step
from nnap_em.estimate.em import multistep
from nnap_em.estimate.em.loop import EMState
from nnap_em.estimate.em.recorded import Risen
from nnap_em.estimate.identify import Identified
from nnap_em.estimate.smoother.start import StartBank
from nnap_em.explain.diagnosis import backward, diagnose, rounds, search, trial
from nnap_em.explain.diagnosis.context import SearchContext, chosen, lengths_of, likelier
from nnap_em.explain.diagnosis.hypothesis import Evidence, Hypothesis, covariances
from nnap_em.explain.diagnosis.keys import completed, key_of, remainder_of, replaced
from nnap_em.explain.diagnosis.outcome import Diagnosis, Step, Suspect
from nnap_em.explain.diagnosis.propose import seeded
from nnap_em.explain.diagnosis.rounds import decided, joined
from nnap_em.explain.diagnosis.screen import Screened
from nnap_em.explain.diagnosis.search import Method, Progress, Round
from nnap_em.explain.diagnosis.trial import Trial, certainty, leader
from nnap_em.explain.diagnosis.verdict import Share
from nnap_em.logs.dataset import Dataset
from nnap_em.machines.rig import Declared, Rig
from nnap_em.model.effects import AbstractEffect, Candidate, catalogue, flat
from nnap_em.model.effects.function import Axis, InputAxis
from nnap_em.model.state_space import with_effects

GAIN, ZONE, DRAG, HOOKE, FREE = "motor_gain", "dead_zone", "air_drag", "torsional_spring", "unknown_function"
MODEL, RULE = slide()
BARE = Hypothesis(MODEL, RULE)
DATA = Dataset(np.tile(0.05 * np.arange(9), (6, 1)), *(np.zeros((6, 9, n)) for n in (1, 2)), np.ones((6, 9), bool))
RIG = Rig("slide", "slide", {"m": Declared(1.0, 0.5)}, True, ("u",), (1,), 0.05, "sequence", ("x", "dx"), {}, {})
ACROBOT = declared_model(plant.Case(steps=20, hidden=False))
AROUND = around(ACROBOT)


def _law(name: str, value: float = 1.0, joint: int = 1) -> AbstractEffect:
    return catalogue[name](jnp.asarray(value), joint=joint)


def _function(*axes: Axis | InputAxis) -> AbstractEffect:
    return catalogue["unknown_function"](jnp.zeros(20 ** len(axes)), axes, joint=1)


def _axes(*names: str) -> AbstractEffect:
    return _function(*(Axis((name,), -2.0, 2.0, False, 20) for name in names))


OF_INPUT = _function(InputAxis(("u",), -2.0, 2.0, False, 20, index=0))
SPRING = catalogue["torsional_spring"](*map(jnp.asarray, (20.0, 1.0, 0.0, 0.0)), joint=1)


def _candidate(law: AbstractEffect, spread: float = 1.0) -> Candidate:
    """A law of no size, probed at that of `law`."""
    return Candidate(jax.tree.map(jnp.zeros_like, law), (law,), jax.tree.map(lambda a: spread * jnp.ones_like(a), law))


def _with(*names: str) -> Hypothesis:
    """The slide with these effects."""
    hypothesis = BARE
    for i, name in enumerate(names):
        law = _law(name, 1.0 + i)
        hypothesis = hypothesis.plus(law, _candidate(law, 2.0 + i), Evidence(removed=0.5 + 0.1 * i))
    return hypothesis


def _names(hypothesis) -> list[str]:
    return [effect.name for effect in hypothesis.effects]


def _emstate(model) -> EMState:  # whose numbers are known to a hundredth of their prior
    hessian = 1e4 * jnp.eye(1 + sum(flat(effect).size for effect in model.effects))
    return EMState(5, model, model, model, hessian, np.ones(6), 1.0, jax.random.key(0), np.zeros(5), np.inf)


BEFORE = Identified(RIG, _emstate(MODEL), RULE, StartBank((1, 1), (0,)), None)
CONTEXT = SearchContext(BEFORE, {9: (BEFORE.state, np.ones(6, bool))}, DATA, lambda text: None, change=True)


def test_certainty_is_the_marginal_of_the_posterior():
    """Value over standard deviation, whatever is correlated with it: network weights, a mass, another effect."""
    hypothesis = _with("motor_gain", "dead_zone")
    root = np.random.default_rng(0).normal(size=(5, 5))
    hessian = root @ root.T + np.eye(5)  # two network weights, the mass, the effects
    std = np.sqrt(np.diag(np.linalg.inv(hessian)))
    for place, effect in enumerate(hypothesis.model.effects):
        value, spread = 1.0 + place, 2.0 + place
        expected = value / (spread * std[3 + place])
        cov = covariances(hypothesis.model, hypothesis.m_step, hessian)[place]
        assert certainty(_candidate(effect), effect, cov) == pytest.approx(expected, rel=1e-9)


def test_one_fit_is_likelier_than_another_where_most_sequences_are():
    assert likelier(np.array([np.nan, 1e9, 1.0, 2.0, 3.0]), np.zeros(5))
    assert not likelier(np.array([np.nan, 1e9, -1.0, -2.0, 3.0]), np.zeros(5))


def test_the_fit_of_the_least_error_is_kept_the_likelier_of_near_ones_and_none_that_predicts_worse():
    tops = [np.full(6, level) for level in (0.0, 1.0)]
    cases = {(0.9, 0.909): 1, (0.9, 0.911): 0, (0.91, 0.9): 1, (1.1, 0.99): 1, (1.001, 1.1): None, (1.0, 1.1): 0}
    assert {left: chosen(left, tops) for left in cases} == cases


def test_one_of_three_effects_goes_with_its_prior_and_its_reason():
    hypothesis = _with("motor_gain", "dead_zone", "air_drag").without(1)
    assert _names(hypothesis.model) == ["motor_gain", "air_drag"]
    assert [f.removed for f in hypothesis.evidence if f] == [0.5, 0.7]
    np.testing.assert_allclose(hypothesis.m_step.prior.std, [0.1, 2.0, 4.0])
    assert [name.partition(".")[0] for name in hypothesis.m_step.prior.names] == ["m", "0", "1"]


def test_a_rest_belongs_to_the_law_of_the_same_signals_at_its_joint():
    model, rest = with_effects(MODEL, (_law("motor_gain"), SPRING)), _axes("x")
    assert remainder_of(rest, model) == 1
    assert remainder_of(OF_INPUT, model) == 0
    assert remainder_of(dataclasses.replace(rest, joint=2), model) is remainder_of(SPRING, model) is None
    free = with_effects(MODEL, (rest,))
    assert completed(SPRING, free) and not completed(SPRING, model) and not completed(_law("motor_gain"), free)


def test_a_fit_starts_where_the_screen_puts_a_linear_law_and_at_the_probe_of_another():
    gain, zone = (Candidate(_law(n, 0.5), (_law(n, 0.75),), _law(n)) for n in ("motor_gain", "dead_zone"))
    assert float(jax.tree.leaves(seeded(gain, np.array([-2.0])))[0]) == pytest.approx(0.5 - 2.0 * 0.25)
    assert float(jax.tree.leaves(seeded(zone, np.array([-2.0])))[0]) == 0.75


def test_a_function_of_each_turn_and_one_of_all_turns_are_rivals():
    every = [c.start for c in catalogue["unknown_function"].candidates(AROUND) if len(c.start.axes) == 1]
    turning, still = (e for e in every if e.joint == 2 and e.inputs_named() == ("theta2",))
    assert key_of(turning) == key_of(still)
    spring = catalogue["torsional_spring"].candidates(AROUND)[0].start
    model = with_effects(ACROBOT, (spring, turning))
    assert replaced(still, model) == 1
    assert {replaced(law, model) for law in (turning, spring, *(e for e in every if e.joint == 1))} == {None}


def test_a_stop_that_yields_is_none():
    stop = next(c for c in catalogue["hard_stop"].candidates(AROUND) if c.start.joint == 2).probes[0]
    half = np.log(2.0 * AROUND.torque[1])  # N m/rad
    assert dataclasses.replace(stop, stiffness=half + 0.01).is_physical()
    assert not dataclasses.replace(stop, stiffness=half - 0.01).is_physical()
    assert not dataclasses.replace(stop, lower=stop.upper - 0.1).is_physical()


def _screened(law: AbstractEffect, share: float, chance=0.0, folds=None, left_out=None, band=0, survived=1.0):
    """The outcome of the screen of a law that removes `share`, where 15 % is the least."""
    explained = Share(share, share if left_out is None else left_out, folds or (share,) * 3)
    return Screened(_candidate(law), np.ones(1), explained, band, 0.15, chance, survived)


def _named(name: str, share: float, value: float = 1.0, joint: int = 1, **more):
    return _screened(_law(name, value, joint), share, **more)


def _free(share: float, *names: str, **more):
    return _screened(_axes(*(names or ("x",))), share, **more)


_gain, _zone, _drag = (functools.partial(_named, name) for name in (GAIN, ZONE, DRAG))
_spring = functools.partial(_screened, SPRING)


def _run(entries, errors=None, own=None, hypothesis=BARE, shortlist=8, steps=None, p=None, late=math.inf):
    """A round over these candidates, and the names of those that were refitted in turn: a refit removes what the screen
    said, or leaves `errors` by name, or in turn; at its own scale a law removes the same, or leaves `own`.  Of the
    forms of a law it takes the one whose first number has the largest of `steps`.  The time is up before number `late`.
    """
    tried = []

    def refitted(forms):
        screened = max(forms, key=lambda s: float((steps or {}).get(float(flat(s.candidate.probes[0])[0]), 0.0)))
        law = screened.candidate.probes[0]
        if len(tried) >= late:
            raise TimeUp
        left = errors[len(tried)] if isinstance(errors, tuple) else (errors or {}).get(law.name)
        tried.append(law.name)
        removed = screened.share.least if left is None else 1 - left
        alone = 1 - own[law.name] if own else removed
        return Trial(screened, hypothesis.plus(law, screened.candidate), 0.5, removed, alone)

    risen, step = None if p is None else Risen(1.2, p, 1e-4), Step(9, (), (), None)
    with mock.patch.object(rounds, "SHORTLIST", shortlist):
        return decided(entries, refitted, step, hypothesis.model, CONTEXT._replace(risen=risen)), tried


SPRUNG = {"hypothesis": BARE.plus(SPRING, _candidate(SPRING))}
MANY = [_law(name) for name in (GAIN, ZONE, DRAG, "viscous_change", "torque_offset")]
UNSURE, PAIR = {"errors": {ZONE: 0.6, GAIN: 0.5}}, [ZONE, GAIN]
ROUNDS = {  # what the screen says, options, the laws that are refitted in turn, and the one that is accepted
    "a law over the floor": ([_gain(0.151)], {}, [GAIN], GAIN),
    "a law below the floor": ([_gain(0.149)], {}, [], None),
    "a law within twice the chance level": ([_gain(0.3, chance=0.151)], {}, [], None),
    "a law without a name below its higher bar": ([_free(0.249)], {}, [], None),
    "a law that friction can stand for": ([_gain(0.5, survived=0.049)], {}, [], None),
    "a law that friction hardly can": ([_gain(0.5, survived=0.051)], {}, [GAIN], GAIN),
    "parts that disagree": ([_gain(0.5, folds=(0.9, -0.1, -0.1))], {}, [], None),
    # a named law beside a function: one that does not contain it, where it is even with six tenths
    "another cause that is not": ([_free(0.56), _drag(0.3)], {}, [FREE, DRAG], FREE),
    # one that it contains: the parts left out are the same, so that both differ by what they explain
    "a law that explains what its function does": ([_free(0.5), _spring(0.46)], {}, [HOOKE], HOOKE),
    "a law that explains less than its function": ([_free(0.5), _spring(0.44)], {}, [FREE, HOOKE], FREE),
    "a refit shows that a law is even": ([_free(0.5), _spring(0.4)], {"errors": {HOOKE: 0.53}}, [FREE, HOOKE], HOOKE),
    # 0.75 is more than nine tenths of 0.82, but leaves 0.25 for 0.18
    "a refit shows what is left": (
        [_free(0.5), _spring(0.4)], {"errors": {FREE: 0.18, HOOKE: 0.25}}, [FREE, HOOKE], FREE),
    "a function of fewer signals": ([_free(0.5, "x", "dx"), _free(0.46)], {}, [FREE], (FREE, 1, None, ("x",))),
    # a free function is no change where errors have not risen by two standard deviations since the fit
    "a function where errors have risen": ([_free(0.5), _spring(0.16)], {"p": 0.022}, [FREE], FREE),
    "a function where they have not": ([_free(0.5), _spring(0.16)], {"p": 0.023}, [FREE], None),
    "a named law where they have not": ([_spring(0.2)], {"p": 0.023}, [HOOKE], HOOKE),
    "the remainder of a law before another cause": ([_drag(0.5), _free(0.28)], SPRUNG, [DRAG, FREE], FREE),
    # an alias of what shows soon does not stand before a law that the longer horizons show
    "a law of the longer horizons": ([_zone(0.4, band=1), _gain(0.2)], {}, [GAIN], GAIN),
    "two are rejected": ([_gain(0.5), _zone(0.3)], {"errors": {GAIN: 0.92, ZONE: 1.2}}, [GAIN, ZONE], None),
    # what the screen cannot tell apart is told by refits
    "only the best is refitted": ([_gain(0.5), _zone(0.33)], {}, [GAIN], GAIN),
    "a refit removes more than the next may": ([_gain(0.5), _zone(0.305)], {"errors": {GAIN: 0.59}}, [GAIN], GAIN),
    "a refit removes less": ([_gain(0.5), _zone(0.305)], {"errors": {GAIN: 0.61, ZONE: 0.5}}, [GAIN, ZONE], ZONE),
    "even after the refit too": ([_gain(0.5), _zone(0.46)], {"errors": {ZONE: 0.49}}, [GAIN, ZONE], ZONE),
    "another cause explaining the same": ([_gain(0.5), _spring(0.5)], {"errors": {HOOKE: 0.54}}, [GAIN, HOOKE], None),
    "another cause explaining less": ([_gain(0.5), _spring(0.5)], {"errors": {HOOKE: 0.56}}, [GAIN, HOOKE], GAIN),
    "the same cause": ([_gain(0.5), _zone(0.5)], {}, [GAIN, ZONE], GAIN),
    # refits put another first than the screen: what each removes at the scale of what it leaves decides
    "another law at its own scale": ([_zone(0.5), _gain(0.4)], UNSURE | {"own": {ZONE: 0.2, GAIN: 0.25}}, PAIR, ZONE),
    "the same at its own scale": ([_zone(0.5), _gain(0.4)], UNSURE | {"own": {ZONE: 0.2, GAIN: 0.19}}, PAIR, GAIN),
    "even at their own scales": ([_zone(0.5), _gain(0.4)], UNSURE | {"own": {ZONE: 0.2, GAIN: 0.22}}, PAIR, GAIN),
    # the screen gives the second joint less than nine tenths of the first: refits decide at which joint it is
    "a law at its other joint": (
        [_gain(0.6), _gain(0.53, joint=2)], {"errors": (0.35, 0.27)}, [GAIN, GAIN], (GAIN, 2, None, ())),
    # no more laws than the shortlist holds, and not after the time is up
    "a full shortlist": ([_screened(a, 0.5) for a in MANY],
        {"errors": {a.name: 0.99 for a in MANY}, "shortlist": 2}, [a.name for a in MANY[:2]], None),
    "a law whose time is up": ([_gain(0.6), _zone(0.5)], {"errors": {GAIN: 0.99}, "late": 1}, [GAIN], None),
    # another start of a law that explains as much, by the step of each
    "another start": ([_gain(0.51), _gain(0.461, value=2.0)], {"steps": {2.0: 0.4, 1.0: 0.3}}, [GAIN], (GAIN, 2.0)),
    "a start one part contradicts": (
        [_gain(0.56), _gain(0.76, 2.0, folds=(0.9, 0.9, -0.2))], {"steps": {2.0: 0.4, 1.0: 0.3}}, [GAIN], (GAIN, 2.0)),
    "the best of a kind": ([_drag(0.1), _drag(0.4, 2.0), _drag(0.2, 3.0)], {}, [DRAG], (DRAG, 2.0)),
}  # fmt: skip
SAID = {  # of some of these rounds: fields of the step, as names of laws, with their numbers where they have some
    "a function where errors have risen": {"suspects": []},
    "a function where they have not": {"suspects": [FREE]},
    "two are rejected": {"refitted": {GAIN: 0.08, ZONE: -0.2}, "suspects": []},  # what was refitted is no suspect
    "another cause explaining the same": {"rivals": [GAIN, HOOKE]},
    "another cause explaining less": {"rivals": []},
    "the same cause": {"rivals": []},
    "a full shortlist": {"untried": len(MANY) - 2},
    "a law whose time is up": {"untried": 1},
    "the best of a kind": {"screened": {DRAG: 0.4}},
}


@pytest.mark.parametrize("name", ROUNDS)
def test_a_round(name):
    entries, options, refitted, accepted = ROUNDS[name]
    (step, best, complete), tried = _run(entries, **options)
    assert tried == refitted
    effect = best and best[0].effect
    law = effect and key_of(effect)
    assert accepted in ([None] if effect is None else [effect.name, (effect.name, float(flat(effect)[0])), law])
    assert step.accepted == law and complete == ("late" not in options)
    for field, said in SAID.get(name, {}).items():
        value = getattr(step, field)
        if isinstance(said, dict):
            assert {key[0]: number for key, number in value} == pytest.approx(said)
        else:
            assert (value if field == "untried" else [getattr(entry, "key", entry)[0] for entry in value]) == said


def test_suspects_are_near_the_best_and_over_chance_with_named_laws_first():
    """0.08 is less than 0.6 of the best; 0.10 is within twice a chance level of 0.055."""
    for chance, names in ((0.0, [ZONE, GAIN, FREE]), (0.055, [ZONE, FREE])):
        more = {"chance": chance, "folds": (0.2, 0.2, 0.2)}
        (step, *_), tried = _run([_free(0.14, **more), _zone(0.12, **more), _gain(0.10, **more), _drag(0.08, **more)])
        assert not tried and [suspect.key[0] for suspect in step.suspects] == names
        assert all(suspect.chance == chance for suspect in step.suspects)


def test_the_start_of_a_law_whose_step_removes_most_is_refitted():
    """A start that is not physical comes last, as a cogging of another number of periods is another law."""
    begun = []
    for value, share in ((0.8, -0.6), (0.9, 0.2), (-1.0, 0.3)):
        law = _law("dead_zone", value)
        begun.append((Trial(_zone(0.5), BARE.plus(law, _candidate(law)), share), value))
    assert leader(begun)[1] == 0.9


def test_a_refit_that_errs_more_than_its_start_is_not_kept(monkeypatch):
    start, end = (trial.Fitted(BARE, None, name) for name in ("start", "end"))  # type: ignore[arg-type]
    monkeypatch.setattr(trial, "refit", lambda *_: (MODEL, None))
    monkeypatch.setattr(trial, "begun", lambda *_: end)
    for errs, kept in ((1.01, start), (0.99, end)):
        monkeypatch.setattr(trial, "ratio", lambda *_, errs=errs, **__: errs)
        assert trial.fitted(start, mock.Mock()) is kept


def test_a_trial_has_the_share_at_the_scale_of_what_was_there_and_of_what_it_leaves(monkeypatch):
    """Nine of ten errors fall to a tenth, as in test_multistep.py."""
    after = np.where(np.arange(10) > 0, 0.1, 1.0)[None, :, None, None]
    monkeypatch.setattr(trial, "begun", lambda hypothesis, path, fit: trial.Fitted(hypothesis, path, after))
    monkeypatch.setattr(trial, "fitted", lambda start, fit: start)
    monkeypatch.setattr(trial, "extended", lambda model, path, data: path)
    monkeypatch.setattr(multistep, "errors", lambda along, *_: along)
    null, fit = trial.Fitted(BARE, None, np.ones_like(after)), mock.Mock(hypothesis=BARE, used=np.ones(1, bool))
    case = trial.with_candidate([_gain(0.5)], null, fit)
    line = 2.0 * (2 * 10.0 / 1.4826 - 2.0)
    assert 1 - case.removed == pytest.approx(0.109)
    assert 1 - case.own == pytest.approx((9 / 1.4826**2 + line) / (10 * line))


def test_laws_go_without_which_too_little_is_lost_the_least_first():
    """Nine hundredths of the error are the least that counts."""
    sprung = _with(GAIN, ZONE)
    for lost, left in (
        ([0.5, 0.089], [GAIN]), ([0.08, 0.089], []), ([0.5, 0.091], [GAIN, ZONE]), ([0.3, -math.inf], [GAIN]),
        ([math.inf, 0.02], [GAIN]),
    ):  # fmt: skip
        shares = lambda one, lost=lost: [lost[[GAIN, ZONE].index(name)] for name in _names(one.model)]  # noqa: E731
        method = _method(shares)
        assert _names(search._reduced(method, Progress(sprung), print).hypothesis.model) == left


def test_a_law_of_a_rate_is_judged_by_that_reading_too():
    """A late rate counts little where noise was fitted without its law; the position is compared in any case."""
    for channel, errors in (("dx", [(0, ()), (1, ()), (0, (1,))]), ("x", [(0, ()), (1, ())])):
        law = catalogue["sensor_delay"](jnp.asarray(0.07), channel=channel)
        assert backward.judged_by(law, MODEL, RIG.measured) == errors


def _method(lost, rounds=None, ended=lambda fitted: fitted):
    grown = lambda hypothesis, _: _emstate(hypothesis.model)  # noqa: E731
    return Method([9], rounds, grown, lost, ended, 6)  # type: ignore[arg-type]


def _searched(queue, needed=True, ended=lambda fitted: fitted, log=lambda text: None):
    """A search whose rounds come from a queue: a law is accepted, a number of candidates is left as the time is up."""
    left = list(queue)

    def next_round(hypothesis, length):
        law, step = left.pop(0) if left else None, Step(length, (), (), None)
        if isinstance(law, Exception):
            raise law
        if law is None or isinstance(law, int):
            return Round(step._replace(untried=law or 0), None, complete=law is None)
        record = Evidence(math.nan, (), 0.4, 0.0, (3, 3), 0.5, _candidate(law))
        return Round(step._replace(accepted=key_of(law)), hypothesis.plus(law, _candidate(law), record))

    lost = lambda hypothesis: [0.5 if needed else 0.0] * len(hypothesis.evidence)  # noqa: E731
    return search.search(_method(lost, next_round, ended), Progress(BARE), BEFORE, log)


LOST = np.linalg.LinAlgError("Singular matrix")
LATE = {"ended": mock.Mock(side_effect=LOST)}
LAW, OTHER = _law("motor_gain", 0.5), _law("air_drag", 0.5)
SEARCHES = {  # rounds, options, the laws at the end, by round whether one was accepted, whether it ended
    "accepted and needless": ((LAW, None, LAW), {"needed": False}, [], [1, 0], True),
    "no more laws than four": ([LAW] * 6, {}, [GAIN] * 4, [1] * 4, True),
    "its time is up before the second screen": ((LAW, TimeUp()), {}, [GAIN], [1], False),
    "its time is up with candidates left": ((LAW, 3), {}, [GAIN], [1, 0], False),
    "a matrix is singular in the second round": ((LAW, LOST), {}, [GAIN], [1], False),
    "a matrix is singular in the last fit": ((LAW, None), LATE, [GAIN], [1, 0], False),
}


@pytest.mark.parametrize(("queue", "options", "names", "accepted", "complete"), SEARCHES.values(), ids=SEARCHES)
def test_a_search_keeps_what_was_accepted_before(queue, options, names, accepted, complete):
    outcome = _searched(queue, **options)
    assert _names(outcome.after.model) == names and outcome.complete == complete
    assert [step.accepted is not None for step in outcome.steps] == [each == 1 for each in accepted]
    assert outcome.steps[-1].untried == (3 if 3 in queue else 0)
    failed = LOST in queue or options is LATE
    assert outcome.failure == ("Singular matrix" if failed else "")
    assert ("(Singular matrix)" in outcome.unfinished) == failed
    for record in outcome.evidence:
        assert (record.removed, record.share, record.chance, record.parts) == (0.5, 0.4, 0.0, (3, 3))
        assert np.isnan(record.gain)  # a likelihood proves nothing there


def test_a_law_that_is_not_determined_as_it_is_stated_is_a_suspect():
    """The gain is 0.5, of so many standard deviations as stated; the drag is sure."""

    def ended(fitted):
        stated = [1.0, *(4e4 if effect.name == DRAG else (certain / 0.5) ** 2 for effect in fitted.model.effects)]
        return fitted._replace(state=fitted.state._replace(hessian=jnp.diag(jnp.asarray(stated))))

    for certain, stays in ((2.7, True), (2.6, False)):  # six recordings: Student's t of five degrees of freedom
        log = []
        outcome = _searched((LAW, OTHER), ended=ended, log=log.append)
        assert _names(outcome.after.model) == ([GAIN, DRAG] if stays else [DRAG])
        assert outcome.steps[0].accepted == (key_of(LAW) if stays else None) and outcome.steps[1].accepted is not None
        assert outcome.steps[-1].suspects == (() if stays else (Suspect(key_of(LAW), 0.4, 0.0),))
        line = f"  motor gain at joint 1 is removed: it is {certain} standard deviations from none"
        assert (line in log) != stays


def test_a_named_law_gives_way_to_a_remainder_that_explains_the_larger_part():
    """The remainder removes half of what is left by a law that removed nine tenths, or one."""
    for removed, names in ((0.9, [HOOKE, FREE]), (0.1, [FREE])):
        hypothesis = BARE.plus(SPRING, _candidate(SPRING), Evidence(removed=removed))
        rest = _axes("x")
        trial = Trial(_screened(rest, 0.4), hypothesis.plus(rest, _candidate(rest)), 0.5, 0.5)
        following = joined(hypothesis, trial, (), CONTEXT)
        assert _names(following.model) == names
        # the remainder that took the place removed what both did; beside the law only its own
        assert following.evidence[-1].removed == pytest.approx(0.5 if len(names) == 2 else 1 - 0.9 * 0.5)


def test_a_search_begins_at_the_whole_length_unless_most_sequences_are_lost_there():
    """With a hidden joint and white readings it begins at the two shortest horizons of at most 150 rows and one in the
    middle; with others at the last horizon before the whole length, which follows.
    """
    every, most, few = np.ones(6, bool), np.arange(6) < 3, np.arange(6) < 2
    for short, whole, first in ((every, most, 9), (every, few, 4), (few, few, 4)):
        assert lengths_of(CONTEXT._replace(stages={4: (None, short), 9: (None, whole)})) == sorted({first, 9})
    long = Dataset(*(np.zeros((1, 500, *part.shape[2:])) for part in DATA[:3]), np.ones((1, 500), bool))
    hidden = BEFORE.state._replace(best=dataclasses.replace(MODEL, measured=(1,)))
    stages = dict.fromkeys([60, 96, 140, 246, 393, 500], (None, every))
    for state, white, lengths in (
        (hidden, True, [60, 96, 246, 500]), (hidden, False, [393, 500]), (BEFORE.state, True, [500]),
    ):  # fmt: skip
        context = CONTEXT._replace(stages=stages, data=long, white=white, before=BEFORE._replace(state=state))
        assert lengths_of(context) == lengths


def test_declared_numbers_are_held_where_all_is_read_and_released_at_the_end():
    for measured, share in (((0, 1), 0.2), ((1,), 1.0)):
        held, part = diagnose.held_in(RIG, dataclasses.replace(MODEL, measured=measured))
        assert part == share and held.parameters["m"] == Declared(1.0, pytest.approx(0.5 * share))
    rule = _with("motor_gain").m_step
    after = diagnose.released(rule)
    np.testing.assert_allclose(after.prior.std / rule.prior.std, [5.0, 1.0])  # of the law nothing was held
    np.testing.assert_allclose(after.least, 0.2 * rule.least)


def test_states_are_smoothed_and_predicted_by_the_branches_that_a_search_leaves_out():
    fit = BEFORE._replace(smoother=diagnose.unbranched(BEFORE.bank))
    outcome = diagnose.branching(Diagnosis(fit, fit, (), ()))
    assert fit.smoother.second() is None and outcome.after is outcome.before
    assert outcome.before.smoother.second() is not None


def test_no_step_begins_after_the_deadline():
    toy = step(lambda: HERE)(lambda: np.zeros(1))
    with until(time.monotonic() + 3600):
        toy()
    with until(time.monotonic() - 1), pytest.raises(TimeUp):
        toy()
