"""What the search makes of numbers: which candidates are refitted, what is asked of the rule, what goes again."""

import dataclasses
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import slide

from nnap_em.data.dataset import Dataset
from nnap_em.data.rig import Declared, Rig
from nnap_em.diagnose import case as case_of
from nnap_em.diagnose import grow, loop, undo
from nnap_em.diagnose import look as search
from nnap_em.diagnose.accept import LikelihoodRule, ShareRule, SoonRule
from nnap_em.diagnose.case import Case, left_out_error, significance, trimmed
from nnap_em.diagnose.evidence import Projected, Question, Screen, Screened, Share
from nnap_em.diagnose.grow import Loop
from nnap_em.diagnose.hypothesis import Found, Hypothesis
from nnap_em.diagnose.keys import covered, key_of, rest_of
from nnap_em.diagnose.look import (
    EFFORT,
    Look,
    _best_of_kind,
    _disputed,
    _likelier_first,
    _named_first,
    _shortlist,
    look,
)
from nnap_em.diagnose.outcome import Closed, Step
from nnap_em.diagnose.propose import seeded
from nnap_em.diagnose.refit import Trial
from nnap_em.effects import Candidate, catalogue
from nnap_em.effects.function import Axis, InputAxis
from nnap_em.em.identify import Identified
from nnap_em.em.loop import EMState
from nnap_em.em.multistep import Forks, ratio
from nnap_em.model.state_space import with_effects
from nnap_em.numerics.gaussian import Gaussian

MODEL, RULE = slide()
BARE = Hypothesis(MODEL, RULE)
DATA = Dataset(*(np.zeros((6, 9, *shape)) for shape in ((), (1,), (2,))), np.ones((6, 9), bool))
RIG = Rig("slide", "slide", {"m": Declared(1.0, 0.0)}, True, ("u",), (1,), 0.05, "sequence", ("x", "dx"), {}, {})


def _law(name: str, value: float = 0.0):
    return catalogue[name](jnp.asarray(value), joint=1)


def _candidate(name: str, spread: float = 2.0) -> Candidate:
    return Candidate(_law(name), (_law(name, 1.0),), _law(name, spread))


def _found(name: str) -> Found:
    return Found(_candidate(name), 100.0, 50.0, 1e-20, 9)


def _function(name: str = "unknown_function"):
    axis = Axis(("x",), -2.0, 2.0, False, 20)
    return catalogue[name](axis.centres(), (axis,), joint=1)


def _of_input():
    axis = InputAxis(("u",), -2.0, 2.0, False, 20, index=0)
    return catalogue["unknown_function"](axis.centres(), (axis,), joint=1)


def _spring():
    return catalogue["torsional_spring"](*map(jnp.asarray, (20.0, 1.0, 0.0, 0.0)), joint=1)


def _screened(law, gain: float = 100.0, coefficient: float = 1.0) -> Screened:
    return Screened(Candidate(law, (law,), law), np.array([coefficient]), 1, gain, Share(0.3, 0.3, (0.3, 0.3)))


def _with(*names: str) -> Hypothesis:
    """The slide with these effects."""
    now = BARE
    for i, name in enumerate(names):
        now = now.plus(_law(name, 1.0 + i), _candidate(name, 2.0 + i), _found(name))
    return now


def _names(now) -> list[str]:
    return [effect.name for effect in now.effects]


# --- numbers


def test_certainty_is_the_marginal_of_the_posterior():
    """Value over standard deviation, whatever is correlated with it: network weights, a mass, another effect."""
    now = _with("motor_gain", "dead_zone")
    root = np.random.default_rng(0).normal(size=(5, 5))
    hessian = root @ root.T + np.eye(5)  # two network weights, the mass, the effects
    std = np.sqrt(np.diag(np.linalg.inv(hessian)))
    for place, name in enumerate(("motor_gain", "dead_zone")):
        value, spread = 1.0 + place, 2.0 + place
        expected = value / (spread * std[3 + place])
        assert significance(_candidate(name), now, hessian, place) == pytest.approx(expected, rel=1e-9)


