"""Decisions of the search on numbers: laws that enter a model or leave it, and what is left where it fails."""

import dataclasses
import math
import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import plant
import pytest
from helpers import around, declared_model, slide

from nnap_em.data.dataset import Dataset
from nnap_em.data.rig import Declared, Rig
from nnap_em.diagnosis import backward, search
from nnap_em.diagnosis import context as context_of
from nnap_em.diagnosis.context import SEARCH_EFFORT, SearchContext, ahead
from nnap_em.diagnosis.hypothesis import Evidence, Hypothesis, covariances
from nnap_em.diagnosis.keys import completed, key_of, remainder_of, replaced
from nnap_em.diagnosis.losses import MultiStep
from nnap_em.diagnosis.outcome import Step, Suspect
from nnap_em.diagnosis.propose import seeded
from nnap_em.diagnosis.refit import Refit
from nnap_em.diagnosis.rounds import Round
from nnap_em.diagnosis.screen import Screened
from nnap_em.diagnosis.smoothed import SmoothedFit
from nnap_em.diagnosis.trial import Null, Trial, certainty
from nnap_em.diagnosis.verdict import Share
from nnap_em.effects import Candidate, catalogue
from nnap_em.effects.function import Axis, InputAxis
from nnap_em.em.loop import EMState
from nnap_em.em.mstep import MStepInfo
from nnap_em.fit.identify import Identified
from nnap_em.model.state_space import with_effects
from nnap_em.smoother.start import StartBank
from nnap_em.storage.deadline import TimeUp, until
from nnap_em.storage.journal import HERE, step

MODEL, RULE = slide()
BARE = Hypothesis(MODEL, RULE)
DATA = Dataset(np.tile(0.05 * np.arange(9), (6, 1)), *(np.zeros((6, 9, n)) for n in (1, 2)), np.ones((6, 9), bool))
RIG = Rig("slide", "slide", {"m": Declared(1.0, 0.0)}, True, ("u",), (1,), 0.05, "sequence", ("x", "dx"), {}, {})
ACROBOT = declared_model(plant.Case(steps=20, hidden=False))
AROUND = around(ACROBOT)
MULTI = MultiStep()
SMOOTHED = SmoothedFit(BARE, BARE, None, DATA, np.ones(6, bool), 9)


def _law(name: str, value: float = 0.0):
    return catalogue[name](jnp.asarray(value), joint=1)


def _candidate(name: str, spread: float = 2.0) -> Candidate:
    return Candidate(_law(name), (_law(name, 1.0),), _law(name, spread))


def _function(axis=None):
    axis = axis or Axis(("x",), -2.0, 2.0, False, 20)
    return catalogue["unknown_function"](axis.centres(), (axis,), joint=1)


OF_INPUT = _function(InputAxis(("u",), -2.0, 2.0, False, 20, index=0))
SPRING = catalogue["torsional_spring"](*map(jnp.asarray, (20.0, 1.0, 0.0, 0.0)), joint=1)


def _with(*names: str) -> Hypothesis:
    """The slide with these effects."""
    hypothesis = BARE
    for i, name in enumerate(names):
        hypothesis = hypothesis.plus(_law(name, 1.0 + i), _candidate(name, 2.0 + i), Evidence(removed=0.5 + 0.1 * i))
    return hypothesis


def _names(hypothesis) -> list[str]:
    return [effect.name for effect in hypothesis.effects]


def test_certainty_is_the_marginal_of_the_posterior():
    """Value over standard deviation, whatever is correlated with it: network weights, a mass, another effect."""
    hypothesis = _with("motor_gain", "dead_zone")
    root = np.random.default_rng(0).normal(size=(5, 5))
    hessian = root @ root.T + np.eye(5)  # two network weights, the mass, the effects
    std = np.sqrt(np.diag(np.linalg.inv(hessian)))
    for place, name in enumerate(("motor_gain", "dead_zone")):
        value, spread = 1.0 + place, 2.0 + place
        expected = value / (spread * std[3 + place])
        cov = covariances(hypothesis.model, hypothesis.m_step, hessian)[place]
        assert certainty(_candidate(name), hypothesis.model.effects[place], cov) == pytest.approx(expected, rel=1e-9)


