"""Rates that are read beside their coordinates: scale and lag of what should be a derivative."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..logs.noise import reading_noise
from .inverse_dynamics import filtered

MISREAD = 0.01
"""Share of a rate (root mean square) from which on its scale or lag is reported, as friction and inertia
are off by as much: half a row late is 0.03 to 0.09 on real double pendulums at 100 Hz, whose rates are off by 0.003."""
SURE = 5.0
"""Standard errors from which on they are reported; these come from as few as `FEWEST` pieces."""
RATE_PIECES, FEWEST = 20, 5
"""Pieces of the logs whose disagreement is the standard error, and those below which nothing is concluded."""
REACH_S, REACH_ROWS = 0.25, 10
"""Longest lag that is looked for, the longer of the two."""
NOISE = 0.3
"""Largest noise of a filtered derivative as a share of its size: white noise is taken out, but for a tenth of it."""


class Timing(NamedTuple):
    """A rate w(t) = scale p(t - late), with p the derivative of its coordinate."""

    scale: float
    late: float
    """Lag of the rate after the coordinate [s]."""
    wrong: tuple[bool, bool]
    """True where scale and lag change the rate by `MISREAD`, and are `SURE`."""


def timing(y: Float[np.ndarray, "seq time"], rate: Float[np.ndarray, "seq time"], dt: float) -> Timing | None:
    """Scale and lag of `rate` beside its coordinate `y`; None where the logs hardly show them.

    Both pass one window.  The row of the highest correlation, which noise does not bend, is refined by regression on
    the derivatives there (the third takes up a mean), with standard errors by the jackknife over pieces [Tukey 1958,
    Ann. Math. Stat. 29, 614].
    """
    y, rate = bridged(y), bridged(rate)
    both = np.isfinite(y) & np.isfinite(rate)
    if both.sum(axis=1).max() < 4 * REACH_ROWS or not np.std(rate[both]) > 0:
        return None
    size, noise, low, terms = np.zeros(3), np.eye(3), np.zeros(1), np.zeros(0)
    for window in (window for window in (3, 5, 9, 15, 25, 41, 61) if 4 * window < y.shape[1]):
        low = np.hanning(window + 2)[1:-1] / np.hanning(window + 2).sum()
        slope = np.convolve(low, (-0.5, 0.0, 0.5))
        taps = np.stack([np.pad(slope, 1), np.convolve(slope, (-0.5, 0.0, 0.5)), np.convolve(slope, (1.0, -2.0, 1.0))])
        terms = np.stack([filtered(y, one) for one in taps], axis=-1)
        noise, size = reading_noise(y) ** 2 * taps @ taps.T, terms[np.isfinite(terms).all(axis=-1)].var(axis=0)
        if noise[2, 2] < NOISE**2 * size[2]:
            break
    if not noise[1, 1] < NOISE**2 * size[1]:
        return None
    w = filtered(rate * dt, np.convolve(low, (1 / 6, 4 / 6, 1 / 6)))[:, 1:-1]  # the mean over two rows [Simpson]
    terms = np.concatenate([terms, np.ones_like(w)[..., None], w[..., None]], axis=-1)
    reach = min(max(round(REACH_S / dt), REACH_ROWS), w.shape[1] // 4)
    count = w.shape[1] - 2 * reach

    def lagged(lag: int) -> list[Float[np.ndarray, "row 5"]]:
        parts = terms[:, reach - lag :, :4][:, :count], terms[:, reach:, 4:][:, :count]
        return [row[np.isfinite(row).all(axis=1)] for row in np.concatenate(parts, axis=-1)]

    def likeness(lag: int) -> float:
        both = np.concatenate(lagged(lag))[:, [0, 4]]
        return float(np.corrcoef(both, rowvar=False)[0, 1]) - 1e-3 * abs(lag) / reach  # the first of periodic ones

    lag = max(range(-reach, reach + 1), key=likeness)
    rows = [row for row in lagged(lag) if len(row)]
    parts = [part for row in rows for part in np.array_split(row, max(1, round(RATE_PIECES / len(rows))))]
    sums = [part.T @ part - len(part) * np.pad(noise, (0, 2)) for part in parts]
    if len(sums) < FEWEST:
        return None
    whole = np.sum(sums, axis=0)
    value, *others = (_moments(part, lag) for part in (whole, *(whole - part for part in sums)))
    std = np.sqrt(len(sums) - 1) * np.std(others, axis=0)
    size = np.sqrt(np.abs(np.diag(whole)[:2] / whole[0, 0]))
    off = np.abs(value - (1, 0))
    wrong = (off * size > MISREAD) & (off > SURE * std)
    return Timing(float(value[0]), float(value[1]) * dt, tuple(wrong.tolist()))


def _moments(sums: Float[np.ndarray, "5 5"], lag: int) -> Float[np.ndarray, "2"]:
    """Scale and lag [rows] of the filter between both, by sums of products about `lag`."""
    unit = np.sqrt(np.abs(np.diag(sums)[:4])) + 1e-300
    by = np.linalg.lstsq(sums[:4, :4] / np.outer(unit, unit), sums[:4, 4] / unit, rcond=None)[0] / unit
    return np.array([by[0], lag - by[1] / by[0]])


def bridged(y: Float[np.ndarray, "seq time"]) -> Float[np.ndarray, "seq time"]:
    """Readings with straight lines between them; NaN before the first and after the last."""
    out = np.array(y, float)
    for row in out:
        k = np.flatnonzero(np.isfinite(row))
        row[:] = np.interp(np.arange(row.size), k, row[k], np.nan, np.nan) if k.size else np.nan
    return out
