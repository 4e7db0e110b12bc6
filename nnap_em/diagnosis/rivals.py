"""A law in the place of another over the whole length, for an experiment that discriminates the two."""

from collections.abc import Callable

import jax
import numpy as np

from ..data.dataset import Dataset
from ..effects import AbstractEffect
from ..fit.identify import Identified
from ..storage.log import silent
from .context import SEARCH_EFFORT, SearchContext, smooth
from .losses import OneStep
from .propose import proposals, seeded, surroundings
from .refit import Refit, refit
from .screen import screen
from .smoothed import SmoothedFit, extended

STARTS = 3
"""Places from which a law is fitted; one that is not linear, from all that there are."""


def proposals_for(fitted: Identified, data: Dataset) -> list[AbstractEffect]:
    """The laws that the machine of a fit may have."""
    fit = _smoothed(fitted, data, None)
    around = surroundings(fitted.rig, fit.model, fit.data, fit.path, fit.rows)
    return [candidate.start for candidate in proposals(around, fit.model.effects)]


def with_rival(
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
        passes = 10  # more than in a search: rivals are compared closely
        trials.append(refit(full.model, full.m_step, path, fit.data, fit.used, passes=passes))
    return _with(fitted, max(trials, key=lambda trial: float(np.nansum(trial.loglik)))) if trials else None


def _context(fitted: Identified, data: Dataset) -> SearchContext:
    return SearchContext(fitted, {}, jax.device_put(data), OneStep(), SEARCH_EFFORT, silent)


def _smoothed(fitted: Identified, data: Dataset, place: int | None) -> SmoothedFit:
    """Smoothed fit without one of its effects, over the whole length."""
    context = _context(fitted, data)
    hypothesis = context.declared if place is None else context.declared.without(place)
    return smooth(context, hypothesis, context.longest)[0]._replace(declared=hypothesis.having(()))


def _with(fitted: Identified, trial: Refit) -> Identified:
    """The fit with the numbers of a trial."""
    state = fitted.state._replace(model=trial.model, best=trial.model, hessian=trial.hessian, top=trial.loglik)
    return fitted._replace(state=state, m_step=trial.m_step)