def test_one_fit_is_ahead_of_another_by_what_it_is_likelier_less_a_sixth_at_either_end():
    assert ahead(np.array([np.nan, 1e9, 1.0, 2.0, 3.0, 4.0]), np.zeros(6)) == pytest.approx(6 * 2.5)
    assert ahead(np.array([1.0, 2.0]), np.zeros(2)) == pytest.approx(3.0)
    assert ahead(np.full(6, 5.0), np.full(6, 3.0)) == pytest.approx(12.0)


@pytest.mark.parametrize("place", [0, 1, 2])
def test_one_of_three_effects_goes_with_its_prior_and_its_reason(place):
    left, names = [i for i in range(3) if i != place], ("motor_gain", "dead_zone", "air_drag")
    hypothesis = _with(*names).without(place)
    assert _names(hypothesis.model) == [names[i] for i in left]
    assert [f.removed for f in hypothesis.evidence if f] == [0.5 + 0.1 * i for i in left]
    np.testing.assert_allclose(hypothesis.m_step.prior.std, [0.1, *(2.0 + i for i in left)])
    assert [name.partition(".")[0] for name in hypothesis.m_step.prior.names] == ["m", "0", "1"]


def test_a_rest_belongs_to_the_law_of_the_same_signals_at_its_joint():
    model = with_effects(MODEL, (_law("motor_gain"), SPRING))
    assert remainder_of(_function(), model) == 1
    assert remainder_of(OF_INPUT, model) == 0
    assert remainder_of(dataclasses.replace(_function(), joint=2), model) is None
    assert remainder_of(SPRING, model) is None
    assert remainder_of(_function(), with_effects(MODEL, (_law("motor_gain"), _law("air_drag")))) is None
    free = with_effects(MODEL, (_function(),))
    assert completed(SPRING, free) and not completed(SPRING, model) and not completed(_law("motor_gain"), free)
    assert completed(_law("motor_gain"), with_effects(MODEL, (OF_INPUT,)))


def test_a_fit_starts_where_the_screen_puts_a_linear_law_and_at_the_probe_of_another():
    gain = Candidate(_law("motor_gain", 0.5), (_law("motor_gain", 0.75),), _law("motor_gain", 1.0))
    assert float(jax.tree.leaves(seeded(gain, np.array([-2.0])))[0]) == pytest.approx(0.5 - 2.0 * 0.25)
    zone = Candidate(_law("dead_zone"), (_law("dead_zone", 0.75),), _law("dead_zone", 1.0))
    assert float(jax.tree.leaves(seeded(zone, np.array([-2.0])))[0]) == 0.75


def _functions(joint: int, *names: str):
    """Functions of these signals at a joint: the one that repeats each turn, and the one that does not."""
    functions = [c.start for c in catalogue["unknown_function"].candidates(AROUND) if c.start.joint == joint]
    turning, still = (e for e in functions if e.inputs_named() == names and len(e.axes) == 1)
    return turning, still


def test_a_function_of_each_turn_and_one_of_all_turns_are_rivals():
    turning, still = _functions(2, "theta2")
    assert key_of(turning) == key_of(still)
    spring = catalogue["torsional_spring"].candidates(AROUND)[0].start
    model = with_effects(ACROBOT, (spring, turning))
    assert replaced(still, model) == 1
    assert replaced(turning, model) is None
    assert replaced(_functions(1, "theta1")[1], model) is None
    assert replaced(spring, model) is None


def test_a_stop_that_yields_is_none():
    """One that a typical torque pushes in by half a radian, or whose ends nearly meet, is a spring in disguise."""
    stop = next(c for c in catalogue["hard_stop"].candidates(AROUND) if c.start.joint == 2).probes[0]
    assert stop.is_physical()
    half = np.log(2.0 * AROUND.torque[1])  # N m/rad
    assert eqx.tree_at(lambda s: s.stiffness, stop, half + 0.01).is_physical()
    assert not eqx.tree_at(lambda s: s.stiffness, stop, half - 0.01).is_physical()
    assert not eqx.tree_at(lambda s: s.lower, stop, stop.upper - 0.1).is_physical()


