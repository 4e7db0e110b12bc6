"""Equal readings that are none: of a sensor that is stuck, starts late, or is at the end of its range.

Another column or a jump contradicts a stuck sensor; its motion goes on beyond a limit.
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
_SIDE = 10  # rows before and after a run that show its motion: fewer vanish in noise, more are no parabola
_AHEAD = 3  # rows that a parabola through `_SIDE` rows is trusted beyond its end
_SURE = 3.0  # standard deviations of such a prediction, on either side, by which a reading lies beyond a limit
_SAME = 0.02  # of the noise: nearer than that neighbours lie in 1.1 % of the rows of white noise
_REPEATS = 3  # such rows of the 20 about a run that are a held value: of white noise .2 % of the runs have as many


class Run(NamedTuple):
    """Equal readings in the rows from `first` to before `end`; some may be missing."""

    first: int
    end: int

    @property
    def length(self) -> int:
        """Rows."""
        return self.end - self.first


def constant_readings(
    name: str, readings: Columns, dt: float, limits: Collection[float]
) -> Iterator[tuple[str, Int[np.ndarray, " row"]]]:
    """Saturated, stuck and late: kinds and rows."""
    y = readings[name]
    every = runs(y)
    first, end = np.array(every, int).reshape(-1, 2).T
    lengths = end - first
    if lengths.max(initial=0) >= np.isfinite(y).sum():
        return
    others = np.sort(lengths)[:-1]  # a sensor that stays stuck would be its own measure
    usual = float(np.median(np.repeat(others, others)))
    full = np.zeros(y.size, bool)
    for limit, sign in ((np.nanmax(y), 1.0), (np.nanmin(y), -1.0)):
        at_limit = [every[i] for i in np.flatnonzero((y[first] == limit) & (lengths >= max(3, 2 * usual)))]
        if limit in limits or any(_beyond(name, readings, run, sign, dt) for run in at_limit):
            full |= _closed(y == limit) & np.isfinite(y)
    if full.any():
        yield FULL, np.flatnonzero(full)
    lively = bool(np.sum((lengths > 1) & (lengths < STILL) & ~full[first]) <= 0.002 * y.size)
    noisy = np.where(full, np.nan, y) if lively else None
    for run in (every[i] for i in np.flatnonzero((lengths >= max(STILL, 3 * usual)) & ~full[first])):
        if _stuck(name, readings, run, dt, noisy):
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


def _stuck(name: str, readings: Columns, run: Run, dt: float, noisy: Float[np.ndarray, " time"] | None) -> bool:
    """True where equal readings are none: another column moved meanwhile, or the next reading is somewhere else.

    The noise of a column that hardly ever repeats a reading counts as well: `noisy`, without readings at a limit.
    """
    away = _travel(name, readings, run, dt)
    if away is not None:
        return float(np.max(np.abs(away), initial=0.0)) > 1.0 or _jumps(readings[name], run)
    return _jumps(readings[name], run) or (noisy is not None and _alive(noisy, run))


def _jumps(y: Float[np.ndarray, " time"], run: Run) -> bool:
    """True where the reading after the run is far from it, beside the usual steps."""
    step = np.abs(np.diff(y[np.isfinite(y)]))
    usual = np.percentile(step[step > 0], 95) if (step > 0).any() else 0.0
    later = y[run.end : run.end + LONGEST + 1]
    later = later[np.isfinite(later)]
    return later.size > 0 and bool(abs(later[0] - y[run.first]) > 4 * usual)


def _alive(y: Float[np.ndarray, " time"], run: Run) -> bool:
    """True where the readings right before and right after the run are noise, as elsewhere: no creep, no steps.

    A value that is held again there is that of an encoder between two steps.
    """
    usual = noise(y)
    around = np.concatenate([_steps(y[: run.first + 1][::-1]), _steps(y[run.end - 1 :])])
    if np.sum(around < _SAME * usual) >= _REPEATS:
        return False
    sides = [part[np.isfinite(part)][:10] for part in (y[: run.first][::-1], y[run.end :])]
    sides = [side for side in sides if side.size >= 8]
    bend, turn = (np.array([np.std(np.diff(side, n)) for side in sides]) for n in (2, 3))
    least = max(usual / 3, 3 * _quantum(y))
    return len(sides) > 0 and bool(np.all((bend > least) & (turn > bend)))


def _steps(side: Float[np.ndarray, " row"]) -> Float[np.ndarray, " step"]:
    """Sizes of the first steps of a side."""
    return np.abs(np.diff(side[np.isfinite(side)][: _SIDE + 1]))


def _partner(name: str, readings: Columns) -> str | None:
    """The rate of a coordinate, or the coordinate of a rate."""
    return next((other for other in (f"d{name}", name[1:] * name.startswith("d")) if other in readings), None)


def _travel(name: str, readings: Columns, run: Run, dt: float) -> Float[np.ndarray, " row"] | None:
    """Motion during equal readings by the other column, over the part that noise and steps explain."""
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
    uncertainty = 9 * noise(z) + 3 * _quantum(z) + (_quantum(y) + 0.3 * abs(still)) * since[-1]
    return away / (uncertainty + 1e-300)


def _quantum(y: Float[np.ndarray, " time"]) -> float:
    """The step of the sensor: the smallest of the column, or the usual one between values that are held in turn.

    A log that was resampled or filtered has steps as small as its digits; the sensor's are between its plateaus.
    """
    step = np.abs(np.diff(y[np.isfinite(y)]))
    least = float(np.min(step, where=step > 0, initial=math.inf))
    plateaus = [run for run in runs(y) if run.length >= 3]
    near = [(a, b) for a, b in pairwise(plateaus) if b.first - a.end <= 3]
    steps = np.array([abs(y[b.first] - y[a.first]) for a, b in near])
    steps = steps[steps > 0]
    usual = float(np.median(steps)) if steps.size >= 3 else 0.0
    return max(least, usual) if math.isfinite(least) else 0.0


def _beyond(name: str, readings: Columns, run: Run, sign: float, dt: float) -> bool:
    """True where it went beyond its limit: by the other column, or by the motion before and after.

    A rate decides against the motion of its coordinate: a machine at a stop comes and goes as fast.
    """
    y = readings[name]
    before, after = y[max(run.first - _SIDE, 0) : run.first], y[run.end : run.end + _SIDE]
    if np.isfinite(before).sum() < 5 or np.isfinite(after).sum() < 5:
        return False
    away = _travel(name, readings, run, dt)
    if away is not None and (float(np.max(sign * away)) > 1.0 or _partner(name, readings) == f"d{name}"):
        return float(np.max(sign * away)) > 1.0
    rows = np.arange(1, math.ceil(min(run.length / 2, _AHEAD)) + 1)
    spread, coarse = noise(y), 4 * _quantum(y)
    for side in (before, after[::-1]):
        expected, uncertainty = _ahead(side, rows, spread)
        if np.all(sign * (expected - y[run.first]) <= _SURE * uncertainty + coarse):
            return False
    return True


def _ahead(
    side: Float[np.ndarray, " row"], rows: Int[np.ndarray, " ahead"], spread: float
) -> tuple[Float[np.ndarray, " ahead"], Float[np.ndarray, " ahead"]]:
    """The parabola through a side, some rows beyond its last one, and its standard deviation there.

    A parabola slows down towards a turning point, as a machine does; a straight line would go on.
    """
    k = np.flatnonzero(np.isfinite(side))
    base = np.vander(k - (side.size - 1.0), 3)
    solve = np.linalg.pinv(base)
    left = side[k] - base @ (solve @ side[k])
    spread = max(spread, math.sqrt(left @ left / (k.size - 3)))
    weights = np.vander(rows.astype(float), 3) @ solve
    return weights @ side[k], spread * np.maximum(np.sqrt(np.sum(weights**2, axis=1)), 1.0)
