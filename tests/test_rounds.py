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
FLOOR = 0.15
MULTI = MultiStep()


def _law(name: str, value: float = 1.0, joint: int = 1) -> AbstractEffect:
    return catalogue[name](jnp.asarray(value), joint=joint)


def _spring() -> AbstractEffect:
    return catalogue["torsional_spring"](*map(jnp.asarray, (20.0, 1.0, 0.0, 0.0)), joint=1)


def _function(*names: str) -> AbstractEffect:
    axes = tuple(Axis((name,), -2.0, 2.0, False, 20) for name in names)
    return catalogue["unknown_function"](jnp.zeros(20 ** len(axes)), axes, joint=1)


def _screened(law: AbstractEffect, share: float, chance: float = 0.0, folds=None, left_out=None, band: int = 0):
    explained = Share(share, share if left_out is None else left_out, folds or (share,) * 3)
    return Screened(
        Candidate(law, (law,), jax.tree.map(jnp.ones_like, law)), np.ones(1), explained, band, FLOOR, chance
    )


def _run(
    monkeypatch,
    entries,
    errors=None,
    hypothesis=BARE,
    shortlist=8,
    steps=None,
    risen=None,
    unfitted=(),
    late=math.inf,
):
    """A round over these candidates, and the names of those that were refitted in turn.

    A refit removes what the screen said, or leaves `errors` by name; those of `unfitted` remove nothing along their
    step.  Of the forms of a law it takes the one whose first number has the largest of `steps`.  The time is up before
    number `late`.
    """
    tried = []

    def refit(forms, null, fit, loss, passes):
        screened = max(forms, key=lambda s: float((steps or {}).get(float(flat(s.candidate.start)[0]), 0.0)))
        law = screened.candidate.start
        if len(tried) >= late:
            raise TimeUp
        tried.append(law.name)
        removed = 1 - (errors or {}).get(law.name, 1 - screened.share.least)
        after = hypothesis.plus(law, screened.candidate)
        if law.name in unfitted:
            return Trial(screened, after, 0.0, np.inf, np.inf, 0.0)
        return Trial(screened, after, removed, 12.0, np.inf, 0.5, object())

    monkeypatch.setattr(rounds, "surroundings", lambda *_, **__: None)
    monkeypatch.setattr(AbstractEffect, "visible", lambda *_: True)
    monkeypatch.setattr(rounds, "proposals", lambda *_: [])
    monkeypatch.setattr(rounds, "screen", lambda *_: tuple(entries))
    monkeypatch.setattr(rounds, "null_of", lambda *_: None)
    monkeypatch.setattr(rounds, "with_candidate", refit)
    fit = SmoothedFit(BARE, hypothesis, None, DATA, np.ones(6, bool), 9)
    before = SimpleNamespace(rig=RIG)
    effort = SEARCH_EFFORT._replace(shortlist=shortlist)
    context = SearchContext(before, {}, DATA, MULTI, effort, lambda text: None, risen=risen)
    return screening_round(fit, context), tried


@pytest.mark.parametrize(
    ("law", "share", "chance", "accepted"),
    [
        (_law("motor_gain"), 0.151, 0.0, True),
        (_law("motor_gain"), 0.149, 0.0, False),
        (_law("motor_gain"), 0.3, 0.149, True),
        (_law("motor_gain"), 0.3, 0.151, False),
        (_function("x"), 0.251, 0.0, True),  # a law without a name has a higher bar
        (_function("x"), 0.249, 0.0, False),
    ],
)
def test_a_law_is_accepted_from_the_floor_and_from_twice_the_chance_level_on(monkeypatch, law, share, chance, accepted):
    outcome, tried = _run(monkeypatch, [_screened(law, share, chance)])
    assert (outcome.accepted is not None) == bool(tried) == accepted
    assert outcome.step.accepted == (key_of(law) if accepted else None)


def test_the_smaller_of_both_shares_counts_where_the_parts_agree(monkeypatch):
    least = [_screened(_law("motor_gain"), 0.5, left_out=0.1)]
    split = [_screened(_law("motor_gain"), 0.5, folds=(0.9, -0.1, -0.1))]
    assert not _run(monkeypatch, least)[1] and not _run(monkeypatch, split)[1]