# --- the search


def _emstate(model, top: float) -> EMState:
    return EMState(5, model, model, model, jnp.eye(1), np.full(6, top), 1.0, jax.random.key(0), np.full(5, top), np.inf)


def _context(stages=None) -> SearchContext:
    before = Identified(RIG, _emstate(MODEL, 0.0), RULE, StartBank((1, 1), (0,)), None)
    return SearchContext(
        before, stages or {9: (before.state, np.ones(6, bool))}, DATA, MULTI, SEARCH_EFFORT, lambda text: None
    )


def _patched(monkeypatch, module, **values) -> None:
    for name, value in values.items():
        monkeypatch.setattr(module, name, value)


@pytest.mark.parametrize(("worse", "kept"), [(0.9, 7.0), (1.1, 0.0)])
def test_a_fit_that_predicts_worse_than_what_it_began_from_is_not_kept(monkeypatch, worse, kept):
    def fit(state, data, smoother, m_step, *, epochs, schedule):
        return _emstate(state.model, 0.0 if epochs == 2 else 7.0)  # one epoch, which only judges the model as it is

    nothing = dict.fromkeys(("_afresh", "followed", "errors"), lambda *_: None)
    smoothed = lambda *_: (SMOOTHED, np.ones(6, bool))  # noqa: E731
    _patched(monkeypatch, context_of, fit=fit, smooth=smoothed, ratio=lambda *_: worse, **nothing)
    assert context_of.extend(_context(), _with("motor_gain"), 9).top[0] == kept


def _pretend(monkeypatch, worth: dict[str, float], others=()):
    """Fits whose squared error is one, less what each law of theirs is worth; `others` come in the place of laws."""
    left = lambda model: 1 - sum(worth[name] for name in _names(model))  # noqa: E731
    fit_of = lambda _, hypothesis, __: (SMOOTHED._replace(hypothesis=hypothesis), np.ones(6, bool))  # noqa: E731
    for module in (search, backward):
        monkeypatch.setattr(module, "smooth", fit_of)
    monkeypatch.setattr(backward, "null_of", lambda hypothesis, *_: Null(*2 * [_refit(hypothesis.model)]))
    monkeypatch.setattr(backward, "_in_place", lambda *_: iter(others))
    monkeypatch.setattr(MultiStep, "ratio", lambda self, null, full, *_: left(full.model) / left(null.model))
    monkeypatch.setattr(search, "extend", lambda context, hypothesis, length: _emstate(hypothesis.model, 1.0))


@pytest.mark.parametrize(
    ("worth", "hypothesis", "stay"),
    [
        ((0.5, 0.04), _with("motor_gain", "dead_zone"), ["motor_gain"]),
        ((0.5, 0.04), _with("dead_zone", "motor_gain"), ["motor_gain"]),
        ((0.5, 0.06), _with("motor_gain", "dead_zone"), ["motor_gain", "dead_zone"]),
        ((0.5, 0.06), _with("dead_zone", "motor_gain"), ["dead_zone", "motor_gain"]),
        ((0.01, 0.02), _with("motor_gain", "dead_zone"), []),
        (
            (0.0, 0.5),
            BARE.plus(_law("dead_zone", -1.0), _candidate("dead_zone"), Evidence(removed=0.5)),
            [],
        ),  # without meaning
    ],
)
def test_a_law_goes_without_which_too_little_is_lost(monkeypatch, worth, hypothesis, stay):
    """Of an error of 0.5, 0.09 of it, the least that counts, are 0.045; without either the other is worth more."""
    _pretend(monkeypatch, dict(zip(("motor_gain", "dead_zone"), worth, strict=True)))
    assert _names(backward.backward(_context(), hypothesis).model) == stay


