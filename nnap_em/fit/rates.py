"""Rates that are read beside their coordinates: scale, lag and averaging of what should be a derivative."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..data.dataset import Dataset
from ..data.noise import reading_noise
from ..data.rig import Rig
from .inverse_dynamics import filtered

MISREAD = 0.01
"""Share of a rate (root mean square) from which on its scale, lag or averaging is reported, as friction and inertia
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
    """A rate w(t) = scale (p + width^2 / 24 p'')(t - late), with p the derivative of its coordinate."""

    scale: float
    late: float
    """Lag of the rate after the coordinate [s]."""
    width: float
    """Time over which a mean smooths as much [s]; negative where the coordinate is the smoother of the two."""
    wrong: tuple[bool, bool, bool]
    """True where scale, lag and averaging change the rate by `MISREAD`, and are `SURE`."""


def timing(y: Float[np.ndarray, "seq time"], rate: Float[np.ndarray, "seq time"], dt: float) -> Timing | None:
    """Scale, lag and averaging of `rate` beside its coordinate `y`; None where the logs hardly show them.

    Both pass one window.  The row of the highest correlation, which noise does not bend, is refined by regression on
    the derivatives there, with standard errors by the jackknife over pieces [Tukey 1958, Ann. Math. Stat. 29, 614].
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
    size = np.sqrt(np.abs(np.diag(whole)[:3] / whole[0, 0])) * (1, 1, 0.5)
    off = np.abs(value - (1, 0, 0))
    scale, late, spread = map(float, value)
    wrong = (off * size > MISREAD) & (off > SURE * std)
    return Timing(scale, late * dt, float(np.copysign(np.sqrt(12 * abs(spread)) * dt, spread)), tuple(wrong.tolist()))


def _moments(sums: Float[np.ndarray, "5 5"], lag: int) -> Float[np.ndarray, "3"]:
    """Scale, lag [rows] and variance [rows^2] of the filter between both, by sums of products about `lag`."""
    unit = np.sqrt(np.abs(np.diag(sums)[:4])) + 1e-300
    by = np.linalg.lstsq(sums[:4, :4] / np.outer(unit, unit), sums[:4, 4] / unit, rcond=None)[0] / unit
    shift = -by[1] / by[0]
    return np.array([by[0], lag + shift, 2 * by[2] / by[0] - shift**2])


def timings(rig: Rig, data: Dataset) -> Iterator[tuple[bool, str]]:
    """A sentence for every rate that is read beside its coordinate, and True where it is not its derivative."""
    for name, rate in rig.pairs():
        y, w = (np.asarray(data.y)[..., rig.measured.index(column)] for column in (name, rate))
        found = timing(y, w, rig.dt)
        if found is None:
            continue
        scaled, shifted, smoothed = found.wrong
        lag = f"{abs(found.late):.3g} s ({abs(found.late) / rig.dt:.3g} rows)"
        late, first = (rate, f"the derivative of {name}") if found.late > 0 else (name, rate)
        smooth = rate if found.width > 0 else name
        worse = late if shifted else smooth
        remarks = (
            (scaled, f"{rate} is {found.scale:.4g} times the derivative of {name}: correct the unit or gear of one"),
            (shifted, f"{late} is {lag} later than {first}"),
            (smoothed, f"{smooth} is as smooth as a mean over {abs(found.width):.2g} s"),
            (shifted or smoothed, f"take {worse} out of [measurement] columns, or log both unfiltered, of one moment"),
        )
        text = "; ".join(remark for holds, remark in remarks if holds)
        yield bool(text), text or f"{rate} is the derivative of {name}, {lag} {'late' if found.late > 0 else 'early'}"


def bridged(y: Float[np.ndarray, "seq time"]) -> Float[np.ndarray, "seq time"]:
    """Readings with straight lines between them; NaN before the first and after the last."""
    out = np.array(y, float)
    for row in out:
        k = np.flatnonzero(np.isfinite(row))
        row[:] = np.interp(np.arange(row.size), k, row[k], np.nan, np.nan) if k.size else np.nan
    return out
