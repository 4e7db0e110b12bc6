"""One screening round on numbers: which laws are refitted, in what order, and what is said of those that are not."""

import dataclasses
import math
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import slide

from nnap_em.data.dataset import Dataset
from nnap_em.data.rig import Declared, Rig
from nnap_em.diagnosis import rounds, trial
from nnap_em.diagnosis.context import SEARCH_EFFORT, SearchContext
from nnap_em.diagnosis.hypothesis import Hypothesis
from nnap_em.diagnosis.keys import contains, elsewhere, key_of
from nnap_em.diagnosis.losses import MultiStep
from nnap_em.diagnosis.refit import Refit
from nnap_em.diagnosis.rounds import screening_round
from nnap_em.diagnosis.screen import Screened
from nnap_em.diagnosis.smoothed import SmoothedFit
from nnap_em.diagnosis.trial import Trial
from nnap_em.diagnosis.verdict import Share
from nnap_em.effects import AbstractEffect, Candidate, catalogue, flat
from nnap_em.effects.function import Axis
from nnap_em.em.recorded import Risen
from nnap_em.storage.deadline import TimeUp

MODEL, RULE = slide()
BARE = Hypothesis(MODEL, RULE)
DATA = Dataset(*(np.zeros((6, 9, *shape)) for shape in ((), (1,), (2,))), np.ones((6, 9), bool))
RIG = Rig("slide", "slide", {"m": Declared(1.0, 0.0)}, True, ("u",), (1,), 0.05, "sequence", ("x", "dx"), {}, {})
MULTI = MultiStep()


def _law(name: str, value: float = 1.0, joint: int = 1) -> AbstractEffect:
    return catalogue[name](jnp.asarray(value), joint=joint)


def _axes(*names: str) -> AbstractEffect:
    axes = tuple(Axis((name,), -2.0, 2.0, False, 20) for name in names)
    return catalogue["unknown_function"](jnp.zeros(20 ** len(axes)), axes, joint=1)


SPRING = catalogue["torsional_spring"](*map(jnp.asarray, (20.0, 1.0, 0.0, 0.0)), joint=1)


def _screened(law: AbstractEffect, share: float, chance: float = 0.0, folds=None, left_out=None, band: int = 0):
    """The outcome of the screen of a law that removes `share`, where 15 % is the least."""
    explained = Share(share, share if left_out is None else left_out, folds or (share,) * 3)
    return Screened(Candidate(law, (law,), jax.tree.map(jnp.ones_like, law)), np.ones(1), explained, band, 0.15, chance)


def _gain(share, chance=0.0, value=1.0, joint=1, **more):
    return _screened(_law("motor_gain", value, joint), share, chance, **more)


def _zone(share, **more):
    return _screened(_law("dead_zone"), share, **more)


def _drag(share, value=1.0, **more):
    return _screened(_law("air_drag", value), share, **more)


def _spring(share, **more):
    return _screened(SPRING, share, **more)


def _free(share, *names, **more):
    return _screened(_axes(*(names or ("x",))), share, **more)


def _run(
    monkeypatch, entries, errors=None, hypothesis=BARE, shortlist=8, steps=None, p=None, unfitted="", late=math.inf
):
    """A round over these candidates, and the names of those that were refitted in turn.

    A refit removes what the screen said, or leaves `errors` by name, or in turn; that of `unfitted` removes nothing
    along its step.  Of the forms of a law it takes the one whose first number has the largest of `steps`.  The time is
    up before number `late`; `p` is the chance of errors as large as since the fit.
    """
    tried = []

    def refit(forms, null, fit, loss, passes):
        screened = max(forms, key=lambda s: float((steps or {}).get(float(flat(s.candidate.start)[0]), 0.0)))
        law = screened.candidate.start
        if len(tried) >= late:
            raise TimeUp
        own = errors[len(tried)] if isinstance(errors, tuple) else (errors or {}).get(law.name)
        tried.append(law.name)
        after = hypothesis.plus(law, screened.candidate)
        if law.name == unfitted:
            return Trial(screened, after, 0.0, np.inf, np.inf, 0.0)
        removed = screened.share.least if own is None else 1 - own
        return Trial(screened, after, removed, 12.0, np.inf, 0.5, object())

    monkeypatch.setattr(rounds, "surroundings", lambda *_, **__: None)
    monkeypatch.setattr(AbstractEffect, "visible", lambda *_: True)
    monkeypatch.setattr(rounds, "proposals", lambda *_: [])
    monkeypatch.setattr(rounds, "screen", lambda *_: tuple(entries))
    monkeypatch.setattr(rounds, "null_of", lambda *_: None)
    monkeypatch.setattr(rounds, "with_candidate", refit)
    fit = SmoothedFit(BARE, hypothesis, None, DATA, np.ones(6, bool), 9)
    effort = SEARCH_EFFORT._replace(shortlist=shortlist)
    risen = None if p is None else Risen(1.2, p, 1e-4)
    context = SearchContext(SimpleNamespace(rig=RIG), {}, DATA, MULTI, effort, lambda text: None, risen=risen)
    return screening_round(fit, context), tried