def _refit(model, top: float = 0.0) -> Refit:
    return Refit(model, RULE, None, np.full(6, top), None)


def _case(law, removed: float = 0.5) -> Trial:
    screened = Screened(Candidate(law, (law,), law), np.ones(1), Share(0.5, 0.4, (0.5,) * 3), 0, 0.15, 0.0)
    return Trial(screened, BARE.plus(law, screened.candidate), removed, 12.0, np.inf)


def _rounds(monkeypatch, *queue):
    """Replace screening rounds by a queue: a law is accepted, a number of candidates is left as the time is up."""
    left = list(queue)

    def screening_round(fit, context):
        law = left.pop(0) if left else None
        if isinstance(law, Exception):
            raise law
        step = Step(fit.rows, (), (), None, 400, context.loss.measure)
        if law is None or isinstance(law, int):
            return Round(step._replace(untried=law or 0), None, complete=law is None)
        case = _case(law)
        return Round(step._replace(accepted=key_of(law)), case._replace(after=fit.hypothesis.plus(law, case.candidate)))

    _patched(monkeypatch, search, release_programs=lambda: None, screening_round=screening_round)


LOST = np.linalg.LinAlgError("Singular matrix")
GAIN, DRAG = _law("motor_gain", 0.5), _law("air_drag", 0.5)
SEARCHES = {  # rounds, what a gain is worth, the laws at the end, by round whether one was accepted, whether it ended
    "until none is accepted": ((GAIN, DRAG), 0.4, ["motor_gain", "air_drag"], [1, 1, 0], True),
    "accepted in every round, needless in every backward pass": ((GAIN, None, GAIN), 0.01, [], [1, 0], True),
    "its time is up before the second screen": ((GAIN, TimeUp()), 0.4, ["motor_gain"], [1], False),
    "its time is up with candidates left": ((GAIN, 3), 0.4, ["motor_gain"], [1, 0], False),
    "a matrix is singular in the second round": ((GAIN, LOST), 0.4, ["motor_gain"], [1], False),
}


@pytest.mark.parametrize(("queue", "worth", "names", "accepted", "complete"), SEARCHES.values(), ids=SEARCHES)
def test_a_search_keeps_what_was_accepted_before(monkeypatch, queue, worth, names, accepted, complete):
    _pretend(monkeypatch, {"motor_gain": worth, "air_drag": 0.3})
    _rounds(monkeypatch, *queue)
    hypothesis, state, steps, ended, failure = search._search(_context(), BARE, None, [9])
    assert _names(hypothesis.model) == names and (state is not None) == bool(names) and ended == complete
    assert [step.accepted is not None for step in steps] == [each == 1 for each in accepted]
    assert steps[-1].untried == (3 if 3 in queue else 0) and failure == ("Singular matrix" if LOST in queue else "")
    for record in hypothesis.evidence:
        assert (record.removed, record.share, record.chance, record.parts) == (0.5, 0.4, 0.0, (3, 3))
        assert np.isnan(record.gain)  # a likelihood proves nothing there


@pytest.mark.parametrize("late", [True, False])
def test_a_search_that_fails_says_so(monkeypatch, late):
    """At the end of the fit, or in its second round."""

    def release(fitted, data):
        if late:
            raise LOST
        return fitted

    _pretend(monkeypatch, {"motor_gain": 0.4})
    certain = lambda model, *_: [np.eye(1)] * len(model.effects)  # noqa: E731
    start = lambda context, hypothesis: (hypothesis, None)  # noqa: E731
    _patched(monkeypatch, search, quantised=start, covariances=certain, certainty=lambda *_: math.inf)
    _rounds(monkeypatch, GAIN, *(() if late else (LOST,)))
    log = []
    outcome = search.search(_context()._replace(log=log.append), release=release)
    assert _names(outcome.after.model) == ["motor_gain"] and len(outcome.evidence) == 1
    assert not outcome.complete and outcome.failure == "Singular matrix" and "(Singular matrix)" in outcome.unfinished
    assert "numerical failure" in log[-1]