@pytest.mark.parametrize(
    ("free", "law", "share", "accepted"),
    [
        (0.55, _law("air_drag"), 0.3, "air_drag"),  # one that it does not contain: where it is even with six tenths
        (0.56, _law("air_drag"), 0.3, "unknown_function"),
        (0.5, _spring(), 0.46, "torsional_spring"),
        (0.5, _spring(), 0.44, "unknown_function"),
    ],
)
def test_a_named_law_is_preferred_to_the_function_that_contains_it_where_it_reaches_nine_tenths(
    monkeypatch, free, law, share, accepted
):
    """The parts left out of both are the same, so that they differ by what they explain: a bump is no ripple."""
    outcome, _ = _run(monkeypatch, [_screened(_function("x"), free), _screened(law, share)])
    assert outcome.accepted.effect.name == accepted


@pytest.mark.parametrize(("error", "accepted"), [(0.54, "torsional_spring"), (0.56, "unknown_function")])
def test_a_refit_may_show_that_a_named_law_is_even_with_the_function_that_contains_it(monkeypatch, error, accepted):
    """The screen is linear: it gave the spring 0.4, and its refit removes more."""
    entries = [_screened(_function("x"), 0.5), _screened(_spring(), 0.4)]
    outcome, tried = _run(monkeypatch, entries, {"torsional_spring": error})
    assert set(tried) == {"torsional_spring", "unknown_function"} and outcome.accepted.effect.name == accepted
    assert _run(monkeypatch, [_screened(_function("x"), 0.5), _screened(_spring(), 0.26)])[1] == ["unknown_function"]


def test_a_function_of_fewer_signals_is_preferred_where_it_reaches_nine_tenths(monkeypatch):
    one, two = _function("x"), _function("x", "dx")
    assert contains(two, one, MODEL.system) and not contains(one, two, MODEL.system)
    assert contains(one, _spring(), MODEL.system) and not contains(one, _law("motor_gain"), MODEL.system)
    assert not contains(two, _spring(), MODEL.system)  # another signal is another cause
    for share, names in ((0.46, ("x",)), (0.44, ("x", "dx"))):
        outcome, _ = _run(monkeypatch, [_screened(two, 0.5), _screened(one, share)])
        assert outcome.accepted.effect.inputs_named() == names


def test_a_simpler_law_is_refitted_where_the_function_that_beat_it_is_rejected(monkeypatch):
    entries = [_screened(_function("x"), 0.5), _screened(_spring(), 0.2)]
    outcome, tried = _run(monkeypatch, entries, errors={"unknown_function": 0.95})
    assert tried == ["unknown_function", "torsional_spring"] and outcome.accepted.effect.name == "torsional_spring"


def test_a_band_shows_a_free_function_at_its_own_bar():
    """At 1.2 times the bar of a named law at the longer horizons, and 4 times at the shorter ones."""
    free = [_screened(_function("x"), share, band=band) for share, band in ((0.18, 0), (0.6, 1))]
    named = [_screened(_spring(), share, band=band) for share, band in ((0.18, 0), (0.6, 1))]
    assert max(free, key=lambda s: s.rank).band == 1
    assert max(named, key=lambda s: s.rank).band == 0


def test_of_a_chain_of_laws_that_contain_each_other_one_stands(monkeypatch):
    """Each is even with the next, and the first is not even with the last."""
    laws = [_screened(_function("x"), 0.42), _screened(_function("x", "dx"), 0.46), _screened(_spring(), 0.38)]
    outcome, _ = _run(monkeypatch, laws)
    assert outcome.accepted.effect.name == "torsional_spring"


def test_a_free_function_is_no_change_where_errors_have_not_risen_since_the_fit(monkeypatch):
    """It is a suspect then, and what it contains does not take its place; a law with a name is told by its form."""
    laws = [_screened(_function("x"), 0.5), _screened(_spring(), 0.2)]
    for p, function in ((0.022, True), (0.023, False)):  # two standard deviations
        risen = Risen(1.2, p, 1e-4)
        outcome, tried = _run(monkeypatch, laws, risen=risen)
        assert (outcome.accepted is not None) == function and tried == ["unknown_function"]
        assert [s.key[0] for s in outcome.step.suspects] == ([] if function else ["unknown_function"])
        assert _run(monkeypatch, laws[1:], risen=risen)[0].accepted.effect.name == "torsional_spring"


