"""Tests of the innovations of a fit, channel by channel: each with a size and a sentence for the report.

Innovations of a right model are white, of variance 1, and independent of inputs, states and time.
[Bar-Shalom, Li & Kirubarajan 2001, "Estimation with Applications to Tracking and Navigation", section 5.4]
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .residual import Names, Residual
from .statistics import FAILS, LAGS, dependence, holm, spread, whiteness


class Test(NamedTuple):
    """One test of the innovations of one channel."""

    name: str
    channel: str
    statistic: float
    p_value: float
    """Corrected for the number of tests [Holm 1979]."""
    size: float
    """Distance from a right model, whatever the number of samples: largest autocorrelation; standard deviation minus 1;
    correlation."""
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


KINDS = {  # of each test what is said where it passes, and where it fails; a correlation has its cause
    "whiteness": ("are uncorrelated over time", "are correlated over time (up to {size:.2g}): {how}"),
    "spread": ("are as large as the model expects", "are {times:.3g} times as large as the model expects"),
    "correlation": ("show no link with {cause}", "change with {cause} (correlation {size:.2g})"),
}
SMALL_MISFIT = 0.1
"""Size below which a failed test is called small."""


def tests(residual: Residual, names: Names) -> list[Test]:
    """All tests of the innovations of every measured channel, over the sequences that did not diverge."""
    residual = residual.followed()
    rows: list[tuple[str, str, tuple[float, float, float]]] = []
    for i, channel in enumerate(names.measured):
        e = residual.innovation[..., i] if residual.t.size else np.zeros((0, 0))
        if np.isfinite(e).sum() < 3 * LAGS or not np.nanstd(e) > 0:
            continue
        rows += [("whiteness", channel, whiteness(e)), ("spread", channel, spread(e))]
        rows += [(f"correlation with {name}", channel, dependence(e, g)) for name, g in causes(residual, names)]
    out = []
    for (name, channel, (statistic, _, size)), p in zip(rows, holm([p for _, _, (_, p, _) in rows]), strict=True):
        kind, _, cause = name.partition(" with ")
        slight = bool(p < FAILS and abs(size) < SMALL_MISFIT)
        how = "something acts that lasts" if size > 0 else "they alternate, as with filtered readings"
        said = KINDS[kind][int(p < FAILS)].format(size=size, times=1 + size, how=how, cause=cause)
        text = f"Errors in {channel} {said}{'; certain, but small' if slight else ''}."
        out.append(Test(name, channel, statistic, float(p), size, text, slight))
    return out
