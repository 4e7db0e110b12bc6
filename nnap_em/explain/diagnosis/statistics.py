"""Tests of the innovations of a fit, channel by channel: each with a size and a sentence for the report.

Innovations of a right model are white, of variance 1, and independent of inputs, states and time.  Each test gives its
statistic, its p-value, and a size, the distance from a right model whatever the number of samples.
[Bar-Shalom, Li & Kirubarajan 2001, "Estimation with Applications to Tracking and Navigation", section 5.4]
"""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import scipy.stats
from jaxtyping import Bool, Float

from .residual import Names, Residual

LAGS, FAILS, SMALL_MISFIT = 20, 0.05, 0.1
"""Samples over which innovations are tested for whiteness; corrected p-value below which a test counts as failed; size
below which a failed test is called small."""


def holm(p: Sequence[float]) -> Float[np.ndarray, " test"]:
    """p-values corrected for their number: the chance that any test of all true hypotheses fails [Holm 1979]."""
    values = np.asarray(p, float)
    order = np.argsort(values)
    steps = np.maximum.accumulate((values.size - np.arange(values.size)) * values[order])
    return np.minimum(steps, 1.0)[np.argsort(order)]


def whiteness(e: Float[np.ndarray, "seq time"], lags: int = LAGS) -> tuple[float, float, float]:
    """Ljung & Box's portmanteau test over all sequences together: statistic, p-value, largest autocorrelation.

        Q = (N + 2) / N sum_l N_l r_l^2 ~ chi^2_lags,  N_l pairs of readings l samples apart

    NaN is not measured.  [Ljung & Box 1978; Box, Jenkins, Reinsel & Ljung 2015, "Time Series Analysis", section 8.2]
    """
    r, pairs = (part[1:] for part in autocorrelation(e, lags))
    count = int(np.isfinite(e).sum())
    statistic = (count + 2) / count * float(pairs @ r**2)
    p_value = scipy.stats.chi2.sf(statistic, max(1, np.count_nonzero(pairs)))
    return statistic, float(p_value), float(r[np.argmax(np.abs(r))]) if r.size else 0.0


def autocorrelation(
    e: Float[np.ndarray, "seq time"], lags: int
) -> tuple[Float[np.ndarray, " lag"], Float[np.ndarray, " lag"]]:
    """Autocorrelation at lags 0 to `lags` samples over all sequences, and the number of pairs behind each."""
    seen, rows = np.isfinite(e), e.shape[1]
    filled, spans = np.where(seen, e - np.nanmean(e), 0.0), range(min(lags, rows - 1) + 1)
    pairs = np.asarray([np.sum(seen[:, : rows - k] & seen[:, k:]) for k in spans], float)
    sums = np.asarray([np.sum(filled[:, : rows - k] * filled[:, k:]) for k in spans])
    return sums / np.maximum(pairs, 1.0) * (pairs[0] / sums[0]), pairs


def spread(e: Float[np.ndarray, "seq time"]) -> tuple[float, float, float]:
    """Normalised innovation squared: its mean (1 if the stated uncertainty is right), p-value, std minus 1. N times the
    mean is chi^2_N. [Bar-Shalom, Li & Kirubarajan 2001, section 5.4.2]
    """
    count, mean = int(np.isfinite(e).sum()), float(np.nanmean(e**2))
    tails = scipy.stats.chi2.sf(count * mean, count), scipy.stats.chi2.cdf(count * mean, count)
    return mean, min(1.0, 2 * float(min(tails))), math.sqrt(mean) - 1.0