def test_halves_share_no_motion():
    """Two motions in quarters of their times, three apart, and one that runs through all."""
    quarters = np.repeat(np.array([[1, 0, 1, 0], [0, 1, 0, 0]], bool), 4, axis=0)  # the last sequence is not used
    apart = np.eye(3, dtype=bool)
    screen = Screen((), Projected(np.zeros(0), np.eye(0)))
    for members, halves in ((quarters, [[0, 2], [1]]), (apart, [[0, 2], [1]]), (np.ones((4, 3), bool), [])):
        assert [np.flatnonzero(half).tolist() for half in screen._replace(members=members).halves] == halves


def test_an_effect_is_seen_on_either_half_after_a_fit_to_the_other(monkeypatch):
    """The error of a half is that of a fit which knows its sequences over one which does not: 1 and 3."""
    fitted, used = [], np.array([True, True, True, True, True, False])

    def fit(now, path, question):
        fitted.append((now, tuple(np.flatnonzero(question.used))))
        return Trial(now.model, RULE, fitted[-1], np.zeros(6), None)

    def error(null, full, data, out, horizons):
        assert (null.path[0], full.path[0]) == (BARE, now)
        assert null.path[1] == full.path[1] == tuple(np.flatnonzero(used & ~out))
        return 10 * len(horizons) + float(np.flatnonzero(out)[0] + 1)

    monkeypatch.setattr("nnap_em.diagnose.case.open_loop_error", error)
    now = _with("motor_gain")
    question = Question(BARE, BARE, None, DATA, used, 9)
    halves = (np.array([1, 1, 0, 0, 0, 1], bool), np.array([0, 0, 1, 1, 1, 0], bool))
    null = Trial(MODEL, RULE, None, np.zeros(6), None)
    path = Gaussian(jnp.zeros((6, 9, 2)), jnp.zeros((6, 9, 2, 2)))
    found = Case(_screened(_law("motor_gain", 1.0)), now, path, null, question, fit, halves)
    assert (found.unseen, found.soon_unseen) == (32.0, 22.0)
    assert len(fitted) == 5  # once on all, twice on either half


def test_what_is_left_out_is_foretold_by_the_numbers_of_the_effect_that_the_others_ask_for(monkeypatch):
    """Errors of one number that differs by sequence: what is left is that of the other half, in closed form."""
    now, true = _with("motor_gain"), np.array([1.0, 1.2, 3.0, 3.2])
    nodes, size = RULE.weights(now.model).nodes.size, now.m_step.prior.size
    slopes = np.random.default_rng(0).uniform(1.0, 2.0, (4, 9, 2, 1))
    columns = np.zeros((4, 9, 2, 1, nodes + size))
    columns[..., -1] = slopes
    error = slopes * true[:, None, None, None]
    monkeypatch.setattr(case_of, "forks", lambda *_: Forks(error, columns, np.ones(2)))
    monkeypatch.setattr(case_of, "errors", lambda *_: error)
    monkeypatch.setattr(case_of, "weighed", lambda *_: np.full(error.shape, 1e9))  # the prior says nothing beside
    every = np.ones(4, bool)
    question = Question(now, now, None, DATA, every, 9)
    first = np.array([True, True, False, False])
    trial = Trial(now.model, now.m_step, None, np.zeros(4), None)
    told = left_out_error(trial, trial, slice(size - 1, size), question, [(first, ~first), (~first, first)])
    sides = []
    for left in (first, ~first):
        by = slopes[~left]
        number = np.sum(by * error[~left]) / np.sum(by**2)
        sides.append(ratio(error, error - number * slopes, left))
    assert told == pytest.approx(np.mean(sides), rel=1e-6)
    assert sides[0] > 2 > 1 > sides[1]  # 3 is too much for 1, and 1 a part of 3


def test_a_sixth_is_trimmed_at_either_end():
    gains = np.array([np.nan, 1e9, 1.0, 2.0, 3.0, 4.0])
    assert trimmed(gains) == pytest.approx(6 * 2.5)
    assert trimmed(np.array([1.0, 2.0])) == pytest.approx(3.0)


def test_one_fit_is_ahead_of_another_by_what_it_is_likelier():
    one, other = (_emstate(MODEL, top) for top in (5.0, 3.0))
    assert grow.ahead(one, other) == pytest.approx(12.0)


@pytest.mark.parametrize(("length", "further"), [(60, 150), (150, 375), (300, 500)])
def test_a_playoff_is_two_and_a_half_times_as_far(length, further):
    assert grow.playoff(length, 500) == further


# --- records