GAIN, ZONE, DRAG, HOOKE, FREE = "motor_gain", "dead_zone", "air_drag", "torsional_spring", "unknown_function"
SPRUNG = {"hypothesis": BARE.plus(SPRING, Candidate(SPRING, (SPRING,), SPRING))}
OVERSHOT = _gain(0.76, value=2.0, folds=(0.9, 0.9, -0.2))  # a ripple of nine periods, which one part contradicts
MANY = ("motor_gain", "dead_zone", "air_drag", "viscous_change", "stiction", "torque_offset", "motor_back_emf")
MANY = [_law(name) for name in MANY if name in catalogue and len(catalogue[name].units) == 1]
ROUNDS = {  # what the screen says, options, the laws that are refitted in turn, and the one that is accepted
    "a law over the floor": ([_gain(0.151)], {}, [GAIN], GAIN),
    "a law below the floor": ([_gain(0.149)], {}, [], None),
    "a law over twice the chance level": ([_gain(0.3, 0.149)], {}, [GAIN], GAIN),
    "a law within twice the chance level": ([_gain(0.3, 0.151)], {}, [], None),
    "a law without a name over its higher bar": ([_free(0.251)], {}, [FREE], FREE),
    "a law without a name below its higher bar": ([_free(0.249)], {}, [], None),
    "the smaller of both shares counts": ([_gain(0.5, left_out=0.1)], {}, [], None),
    "parts that disagree": ([_gain(0.5, folds=(0.9, -0.1, -0.1))], {}, [], None),
    # a named law beside a function: one that does not contain it, where it is even with six tenths
    "another cause that is even with the function": ([_free(0.55), _drag(0.3)], {}, [FREE, DRAG], DRAG),
    "another cause that is not": ([_free(0.56), _drag(0.3)], {}, [FREE], FREE),
    # one that it contains: the parts left out are the same, so that both differ by what they explain
    "a law that explains what its function does": ([_free(0.5), _spring(0.46)], {}, [HOOKE], HOOKE),
    "a law that explains less than its function": ([_free(0.5), _spring(0.44)], {}, [FREE, HOOKE], FREE),
    "a law that explains much less": ([_free(0.5), _spring(0.26)], {}, [FREE], FREE),
    "a refit shows that a law is even": ([_free(0.5), _spring(0.4)], {"errors": {HOOKE: 0.54}}, [FREE, HOOKE], HOOKE),
    "a refit shows that it is not": ([_free(0.5), _spring(0.4)], {"errors": {HOOKE: 0.56}}, [FREE, HOOKE], FREE),
    "a function that is rejected": ([_free(0.5), _spring(0.2)], {"errors": {FREE: 0.95}}, [FREE, HOOKE], HOOKE),
    "a function of fewer signals": ([_free(0.5, "x", "dx"), _free(0.46)], {}, [FREE], (FREE, 1, None, ("x",))),
    "one that explains less": ([_free(0.5, "x", "dx"), _free(0.44)], {}, [FREE, FREE], (FREE, 1, None, ("x", "dx"))),
    "each is even with the next": (
        [_free(0.42), _free(0.46, "x", "dx"), _spring(0.38)], {}, [HOOKE], HOOKE),
    "a named law, a function that contains it, and another cause": (
        [_spring(0.60), _free(0.72), _zone(0.53)], {"errors": {HOOKE: 0.27, FREE: 0.27}}, [FREE, HOOKE], HOOKE),
    # a free function is no change where errors have not risen by two standard deviations since the fit
    "a function where errors have risen": ([_free(0.5), _spring(0.2)], {"p": 0.022}, [FREE], FREE),
    "a function where they have not": ([_free(0.5), _spring(0.2)], {"p": 0.023}, [FREE], None),
    "a named law where they have not": ([_spring(0.2)], {"p": 0.023}, [HOOKE], HOOKE),
    "the remainder of a law before another cause": ([_drag(0.5), _free(0.28)], SPRUNG, [DRAG, FREE], FREE),
    "a remainder that is too small": ([_drag(0.5), _free(0.26)], SPRUNG, [DRAG], DRAG),
    # an alias of what shows soon does not stand before a law that the longer horizons show
    "a law of the longer horizons": ([_zone(0.4, band=1), _gain(0.2)], {}, [GAIN], GAIN),
    "a law of the shorter ones alone": ([_zone(0.4, band=1)], {}, [ZONE], ZONE),
    "a law of the longer ones that is rejected": (
        [_zone(0.4, band=1), _gain(0.2)], {"errors": {GAIN: 0.95}}, [GAIN, ZONE], ZONE),
    "the best is rejected": ([_gain(0.5), _zone(0.3)], {"errors": {GAIN: 0.92}}, [GAIN, ZONE], ZONE),
    "two are rejected": ([_gain(0.5), _zone(0.3)], {"errors": {GAIN: 0.92, ZONE: 1.2}}, [GAIN, ZONE], None),
    # what the screen cannot tell apart is told by refits
    "only the best is refitted": ([_gain(0.5), _zone(0.44)], {}, [GAIN], GAIN),
    "even on the screen": ([_gain(0.5), _zone(0.46)], {"errors": {ZONE: 0.3}}, [GAIN, ZONE], ZONE),
    "even after the refit too": ([_gain(0.5), _zone(0.46)], {"errors": {ZONE: 0.49}}, [GAIN, ZONE], ZONE),
    "a little less after the refit": ([_gain(0.5), _zone(0.46)], {"errors": {ZONE: 0.51}}, [GAIN, ZONE], GAIN),
    "another cause explaining the same": ([_gain(0.5), _spring(0.5)], {"errors": {HOOKE: 0.54}}, [GAIN, HOOKE], None),
    "another cause explaining less": ([_gain(0.5), _spring(0.5)], {"errors": {HOOKE: 0.56}}, [GAIN, HOOKE], GAIN),
    "the same cause": ([_gain(0.5), _zone(0.5)], {}, [GAIN, ZONE], GAIN),
    # the screen gives the second joint less than nine tenths of the first: refits decide at which joint it is
    "a law at its other joint": (
        [_gain(0.6), _gain(0.53, joint=2)], {"errors": (0.35, 0.27)}, [GAIN, GAIN], (GAIN, 2, None, ())),
    "a law at its first joint": (
        [_gain(0.6), _gain(0.53, joint=2)], {"errors": (0.27, 0.35)}, [GAIN, GAIN], (GAIN, 1, None, ())),
    # no more laws than the shortlist holds, and not after the time is up
    "a full shortlist": ([_screened(a, 0.5) for a in MANY],
        {"errors": {a.name: 0.99 for a in MANY}, "shortlist": 2}, [a.name for a in MANY[:2]], None),
    "a law that is not refitted": ([_gain(0.6), _zone(0.5)], {"shortlist": 1, "unfitted": GAIN}, [GAIN, ZONE], ZONE),
    "a law whose time is up": ([_gain(0.6), _zone(0.5)], {"errors": {GAIN: 0.99}, "late": 1}, [GAIN], None),
    # another start of a law that explains as much, by the step of each
    "another start": ([_gain(0.51), _gain(0.461, value=2.0)], {"steps": {2.0: 0.4, 1.0: 0.3}}, [GAIN], (GAIN, 2.0)),
    "another start that explains less": (
        [_gain(0.51), _gain(0.449, value=2.0)], {"steps": {2.0: 0.4, 1.0: 0.3}}, [GAIN], (GAIN, 1.0)),
    "a start one part contradicts": ([_gain(0.56), OVERSHOT], {"steps": {2.0: 0.4, 1.0: 0.3}}, [GAIN], (GAIN, 2.0)),
    "one that friction can imitate": (
        [_gain(0.56), OVERSHOT._replace(survived=0.02)], {"steps": {2.0: 0.4, 1.0: 0.3}}, [GAIN], (GAIN, 1.0)),
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
    "a law that is not refitted": {"refitted": {ZONE: 0.5}, "untried": 0},
    "a law whose time is up": {"untried": 1},
    "the best of a kind": {"screened": {DRAG: 0.4}},
}


