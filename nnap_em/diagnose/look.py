"""One look at one horizon: everything screened, the best few refitted, and what the rule says of them."""

import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from ..effects import catalogue
from ..model.state_space import StateSpaceModel
from .accept import AbstractRule
from .case import Case, Fit, refitted
from .evidence import Question, Screen, Screened, price
from .keys import Key, covered, key_of, replaced, rest_of, words
from .outcome import Disputed, Step, Suspect
from .propose import extended, proposals, seeded, surroundings
from .refit import Trial
from .screen import unlike

Say = Callable[[str], None]


class Effort(NamedTuple):
    """How long is looked, whatever is believed."""

    shortlist: int = 5
    """Candidates that are refitted."""
    close: float = 0.4
    """Share of the best promise below which a candidate is not refitted."""
    starts: int = 3
    """Places from which a law that is not linear is refitted."""
    passes: int = 8
    """Passes of a refit."""
    most: int = 4
    """Effects at most."""
    loud: float = 5.0
    """Standard deviations of a kick with which a track begins to be lost."""
    later: tuple[int, ...] = (8, 3, 1)
    """Rows after that which still count; the fewer where the many are too much."""


EFFORT = Effort()


class Look(NamedTuple):
    """The outcome."""

    step: Step
    screen: Screen
    sound: list[Case]
    """What may be believed, best first."""
    tried: list[Case]


def _best_of_kind(every: Sequence[Screened], rule: AbstractRule, readings: int) -> list[tuple[float, Screened]]:
    """The most promising member of every kind, best first."""
    best: dict[Key, tuple[float, Screened]] = {}
    for screened in every:
        if not seeded(screened.candidate, screened.coefficients).possible():
            continue
        promise, key = rule.promise(screened, readings), key_of(screened.candidate.start)
        if key not in best or best[key][0] < promise:
            best[key] = (promise, screened)
    return sorted(best.values(), key=lambda entry: -entry[0])


def _shortlist(
    ranked: Sequence[tuple[float, Screened]], model: StateSpaceModel, worthy: Callable[[float], bool], effort: Effort
) -> list[Screened]:
    """The few to be refitted: the best, and a law without a name only where it promises more than any with one."""
    present = {key_of(effect) for effect in model.effects}
    law = lambda entry: entry[1].candidate.start  # noqa: E731
    worth = [entry for entry in ranked if worthy(entry[0])]
    other = [entry for entry in worth if replaced(law(entry), model) is not None]
    fresh = other + [entry for entry in worth if key_of(law(entry)) not in present]
    fresh = [entry for entry in fresh if not covered(law(entry), model)]
    named = [entry for entry in fresh if law(entry).named]
    top = named[0][0] if named else 0.0
    unnamed = [entry for entry in fresh if not law(entry).named and entry[0] > top][:2]
    beside = other + [e for e in fresh if rest_of(law(e), model) is not None and not any(e is o for o in other)]
    unnamed = (beside + [entry for entry in unnamed if not any(entry is b for b in beside)])[:2]
    close = [e for e in named if e[0] > effort.close * top and not any(e is other for other in unnamed)]
    return [screened for _, screened in unnamed + close[: effort.shortlist - len(unnamed)]]


def _more_starts(chosen: Sequence[Screened], screen: Screen, effort: Effort) -> list[Screened]:
    """The next best places to start from of laws that are not linear: the score test says less of them."""
    more = []
    for best in chosen:
        if best.candidate.start.linear:
            continue
        key, seen = key_of(best.candidate.start), {best.gain}
        own = [s for s in screen.screened if key_of(s.candidate.start) == key]
        for other in sorted(own, key=lambda s: -s.gain):
            if len(seen) < effort.starts and other.gain not in seen and other.gain > 0.3 * best.gain:
                seen.add(other.gain)
                more.append(other)
    return more


def _try(question: Question, screened: Screened, null: Trial, fit: Fit, halves) -> Case:
    """A candidate in the model, refitted."""
    effect, now = seeded(screened.candidate, screened.coefficients), question.now
    place = replaced(effect, now.model)
    full = (now if place is None else now.without(place)).plus(effect, screened.candidate)
    path = extended(full.model, question.path, question.data)
    return Case(screened, full, path, null, question, fit, halves)


