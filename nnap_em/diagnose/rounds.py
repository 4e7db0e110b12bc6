"""One screening round: all candidates are screened, and the best are refitted until one is accepted."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple, TypeVar, cast

import numpy as np

from ..effects import AbstractEffect, flat
from ..model.state_space import StateSpaceModel
from ..numerics.digits import share_of
from ..storage.deadline import TimeUp
from ..systems import AbstractSystem
from .context import SearchContext
from .keys import Key, completed, contains, free_signals, key_of, remainder_of, replaced, words
from .outcome import Disputed, Step, Suspect
from .propose import proposals, seeded, surroundings
from .refit import Refit
from .screen import Screen, Screened, overlaps, screen
from .smoothed import SmoothedFit
from .trial import Trial, fitted, with_candidate
from .verdict import EQUIVALENT, EQUIVALENT_NATS, NAMED, PRICE, SAME, agreed, odds, required, suspected

_Law = TypeVar("_Law", Screened, Trial)

SUSPECTS = 4
"""Suspects that are listed: the right law was the fourth on a real arm with three recordings."""


class Round(NamedTuple):
    """Outcome of a screening round."""

    step: Step
    screen: Screen
    accepted: Trial | None
    equivalent: tuple[Key, ...] = ()
    """Named laws that the data cannot distinguish from the accepted one."""


def screening_round(fit: SmoothedFit, context: SearchContext) -> Round:
    """Screen everything that the machine may have, and refit the best until one is accepted."""
    rig, model = context.before.rig, fit.model
    around = surroundings(rig, model, fit.data, fit.path, fit.rows)
    seen = screen(context.loss, fit, proposals(around, model.effects))
    fresh = [s for s in seen.screened if s.candidate.start.visible(around) and _fresh(s.candidate.start, model)]
    ranked = _best_of_kind(s for s in fresh if seeded(s.candidate, s.coefficients).possible())
    length = int(np.max(np.sum(np.asarray(fit.data.valid), axis=1)))
    listed = tuple((key_of(s.candidate.start), _listed(s)) for s in ranked)
    disputed = _disputed(fresh, seen) if context.loss.predicts else ()
    step = Step(length, listed, (), None, len(seen.screened), context.loss.measure, disputed)
    admitted = [s for s in ranked if s.reached]
    tried: list[Trial] = []
    fitting = fit, context.loss, context.effort.passes
    try:
        null = fitted(fit.hypothesis, fit.path, *fitting) if admitted else None
        while admitted and len(tried) < context.effort.shortlist:
            first = min(s.band for s in admitted)
            band = [s for s in admitted if s.band == first]
            entries = sorted(_standing(band, [s.ratio for s in band], model), key=lambda s: -score(s, model))
            tied = [s for s in entries if score(s, model) >= EQUIVALENT * score(entries[0], model)]
            group = tied + _inside(tied, admitted, model)
            cases = []
            for s in group:
                cases.append(with_candidate(s, cast(Refit, null), *fitting))
                _log(cases[-1], context)
            tried += cases
            admissible = [case for case in cases if case.rejection is None]
            if admissible:
                return _accepted(admissible, Round(step._replace(refitted=_removals(tried)), seen, None), fit, context)
            admitted = [s for s in admitted if not any(s is other for other in group)]
    except TimeUp:
        step = step._replace(untried=len(admitted))
    others = [s for s in ranked if not any(s is case.screened for case in tried)]
    suspects = _suspects(others) if context.loss.predicts else ()
    return Round(step._replace(refitted=_removals(tried), suspects=suspects), seen, None)


def _accepted(admissible: list[Trial], outcome: Round, fit: SmoothedFit, context: SearchContext) -> Round:
    """Choose among laws that the screen cannot distinguish.

    The one counts whose refit removes most, in view of its prior odds; of those that are even in this, too, that of the
    best odds, then the likeliest.  None is accepted where one of these is of another cause.
    """
    admissible = _standing(admissible, [case.removed for case in admissible], fit.model)
    values = [case.removed * _odds(case.candidate.start, fit.model) for case in admissible]
    tied = [case for case, value in zip(admissible, values, strict=True) if value >= EQUIVALENT * max(values)]
    best = max(tied, key=lambda case: (_odds(case.candidate.start, fit.model), _priced(case)))
    law = best.candidate.start
    rivals = [case for case in tied if other_cause(case.effect, law, fit.model.system)]
    if rivals and context.loss.predicts:
        keys = tuple(key_of(case.effect) for case in (best, *rivals))
        context.log(f"  cannot tell: {', '.join(map(words, keys))} explain the same; none is added")
        return outcome._replace(step=outcome.step._replace(rivals=keys))
    candidates = [s.candidate.start for s in outcome.screen.screened]
    parts = zip(candidates, overlaps(outcome.screen, best.screened), strict=True)
    same = [key_of(c) for c, part in parts if c.named and (part < SAME or 0.0 < part * best.gain < EQUIVALENT_NATS)]
    same += [
        key_of(case.effect) for case in tied if case.effect.named and _priced(best) - _priced(case) < EQUIVALENT_NATS
    ]
    equivalent = tuple(key for key in dict.fromkeys(same) if key != key_of(law))
    return Round(outcome.step._replace(accepted=key_of(best.effect)), outcome.screen, best, equivalent)


def _priced(case: Trial) -> float:
    """Gain in log-likelihood less the price of the law's numbers [nat]."""
    return case.gain - PRICE * flat(case.effect).size