@pytest.mark.parametrize(("remainder", "accepted"), [(0.28, "unknown_function"), (0.26, "air_drag")])
def test_the_remainder_of_a_law_comes_before_other_causes(monkeypatch, remainder, accepted):
    hypothesis = BARE.plus(_spring(), Candidate(_spring(), (_spring(),), _spring()))
    outcome, _ = _run(
        monkeypatch, [_screened(_law("air_drag"), 0.5), _screened(_function("x"), remainder)], hypothesis=hypothesis
    )
    assert outcome.accepted.effect.name == accepted


def test_errors_soon_after_a_start_decide_where_later_ones_show_nothing(monkeypatch):
    """An alias of what shows soon does not stand before a law that the longer horizons show."""
    soon, late = _screened(_law("dead_zone"), 0.4, band=1), _screened(_law("motor_gain"), 0.2)
    assert _run(monkeypatch, [soon, late])[1] == ["motor_gain"]
    assert _run(monkeypatch, [soon])[1] == ["dead_zone"]
    outcome, tried = _run(monkeypatch, [soon, late], errors={"motor_gain": 0.95})
    assert tried == ["motor_gain", "dead_zone"] and outcome.accepted.effect.name == "dead_zone"


def test_the_next_is_refitted_where_the_best_is_rejected(monkeypatch):
    entries = [_screened(_law("motor_gain"), 0.5), _screened(_law("dead_zone"), 0.3)]
    outcome, tried = _run(monkeypatch, entries, errors={"motor_gain": 0.92})
    assert tried == ["motor_gain", "dead_zone"] and outcome.accepted.effect.name == "dead_zone"
    outcome, _ = _run(monkeypatch, entries, errors={"motor_gain": 0.92, "dead_zone": 1.2})
    assert outcome.accepted is None and not outcome.step.suspects  # what was refitted and rejected is no suspect
    assert dict(outcome.step.refitted)[key_of(_law("motor_gain"))] == pytest.approx(0.08)


@pytest.mark.parametrize(
    ("share", "errors", "accepted"),
    [
        (0.44, {}, "motor_gain"),  # only the best is refitted
        (0.46, {"dead_zone": 0.3}, "dead_zone"),  # even on the screen: the refit that removes more
        (0.46, {"dead_zone": 0.49}, "dead_zone"),  # even after it, too
        (0.46, {"dead_zone": 0.51}, "motor_gain"),
    ],
)
def test_refits_decide_between_laws_that_the_screen_cannot_tell_apart(monkeypatch, share, errors, accepted):
    entries = [_screened(_law("motor_gain"), 0.5), _screened(_law("dead_zone"), share)]
    outcome, tried = _run(monkeypatch, entries, errors)
    assert outcome.accepted.effect.name == accepted
    assert len(tried) == (1 if share < 0.45 else 2)


@pytest.mark.parametrize(
    ("law", "error", "open_"),
    [(_spring(), 0.54, True), (_spring(), 0.56, False), (_law("dead_zone"), 0.5, False)],
)
def test_laws_of_other_causes_that_explain_the_same_leave_the_question_open(monkeypatch, law, error, open_):
    """A gain and a spring; two laws of the input are told by what they remove."""
    entries = [_screened(_law("motor_gain"), 0.5), _screened(law, 0.5)]
    outcome, _ = _run(monkeypatch, entries, {law.name: error})
    assert (outcome.accepted is None) == bool(outcome.step.rivals) == open_
    if open_:
        assert set(outcome.step.rivals) == {key_of(e.candidate.start) for e in entries}


def test_the_best_of_every_kind_stands_for_it(monkeypatch):
    entries = [_screened(_law("air_drag", v), share) for v, share in ((1.0, 0.1), (2.0, 0.4), (3.0, 0.2))]
    outcome, _ = _run(monkeypatch, entries)
    assert outcome.step.screened == ((key_of(_law("air_drag")), 0.4),)
    assert float(outcome.accepted.effect.c) == 2.0


