"""The backward pass: laws that are not needed go, and a rival that explains clearly more replaces a law."""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple, cast

import numpy as np

from ..em.multistep import channels
from ..numerics.digits import share_of
from .context import SearchContext, smooth
from .hypothesis import Evidence, Hypothesis
from .keys import Key, elsewhere, key_of, remainder_of, words
from .propose import proposals, surroundings
from .refit import Refit
from .rounds import best_of_kind
from .screen import screen
from .smoothed import SmoothedFit
from .trial import Null, Trial, null_of, with_candidate
from .verdict import KEEP, MULTI_STEP, Rejection, needed


class _Reduced(NamedTuple):
    """A hypothesis without one of its laws."""

    lost: float
    """Share of the squared error that goes with the law; infinite for one that stays in any case."""
    fit: SmoothedFit | None = None
    null: Null | None = None


def backward(context: SearchContext, hypothesis: Hypothesis) -> Hypothesis:
    """Backward elimination: remove laws, the least needed first, without which a fit loses too little to count; then
    put into the place of each law what may explain the same.

    The models with and without a law are fitted in the same way, from their own smoothed paths.
    """
    while hypothesis.evidence:
        fit, _ = smooth(context, hypothesis, context.longest)
        if not fit.used.any():
            break
        full = null_of(hypothesis, fit, context.loss, context.effort.passes).end
        reduced = [_without(context, fit, full, place) for place in range(len(hypothesis.evidence))]
        least = int(np.argmin([one.lost for one in reduced]))
        lost = reduced[least].lost
        if needed(lost, MULTI_STEP):
            return _compared(context, hypothesis, full, reduced)
        reason = f"without it {share_of(lost, 'the squared error', 1)} is lost, {KEEP * MULTI_STEP:.1%} counts"
        reason = reason if lost > -math.inf else Rejection("impossible").sentence
        context.log(f"  {words(key_of(hypothesis.model.effects[least]))} is removed: {reason}")
        hypothesis = hypothesis.without(least)
    return hypothesis


def _without(context: SearchContext, fit: SmoothedFit, full: Refit, place: int) -> _Reduced:
    """The fit without the effect at `place`, and the share of its squared error that the effect removes at best.

    A law of a rate, which is not compared, is judged by the errors of that reading, too.
    """
    hypothesis, effects = fit.hypothesis, fit.model.effects
    if (
        hypothesis.evidence[place] is None
        or effects[place].read_off
        or any(remainder_of(other, fit.model) == place for other in effects)
    ):
        return _Reduced(math.inf)  # of an earlier fit, seen in the numbers themselves, or its remainder goes first
    if not effects[place].is_physical():
        return _Reduced(-math.inf)
    smoothed, _ = smooth(context, hypothesis.without(place), context.longest)
    both = fit._replace(hypothesis=smoothed.hypothesis, path=smoothed.path, used=fit.used & smoothed.used)
    if not both.used.any():  # without it no sequence is followed
        return _Reduced(math.inf)
    null = null_of(both.hypothesis, both, context.loss, context.effort.passes)
    judged: list[tuple[int, tuple[int, ...]]] = [(band, ()) for band in range(len(context.loss.bands))]
    measured, channel = context.before.rig.measured, key_of(effects[place])[2]
    if channel in measured and (own := measured.index(channel)) not in channels(fit.model):
        # Noise that is fitted without its law makes a rate count for nothing: of others the law then removes nothing
        judged.append((0, (own,)))
    return _Reduced(max(1 - context.loss.ratio(null.end, full, both, *one) for one in judged), both, null)


def _compared(context: SearchContext, hypothesis: Hypothesis, full: Refit, reduced: Sequence[_Reduced]) -> Hypothesis:
    """The hypothesis after its equivalents, and each law at its other places, stood in the place of their law.

    One that is clearly worse is no equivalent any more; the first that is clearly better takes the place.
    """
    found = list(hypothesis.evidence)
    for place, (law, without) in enumerate(zip(hypothesis.model.effects, reduced, strict=True)):
        evidence, leads = found[place], {}
        if without.fit is None or without.null is None or evidence is None:
            continue
        for trial in _in_place(context, key_of(law), evidence, without.fit, without.null):
            key, own = key_of(trial.effect), cast(Refit, trial.refit)
            lead = -math.inf if trial.rejection else context.loss.lead(without.null.end, full, own, without.fit)
            leads[key] = max(lead, leads.get(key, -math.inf))
            if lead > 1:
                context.log(f"  {words(key)} takes the place of {words(key_of(law))}")
                record = evidence._replace(removed=trial.removed, equivalent=(), candidate=trial.candidate)
                return trial.after._replace(evidence=(*trial.after.evidence[:-1], record))
        same = tuple(key for key in evidence.equivalent if leads.get(key, 0.0) >= -1)
        found[place] = evidence._replace(equivalent=same)
    return hypothesis._replace(evidence=tuple(found))


def _in_place(context: SearchContext, law: Key, evidence: Evidence, fit: SmoothedFit, null: Null) -> Iterator[Trial]:
    """Refits, in the place of a law, of its equivalents and, beside other laws, of the same law elsewhere: a law alone
    was compared with that when it was found.  Of each the best candidate.
    """
    around = surroundings(context.before.rig, fit.model, fit.data, fit.path, fit.rows, change=context.change)
    every = proposals(around, fit.model.effects)
    keyed = [(key_of(c.start), c) for c in every if c.start.visible(around)]
    some = [c for key, c in keyed if key in evidence.equivalent or (fit.model.effects and elsewhere(key, law))]
    listed = screen(context.loss, fit, some, shifts=0) if some else ()
    for entry in best_of_kind(s for s in listed if s.reached or key_of(s.candidate.start) in evidence.equivalent):
        yield with_candidate([entry], null, fit, context.loss, context.effort.passes)