@pytest.mark.parametrize("place", [0, 1, 2])
def test_one_of_three_effects_goes_with_its_prior_and_its_reason(place):
    left, names = [i for i in range(3) if i != place], ("motor_gain", "dead_zone", "air_drag")
    now = _with(*names).without(place)
    assert _names(now.model) == [names[i] for i in left]
    assert [f.candidate.start.name for f in now.found if f] == [names[i] for i in left]
    np.testing.assert_allclose(now.m_step.prior.std, [0.1, *(2.0 + i for i in left)])
    assert [name.partition(".")[0] for name in now.m_step.prior.names] == ["m", "0", "1"]


def test_a_rest_belongs_to_the_law_of_the_same_signals_at_its_joint():
    model = with_effects(MODEL, (_law("motor_gain"), _spring()))
    assert rest_of(_function(), model) == 1
    assert rest_of(_of_input(), model) == 0
    assert rest_of(dataclasses.replace(_function(), joint=2), model) is None
    assert rest_of(_spring(), model) is None
    assert rest_of(_function(), with_effects(MODEL, (_law("motor_gain"), _law("air_drag")))) is None
    free = with_effects(MODEL, (_function(),))
    assert covered(_spring(), free) and not covered(_spring(), model) and not covered(_law("motor_gain"), free)
    assert covered(_law("motor_gain"), with_effects(MODEL, (_of_input(),)))


def test_a_fit_starts_where_the_screen_puts_a_linear_law_and_at_the_probe_of_another():
    gain = Candidate(_law("motor_gain", 0.5), (_law("motor_gain", 0.75),), _law("motor_gain", 1.0))
    assert float(jax.tree.leaves(seeded(gain, np.array([-2.0])))[0]) == pytest.approx(0.5 - 2.0 * 0.25)
    zone = Candidate(_law("dead_zone"), (_law("dead_zone", 0.75),), _law("dead_zone", 1.0))
    assert float(jax.tree.leaves(seeded(zone, np.array([-2.0])))[0]) == 0.75


# --- what is refitted


def test_the_best_of_every_kind_stands_for_it():
    weak, strong, other = (
        _screened(_law(name, 1.0), gain)
        for name, gain in (("air_drag", 20.0), ("air_drag", 50.0), ("motor_gain", 30.0))
    )
    ranked = _best_of_kind((strong, other, weak), LikelihoodRule(), 100)
    assert [s.gain for _, s in ranked] == [50.0, 30.0]


@pytest.mark.parametrize(
    ("free", "chosen"), [(90.0, ["air_drag", "motor_gain"]), (101.0, ["unknown_function", "air_drag", "motor_gain"])]
)
def test_the_close_ones_are_refitted_and_a_free_law_that_promises_more(free, chosen):
    ranked = [
        (100.0, _screened(_law("air_drag"))),
        (41.0, _screened(_law("motor_gain"))),
        (39.0, _screened(_law("dead_zone"))),
    ]
    ranked.append((free, _screened(_function())))
    short = _shortlist(ranked, MODEL, lambda promise: promise > 10, EFFORT)
    assert [s.candidate.start.name for s in short] == chosen
    present = with_effects(MODEL, (_law("air_drag"),))
    assert "air_drag" not in [s.candidate.start.name for s in _shortlist(ranked, present, lambda p: p > 10, EFFORT)]
    assert not _shortlist(ranked, MODEL, lambda promise: False, EFFORT)


def _case(law, gain: float, held_out: float = 1e3) -> Case:
    """A refit of this outcome."""
    case = Case.__new__(Case)
    case.screened, case.gain, case.directions, case.readings = _screened(law), gain, 1, 100
    case.trial = Trial(with_effects(MODEL, (law,)), RULE, None, np.zeros(1), None)
    case.__dict__["_held_out"] = held_out
    return case


@pytest.mark.parametrize(("gain", "first"), [(70.0, "air_drag"), (50.0, "unknown_function")])
def test_a_law_with_a_name_is_preferred_where_it_is_nearly_as_good(gain, first):
    sound = [_case(_function(), 100.0), _case(_law("air_drag"), gain)]
    assert _named_first(sound, LikelihoodRule())[0].effect.name == first