def _standing(laws: Sequence[_Law], values: Sequence[float], model: StateSpaceModel) -> list[_Law]:
    """Laws that none of the others stands for, from simple ones to free functions of many signals.

    A free function contains the named laws of its signals, and functions of fewer: as far as one of these is even with
    it the free one goes, else they go.
    """
    standing: list[tuple[_Law, float]] = []
    for law, value in sorted(zip(laws, values, strict=True), key=lambda pair: free_signals(pair[0].candidate.start)):
        inside = [k for k in standing if contains(law.candidate.start, k[0].candidate.start, model.system)]
        if not any(other >= EQUIVALENT * value for _, other in inside):
            standing = [k for k in standing if not any(k is other for other in inside)] + [(law, value)]
    return [law for law, _ in standing]


def _inside(chosen: Sequence[Screened], admitted: Sequence[Screened], model: StateSpaceModel) -> list[Screened]:
    """Best named law that each free function among the `chosen` contains: a refit may show that it is even with it."""
    out: list[Screened] = []
    for free in chosen:
        named = [
            s
            for s in admitted
            if s.band == free.band
            and not any(s is other for other in (*chosen, *out))
            and s.candidate.start.named
            and contains(free.candidate.start, s.candidate.start, model.system)
        ]
        out += named[:1] if named and named[0].ratio >= NAMED * free.ratio else []
    return out


def other_cause(one: AbstractEffect, best: AbstractEffect, system: AbstractSystem) -> bool:
    """True for laws of another kind and of other signals."""
    of_best, of_one = (set(effect.signals(system)) for effect in (best, one))
    same_law = one.named and one.name == best.name
    return not same_law and bool(of_best and of_one) and of_best.isdisjoint(of_one)


def score(screened: Screened, model: StateSpaceModel) -> float:
    """Multiple of its bar that the share of a candidate reaches, times its prior odds; the larger the better."""
    return screened.ratio * _odds(screened.candidate.start, model)


def _odds(law: AbstractEffect, model: StateSpaceModel) -> float:
    remainder = remainder_of(law, model) is not None or replaced(law, model) is not None
    return odds(free_signals(law), remainder=remainder)


def _listed(screened: Screened) -> float:
    """Share as a report lists it: none where the parts disagree."""
    return screened.share.least if screened.admissible else 0.0


def _fresh(law: AbstractEffect, model: StateSpaceModel) -> bool:
    """True for a law that the model does not hold, or that takes the place of one."""
    present = {key_of(effect) for effect in model.effects}
    return (key_of(law) not in present or replaced(law, model) is not None) and not completed(law, model)


def _best_of_kind(every: Iterable[Screened]) -> list[Screened]:
    """The best candidate of every kind, by its listed share."""
    best: dict[Key, Screened] = {}
    for screened in every:
        key = key_of(screened.candidate.start)
        if key not in best or best[key].rank < screened.rank:
            best[key] = screened
    return sorted(best.values(), key=_listed, reverse=True)


def _log(case: Trial, context: SearchContext) -> None:
    """One line on a refit."""
    values = {n: float(f"{float(v):.4g}") for n, v in case.effect.values().items()}
    share, reason, error = case.screened.share.least, case.rejection, "the squared error"
    nats = "" if context.loss.predicts else f" ({case.gain:.0f} nat)"
    context.log(
        f"  refitted {words(key_of(case.effect))} {values}: {share_of(share, error, 1)} before the refit, "
        f"{share_of(case.removed, error, 1)} after it{nats}; bar {case.screened.bar:.1%}"
    )
    if reason is not None:
        context.log(f"  {words(key_of(case.effect))} {reason.sentence}")


def _removals(tried: Sequence[Trial]) -> tuple[tuple[Key, float], ...]:
    best: dict[Key, float] = {}
    for case in tried:
        key = key_of(case.effect)
        best[key] = max(best.get(key, -np.inf), case.removed)
    return tuple(sorted(best.items(), key=lambda entry: -entry[1]))


def _suspects(ranked: Sequence[Screened]) -> tuple[Suspect, ...]:
    """Laws that remove more than chance in a round after which none was accepted: those near the best, and of these the
    named ones first.
    """
    near = [s for s in ranked if _listed(s) >= NAMED * max(map(_listed, ranked))]
    near.sort(key=lambda s: not s.candidate.start.named)
    over = (s for s in near if suspected(_listed(s), s.floor, s.chance))
    return tuple(Suspect(key_of(s.candidate.start), s.share.least, s.chance) for s in over)[:SUSPECTS]


def _disputed(every: Sequence[Screened], seen: Screen) -> tuple[Disputed, ...]:
    """The best law of every kind that would reach its bar, had a few recordings not contradicted."""
    best: dict[Key, Disputed] = {}
    for screened in every:
        share, start = screened.share, screened.candidate.start
        if share.least < required(screened.bar, free_signals(start)) or agreed(share.folds, screened.floor):
            continue
        folds = np.asarray(share.folds)
        held = seen.members[screened.band]
        against = held[folds < 0].any(axis=0)
        if not 0 < 2 * against.sum() < held.any(axis=0).sum():
            continue  # no odd ones: it is no law
        if not seeded(screened.candidate, screened.coefficients).possible():
            continue
        key = key_of(start)
        entry = Disputed(key, share.least, tuple(map(int, np.flatnonzero(against))), -float(folds.min()))
        if key not in best or best[key].share < entry.share:
            best[key] = entry
    return tuple(sorted(best.values(), key=lambda entry: -entry.share))
