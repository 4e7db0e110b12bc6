"""A candidate after its refit, beside the model without it fitted in the same way."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from ..effects import AbstractEffect, Candidate, flat
from ..fit.memory import extended
from ..numerics.gaussian import Gaussian
from .findings import estimates
from .hypothesis import Hypothesis, blocks
from .keys import free_signals, replaced
from .losses import AbstractLoss
from .propose import seeded
from .refit import Trial, refit
from .screen import Screened
from .smoothed import SmoothedFit
from .verdict import Rejection, veto


class Refit(NamedTuple):
    """A hypothesis with one effect more (or another in the place of one), and what that is worth."""

    screened: Screened
    trial: Trial
    after: Hypothesis
    """The model with it."""
    removed: float
    """Share of the squared error that it removes, at the horizons by which its band is judged."""
    gain: float
    """Log-likelihood over the model without it [nat]."""
    certainty: float
    """Wald statistic of its strengths, jointly [standard deviations]."""
    amplitude: float
    """The same of its reported amplitude alone; infinite for a law that reports none."""

    @property
    def candidate(self) -> Candidate:
        """The candidate that was refitted."""
        return self.screened.candidate

    @property
    def effect(self) -> AbstractEffect:
        """The effect with its fitted parameters."""
        return self.after.model.effects[-1]

    @property
    def rejection(self) -> Rejection | None:
        """Reason against it; None where there is none."""
        numbers = {"certainty": self.certainty, "amplitude": self.amplitude, "removed": self.removed}
        return veto(
            possible=self.effect.possible(), floor=self.screened.floor, signals=free_signals(self.effect), **numbers
        )


def fitted(hypothesis: Hypothesis, path: Gaussian, fit: SmoothedFit, loss: AbstractLoss, passes: int) -> Trial:
    """`hypothesis` after some passes from a path, finished before and after on the data of the loss."""
    begun = Trial(hypothesis.model, hypothesis.m_step, path, np.zeros(0), jnp.zeros((0, 0)))
    begun = loss.finish(fit, begun)
    return loss.finish(fit, refit(begun.model, hypothesis.m_step.early(), path, fit.data, fit.used, passes=passes))


def with_candidate(screened: Screened, null: Trial, fit: SmoothedFit, loss: AbstractLoss, passes: int) -> Refit:
    """A candidate in the model, or in the place of the law that it is another form of, refitted."""
    candidate, hypothesis = screened.candidate, fit.hypothesis
    effect = seeded(candidate, screened.coefficients)
    place = replaced(effect, hypothesis.model)
    full = (hypothesis if place is None else hypothesis.without(place)).plus(effect, candidate)
    trial = fitted(full, extended(full.model, fit.path, fit.data), fit, loss, passes)
    after = full.refitted(trial.model)
    gain = np.nan_to_num(trial.loglik, nan=-1e3) - np.nan_to_num(null.loglik, nan=-1e3)
    return Refit(
        screened,
        trial,
        after,
        1 - loss.ratio(null, trial, fit, screened.band),
        float(np.sum(gain[fit.used])),
        certainty(candidate, after, trial.hessian),
        _amplitude(after, trial.hessian),
    )


def _covariance(hypothesis: Hypothesis, hessian, place: int) -> np.ndarray:
    """Covariance of the parameters of an effect, all else integrated out."""
    prior, block = hypothesis.m_step.prior, blocks(hypothesis.model, hypothesis.m_step)[place]
    cov = np.linalg.inv(np.asarray(hessian))
    cut, std = cov.shape[0] - prior.size, np.asarray(prior.std)[block]
    return cov[cut:, cut:][block, block] * np.outer(std, std)


def certainty(candidate: Candidate, hypothesis: Hypothesis, hessian, place: int = -1) -> float:
    """Wald statistic of the strengths of the effect at `place`, jointly, in standard deviations [Wald 1943].

    Half its square is the log-likelihood that would be lost without the effect, to second order.
    """
    none = np.asarray(flat(candidate.start))
    strong = np.any([np.asarray(flat(probe)) != none for probe in candidate.probes], axis=0)
    cov = _covariance(hypothesis, hessian, place)[np.ix_(strong, strong)]
    away = (np.asarray(flat(hypothesis.model.effects[place])) - none)[strong]
    return float(np.sqrt(max(0.0, away @ np.linalg.pinv(cov, rcond=1e-12, hermitian=True) @ away)))


def _amplitude(hypothesis: Hypothesis, hessian, place: int = -1) -> float:
    """Standard deviations of the reported amplitude of an effect from zero."""
    model, cov = hypothesis.model, _covariance(hypothesis, hessian, place)
    reported = estimates(model.effects[place], cov, model.system).get("amplitude")
    return reported.value / reported.std if reported and reported.std > 0 else np.inf