def dependence(e: Float[np.ndarray, "seq time"], cause: Float[np.ndarray, "seq time"]) -> tuple[float, float, float]:
    """Correlation of innovations with a cause known before them: Student's t, p-value, correlation. The sums of their
    product over sequences, cut in parts of some 50 readings, are of mean 0, as good as independent, and of unlike
    variance; the t-test of them is conservative then, and holds where errors follow each other over some samples.
    [Ibragimov & Mueller 2010, J. Bus. Econ. Stat. 28, 453]
    """
    seen = np.isfinite(e) & np.isfinite(cause)
    x, g = (np.where(seen, a - np.mean(a, where=seen), 0.0) for a in (e, cause))
    scale = math.sqrt(np.sum(x**2) * np.sum(g**2))
    largest = float(np.max(np.abs(cause), where=seen, initial=1e-300))
    varies = scale > 1e-9 * math.sqrt(seen.sum()) * largest  # a cause that never changes has no sums
    sums = _group_sums(x * g, seen) if varies else np.zeros(0)
    if sums.size < 3 or not np.std(sums) > 0:
        return 0.0, 1.0, 0.0
    t, p_value = scipy.stats.ttest_1samp(sums, 0.0)
    return float(t), float(p_value), float(np.sum(x * g) / scale)


def _group_sums(values: Float[np.ndarray, "seq time"], seen: Bool[np.ndarray, "seq time"]):
    """Sums over groups of about equally many readings: parts of sequences, of which some are `seen`."""
    rows = [row[known] for row, known in zip(values, seen, strict=True) if known.any()]
    groups, readings = 20, 50  # least number of groups, and of readings in a group where there are enough
    parts = max(-(-groups // len(rows)), int(np.median([row.size for row in rows]) // readings))
    return np.asarray([piece.sum() for row in rows for piece in np.array_split(row, parts) if piece.size])


class Test(NamedTuple):
    """One test of the innovations of one channel."""

    name: str
    channel: str
    statistic: float
    p_value: float
    """Corrected for the number of tests [Holm 1979]."""
    size: float
    """Distance from a right model: largest autocorrelation; standard deviation minus 1; correlation."""
    meaning: str
    """The result in one sentence."""
    slight: bool
    """True where it failed by a size too small to matter."""


def causes(residual: Residual, names: Names) -> Iterator[tuple[str, Float[np.ndarray, "seq time"]]]:
    """Names and values of all, known one row before, that the innovations of a right model do not depend on."""
    before = np.concatenate([np.full_like(residual.u[:, :1], np.nan), residual.u[:, :-1]], axis=1)
    yield from zip(names.inputs, np.moveaxis(before, -1, 0), strict=True)
    states = np.moveaxis(residual.predicted, -1, 0)
    for name, q, turns in zip(names.coordinates, states, names.rotary, strict=False):
        if turns:
            yield from ((f"sin({name})", np.sin(q)), (f"cos({name})", np.cos(q)))
        else:
            yield name, q
    for name, v in zip(names.rates, states[len(names.coordinates) :], strict=False):
        yield name, v
        yield f"|{name}| {name}", np.abs(v) * v
    yield "time", residual.t


KINDS = {  # of each test what is said where it passes, and where it fails; a correlation has its cause
    "whiteness": ("are uncorrelated over time", "are correlated over time (up to {size:.2g}): {how}"),
    "spread": ("are as large as the model expects", "are {times:.3g} times as large as the model expects"),
    "correlation": ("show no link with {cause}", "change with {cause} (correlation {size:.2g})"),
}


def tests(residual: Residual, names: Names) -> list[Test]:
    """All tests of the innovations of every measured channel, over the sequences that did not diverge."""
    residual, rows, out = residual.followed(), [], []
    for i, channel in enumerate(names.measured):
        e = residual.innovation[..., i] if residual.t.size else np.zeros((0, 0))
        if np.isfinite(e).sum() < 3 * LAGS or not np.nanstd(e) > 0:
            continue
        rows += [("whiteness", channel, whiteness(e)), ("spread", channel, spread(e))]
        rows += [(f"correlation with {name}", channel, dependence(e, g)) for name, g in causes(residual, names)]
    for (name, channel, (statistic, _, size)), p in zip(rows, holm([p for _, _, (_, p, _) in rows]), strict=True):
        kind, _, cause = name.partition(" with ")
        slight = bool(p < FAILS and abs(size) < SMALL_MISFIT)
        how = "something acts that lasts" if size > 0 else "they alternate, as with filtered readings"
        said = KINDS[kind][int(p < FAILS)].format(size=size, times=1 + size, how=how, cause=cause)
        text = f"Errors in {channel} {said}{'; certain, but small' if slight else ''}."
        out.append(Test(name, channel, statistic, float(p), size, text, slight))
    return out
