"""Tests that the innovations of a right model pass: white, of variance 1, independent of all known before.

Each gives its statistic, its p-value, and a size, the distance from a right model whatever the number of samples.
[Bar-Shalom, Li & Kirubarajan 2001, "Estimation with Applications to Tracking and Navigation", section 5.4]
"""

import math
from collections.abc import Sequence

import numpy as np
import scipy.stats
from jaxtyping import Bool, Float

LAGS = 20
"""Samples over which innovations are tested for whiteness."""
FAILS = 0.05
"""Corrected p-value below which a test counts as failed."""


def holm(p: Sequence[float]) -> Float[np.ndarray, " test"]:
    """p-values corrected for their number: the chance that any test of all true hypotheses fails [Holm 1979]."""
    values = np.asarray(p, float)
    order = np.argsort(values)
    steps = np.maximum.accumulate((values.size - np.arange(values.size)) * values[order])
    out = np.empty_like(values)
    out[order] = np.minimum(steps, 1.0)
    return out


def whiteness(e: Float[np.ndarray, "seq time"], lags: int = LAGS) -> tuple[float, float, float]:
    """Ljung & Box's portmanteau test over all sequences together: statistic, p-value, largest autocorrelation.

        Q = (N + 2) / N sum_l N_l r_l^2 ~ chi^2_lags,  N_l pairs of readings l samples apart

    NaN is not measured.  [Ljung & Box 1978; Box, Jenkins, Reinsel & Ljung 2015, "Time Series Analysis", section 8.2]
    """
    r, pairs = autocorrelation(e, lags)
    count = int(np.isfinite(e).sum())
    known = pairs[1:] > 0
    statistic = float((count + 2) / count * np.sum((pairs[1:] * r[1:] ** 2)[known]))
    largest = r[1:][known][np.argmax(np.abs(r[1:][known]))] if known.any() else 0.0
    return statistic, float(scipy.stats.chi2.sf(statistic, max(1, int(known.sum())))), float(largest)


def autocorrelation(
    e: Float[np.ndarray, "seq time"], lags: int
) -> tuple[Float[np.ndarray, " lag"], Float[np.ndarray, " lag"]]:
    """Autocorrelation at lags 0 to `lags` samples over all sequences, and the number of pairs behind each."""
    centred = e - np.nanmean(e)
    seen = np.isfinite(centred)
    filled = np.where(seen, centred, 0.0)
    rows = e.shape[1]
    spans = range(min(lags, rows - 1) + 1)
    pairs = np.asarray([np.sum(seen[:, : rows - k] & seen[:, k:]) for k in spans], float)
    sums = np.asarray([np.sum(filled[:, : rows - k] * filled[:, k:]) for k in spans])
    return sums / np.maximum(pairs, 1.0) * (pairs[0] / sums[0]), pairs


def spread(e: Float[np.ndarray, "seq time"]) -> tuple[float, float, float]:
    """Normalised innovation squared: its mean (1 if the stated uncertainty is right), p-value, std minus 1.

    N times the mean is chi^2_N.  [Bar-Shalom, Li & Kirubarajan 2001, section 5.4.2]
    """
    x = e[np.isfinite(e)]
    mean = float(np.mean(x**2))
    tails = scipy.stats.chi2.sf(x.size * mean, x.size), scipy.stats.chi2.cdf(x.size * mean, x.size)
    return mean, min(1.0, 2 * float(min(tails))), math.sqrt(mean) - 1.0


def dependence(e: Float[np.ndarray, "seq time"], cause: Float[np.ndarray, "seq time"]) -> tuple[float, float, float]:
    """Correlation of innovations with a cause known before them: Student's t, p-value, correlation.

    The sums of their product over sequences, cut in parts of some 50 readings, are of mean 0, as good as independent,
    and of unlike variance; the t-test of them is conservative then, and holds where errors follow each other over
    some samples.  [Ibragimov & Mueller 2010, J. Bus. Econ. Stat. 28, 453]
    """
    seen = np.isfinite(e) & np.isfinite(cause)
    x, g = (np.where(seen, a - np.mean(a, where=seen), 0.0) for a in (e, cause))
    scale = math.sqrt(np.sum(x**2) * np.sum(g**2))
    if not scale > 1e-9 * math.sqrt(seen.sum()) * max(1e-300, float(np.max(np.abs(cause), where=seen, initial=0))):
        return 0.0, 1.0, 0.0  # a cause that never changes
    sums = _group_sums(x * g, seen)
    if sums.size < 3 or not np.std(sums) > 0:
        return 0.0, 1.0, 0.0
    t = float(np.mean(sums) / np.std(sums, ddof=1) * math.sqrt(sums.size))
    return t, 2 * float(scipy.stats.t.sf(abs(t), sums.size - 1)), float(np.sum(x * g) / scale)


def _group_sums(values: Float[np.ndarray, "seq time"], seen: Bool[np.ndarray, "seq time"]):
    """Sums over groups of about equally many readings: parts of sequences."""
    active = seen.any(1)
    values, seen = values[active], seen[active]
    groups, readings = 20, 50  # least number of groups, and of readings in a group where there are enough
    parts = max(1, -(-groups // max(len(values), 1)), int(np.median(seen.sum(1)) // readings) if len(seen) else 1)
    sums = []
    for row, known in zip(values, seen, strict=True):
        sums += [piece.sum() for piece in np.array_split(row[known], parts) if piece.size]
    return np.asarray(sums)