def look(question: Question, rig, rule: AbstractRule, effort: Effort, say: Say) -> Look:
    """One look: everything screened, the best few refitted; those that hold, best first."""
    now, data, readings = question.now, question.data, question.readings
    around = surroundings(rig, now.model, data, question.path, question.rows)
    candidates = proposals(around, now.model.effects)
    screen = rule.screen(question, candidates)
    present = {key_of(effect) for effect in now.model.effects}
    law = lambda one: one.candidate.start  # noqa: E731
    seen = [s for s in screen.screened if law(s).visible(around)]
    fresh = [s for s in seen if key_of(law(s)) not in present or replaced(law(s), now.model) is not None]
    ranked = _best_of_kind(fresh, rule, readings)
    worthy = functools.partial(rule.worth_a_refit, readings=readings)
    entries = _shortlist(ranked, now.model, worthy, effort)
    length = int(np.max(np.sum(np.asarray(data.valid), axis=1)))
    told = tuple((key_of(s.candidate.start), promise) for promise, s in ranked)
    step = Step(length, told, (), None, len(candidates), rule.promises, _disputed(seen, screen.members, rule))
    if not entries:
        return Look(step, screen, [], [])
    fit = functools.partial(refitted, passes=effort.passes, multistep=rule.multistep)
    null = fit(now, question.path, question)
    if data.t.shape[1] < question.rows:  # over a long horizon a start that is far off loses every track
        entries += _more_starts(entries, screen, effort)
    # what is left of a law is not to be explained by another cause: its own rest comes first
    bar = rule.near * ranked[0][0]
    forms = [s for s in entries if any(of(law(s), now.model) is not None for of in (rest_of, replaced))]
    first = [s for s in forms if rule.promise(s, readings) > bar]
    tried, sound = [], []
    for group in (first, [s for s in entries if not any(s is f for f in first)]):
        if not sound:
            cases = _refits(question, group, null, rule, fit, screen.halves, say)
            tried, sound = tried + cases, [case for case in cases if _is_sound(case, rule, say)]
    by_worth = functools.partial(sorted, key=lambda case: -rule.worth(case))
    step = step._replace(refitted=tuple((key_of(c.effect), rule.worth(c)) for c in by_worth(tried)))
    return Look(step, screen, _named_first(_likelier_first(by_worth(sound), rule), rule), by_worth(tried))


def _refits(question: Question, group: Sequence[Screened], null: Trial, rule, fit: Fit, halves, say: Say) -> list[Case]:
    """Some candidates refitted, the best of every kind."""
    best: dict[Key, Case] = {}
    for screened in group:
        case = _try(question, screened, null, fit, halves)
        key = key_of(case.effect)
        values = {n: float(f"{float(v):.4g}") for n, v in case.effect.values().items()}
        promise = rule.promise(screened, question.readings)
        say(f"  tried {words(key)} {values}: promises {promise:.3g}, refit {case.gain:.0f} nat")
        if key not in best or rule.worth(best[key]) < rule.worth(case):
            best[key] = case
    return list(best.values())


def _is_sound(case: Case, rule: AbstractRule, say: Say) -> bool:
    verdict = rule.sound(case)
    if case.effect.possible() and verdict.believed:
        return True
    reason = verdict.reason if case.effect.possible() else "has values that make no sense"
    say(f"  {words(key_of(case.effect))} {reason}")
    return False


def _disputed(
    every: Sequence[Screened], members: Bool[np.ndarray, "fold seq"], rule: AbstractRule
) -> tuple[Disputed, ...]:
    """The best of every kind on which a few recordings disagree with the others."""
    best: dict[Key, Disputed] = {}
    for one in filter(rule.disputed, every):
        if not seeded(one.candidate, one.coefficients).possible():
            continue
        key, folds = key_of(one.candidate.start), np.asarray(one.share.folds if one.share else ())
        against = members[folds < 0].any(axis=0)
        if not 0 < 2 * against.sum() < members.any(axis=0).sum():
            continue  # no odd ones: it is no law
        told = Disputed(
            key, one.share.least if one.share else 0.0, tuple(map(int, np.flatnonzero(against))), -float(folds.min())
        )
        if key not in best or best[key].share < told.share:
            best[key] = told
    return tuple(sorted(best.values(), key=lambda told: -told.share))


def suspects(seen: Look, rule: AbstractRule, chance: Callable[[], float | None]) -> tuple[Suspect, ...]:
    """Laws that removed more than chance in a look after which none was accepted: those near the best, and of these
    the named ones first.  `chance` measures the chance level of that look, which takes time.
    """
    over = [(key, promise) for key, promise in seen.step.screened if rule.suspected(promise)]
    level = chance() if over else None
    if level is None:
        return ()
    near = [(key, promise) for key, promise in over if promise >= rule.near * over[0][1]]
    near.sort(key=lambda entry: not catalogue[entry[0][0]].named)
    return tuple(Suspect(key, promise, level) for key, promise in near[:MOST] if rule.suspected(promise, level))


MOST = 4
"""Suspects that are listed: the right law was the fourth on a real arm with three recordings."""


def _likelier_first(sound: list[Case], rule: AbstractRule) -> list[Case]:
    """The likeliest, its price paid, of those whose errors cannot tell them from the best in front."""
    even = [case for case in sound if rule.multistep and rule.even(sound[0], case)]
    net = lambda case: case.gain - price(case.directions, case.readings)  # noqa: E731
    return sorted(even, key=net, reverse=True) + [case for case in sound if not any(case is e for e in even)]


def _named_first(sound: list[Case], rule: AbstractRule) -> list[Case]:
    """Only those with a name where the best of them is nearly as good as the best."""
    named = [case for case in sound if case.effect.named]
    near = named and rule.worth(named[0]) > rule.near * rule.worth(sound[0])
    return named if near else sound


def alike(case: Case, screen: Screen) -> list[tuple[Key, float]]:
    """Named effects of other kinds, and the share of what the data say of `case` that each could not say [0 to 1]."""
    candidates = [s.candidate for s in screen.screened]
    own = key_of(case.screened.candidate.start)
    told = zip(candidates, unlike(screen.projected, candidates, case.screened.candidate), strict=True)
    return [(key_of(c.start), part) for c, part in told if c.start.named and key_of(c.start) != own]
