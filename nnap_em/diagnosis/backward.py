"""The backward pass: laws that are not needed go, and a rival that explains clearly more replaces a law."""

import functools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple, cast

import numpy as np

from ..effects import AbstractEffect, Candidate, SearchScales
from ..em.multistep import channels
from ..model.state_space import StateSpaceModel
from ..numerics.digits import share_of
from ..storage.log import Log
from .context import SearchContext, smooth
from .hypothesis import Evidence, Hypothesis
from .keys import Key, elsewhere, key_of, remainder_of, words
from .propose import proposals, surroundings
from .refit import Refit
from .rounds import best_of_kind
from .screen import screen
from .smoothed import SmoothedFit
from .trial import Null, Trial, null_of, with_candidate
from .verdict import IMPOSSIBLE, KEEP, MULTI_STEP, lead, needed


class _Reduced(NamedTuple):
    """A hypothesis without one of its laws, and the share of the squared error that goes with it; infinite where the
    law stays in any case.
    """

    lost: float
    fit: SmoothedFit | None = None
    null: Null | None = None


def backward(context: SearchContext, hypothesis: Hypothesis) -> Hypothesis:
    """Backward elimination: remove laws, the least needed first, without which a fit loses too little to count; then
    put into the place of each law what may explain the same. The models with and without a law are fitted in the same
    way, from their own smoothed paths.
    """
    while hypothesis.evidence:
        fit, _ = smooth(context, hypothesis, context.longest)
        if not fit.used.any():
            break
        full = null_of(hypothesis, fit, context.loss).end
        reduced = [_without(context, fit, full, place) for place in range(len(hypothesis.evidence))]
        least = needless([one.lost for one in reduced])
        if least is None:
            return compared(hypothesis, functools.partial(_in_place, context, full, reduced), context.log)
        lost = reduced[least].lost
        reason = f"without it {share_of(lost, 'the squared error', 1)} is lost, {KEEP * MULTI_STEP:.1%} counts"
        reason = reason if lost > -math.inf else IMPOSSIBLE
        context.log(f"  {words(key_of(hypothesis.model.effects[least]))} is removed: {reason}")
        hypothesis = hypothesis.without(least)
    return hypothesis


def needless(lost: Sequence[float]) -> int | None:
    """Place of the law with which the least share of the squared error goes, where that is too little to count."""
    least = int(np.argmin(lost))
    return None if needed(lost[least], MULTI_STEP) else least


def _without(context: SearchContext, fit: SmoothedFit, full: Refit, place: int) -> _Reduced:
    """The fit without the effect at `place`, and the share of its squared error that the effect removes at best."""
    hypothesis, effects = fit.hypothesis, fit.model.effects
    kept = hypothesis.evidence[place] is None or effects[place].read_off
    if kept or any(remainder_of(other, fit.model) == place for other in effects):
        return _Reduced(math.inf)  # of an earlier fit, seen in the numbers themselves, or its remainder goes first
    if not effects[place].is_physical():
        return _Reduced(-math.inf)
    smoothed, _ = smooth(context, hypothesis.without(place), context.longest)
    both = fit._replace(hypothesis=smoothed.hypothesis, path=smoothed.path, used=fit.used & smoothed.used)
    if not both.used.any():  # without it no sequence is followed
        return _Reduced(math.inf)
    null = null_of(both.hypothesis, both, context.loss)
    errors = judged_by(effects[place], fit.model, context.before.rig.measured, len(context.loss.bands))
    return _Reduced(max(1 - context.loss.ratio(null.end, full, both, *one) for one in errors), both, null)


def judged_by(
    law: AbstractEffect, model: StateSpaceModel, measured: Sequence[str], bands: int
) -> list[tuple[int, tuple[int, ...]]]:
    """Band and readings of the errors by which a law is judged; without readings, of those that are compared. Noise
    that is fitted without a law of a rate makes this rate count for nothing: of others the law removes nothing.
    """
    every: list[tuple[int, tuple[int, ...]]] = [(band, ()) for band in range(bands)]
    if law.channel in measured and (own := measured.index(law.channel)) not in channels(model):
        every.append((0, (own,)))
    return every


def compared(
    hypothesis: Hypothesis, rivals: Callable[[int, AbstractEffect, Evidence], Iterable[tuple[Trial, float]]], log: Log
) -> Hypothesis:
    """The hypothesis after the `rivals` of each law, with their leads, stood in its place. One that is clearly worse is
    no equivalent any more; the first that is clearly better takes the place.
    """
    found = list(hypothesis.evidence)
    for place, (law, evidence) in enumerate(zip(hypothesis.model.effects, hypothesis.evidence, strict=True)):
        if evidence is None:
            continue
        leads: dict[Key, float] = {}
        for trial, ahead in rivals(place, law, evidence):
            key = key_of(trial.effect)
            leads[key] = max(ahead, leads.get(key, -math.inf))
            if ahead > 1:
                log(f"  {words(key)} takes the place of {words(key_of(law))}")
                record = evidence._replace(removed=trial.removed, equivalent=(), candidate=trial.candidate)
                return trial.after._replace(evidence=(*trial.after.evidence[:-1], record))
        same = tuple(key for key in evidence.equivalent if leads.get(key, 0.0) >= -1)
        found[place] = evidence._replace(equivalent=same)
    return hypothesis._replace(evidence=tuple(found))


def _in_place(
    context: SearchContext,
    full: Refit,
    reduced: Sequence[_Reduced],
    place: int,
    law: AbstractEffect,
    evidence: Evidence,
) -> Iterator[tuple[Trial, float]]:
    """Refits in the place of a law, of each rival the best candidate, with the lead over the `full` fit."""
    _, fit, null = reduced[place]
    if fit is None or null is None:
        return
    loss = context.loss
    around = surroundings(context.before.rig, fit.model, fit.data, fit.path, fit.rows, change=context.change)
    some = rivals_of(law, evidence, proposals(around, fit.model.effects), around, alone=not fit.model.effects)
    listed = screen(loss, fit, some, shifts=0) if some else ()
    own = 1 - loss.ratio(null.end, full, fit, 0) if some else 0.0
    for entry in best_of_kind(s for s in listed if s.reached or key_of(s.candidate.start) in evidence.equivalent):
        trial = with_candidate([entry], null, fit, loss)
        its = -math.inf if trial.rejection else 1 - loss.ratio(null.end, cast(Refit, trial.refit), fit, 0)
        yield trial, lead(own, its)


def rivals_of(
    law: AbstractEffect, evidence: Evidence, every: Sequence[Candidate], around: SearchScales, *, alone: bool
) -> list[Candidate]:
    """Candidates for the place of a law: its equivalents and, unless it was found `alone`, the law elsewhere."""
    seen = [(key_of(c.start), c) for c in every if c.start.visible(around)]
    return [c for key, c in seen if key in evidence.equivalent or (not alone and elsewhere(key, key_of(law)))]