def test_the_likeliest_of_those_that_shares_cannot_tell_is_first():
    laws = (_law("motor_gain"), _law("dead_zone"), _spring())
    cases = [_case(law, gain) for law, gain in zip(laws, (100.0, 160.0, 900.0), strict=True)]
    for case, error in zip(cases, (0.40, 0.42, 0.6), strict=True):
        case.__dict__["_error"] = error
    first = [case.effect.name for case in _likelier_first(cases, ShareRule())]
    assert first == ["dead_zone", "motor_gain", "torsional_spring"]  # the last removes far less, likely as it is
    assert _likelier_first([], ShareRule()) == []
    cases[1].directions = 40  # 92 nat, paid
    assert _likelier_first(cases, ShareRule())[0].effect.name == "motor_gain"
    assert _likelier_first(cases, LikelihoodRule()) == cases  # its worth is the likelihood


def test_laws_of_other_causes_that_explain_the_same_are_rivals():
    """A gain and a spring, where multi-step errors decide; two laws of the input are not."""
    gain, zone, spring = (_case(law, 100.0) for law in (_law("motor_gain"), _law("dead_zone"), _spring()))
    for case, error in ((gain, 0.40), (zone, 0.41), (spring, 0.42)):
        case.__dict__["_error"] = error
    rivals = lambda rule, *cases: [c.effect.name for c in loop._rivals(list(cases), rule, MODEL.system)]  # noqa: E731
    assert rivals(ShareRule(), gain, zone, spring) == ["motor_gain", "torsional_spring"]
    assert rivals(ShareRule(), gain, zone) == []
    assert rivals(LikelihoodRule(), gain, spring) == []
    spring.__dict__["_error"] = 0.5
    assert rivals(ShareRule(), gain, spring) == []


def test_a_law_on_which_recordings_disagree_is_told_with_those_against_it():
    law, other = _screened(_law("motor_gain")), _screened(_law("dead_zone"))
    law = law._replace(share=Share(0.8, 0.5, (0.8, 0.8, -0.6)))
    members = np.array([[True, True, False, False], [False, False, True, False], [False, False, False, True]])
    (told,) = _disputed((law, other), members, ShareRule())
    assert (told.key, told.share, told.against, told.harm) == (key_of(_law("motor_gain")), 0.5, (3,), 0.6)
    assert not _disputed((law, other), members, LikelihoodRule())
    law = eqx.tree_at(lambda law: law.weights, _of_input(), jnp.zeros(20))
    nobody = _screened(law)._replace(share=Share(0.3, 0.2, (0.4, 0.3, 0.1)))  # refused, but harms none
    assert ShareRule().disputed(nobody) and not _disputed((nobody,), members, ShareRule())


@pytest.mark.parametrize(("rest", "tried"), [(0.4, ["rest"]), (0.2, ["others"])])
def test_the_rest_of_a_law_comes_before_other_causes(monkeypatch, rest, tried):
    """Unless it promises far less than they do."""
    function, drag = (
        _screened(law)._replace(share=Share(p, p, (p,) * 3))
        for law, p in ((_function(), rest), (_law("air_drag"), 0.5))
    )
    ranked = [(0.5, drag), (rest, function)]
    monkeypatch.setattr(search, "_best_of_kind", lambda *_: ranked)
    groups = []

    def refits(question, group, *_):
        groups.append([s.candidate.start.name for s in group])
        return [_case(group[0].candidate.start, 100.0)] if group else []

    monkeypatch.setattr(search, "_refits", refits)
    monkeypatch.setattr(search, "_is_sound", lambda *_: True)
    monkeypatch.setattr(search, "surroundings", lambda *_: None)
    monkeypatch.setattr(search, "proposals", lambda *_: [])
    monkeypatch.setattr(search, "refitted", lambda *_, **__: None)
    now = BARE.plus(_spring(), Candidate(_spring(), (_spring(),), _spring()))
    question = Question(BARE, now, None, DATA, np.ones(6, bool), 9)
    monkeypatch.setattr(ShareRule, "screen", lambda *_: Screen((), Projected(np.zeros(0), np.eye(0))))
    monkeypatch.setattr(ShareRule, "worth", lambda *_: 1.0)
    look(question, RIG, ShareRule(), EFFORT, lambda text: None)
    assert groups == ([["unknown_function"]] if tried == ["rest"] else [[], ["unknown_function", "air_drag"]])


# --- the loop


