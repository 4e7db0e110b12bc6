"""Equal readings that are none: of a sensor that is stuck, starts late, or is at the end of its range.

Another column or a jump contradicts a stuck sensor; a trend goes on beyond a limit.
"""

import math
from collections.abc import Collection, Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from .plausible import Columns, bridge
from .spikes import LONGEST, noise

FULL = "saturated"
STILL = 5  # equal rows in a run that may be a stuck sensor


class Run(NamedTuple):
    """Equal readings in the rows from `first` to before `end`; some may be missing."""

    first: int
    end: int

    @property
    def length(self) -> int:
        """Rows."""
        return self.end - self.first


def frozen(
    name: str, readings: Columns, dt: float, limits: Collection[float]
) -> Iterator[tuple[str, Int[np.ndarray, " row"]]]:
    """Saturated, stuck and late: kinds and rows."""
    y = readings[name]
    every = runs(y)
    first, end = np.array(every, int).reshape(-1, 2).T
    lengths = end - first
    if lengths.max(initial=0) >= np.isfinite(y).sum():
        return
    usual = float(np.median(np.repeat(lengths, lengths)))
    full = np.zeros(y.size, bool)
    for limit, sign in ((np.nanmax(y), 1.0), (np.nanmin(y), -1.0)):
        there = [every[i] for i in np.flatnonzero((y[first] == limit) & (lengths >= max(3, 2 * usual)))]
        if limit in limits or any(_beyond(name, readings, run, sign, dt) for run in there):
            full |= _closed(y == limit) & np.isfinite(y)
    if full.any():
        yield FULL, np.flatnonzero(full)
    lively = bool(np.sum((lengths > 1) & (lengths < STILL) & ~full[first]) <= 0.002 * y.size)
    for run in (every[i] for i in np.flatnonzero((lengths >= max(STILL, 3 * usual)) & ~full[first])):
        if _stuck(name, readings, run, dt, lively):
            late = run.first == np.flatnonzero(np.isfinite(y))[0]
            yield "late start" if late else "stuck", np.arange(run.first + (not late), run.end)


def runs(y: Float[np.ndarray, " time"]) -> list[Run]:
    """All readings as runs of equal ones, missing samples among them left out."""
    k = np.flatnonzero(np.isfinite(y))
    new = np.append(True, np.diff(y[k]) != 0)[: k.size]
    last = np.append(new[1:], True)[: k.size]
    return [Run(int(a), int(b) + 1) for a, b in zip(k[new], k[last], strict=True)]


def _closed(rows: Bool[np.ndarray, " time"], hole: int = 2) -> Bool[np.ndarray, " time"]:
    """`rows` with the holes of up to `hole` rows between them: what is let through there was chosen by its noise."""
    k = np.flatnonzero(rows)
    out = rows.copy()
    for a, b in pairwise(k.tolist()):
        if b - a <= hole + 1:
            out[a:b] = True
    return out


def _stuck(name: str, readings: Columns, run: Run, dt: float, lively: bool) -> bool:
    """Whether equal readings are none: another column moved meanwhile, or the next reading is somewhere else.

    A `lively` column hardly ever repeats a reading: its noise tells as well.
    """
    y = readings[name]
    away = _travel(name, readings, run, dt)
    if away is not None:
        return float(np.max(np.abs(away), initial=0.0)) > 1.0 or _jumps(y, run)
    return _jumps(y, run) or (lively and _alive(y, run))


def _jumps(y: Float[np.ndarray, " time"], run: Run) -> bool:
    """Whether the reading after the run is far from it, beside the usual steps."""
    step = np.abs(np.diff(y))
    usual = np.percentile(step[step > 0], 95) if (step > 0).any() else 0.0
    later = y[run.end : run.end + LONGEST + 1]
    later = later[np.isfinite(later)]
    return later.size > 0 and bool(abs(later[0] - y[run.first]) > 4 * usual)


def _alive(y: Float[np.ndarray, " time"], run: Run) -> bool:
    """Whether the readings right before and right after the run are noise, as elsewhere: no creep, no steps."""
    sides = [part[np.isfinite(part)][:10] for part in (y[: run.first][::-1], y[run.end :])]
    sides = [side for side in sides if side.size >= 8]
    bend, turn = (np.array([np.std(np.diff(side, n)) for side in sides]) for n in (2, 3))
    least = max(noise(y) / 3, 3 * _quantum(y))
    return len(sides) > 0 and bool(np.all((bend > least) & (turn > bend)))


def _partner(name: str, readings: Columns) -> str | None:
    """The rate of a coordinate, or the coordinate of a rate."""
    return next((other for other in (f"d{name}", name[1:] * name.startswith("d")) if other in readings), None)


def _travel(name: str, readings: Columns, run: Run, dt: float) -> Float[np.ndarray, " row"] | None:
    """How far the other column says that it moved while it read the same, over what noise and steps explain."""
    other = _partner(name, readings)
    if other is None:
        return None
    y, z = readings[name], readings[other]
    part = z[run.first : run.end]
    longest = max((same.length for same in runs(part)), default=0)
    if np.isfinite(part).mean() < 0.5 or longest >= max(STILL, 0.5 * run.length):
        return None
    part = bridge(part)
    since = dt * np.arange(run.length)
    still = y[run.first]
    if other == f"d{name}":
        away = dt * (np.cumsum(part) - part[0])
        return away / (6 * noise(z) * dt * math.sqrt(run.length) + 3 * _quantum(y) + 1e-300)
    away = part - np.median(part[:3]) - still * since
    doubt = 9 * noise(z) + 3 * _quantum(z) + (_quantum(y) + 0.3 * abs(still)) * since[-1]
    return away / (doubt + 1e-300)


def _quantum(y: Float[np.ndarray, " time"]) -> float:
    """The smallest step of a signal."""
    step = np.abs(np.diff(y))
    least = float(np.min(step, where=step > 0, initial=math.inf))
    return least if math.isfinite(least) else 0.0


def _beyond(name: str, readings: Columns, run: Run, sign: float, dt: float) -> bool:
    """Whether it went beyond its limit: by the other column, or by the trends before and after.

    A rate denies what the trends of its coordinate say: a machine at a stop comes and goes as fast.
    """
    y = readings[name]
    before, after = y[max(run.first - 6, 0) : run.first], y[run.end : run.end + 6]
    if np.isfinite(before).sum() < 4 or np.isfinite(after).sum() < 4:
        return False
    away = _travel(name, readings, run, dt)
    if away is not None and (float(np.max(sign * away)) > 1.0 or _partner(name, readings) == f"d{name}"):
        return float(np.max(sign * away)) > 1.0
    reach = min(run.length / 2, 3.0)
    slopes = np.array([_slope(before), -_slope(after)])
    return bool(np.all(sign * slopes * reach > 4 * noise(y) + 4 * _quantum(y)))


def _slope(y: Float[np.ndarray, " row"]) -> float:
    """Change per row of a straight line through the readings."""
    k = np.flatnonzero(np.isfinite(y))
    return float(np.polyfit(k, y[k], 1)[0])
