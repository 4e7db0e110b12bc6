"""A candidate after its refit, beside the model without it fitted in the same way."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..effects import AbstractEffect, Candidate, flat
from ..fit.memory import extended
from ..numerics.gaussian import Gaussian
from .findings import estimates
from .hypothesis import Hypothesis, covariances
from .keys import free_signals, replaced
from .losses import AbstractLoss
from .propose import seeded
from .refit import Refit, refit
from .screen import Screened
from .smoothed import SmoothedFit
from .verdict import Rejection, veto


class Trial(NamedTuple):
    """A hypothesis with one effect more (or another in the place of one), and the error that it removes."""

    screened: Screened
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


def fitted(hypothesis: Hypothesis, path: Gaussian, fit: SmoothedFit, loss: AbstractLoss, passes: int) -> Refit:
    """`hypothesis` after some passes from a path, finished before and after on the data of the loss."""
    begun = Refit(hypothesis.model, hypothesis.m_step, path, np.zeros(0), jnp.zeros((0, 0)))
    begun = loss.finish(fit, begun)
    return loss.finish(fit, refit(begun.model, hypothesis.m_step.early(), path, fit.data, fit.used, passes=passes))


def with_candidate(screened: Screened, null: Refit, fit: SmoothedFit, loss: AbstractLoss, passes: int) -> Trial:
    """A candidate in the model, or in the place of the law that it is another form of, refitted."""
    candidate, hypothesis = screened.candidate, fit.hypothesis
    effect = seeded(candidate, screened.coefficients)
    place = replaced(effect, hypothesis.model)
    full = (hypothesis if place is None else hypothesis.without(place)).plus(effect, candidate)
    trial = fitted(full, extended(full.model, fit.path, fit.data), fit, loss, passes)
    after = full.refitted(trial.model)
    gain = np.nan_to_num(trial.loglik, nan=-1e3) - np.nan_to_num(null.loglik, nan=-1e3)
    effect, cov = after.model.effects[-1], covariances(after.model, after.m_step, trial.hessian)[-1]
    reported = estimates(effect, cov, after.model.system).get("amplitude")
    return Trial(
        screened,
        after,
        1 - loss.ratio(null, trial, fit, screened.band),
        float(np.sum(gain[fit.used])),
        certainty(candidate, effect, cov),
        reported.value / reported.std if reported and reported.std > 0 else np.inf,
    )


def certainty(candidate: Candidate, effect: AbstractEffect, cov: Float[np.ndarray, "param param"]) -> float:
    """Wald statistic of the strengths of an effect, jointly, in standard deviations [Wald 1943].

    Half its square is the log-likelihood that would be lost without the effect, to second order.
    """
    none = np.asarray(flat(candidate.start))
    strong = np.any([np.asarray(flat(probe)) != none for probe in candidate.probes], axis=0)
    cov, away = cov[np.ix_(strong, strong)], (np.asarray(flat(effect)) - none)[strong]
    return float(np.sqrt(max(0.0, away @ np.linalg.pinv(cov, rcond=1e-12, hermitian=True) @ away)))