@pytest.mark.parametrize("name", ROUNDS)
def test_a_round(monkeypatch, name):
    entries, options, refitted, accepted = ROUNDS[name]
    outcome, tried = _run(monkeypatch, entries, **options)
    assert tried == refitted
    effect = outcome.accepted and outcome.accepted.effect
    law = effect and key_of(effect)
    assert accepted in ([None] if effect is None else [effect.name, (effect.name, float(flat(effect)[0])), law])
    assert outcome.step.accepted == law and outcome.complete == ("late" not in options)
    for field, said in SAID.get(name, {}).items():
        value = getattr(outcome.step, field)
        if isinstance(said, dict):
            assert {key[0]: number for key, number in value} == pytest.approx(said)
        else:
            assert (value if field == "untried" else [getattr(entry, "key", entry)[0] for entry in value]) == said


@pytest.mark.parametrize(
    ("chance", "names"),
    [
        (0.0, [ZONE, GAIN, FREE]),  # 0.08 is less than 0.6 of the best
        (0.055, [ZONE, FREE]),  # 0.10 is within twice the chance level
        (0.071, []),
    ],
)
def test_suspects_are_near_the_best_and_over_chance_with_named_laws_first(monkeypatch, chance, names):
    more = {"chance": chance, "folds": (0.2, 0.2, 0.2)}
    entries = [_free(0.14, **more), _zone(0.12, **more), _gain(0.10, **more), _drag(0.08, **more)]
    outcome, tried = _run(monkeypatch, entries)
    assert not tried and [suspect.key[0] for suspect in outcome.step.suspects] == names
    assert all(suspect.chance == chance for suspect in outcome.step.suspects)


