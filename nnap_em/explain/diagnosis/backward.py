"""Shares of the squared error that go with each law of a hypothesis, as both are fitted in the same way."""

import math
from collections.abc import Sequence

from ...estimate.em.multistep import channels
from ...model.effects import AbstractEffect
from ...model.state_space import StateSpaceModel
from .context import SearchContext, smooth
from .hypothesis import Hypothesis
from .keys import remainder_of
from .losses import BANDS, ratio
from .smoothed import SmoothedFit
from .trial import Fitted, null_of


def lost(context: SearchContext, hypothesis: Hypothesis) -> list[float]:
    """Share of the squared error that is lost without each law: infinite where the law stays in any case, -infinite
    where it is not physical. The models with and without it are fitted in the same way, from their own smoothed paths.
    """
    fit, _ = smooth(context, hypothesis, context.longest)
    if not fit.used.any():
        return [math.inf] * len(hypothesis.evidence)
    full = null_of(fit)
    return [_without(context, fit, full, place) for place in range(len(hypothesis.evidence))]


def _without(context: SearchContext, fit: SmoothedFit, full: Fitted, place: int) -> float:
    """The share that the effect at `place` removes at best."""
    hypothesis, effects = fit.hypothesis, fit.model.effects
    kept = hypothesis.evidence[place] is None or effects[place].read_off
    if kept or any(remainder_of(other, fit.model) == place for other in effects):
        return math.inf  # of an earlier fit, seen in the numbers themselves, or its remainder goes first
    if not effects[place].is_physical():
        return -math.inf
    reduced, _ = smooth(context, hypothesis.without(place), context.longest)
    both = fit._replace(hypothesis=reduced.hypothesis, path=reduced.path, used=fit.used & reduced.used)
    if not both.used.any():  # without it no sequence is followed
        return math.inf
    null = null_of(both)
    errors = judged_by(effects[place], fit.model, context.before.rig.measured)
    return max(1 - ratio(null.along, full.along, both.used, *one) for one in errors)


def judged_by(
    law: AbstractEffect, model: StateSpaceModel, measured: Sequence[str]
) -> list[tuple[int, tuple[int, ...]]]:
    """Band and readings of the errors by which a law is judged; without readings, of those that are compared. Noise
    that is fitted without a law of a rate makes this rate count for nothing: of others the law removes nothing.
    """
    every: list[tuple[int, tuple[int, ...]]] = [(band, ()) for band in range(len(BANDS))]
    if law.channel in measured and (own := measured.index(law.channel)) not in channels(model):
        every.append((0, (own,)))
    return every