SCREENED = (("unknown_function", 0.14), ("dead_zone", 0.12), ("motor_gain", 0.10), ("air_drag", 0.08))


@pytest.mark.parametrize(
    ("chance", "names"),
    [
        (0.0, ["dead_zone", "motor_gain", "unknown_function"]),  # 0.08 is less than 0.6 of the best
        (0.055, ["dead_zone", "unknown_function"]),  # 0.10 is within twice the chance level
        (0.071, []),
    ],
)
def test_suspects_are_near_the_best_and_over_chance_with_named_laws_first(monkeypatch, chance, names):
    laws = [_function("x") if name == "unknown_function" else _law(name) for name, _ in SCREENED]
    entries = [_screened(law, share, chance) for law, (_, share) in zip(laws, SCREENED, strict=True)]
    entries = [e._replace(share=Share(e.share.inside, e.share.left_out, (0.2, 0.2, 0.2))) for e in entries]
    outcome, tried = _run(monkeypatch, entries)
    assert not tried
    assert [suspect.key[0] for suspect in outcome.step.suspects] == names
    assert all(suspect.chance == chance for suspect in outcome.step.suspects)


@pytest.mark.parametrize(("errors", "joint"), [((0.27, 0.35), 1), ((0.35, 0.27), 2)])
def test_the_same_law_at_every_other_place_is_refitted_beside_the_one_that_leads(monkeypatch, errors, joint):
    """The screen gives the second joint less than nine tenths of the first: refits decide at which joint it is."""
    entries = [_screened(_law("motor_gain", joint=1), 0.60), _screened(_law("motor_gain", joint=2), 0.53)]
    assert elsewhere(*(key_of(entry.candidate.start) for entry in entries))
    left = iter(errors)
    outcome, tried = _run(monkeypatch, entries, SimpleNamespace(get=lambda *_: next(left)))  # in the order of refits
    assert len(tried) == 2 and outcome.accepted.effect.joint == joint


def test_a_law_is_not_dropped_for_a_function_that_loses_to_another_place(monkeypatch):
    """The measured case: a named law of time at joint 1 is worth most, a free function at joint 1 contains it and
    explains more, and the named law at joint 2 is worth more than the free function."""
    spring, free = _spring(), _function("x")
    entries = [_screened(spring, 0.60), _screened(free, 0.72), _screened(_law("dead_zone"), 0.53)]
    _, tried = _run(monkeypatch, entries)
    assert {"torsional_spring", "unknown_function"} <= set(tried)
    outcome, _ = _run(monkeypatch, entries, {"torsional_spring": 0.27, "unknown_function": 0.27})
    assert outcome.accepted.effect.name == "torsional_spring"


def test_no_more_laws_are_refitted_than_the_shortlist_holds(monkeypatch):
    names = ("motor_gain", "dead_zone", "air_drag", "viscous_change", "stiction", "torque_offset", "motor_back_emf")
    laws = [_law(name) for name in names if name in catalogue and len(catalogue[name].units) == 1]
    entries = [_screened(law, 0.5) for law in laws]
    outcome, tried = _run(monkeypatch, entries, {law.name: 0.99 for law in laws}, shortlist=2)
    assert len(tried) == 2 and outcome.accepted is None and outcome.complete
    assert outcome.step.untried == len(entries) - 2


def test_a_law_that_is_not_refitted_is_not_listed_as_one_that_was_and_takes_no_place_of_the_shortlist(monkeypatch):
    entries = [_screened(_law(name), share) for name, share in (("motor_gain", 0.6), ("dead_zone", 0.5))]
    outcome, tried = _run(monkeypatch, entries, shortlist=1, unfitted=("motor_gain",))
    assert tried == ["motor_gain", "dead_zone"] and outcome.accepted.effect.name == "dead_zone"
    assert [key[0] for key, _ in outcome.step.refitted] == ["dead_zone"] and outcome.step.untried == 0