def test_no_step_begins_after_the_deadline():
    count = []
    toy = step(lambda: HERE)(lambda: count.append(1) or np.zeros(1))
    with until(time.monotonic() + 3600):
        toy()
    with until(time.monotonic() - 1), pytest.raises(TimeUp):
        toy()
    toy()
    assert len(count) == 2


@pytest.mark.parametrize(
    ("removed", "names"), [(0.9, ["torsional_spring", "unknown_function"]), (0.1, ["unknown_function"])]
)
def test_a_named_law_gives_way_to_a_remainder_that_explains_the_larger_part(removed, names):
    """The remainder removes half of what is left by a law that removed nine tenths, or one."""
    spring = Candidate(SPRING, (SPRING,), SPRING)
    hypothesis = BARE.plus(SPRING, spring, Evidence(removed=removed))
    law = _function()
    case = _case(law)._replace(after=hypothesis.plus(law, _case(law).screened.candidate))
    following = search._with(hypothesis, case, Evidence(removed=0.5), _context())
    assert _names(following.model) == names
    # the remainder that took the place removed what both did; beside the law only its own
    assert following.evidence[-1].removed == pytest.approx(0.5 if len(names) == 2 else 1 - 0.9 * 0.5)


@pytest.mark.parametrize(
    ("certain", "count", "white", "stays"),
    [
        (2.1, 6, True, True),
        (1.9, 6, True, False),
        (2.7, 6, False, True),  # six recordings: Student's t of five degrees of freedom
        (2.6, 6, False, False),
        (14.1, 2, False, True),
        (13.9, 2, False, False),
        (13.9, 2, True, True),
    ],
)
def test_a_law_that_is_not_determined_as_it_is_stated_is_a_suspect(monkeypatch, certain, count, white, stays):
    """The gain is 1, of so many standard deviations as stated; the dead zone of 20 is sure."""
    names = ["motor_gain", "dead_zone"] if stays else ["dead_zone"]
    hypothesis = _with("motor_gain", "dead_zone")
    records = (
        Evidence(removed=0.5)._replace(candidate=_candidate("motor_gain"), share=0.3, chance=0.1),
        Evidence(removed=0.5),
    )
    hypothesis = hypothesis._replace(evidence=records)
    spreads = {"motor_gain": np.eye(1) / certain**2, "dead_zone": 0.01 * np.eye(1)}
    _patched(
        monkeypatch,
        search,
        covariances=lambda model, *_: [spreads[e.name] for e in model.effects],
        extend=lambda context, one, length: _emstate(one.model, 1.0),
        backward=lambda context, one: one,
    )
    rounds = [Step(9, (), (), key_of(effect), 2) for effect in hypothesis.model.effects]
    state, log = _emstate(hypothesis.model, 1.0), []
    context = _context()._replace(log=log.append, white=white, data=Dataset(*(part[:count] for part in DATA)))
    left, outcome, steps = search._determined(context, hypothesis, state, rounds, lambda fitted, data: fitted)
    assert _names(left.model) == _names(outcome.model) == names
    dropped = key_of(hypothesis.model.effects[0])
    assert steps[0].accepted == (dropped if stays else None) and steps[1].accepted is not None
    assert steps[-1].suspects == (() if stays else (Suspect(dropped, 0.3, 0.1),))
    line = f"  motor gain at joint 1 is removed: it is {certain} standard deviations from none after its refit"
    assert log == ([] if stays else [line])


def test_a_search_begins_at_the_whole_length_unless_most_sequences_are_lost_there():
    """Its ladder of horizons begins where the fit was short: the two shortest horizons of at most 150 rows, and one in
    the middle; the whole comes of itself.
    """
    state, every, most, few = _emstate(MODEL, 0.0), np.ones(6, bool), np.arange(6) < 3, np.arange(6) < 2
    for short, whole, first in ((every, most, 9), (every, few, 4), (few, few, 4)):
        assert search._first(_context(stages={4: (state, short), 9: (state, whole)})) == first
    long = Dataset(*(np.zeros((1, 500, *part.shape[2:])) for part in DATA[:3]), np.ones((1, 500), bool))
    context = _context(stages=dict.fromkeys([60, 96, 154, 246, 393, 500]))._replace(data=long)
    assert search._ladder(context) == [60, 96, 246]


