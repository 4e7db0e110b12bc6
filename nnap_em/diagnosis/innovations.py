"""Tests of the innovations of a fit, channel by channel: each with a size and a sentence for the report.

Innovations of a right model are white, normal, of variance 1, and independent of inputs, states and time.
[Bar-Shalom, Li & Kirubarajan 2001, "Estimation with Applications to Tracking and Navigation", section 5.4]
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .residual import Names, Residual
from .statistics import FAILS, LAGS, bias, dependence, holm, normality, spread, whiteness


class Test(NamedTuple):
    """One test of the innovations of one channel."""

    name: str
    channel: str
    statistic: float
    p_value: float
    """Corrected for the number of tests [Holm 1979]."""
    size: float
    """Distance from a right model, whatever the number of samples: largest autocorrelation; excess kurtosis; standard
    deviation minus 1; mean over standard deviation; correlation."""
    meaning: str
    """The result in one sentence."""
    slight: bool
    """True where it failed by a size too small to matter."""


def causes(residual: Residual, names: Names) -> Iterator[tuple[str, Float[np.ndarray, "seq time"]]]:
    """Names and values of all, known one row before, that the innovations of a right model do not depend on."""
    for i, name in enumerate(names.inputs):
        before = np.concatenate([np.full_like(residual.u[:, :1, i], np.nan), residual.u[:, :-1, i]], axis=1)
        yield name, before
    dof = len(names.coordinates)
    for j, name in enumerate(names.coordinates):
        q = residual.predicted[..., j]
        if names.rotary[j]:
            yield f"sin({name})", np.sin(q)
            yield f"cos({name})", np.cos(q)
        else:
            yield name, q
    for j, name in enumerate(names.rates):
        v = residual.predicted[..., dof + j]
        yield name, v
        yield f"|{name}| {name}", np.abs(v) * v
    yield "time", residual.t


def tests(residual: Residual, names: Names) -> list[Test]:
    """All tests of the innovations of every measured channel, over the sequences that did not diverge."""
    residual = residual.followed()
    rows: list[tuple[str, str, tuple[float, float, float]]] = []
    for i, channel in enumerate(names.measured):
        e = residual.innovation[..., i] if residual.t.size else np.zeros((0, 0))
        if np.isfinite(e).sum() < 3 * LAGS or not np.nanstd(e) > 0:
            continue
        rows += [("whiteness", channel, whiteness(e)), ("normality", channel, normality(e))]
        rows += [("spread", channel, spread(e)), ("mean", channel, bias(e))]
        rows += [(f"correlation with {name}", channel, dependence(e, g)) for name, g in causes(residual, names)]
    corrected = holm([p for _, _, (_, p, _) in rows])
    out = []
    # Sizes below which a failed test is called small
    small_misfit = {"whiteness": 0.1, "normality": 1.0, "spread": 0.1, "mean": 0.1, "correlation": 0.1}
    for (name, channel, (statistic, _, size)), p in zip(rows, corrected, strict=True):
        slight = bool(p < FAILS and abs(size) < small_misfit[name.split()[0]])
        out.append(
            Test(
                name, channel, statistic, float(p), size, _meaning(name, channel, bool(p < FAILS), size, slight), slight
            )
        )
    return out


def _meaning(name: str, channel: str, bad: bool, size: float, slight: bool) -> str:
    kind = name.split()[0]
    if kind == "correlation":
        cause = name.removeprefix("correlation with ")
        passed = f"Errors in {channel} show no link with {cause}."
        failed = f"Errors in {channel} change with {cause} (correlation {size:.2g})."
    else:
        passed, failed = {
            "whiteness": (
                f"Errors in {channel} are uncorrelated over time.",
                f"Errors in {channel} are correlated over time (up to {size:.2g}): "
                f"{'something acts that lasts' if size > 0 else 'they alternate, as with filtered readings'}.",
            ),
            "normality": (
                f"Errors in {channel} are bell-shaped.",
                f"Errors in {channel} have {'more' if size > 0 else 'fewer'} outliers than a bell curve, or lean to a "
                f"side (excess kurtosis {size:.2g}).",
            ),
            "spread": (
                f"Errors in {channel} are as large as the model expects.",
                f"Errors in {channel} are {1 + size:.3g} times as large as the model expects.",
            ),
            "mean": (
                f"Errors in {channel} average to zero.",
                f"Errors in {channel} lean to one side (by {size:.2g} standard deviations).",
            ),
        }[kind]
    if not bad:
        return passed
    return failed[:-1] + "; certain, but small." if slight else failed