def _emstate(model, top: float) -> EMState:
    return EMState(5, model, model, model, jnp.eye(1), np.full(6, top), 1.0, jax.random.key(0), np.full(5, top), np.inf)


def _loop(said: list[str]) -> Loop:
    before = Identified(RIG, _emstate(MODEL, 0.0), RULE, None, None)
    return Loop(before, {9: (before.state, np.ones(6, bool))}, DATA, LikelihoodRule(), EFFORT, said.append)


WORTH = {"motor_gain": 50.0, "dead_zone": 1.0}
"""Log-likelihood per sequence that goes with an effect [nat]."""


def _top(model) -> float:
    return sum(WORTH[name] for name in _names(model))


@pytest.mark.parametrize(
    ("error", "rule", "kept"), [(0.9, ShareRule(), 7.0), (1.1, ShareRule(), 0.0), (1.1, LikelihoodRule(), 7.0)]
)
def test_a_fit_that_predicts_worse_than_what_it_began_from_is_not_kept(monkeypatch, error, rule, kept):
    """By multi-step errors; where one-step likelihood decides, it is what the fit is for."""
    tops = []

    def fit(state, data, smoother, m_step, *, epochs, schedule):
        tops.append(0.0 if epochs == 2 else 7.0)  # one epoch, which only judges the model as it is
        return _emstate(state.model, tops[-1])

    monkeypatch.setattr(grow, "fit", fit)
    monkeypatch.setattr(grow, "asked", lambda *_: (None, np.ones(6, bool)))
    monkeypatch.setattr(grow, "open_loop_error", lambda *_: error)
    asked = _loop([])._replace(rule=rule)
    assert grow.grow(asked, _with("motor_gain"), 9, 9).top[0] == kept


@pytest.mark.parametrize("names", [("motor_gain", "dead_zone"), ("dead_zone", "motor_gain")])
def test_the_least_needed_goes_where_a_fit_without_it_loses_nothing(monkeypatch, names):
    monkeypatch.setattr(undo, "_loss", lambda now, state, i: WORTH[now.model.effects[i].name])
    monkeypatch.setattr(undo, "asked", lambda *_: (SimpleNamespace(path=None, used=np.ones(6, bool)), None))
    monkeypatch.setattr(undo, "refit", lambda model, *_, **__: Trial(model, RULE, None, np.full(6, _top(model)), None))
    monkeypatch.setattr(undo, "grow", lambda asked, now, *_: _emstate(now.model, _top(now.model)))
    now, state = _with(*names), _emstate(_with(*names).model, 51.0)
    left, _ = undo.needed(_loop([]), now, state)
    assert _names(left.model) == ["motor_gain"]


def test_what_is_not_worth_it_over_the_whole_length_goes_from_the_last_on(monkeypatch):
    """Two effects together are no better than none; the first alone is."""
    tops = {2: 1.0, 1: 5.0}
    monkeypatch.setattr(undo, "finished", lambda fitted, data: fitted)
    monkeypatch.setattr(undo, "grow", lambda asked, now, *_: _emstate(now.model, tops[len(now.found)]))
    now = _with("motor_gain", "dead_zone")
    closed = undo.concluded(_loop([]), now, _emstate(now.model, tops[2]), [])
    assert _names(closed.after.model) == ["motor_gain"]
    assert [f.candidate.start.name for f in closed.found] == ["motor_gain"]
    tops[1] = 1.0
    assert not undo.concluded(_loop([]), now, _emstate(now.model, tops[2]), []).found


@pytest.mark.parametrize(
    ("unseen", "rule", "taken"),
    [
        ((0.5, 0.5, 0.5), ShareRule(), "motor_gain"),
        ((1.5, 0.5, 0.5), ShareRule(), "dead_zone"),
        ((1.5, 1.5, 0.5), ShareRule(), None),  # the third is worth half of the first
        ((1.5, 0.5, 0.5), LikelihoodRule(), "motor_gain"),  # looks at nats
    ],
)
def test_one_nearly_as_good_is_believed_where_the_best_is_not(unseen, rule, taken):
    laws = (_law("motor_gain"), _law("dead_zone"), _spring())
    cases = [_case(law, gain) for law, gain in zip(laws, (200.0, 190.0, 100.0), strict=True)]
    for case, own, error in zip(cases, unseen, (0.4, 0.45, 0.7), strict=True):
        case.__dict__ |= {"_unseen": own, "_foretold": 2.0, "_error": error, "_held_out": 1e3}
    found = loop._believed(cases[0], cases, rule, lambda text: None)
    assert (found and found.effect.name) == taken