def test_a_round_whose_time_is_up_has_the_number_of_laws_that_were_not_tried(monkeypatch):
    """The first is rejected, the time is up before the second."""
    entries = [_screened(_law(name), share) for name, share in (("motor_gain", 0.6), ("dead_zone", 0.5))]
    outcome, tried = _run(monkeypatch, entries, {"motor_gain": 0.99}, late=1)
    assert tried == ["motor_gain"] and not outcome.complete and outcome.step.untried == 1


@pytest.mark.parametrize(
    ("share", "value"),
    [(0.461, 2.0), (0.449, 1.0)],  # nine tenths of the best, 0.51
)
def test_a_law_is_refitted_from_another_start_that_explains_as_much(monkeypatch, share, value):
    entries = [_screened(_law("motor_gain", 1.0), 0.51), _screened(_law("motor_gain", 2.0), share)]
    outcome, tried = _run(monkeypatch, entries, steps={2.0: 0.4, 1.0: 0.3})
    assert tried == ["motor_gain"] and float(flat(outcome.accepted.effect)[0]) == value


class _Refitted(Exception):
    """A refit begins, from the last effect of a model."""


def _refitted_from(monkeypatch, left, values, model=MODEL) -> float | None:
    """The gain from which one of these starts is refitted, where `left` gives the error after its step; None: none."""

    def fitted(start, *_):
        raise _Refitted(float(start.model.effects[-1].excess))

    none = trial.Null(*2 * [Refit(model, RULE, None, np.zeros(6), None)])
    fit = SmoothedFit(BARE, BARE.refitted(model), None, DATA, np.ones(6, bool), 9)
    monkeypatch.setattr(trial, "begun", lambda hypothesis, *_: none.start._replace(model=hypothesis.model))
    monkeypatch.setattr(trial, "extended", lambda *_: None)
    monkeypatch.setattr(trial, "fitted", fitted)
    monkeypatch.setattr(MultiStep, "ratio", lambda _, null, start, *rest: left(float(start.model.effects[-1].excess)))
    try:
        outcome = trial.with_candidate([_screened(_law("motor_gain", v), 0.5) for v in values], none, fit, MULTI, 8)
    except _Refitted as start:
        return start.args[0]
    assert outcome.refit is None and outcome.rejection.code == "small"
    return None


def test_a_start_that_one_part_contradicts_counts_beside_an_admitted_one(monkeypatch):
    """A ripple of nine periods overshoots on one part, one of ten is admitted, and its refit goes to nine."""
    right = _screened(_law("motor_gain", 2.0), 0.76, folds=(0.9, 0.9, -0.2))
    admitted, steps = _screened(_law("motor_gain", 1.0), 0.56), {2.0: 0.4, 1.0: 0.3}
    for other, value in ((right, 2.0), (right._replace(survived=0.02), 1.0)):  # that friction can imitate is no start
        outcome, _ = _run(monkeypatch, [admitted, other], steps=steps)
        assert not other.admissible and float(flat(outcome.accepted.effect)[0]) == value


def test_of_the_starts_of_a_law_the_one_whose_step_removes_most_is_refitted(monkeypatch):
    """A start whose step is not physical comes last: a cogging of another number of periods is another law."""
    errors = {0.8: 1.6, 0.9: 0.8, 1.1: 0.9, 1.2: 0.7}
    sound = lambda law: float(law.excess) < 1.15  # noqa: E731
    monkeypatch.setattr(catalogue["motor_gain"], "is_physical", sound)
    assert _refitted_from(monkeypatch, lambda value: errors[round(value, 1)], errors) == pytest.approx(0.9)


def test_a_law_whose_step_removes_nothing_is_not_refitted(monkeypatch):
    """Along the step of the screen the nonlinear error falls by less than a third of what a refit must remove; but a
    coordinate that is not read was inferred without the law.
    """
    assert _refitted_from(monkeypatch, lambda _: 1 - 0.029, [1.0]) is None
    assert _refitted_from(monkeypatch, lambda _: 1 - 0.031, [1.0]) == 1.0
    assert _refitted_from(monkeypatch, lambda _: 1 - 0.029, [1.0], dataclasses.replace(MODEL, measured=(1,))) == 1.0
