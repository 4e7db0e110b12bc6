"""A law in the place of another, over the whole length: the likelihood decides between the two."""

import math
from collections.abc import Callable

import jax
import numpy as np

from ..data.dataset import Dataset
from ..effects import AbstractEffect, flat
from ..fit.identify import Identified, finished
from ..fit.memory import extended
from ..storage.log import silent
from .context import EFFORT, SearchContext, extend, smooth
from .keys import key_of
from .losses import OneStep
from .outcome import Closed
from .propose import proposals, seeded, surroundings
from .refit import Refit, refit
from .screen import screen
from .smoothed import SmoothedFit
from .verdict import EQUIVALENT_NATS, PRICE

STARTS = 3
"""Places from which a law is fitted; one that is not linear, from all that there are."""
PASSES = 10
"""Passes of a fit from one of them, more than in a search: rivals are compared closely."""


def possible(fitted: Identified, data: Dataset) -> list[AbstractEffect]:
    """The laws that the machine of a fit may have."""
    fit = _smoothed(fitted, data, None)
    around = surroundings(fitted.rig, fit.model, fit.data, fit.path, fit.rows)
    return [candidate.start for candidate in proposals(around, fit.model.effects)]


def instead(
    fitted: Identified, data: Dataset, place: int | None, means: Callable[[AbstractEffect], bool]
) -> Identified | None:
    """The fit with such a law in the place of its effect number `place` (None: on top), from quick refits.

    None where the machine cannot have one.
    """
    fit = _smoothed(fitted, data, place)
    around = surroundings(fitted.rig, fit.model, fit.data, fit.path, fit.rows)
    same = [candidate for candidate in proposals(around, fit.model.effects) if means(candidate.start)]
    trials = []
    screened = sorted(screen(OneStep(), fit, same, shifts=0).screened, key=lambda s: -s.share.inside) if same else []
    for entry in (s for n, s in enumerate(screened) if n < STARTS or not s.candidate.start.linear):
        full = fit.hypothesis.plus(seeded(entry.candidate, entry.coefficients), entry.candidate)
        path = extended(full.model, fit.path, fit.data)
        trials.append(refit(full.model, full.m_step.early(), path, fit.data, fit.used, passes=PASSES))
    return _with(fitted, max(trials, key=lambda trial: float(np.nansum(trial.loglik)))) if trials else None


def again(fitted: Identified, data: Dataset) -> Identified:
    """The fit after as many quick passes as its rivals get."""
    fit = _smoothed(fitted, data, None)
    rule = fit.m_step.early()
    return _with(fitted, refit(fit.model, rule, fit.path, fit.data, fit.used, passes=PASSES))


def compare_equivalents(closed: Closed, data: Dataset) -> Closed:
    """`closed` after its effects and their equivalents were compared over the whole length of the logs.

    Screens are linear, fits over the whole length are not: an equivalent that is
    clearly less likely goes, and one that is clearly likelier takes the place of its effect.
    """
    for place, evidence in enumerate(closed.found):
        if not evidence.equivalent:
            continue
        fitted, keys = closed.after, (key_of(closed.after.model.effects[place]), *evidence.equivalent)
        reference, *others = (
            (key, instead(fitted, data, place, lambda effect, key=key: key_of(effect) == key)) for key in keys
        )
        reference = max(_total(one) for one in (again(fitted, data), reference[1]) if one is not None)
        leads = {key: _total(other) - reference for key, other in others if other is not None}
        best, other = max(others, key=lambda entry: leads.get(entry[0], -math.inf))
        if other is not None and leads[best] > EQUIVALENT_NATS:
            remaining = [one for i, one in enumerate(closed.found) if i != place]
            equivalent = [key for key, lead in leads.items() if key != best and leads[best] - lead <= EQUIVALENT_NATS]
            evidence = evidence._replace(equivalent=tuple(equivalent), gain=evidence.gain + leads[best])
            return closed._replace(after=_settled(other, data), found=(*remaining, evidence))
        equivalent = [key for key in evidence.equivalent if leads.get(key, 0.0) >= -EQUIVALENT_NATS]
        both = closed.found[:place], closed.found[place + 1 :]
        closed = closed._replace(found=(*both[0], evidence._replace(equivalent=tuple(equivalent)), *both[1]))
    return closed


def _settled(fitted: Identified, data: Dataset) -> Identified:
    """A quick refit after EM over the whole length."""
    context = _context(fitted, data)
    return finished(fitted._replace(state=extend(context, context.declared, context.longest)), context.data)


def _context(fitted: Identified, data: Dataset) -> SearchContext:
    return SearchContext(fitted, {}, jax.device_put(data), OneStep(), EFFORT, silent)


def _smoothed(fitted: Identified, data: Dataset, place: int | None) -> SmoothedFit:
    """Smoothed fit without one of its effects, over the whole length."""
    context = _context(fitted, data)
    hypothesis = context.declared if place is None else context.declared.without(place)
    return smooth(context, hypothesis, context.longest)[0]._replace(declared=hypothesis.having(()))


def _total(fitted: Identified) -> float:
    """Log-likelihood of all sequences, less the price of the numbers of its laws [nat]."""
    numbers = sum(flat(effect).size for effect in fitted.model.effects)
    return float(np.nansum(np.asarray(fitted.state.top))) - PRICE * numbers


def _with(fitted: Identified, trial: Refit) -> Identified:
    """The fit with the numbers of a trial."""
    state = fitted.state._replace(model=trial.model, best=trial.model, hessian=trial.hessian, top=trial.loglik)
    return fitted._replace(state=state, m_step=trial.m_step)