@pytest.mark.parametrize(("held_out", "added"), [(50.0, ["motor_gain"]), (20.0, [])])
def test_only_what_the_rule_believes_is_added(monkeypatch, held_out, added):
    """A gain of 100 nats, of which a third must be seen on sequences left out."""
    case = _case(_law("motor_gain", 0.5), 100.0, held_out)
    case.after = BARE.plus(case.effect, _candidate("motor_gain"))
    empty = Screen((), Projected(np.zeros(0), np.eye(0)))
    looks = [Look(Step(9, (), (), None, 1), empty, [case], [case]), Look(Step(9, (), (), None, 1), empty, [], [])]
    monkeypatch.setattr(loop, "let_go", lambda: None)
    question = Question(BARE, BARE, None, DATA, np.ones(6, bool), 9)
    monkeypatch.setattr(loop, "asked", lambda *_: (question, np.ones(6, bool)))
    monkeypatch.setattr(loop, "look", lambda *_: looks.pop(0))
    monkeypatch.setattr(loop, "_found", lambda *_: _found("motor_gain"))
    monkeypatch.setattr(loop, "_plain", lambda *_: None)
    steps: list[Step] = []
    now, _ = loop._search(_loop([]), BARE, 9, steps)
    assert _names(now.model) == added
    assert [step.accepted for step in steps] == ([key_of(case.effect), None] if added else [None])


@pytest.mark.parametrize(
    ("readings", "innovations", "asked"),
    [
        (True, True, [LikelihoodRule]),
        (True, False, [LikelihoodRule, ShareRule]),
        (False, True, [ShareRule]),
        (False, False, [ShareRule]),
    ],
)
def test_likelihood_is_believed_where_noise_is_what_the_model_says(monkeypatch, readings, innovations, asked):
    before, rules = _loop([]).before, []

    def close(running):
        rules.append(type(running.rule))
        return Closed(before, before, (), ())

    monkeypatch.setattr(loop, "identify", lambda *_, **__: before)
    monkeypatch.setattr(loop, "close", close)
    monkeypatch.setattr(loop, "white_readings", lambda data: readings)
    monkeypatch.setattr(loop, "white_innovations", lambda fitted, data: innovations)
    monkeypatch.setattr(loop, "disturbance_free", lambda fit, fitted, data: (fitted, data, (), ()))
    loop.close_the_loop(RIG, DATA, key=jax.random.key(0))
    assert rules == asked
    rules.clear()
    loop.close_the_loop(RIG, DATA, key=jax.random.key(0), rule=ShareRule())
    assert rules == [ShareRule]


@pytest.mark.parametrize(("unseen", "believed"), [(0.5, "motor_gain"), (1.5, "torsional_spring")])
def test_what_lies_beyond_is_asked_where_the_rule_believes_nobody(monkeypatch, unseen, believed):
    empty = Screen((), Projected(np.zeros(0), np.eye(0)))
    cases = {rule: [_case(law, 100.0)] for rule, law in ((ShareRule, _law("motor_gain")), (SoonRule, _spring()))}
    cases[ShareRule][0].__dict__ |= {"_unseen": unseen, "_foretold": 2.0, "_error": 0.5}
    cases[SoonRule][0].__dict__ |= {"_soon": 0.3, "_soon_unseen": 0.4}
    seen = lambda question, rig, rule, *_: Look(Step(9, (), (), None, 1), empty, cases[type(rule)], [])  # noqa: E731
    monkeypatch.setattr(loop, "look", seen)
    question = Question(BARE, BARE, None, DATA, np.ones(6, bool), 9)
    choice = loop._choice(_loop([])._replace(rule=ShareRule()), BARE, question, 9)
    assert choice.winner is not None and choice.winner.effect.name == believed
    assert type(choice.rule) is (ShareRule if unseen < 1 else SoonRule)
    cases[SoonRule][0].__dict__["_soon_unseen"] = 0.9
    nobody = loop._choice(_loop([])._replace(rule=ShareRule()), BARE, question, 9)
    assert (nobody.winner is None) == (unseen > 1) and nobody.seen.sound == cases[ShareRule]