@pytest.mark.parametrize("white", [True, False])
def test_external_disturbances_are_sought_where_noise_is_not_what_the_model_says(monkeypatch, white):
    sought = []

    def run(context, hypothesis, state, lengths):
        hypothesis = _with("motor_gain")
        return search._Searched(hypothesis, _emstate(hypothesis.model, 1.0), [])

    def identify(rig, data, *, key, smoother, watch):
        before = _context().before
        return before._replace(smoother=smoother(before.bank))

    _patched(
        monkeypatch,
        search,
        identify=identify,
        _search=run,
        quantised=lambda context, hypothesis: (hypothesis, None),
        white_readings=lambda data, _: white,
        covariances=lambda model, rule, hessian: [np.eye(1)] * len(model.effects),
        finished=lambda fitted, data: fitted,
        _released=lambda rig: search.finished,
        begin=lambda rig, data, key: _context().before,
        interventions=lambda fitted, data: sought.append(fitted.model) or ("push",),
    )
    outcome = search.diagnose(RIG, DATA, key=jax.random.key(0))
    assert len(outcome.evidence) == 1 and outcome.complete
    assert outcome.before.smoother.second() is not None and outcome.after.smoother.second() is not None
    assert outcome.interventions == (() if white else ("push",))
    assert sought == ([] if white else [outcome.after.model])  # by the model with its laws


@pytest.mark.parametrize(("channel", "left", "stays"), [("dx", 0.91, False), ("dx", 0.90, True), ("x", 0.1, False)])
def test_a_law_of_a_rate_is_judged_by_that_reading_too(monkeypatch, channel, left, stays):
    """Of the errors of x the law removes 5 %: a late rate counts little where noise was fitted without its law."""
    law = catalogue["sensor_delay"](jnp.asarray(0.07), channel=channel)
    _pretend(monkeypatch, {})
    ratio = lambda self, null, full, fit, band, see=(): left if see == (1,) else 0.95  # noqa: E731
    monkeypatch.setattr(MultiStep, "ratio", ratio)
    hypothesis = BARE.plus(law, Candidate(law, (law,), law), Evidence(removed=0.85))
    assert bool(backward.backward(_context(), hypothesis).evidence) == stays


@pytest.mark.parametrize(
    ("worth", "name", "same"),
    [
        (0.4, "air_drag", ("motor_gain",)),  # clearly less is no equivalent; one that was not fitted stays
        (0.5, "air_drag", ("dead_zone", "motor_gain")),
        (0.55, "air_drag", ("dead_zone", "motor_gain")),
        (0.56, "dead_zone", ()),
    ],
)
def test_what_explains_clearly_more_takes_the_place_of_a_law(monkeypatch, worth, name, same):
    """A law that removes half of the error gives way to one that removes more than ten ninths of that."""
    law = _law("dead_zone", 1.0)
    other = _case(law, worth)._replace(after=BARE.plus(law, _candidate("dead_zone")))
    other = other._replace(refit=_refit(other.after.model))
    _pretend(monkeypatch, {"air_drag": 0.5, "dead_zone": worth}, [other])
    evidence = Evidence(removed=0.5)._replace(equivalent=(key_of(law), key_of(_law("motor_gain"))))
    hypothesis = BARE.plus(_law("air_drag", 1.0), _candidate("air_drag"), evidence)
    after = backward.backward(_context(), hypothesis)
    assert _names(after.model) == [name]
    assert after.evidence[0].equivalent == tuple(key_of(_law(each)) for each in same)


