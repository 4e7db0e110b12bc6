"""Multi-step errors by recording, beside those that a fit has on recordings left out of it."""

import math
from typing import NamedTuple

import numpy as np
import scipy.stats
from jaxtyping import Bool, Float

from ...base.gaussian import Gaussian
from ...logs.dataset import Dataset
from ...model.state_space import StateSpaceModel
from .mstep import ScoringMStep
from .multistep import followed, huber, linear


def left_out(
    model: StateSpaceModel, m_step: ScoringMStep, path: Gaussian, data: Dataset, used: Bool[np.ndarray, " seq"]
) -> Float[np.ndarray, "seq start horizon obs"]:
    """Errors of every recording with the friction and the numbers that the others give, by one Gauss-Newton step."""
    weights = m_step.weights(model)
    one = linear(followed(model, m_step.prior, path, data), weights, used)
    prior = np.asarray(weights.prior_precision(model.unknown))
    return np.where(one.weight > 0, one.left_out(prior), np.nan)


def level(
    error: Float[np.ndarray, "seq start horizon obs"], scale: Float[np.ndarray, "horizon obs"]
) -> Float[np.ndarray, " seq"]:
    """Log of the root mean square of every recording's errors in `scale`, outliers less; NaN where there is none."""
    known = np.isfinite(error)
    square = np.where(known, huber(np.where(known, error, 0.0), scale[None, None]), 0.0).sum(axis=(1, 2, 3))
    count = known.sum(axis=(1, 2, 3))
    return np.where(count > 0, 0.5 * np.log(square / np.maximum(count, 1) + 1e-12), np.nan)


class Risen(NamedTuple):
    """Test of whether the errors of new recordings are larger than those of the fit on recordings left out."""

    ratio: float
    """Root mean square of the new recordings over that of the others, by the medians of the recordings."""
    p_value: float
    """Chance of such ranks where nothing changed."""
    least: float
    """Smallest chance that so few recordings can show."""


def risen(before: Float[np.ndarray, " recording"], now: Float[np.ndarray, " new"]) -> Risen:
    """One-sided rank test of levels [Mann & Whitney 1947, Ann. Math. Stat. 18, 50]."""
    before, now = before[np.isfinite(before)], now[np.isfinite(now)]
    test = scipy.stats.mannwhitneyu(now, before, alternative="greater")
    ratio = float(np.exp(np.median(now) - np.median(before)))
    return Risen(ratio, float(test.pvalue), 1 / math.comb(len(before) + len(now), len(now)))
