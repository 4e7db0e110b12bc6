"""A candidate after its refit, beside the model without it fitted in the same way."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ...base.gaussian import Gaussian
from ...estimate.em.multistep import Followed, finish
from ...model.effects import AbstractEffect, Candidate, flat
from .hypothesis import Hypothesis
from .keys import complexity, replaced
from .losses import ratio
from .propose import seeded
from .refit import refit
from .screen import Screened
from .smoothed import SmoothedFit, extended
from .verdict import required, veto


class Fitted(NamedTuple):
    """A hypothesis after Gauss-Newton steps on the multi-step errors about a path."""

    hypothesis: Hypothesis
    path: Gaussian
    along: Followed


class Trial(NamedTuple):
    """A hypothesis with one effect more (or another in the place of one), and the error that it removes."""

    screened: Screened
    after: Hypothesis
    foreseen: float
    removed: float = np.nan
    """Shares of the squared error of the refitted hypothesis without it, at the horizons by which its band is judged,
    that the step of the screen removes, and its refit."""
    own: float = np.nan
    """The share that the refit removes at the robust scale of what it leaves, not of what was there."""
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
        least = required(self.screened.floor, complexity(self.effect))
        return veto(self.effect.is_physical(), self.removed, least, self.before)


def begun(hypothesis: Hypothesis, path: Gaussian, fit: SmoothedFit) -> Fitted:
    """`hypothesis` before any pass, on the data of `fit` along a path."""
    along = finish(hypothesis.model, hypothesis.m_step, path, fit.data, fit.used)
    return Fitted(hypothesis.refitted(along.model), path, along)


def fitted(start: Fitted, fit: SmoothedFit) -> Fitted:
    """The same after some passes, and finished again, unless it errs more then: passes raise the likelihood, and the
    errors of a wild arm follow that by chance.
    """
    hypothesis = start.hypothesis
    model, path = refit(hypothesis.model, hypothesis.m_step, start.path, fit.data, fit.used)
    end = begun(hypothesis.refitted(model), path, fit)
    return end if ratio(start.along, end.along, fit.used, band=0) <= 1 else start


def null_of(fit: SmoothedFit) -> Fitted:
    """The hypothesis of `fit`, refitted as trials are, with which they are compared."""
    return fitted(begun(fit.hypothesis, fit.path, fit), fit)


def leader(begun: Iterable[tuple[Trial, Fitted]]) -> tuple[Trial, Fitted]:
    """The start of a law whose step removes most; those that are not physical come last."""
    return max(begun, key=lambda each: (each[0].effect.is_physical(), each[0].foreseen))


def with_candidate(forms: Sequence[Screened], null: Fitted, fit: SmoothedFit) -> Trial:
    """A law in the model, or in the place of the law that it is another form of, refitted from the one of its `forms`
    whose step removes most and is physical: on the linear screen a friction of three periods may explain what five do.
    """
    hypothesis = fit.hypothesis

    def stepped(form: Screened) -> tuple[Trial, Fitted]:
        effect = seeded(form.candidate, form.coefficients)
        place = replaced(effect, hypothesis.model)
        full = (hypothesis if place is None else hypothesis.without(place)).plus(effect, form.candidate)
        start = begun(full, extended(full.model, fit.path, fit.data), fit)
        return Trial(form, start.hypothesis, 1 - ratio(null.along, start.along, fit.used, form.band)), start

    trial, start = leader(map(stepped, forms))
    end = fitted(start, fit)
    band = trial.screened.band
    removed, own = (1 - ratio(null.along, end.along, fit.used, band, own=own) for own in (False, True))
    return trial._replace(after=end.hypothesis, removed=removed, own=own)


def certainty(candidate: Candidate, effect: AbstractEffect, cov: Float[np.ndarray, "param param"]) -> float:
    """Wald statistic of the strengths of an effect, jointly, in standard deviations [Wald 1943]. Half its square is the
    log-likelihood that would be lost without the effect, to second order.
    """
    none = np.asarray(flat(candidate.start))
    strong = np.any([np.asarray(flat(probe)) != none for probe in candidate.probes], axis=0)
    cov, away = cov[np.ix_(strong, strong)], (np.asarray(flat(effect)) - none)[strong]
    return float(np.sqrt(max(0.0, away @ np.linalg.pinv(cov, rcond=1e-12, hermitian=True) @ away)))