@pytest.mark.parametrize("seen", [True, False])
def test_an_equivalent_that_the_motion_does_not_show_takes_no_place(monkeypatch, seen):
    """As a cogging of one period a turn that of a spring, where less than a turn was visited."""
    tried = []
    _patched(
        monkeypatch,
        backward,
        surroundings=lambda *_, **__: None,
        proposals=lambda *_: [_candidate("motor_gain")],
        screen=lambda _, fit, some, shifts: tried.extend(some) or (),
    )
    monkeypatch.setattr(catalogue["motor_gain"], "visible", lambda *_: seen)
    evidence, null = (
        Evidence(removed=0.5)._replace(equivalent=(key_of(_law("motor_gain")),)),
        Null(*2 * [_refit(MODEL)]),
    )
    assert not list(backward._in_place(_context(), key_of(_law("air_drag")), evidence, SMOOTHED, null))
    assert bool(tried) == seen


def test_ratios_of_noise_are_held_at_those_of_the_first_model():
    """A law that joins a fitted model does not make its noise the reference."""
    rule = eqx.tree_at(lambda r: r.log_q_prior, RULE, jnp.asarray([-3.0, -4.0]), is_leaf=lambda leaf: leaf is None)
    moved = eqx.tree_at(lambda m: m.log_q, MODEL, jnp.asarray([-1.0, -9.0]))
    hypothesis = Hypothesis(moved, rule).plus(_law("motor_gain", 1.0), _candidate("motor_gain"))
    np.testing.assert_array_equal(hypothesis.m_step.log_q_prior, [-3.0, -4.0])


HELD = {  # measured, white readings, the share of the declared standard deviation of numbers, and the first rounds
    "all is read, in noise that is not white": ((0, 1), False, 0.2, [9]),
    "all is read, in white noise": ((0, 1), True, 1.0, [9]),
    "a joint is hidden": ((1,), False, 1.0, [9]),
    "a joint is hidden, in white noise": ((1,), True, 1.0, [4, 6]),
}


@pytest.mark.parametrize(("measured", "white", "share", "lengths"), HELD.values(), ids=HELD)
def test_numbers_are_held_and_rounds_begin(monkeypatch, measured, white, share, lengths):
    """At short horizons where a joint is hidden and readings are white: numbers are free there, too."""
    rig = dataclasses.replace(RIG, parameters={"m": Declared(1.0, 0.5)})
    model, seen, context = dataclasses.replace(MODEL, measured=measured), [], _context()
    held, part = search._held(rig, model, white)
    assert part == share and (m := held.parameters["m"]).mean == 1.0 and m.std == pytest.approx(0.5 * share)
    before = context.before._replace(state=context.before.state._replace(model=model, best=model))
    _patched(
        monkeypatch,
        search,
        quantised=lambda context, hypothesis: (hypothesis, None),
        _ladder=lambda _: [4, 6],
        _search=lambda *args: seen.append(args[-1]) or search._Searched(BARE, None, []),
    )
    search.search(context._replace(before=before, white=white), release=lambda fitted, data: fitted)
    assert seen == [lengths]


def test_held_numbers_are_released_at_the_end(monkeypatch):
    """All that is reported has the declared standard deviation, and the curvature by it."""
    rig = dataclasses.replace(RIG, parameters={"m": Declared(1.0, 0.5)})
    held, _ = search._held(rig, MODEL, False)
    before = _context().before._replace(rig=held, smoother=search.unbranched(StartBank((1, 1), (0,))))
    stds = []

    def step(rule, model, posterior, data):
        stds.append(float(rule.prior.std[0]))
        return model, MStepInfo(jnp.full((1, 1), 7.0), np.ones(6, bool))

    _patched(monkeypatch, search, e_step=lambda *_, **__: None, finished=lambda fitted, data: fitted)
    monkeypatch.setattr(type(RULE), "__call__", step)
    after = search._released(rig)(before, DATA)
    assert stds == [pytest.approx(float(RULE.prior.std[0]) / 0.2)] and after.rig is rig
    assert float(after.m_step.prior.std[0]) == stds[0] and float(after.state.hessian[0, 0]) == 7.0
    assert after.model is before.model