def test_what_contains_what_and_what_is_elsewhere():
    one, two, gain = _axes("x"), _axes("x", "dx"), _law("motor_gain")
    assert contains(two, one, MODEL.system) and not contains(one, two, MODEL.system)
    assert contains(one, SPRING, MODEL.system) and not contains(one, gain, MODEL.system)
    assert not contains(two, SPRING, MODEL.system)  # another signal is another cause
    assert elsewhere(key_of(gain), key_of(_law("motor_gain", joint=2)))


def test_a_band_shows_a_free_function_at_its_own_bar():
    """At 1.2 times the bar of a named law at the longer horizons, and 4 times at the shorter ones."""
    for law, band in ((_free, 1), (_spring, 0)):
        assert max((law(0.18, band=0), law(0.6, band=1)), key=lambda s: s.rank).band == band


class _Refitted(Exception):
    """A refit begins, from the last effect of a model."""


STEPS = {0.8: 1.6, 0.9: 0.8, 1.1: 0.9, 1.2: 0.7}
"""Errors that are left along the steps of starts, of which the last is not physical: it comes last, as a cogging of
another number of periods is another law."""


@pytest.mark.parametrize(
    ("left", "hidden", "begins"),
    [
        (STEPS, False, 0.9),
        ({1.0: 1 - 0.029}, False, None),  # less than a third of what a refit must remove
        ({1.0: 1 - 0.031}, False, 1.0),
        ({1.0: 1 - 0.029}, True, 1.0),  # a coordinate that is not read was inferred without the law
    ],
)
def test_the_start_of_a_law_whose_step_removes_most_is_refitted_if_that_is_enough(monkeypatch, left, hidden, begins):
    model = dataclasses.replace(MODEL, measured=(1,)) if hidden else MODEL
    value = lambda start: float(start.model.effects[-1].excess)  # noqa: E731

    def fitted(start, *_):
        raise _Refitted(value(start))

    none = trial.Null(*2 * [Refit(model, RULE, None, np.zeros(6), None)])
    fit = SmoothedFit(BARE, BARE.refitted(model), None, DATA, np.ones(6, bool), 9)
    monkeypatch.setattr(catalogue["motor_gain"], "is_physical", lambda law: float(law.excess) < 1.15)
    monkeypatch.setattr(trial, "begun", lambda hypothesis, *_: none.start._replace(model=hypothesis.model))
    monkeypatch.setattr(trial, "extended", lambda *_: None)
    monkeypatch.setattr(trial, "fitted", fitted)
    monkeypatch.setattr(MultiStep, "ratio", lambda _, null, start, *rest: left[round(value(start), 1)])
    try:
        outcome = trial.with_candidate([_gain(0.5, value=v) for v in left], none, fit, MULTI, 8)
    except _Refitted as start:
        assert begins == pytest.approx(start.args[0])
    else:
        assert begins is None and outcome.refit is None and outcome.rejection.code == "small"
