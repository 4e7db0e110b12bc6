"""A candidate after its refit, beside the model without it fitted in the same way."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..effects import AbstractEffect, Candidate, flat
from ..numerics.gaussian import Gaussian
from .context import SearchContext
from .findings import estimates
from .hypothesis import Hypothesis, covariances
from .keys import complexity, replaced
from .losses import MultiStep
from .propose import seeded
from .refit import Refit, refit
from .screen import Screened
from .smoothed import SmoothedFit, extended
from .verdict import foreseen, veto


class Trial(NamedTuple):
    """A hypothesis with one effect more (or another in the place of one), and the error that it removes."""

    screened: Screened
    after: Hypothesis
    removed: float
    """Share of the squared error that it removes, at the horizons by which its band is judged."""
    certainty: float
    amplitude: float
    """Wald statistics [standard deviations] of its strengths, jointly, and of its reported amplitude, inf without."""
    foreseen: float = np.nan
    """Share that the step of the screen removes, before any pass."""
    refit: Refit | None = None
    """Its fit; None where the step of the screen removed too little for one."""
    before: float = -np.inf
    """Share of the squared error that it removes from the recordings of the fit from which the search began."""

    @property
    def candidate(self) -> Candidate:
        """The candidate that was refitted."""
        return self.screened.candidate

    @property
    def effect(self) -> AbstractEffect:
        """The effect with its fitted parameters."""
        return self.after.model.effects[-1]

    @property
    def rejection(self) -> str | None:
        """Reason against it; None where there is none."""
        numbers = {name: getattr(self, name) for name in ("certainty", "amplitude", "removed", "before")}
        possible, count = self.effect.is_physical(), complexity(self.effect)
        return veto(possible=possible, floor=self.screened.floor, complexity=count, **numbers)


class Null(NamedTuple):
    """A hypothesis before and after its passes, with which trials are compared."""

    start: Refit
    end: Refit


def begun(hypothesis: Hypothesis, path: Gaussian, fit: SmoothedFit, loss: MultiStep) -> Refit:
    """`hypothesis` before any pass, finished on the data of the loss along a path."""
    return loss.finish(fit, Refit(hypothesis.model, hypothesis.m_step, path, np.zeros(0), jnp.zeros((0, 0))))


def fitted(start: Refit, fit: SmoothedFit, loss: MultiStep) -> Refit:
    """A refit after some passes from where it was begun, finished again."""
    return loss.finish(fit, refit(start.model, start.m_step, start.path, fit.data, fit.used))


def null_of(hypothesis: Hypothesis, fit: SmoothedFit, loss: MultiStep) -> Null:
    """`hypothesis` along the paths of `fit`, before its passes and after them."""
    start = begun(hypothesis, fit.path, fit, loss)
    return Null(start, fitted(start, fit, loss))


def leader(begun: Iterable[tuple[Trial, Refit]]) -> tuple[Trial, Refit]:
    """The start of a law whose step removes most; those that are not physical come last."""
    return max(begun, key=lambda each: (each[0].effect.is_physical(), each[0].foreseen))


def with_candidate(forms: Sequence[Screened], null: Null, fit: SmoothedFit, loss: MultiStep) -> Trial:
    """A law in the model, or in the place of the law that it is another form of, refitted from the one of its `forms`
    whose step removes most and is physical: on the linear screen a friction of three periods may explain what five do.
    Not refitted where the nonlinear error hardly falls along that step (`foreseen`).
    """
    hypothesis = fit.hypothesis

    def stepped(form: Screened) -> tuple[Trial, Refit]:
        effect = seeded(form.candidate, form.coefficients)
        place = replaced(effect, hypothesis.model)
        full = (hypothesis if place is None else hypothesis.without(place)).plus(effect, form.candidate)
        start = begun(full, extended(full.model, fit.path, fit.data), fit, loss)
        share = 1 - loss.ratio(null.start, start, fit, form.band)
        return Trial(form, full.refitted(start.model), share, np.inf, np.inf, share), start

    trial, start = leader(map(stepped, forms))
    form = trial.screened
    if not foreseen(trial.foreseen, form.floor, complexity(form.candidate.start), hidden=hypothesis.model.hides):
        return trial
    end = fitted(start, fit, loss)
    trial = trial._replace(after=trial.after.refitted(end.model), refit=end)
    effect, cov = trial.effect, covariances(trial.after.model, trial.after.m_step, end.hessian)[-1]
    reported = estimates(effect, cov, trial.after.model.system).get("amplitude")
    amplitude = reported.value / reported.std if reported and reported.std > 0 else np.inf
    sure, removed = certainty(form.candidate, effect, cov), 1 - loss.ratio(null.end, end, fit, form.band)
    return trial._replace(removed=removed, certainty=sure, amplitude=amplitude)


def explained(case: Trial, context: SearchContext) -> float:
    """Share of the squared error on the recordings of an earlier fit that a law removes; -inf without them."""
    if (fit := context.origin) is None:
        return -np.inf
    full, loss = fit.hypothesis.plus(case.effect, case.candidate), context.loss
    null = loss.along(fit, fit.hypothesis, fit.path)
    other = loss.along(fit, full, extended(full.model, fit.path, fit.data))
    return 1 - loss.ratio(null, other, fit, case.screened.band)


def certainty(candidate: Candidate, effect: AbstractEffect, cov: Float[np.ndarray, "param param"]) -> float:
    """Wald statistic of the strengths of an effect, jointly, in standard deviations [Wald 1943]. Half its square is the
    log-likelihood that would be lost without the effect, to second order.
    """
    none = np.asarray(flat(candidate.start))
    strong = np.any([np.asarray(flat(probe)) != none for probe in candidate.probes], axis=0)
    cov, away = cov[np.ix_(strong, strong)], (np.asarray(flat(effect)) - none)[strong]
    return float(np.sqrt(max(0.0, away @ np.linalg.pinv(cov, rcond=1e-12, hermitian=True) @ away)))
