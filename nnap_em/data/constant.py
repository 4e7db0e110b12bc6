"""Repeated readings that are not measurements: of a sensor that is stuck, starts late or is saturated.

A joint that rests repeats a reading as well: only its motion contradicts the sensor.
"""

import math
from collections.abc import Collection, Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from .noise import reading_noise
from .plausible import Columns, bridge

FULL = "saturated"
STILL = 5  # equal rows in a run that may be a stuck sensor
_PARABOLA_ROWS = 10  # rows before and after a run that show its motion: fewer vanish in noise, more are no parabola
_MORE = 4.0  # times a usual step, or a usual disagreement of two columns, that one must be to contradict a sensor
_USUAL = 95  # percentile of the steps of a column


class Run(NamedTuple):
    """Equal readings in the rows from `first` to before `end`; some may be missing."""

    first: int
    end: int

    @property
    def length(self) -> int:
        """Rows."""
        return self.end - self.first


def constant_readings(
    name: str, readings: Columns, as_read: Columns, dt: float, limits: Collection[float]
) -> Iterator[tuple[str, Int[np.ndarray, " row"]]]:
    """Saturated, stuck and late: kinds and rows.  `as_read` has spikes, which may be motion."""
    y = readings[name]
    every = runs(y)
    first, end = np.array(every, int).reshape(-1, 2).T
    lengths = end - first
    if lengths.max(initial=0) >= np.isfinite(y).sum():
        return
    others = np.sort(lengths)[:-1]  # a sensor that stays stuck would be its own measure
    usual = float(np.median(np.repeat(others, others)))
    short_runs = 0.002  # runs of two to four rows, per row, above which a column is coarse
    noisy = usual < 2 and np.sum((lengths > 1) & (lengths < STILL)) <= short_runs * y.size
    both = [_disagreement(name, columns, dt) for columns in (readings, as_read)]
    apart = [each for each in both if each is not None]
    full = np.zeros(y.size, bool)
    for limit, sign in ((np.nanmax(y), 1.0), (np.nanmin(y), -1.0)):
        at_limit = [every[i] for i in np.flatnonzero((y[first] == limit) & (lengths >= max(3, 2 * usual)))]
        if limit in limits or any(_beyond(y, run, sign, dt, apart) for run in at_limit):
            full |= _closed(y == limit) & np.isfinite(y)
    if full.any():
        yield FULL, np.flatnonzero(full)
    y = np.where(full, np.nan, y)
    for run in (every[i] for i in np.flatnonzero((lengths >= max(STILL, 3 * usual)) & ~full[first])):
        silent = _dead(run, apart) or (noisy and _held(run, apart) and _alive(y, run))
        if silent or _moves(y, run, apart, dt) or _jumps(y, run):
            late = run.first == np.flatnonzero(np.isfinite(readings[name]))[0]
            yield "late start" if late else "stuck", np.arange(run.first + (not late), run.end)


def runs(y: Float[np.ndarray, " time"], least: int = 1) -> list[Run]:
    """All readings as runs of equal ones, missing samples among them left out; those of `least` rows or more."""
    k = np.flatnonzero(np.isfinite(y))
    new = np.append(True, np.diff(y[k]) != 0)[: k.size]
    last = np.append(new[1:], True)[: k.size]
    first, end = k[new], k[last] + 1
    long = end - first >= least
    return [Run(a, b) for a, b in zip(first[long].tolist(), end[long].tolist(), strict=True)]


def _closed(rows: Bool[np.ndarray, " time"], hole: int = 2) -> Bool[np.ndarray, " time"]:
    """`rows` with the holes of up to `hole` rows between them: readings in a hole passed the test by chance."""
    k = np.flatnonzero(rows)
    out = rows.copy()
    for a, b in pairwise(k.tolist()):
        if b - a <= hole + 1:
            out[a:b] = True
    return out


class _Apart(NamedTuple):
    """Disagreement of a coordinate and its rate."""

    way: Float[np.ndarray, " time"]
    """Motion that the other column shows and this one does not."""
    least: Float[np.ndarray, " time"]
    """Way that shows no motion in a run from each row: steps, noise and delay."""
    walk: float
    """Standard deviation of the noise of an integrated rate over one row."""
    other: Float[np.ndarray, " time"]
    """The other column."""
    rate: bool
    """True where this column is the rate."""


def _disagreement(name: str, readings: Columns, dt: float) -> _Apart | None:
    """Integral of the rate against the coordinate; None where one of the two is missing."""
    rate = name.startswith("d") and name[1:] in readings
    q, w = (readings.get(other) for other in ((name[1:], name) if rate else (name, f"d{name}")))
    if q is None or w is None or min(np.isfinite(q).sum(), np.isfinite(w).sum()) < 2:
        return None
    way, step = travel(w, dt) - bridge(q), 3 * quantum(q)
    if rate:
        return _Apart(-way, np.full(q.size, step + 9 * reading_noise(q[None])), 0.0, q, rate)
    delay = 5  # rows by which a filtered rate may be late
    return _Apart(way, step + delay * dt * np.abs(bridge(w)), reading_noise(w[None]) * dt, w, rate)


def travel(rate: Float[np.ndarray, " time"], dt: float) -> Float[np.ndarray, " time"]:
    """Integral of a rate from the first row."""
    w = bridge(rate)
    return np.append(0.0, np.cumsum(dt * (w[1:] + w[:-1]) / 2))


def _moves(y: Float[np.ndarray, " time"], run: Run, apart: Sequence[_Apart], dt: float, sign: float = 0.0) -> bool:
    """True where the other column shows that the joint moved meanwhile, with and without its spikes."""
    return len(apart) > 0 and all(_contradicts(y, run, each, dt, sign) for each in apart)


def _contradicts(y: Float[np.ndarray, " time"], run: Run, apart: _Apart, dt: float, sign: float) -> bool:
    """True where the two columns disagree within the run, far more than they usually do."""
    length = min(run.length, (y.size - run.length) // 2)
    if length < 2:
        return False
    away = _away(apart.way, _places(run.first, run.end - length), length)
    outside = np.append(_places(0, run.first - length), _places(run.end, y.size - length))
    usual = float(np.median(np.abs(_away(apart.way, outside, length)).max(axis=1))) if outside.size else 0.0
    hole = _hole(y, run) * dt * length if apart.rate else 0.0
    least = float(apart.least[run.first]) + 6 * apart.walk * math.sqrt(length) + hole
    return float(np.max(sign * away if sign else np.abs(away))) > _MORE * usual + least


def _places(first: int, last: int, most: int = 30) -> Int[np.ndarray, " row"]:
    """Rows from `first` to `last`, not more than `most` of them."""
    return np.unique(np.linspace(first, last, min(most, max(last - first + 1, 0))).astype(int))


def _away(
    way: Float[np.ndarray, " time"], first: Int[np.ndarray, " place"], length: int
) -> Float[np.ndarray, "place row"]:
    """The way within `length` rows from each place."""
    return way[first[:, None] + np.arange(length)] - way[first][:, None]


def _held(run: Run, apart: Sequence[_Apart]) -> bool:
    """True where the other column shows nothing: it is missing or, as a rate, held as well."""
    other = apart[0].other[run.first : run.end] if apart else np.zeros(0)
    return np.unique(other[np.isfinite(other)]).size <= (not apart or not apart[0].rate)


def _dead(run: Run, apart: Sequence[_Apart]) -> bool:
    """True where the coordinate of this rate was read and is masked: one sensor gives both."""
    if not apart or not apart[0].rate:
        return False
    seen, read = (np.isfinite(each.other[run.first : run.end]) for each in apart)
    return bool(2 * np.sum(read & ~seen) > run.length)


def _hole(y: Float[np.ndarray, " time"], run: Run) -> float:
    """Distance of the readings next to a held one: the step of a coarse rate, or the threshold under which it is 0."""
    held = np.convolve(y == y[run.first], np.ones(3), "same") > 0
    other = y[np.isfinite(y) & ~held]
    step = np.abs(np.diff(y))
    usual = float(np.percentile(step[step > 0], _USUAL)) if (step > 0).any() else 0.0
    return min(float(np.min(np.abs(other - y[run.first]), initial=math.inf)), usual)


def _jumps(y: Float[np.ndarray, " time"], run: Run) -> bool:
    """True where the readings behind the run are and stay far from it, beside the usual steps and those near by.

    A joint that rests on both sides slips, and a filtered rate returns.
    """
    step = np.abs(np.diff(y[np.isfinite(y)]))
    before, after = (side[np.isfinite(side)][: _PARABOLA_ROWS + 1] for side in (y[: run.first + 1][::-1], y[run.end :]))
    near = np.abs(np.concatenate([np.diff(before), np.diff(after)]))
    if not after.size or near.size < STILL or np.median(near) == 0:
        return False
    usual, jump = max(np.percentile(step[step > 0], _USUAL), near.max()), abs(after[0] - y[run.first])
    return bool(jump > _MORE * usual and np.min(np.abs(after - y[run.first])) > jump / 2)


def _alive(y: Float[np.ndarray, " time"], run: Run) -> bool:
    """True where the readings right before and right after the run are noise, as elsewhere: no creep, no steps.

    A value that is held again near by is that of an encoder between two steps.
    """
    usual = reading_noise(y[None])
    around = np.concatenate([_steps(y[: run.first + 1][::-1]), _steps(y[run.end - 1 :])])
    near_neighbour = 0.02  # of the noise: nearer than that neighbours lie in 1.1 % of the rows of white noise
    repeats = 3  # such rows of the 20 about a run that are a held value: of white noise 0.2 % of the runs have as many
    if usual < 3 * quantum(y) or np.sum(around < near_neighbour * usual) >= repeats:
        return False
    sides = [part[np.isfinite(part)][:_PARABOLA_ROWS] for part in (y[: run.first][::-1], y[run.end :])]
    sides = [side for side in sides if side.size >= 8]
    bend, turn = (np.array([np.std(np.diff(side, n)) for side in sides]) for n in (2, 3))
    return len(sides) > 0 and bool(np.all((bend > usual / 3) & (turn > bend)))


def _steps(side: Float[np.ndarray, " row"]) -> Float[np.ndarray, " step"]:
    """Sizes of the first steps of a side."""
    return np.abs(np.diff(side[np.isfinite(side)][: _PARABOLA_ROWS + 1]))


def quantum(y: Float[np.ndarray, " time"]) -> float:
    """The step of the sensor: the smallest of the column, or the usual one between values that are held in turn.

    A log that was resampled or filtered has steps as small as its digits; the sensor's are between its plateaus.
    """
    step = np.abs(np.diff(y[np.isfinite(y)]))
    least = float(np.min(step, where=step > 0, initial=math.inf))
    plateaus = runs(y, least=3)
    near = [(a, b) for a, b in pairwise(plateaus) if b.first - a.end <= 3]
    steps = np.array([abs(y[b.first] - y[a.first]) for a, b in near])
    steps = steps[steps > 0]
    usual = float(np.median(steps)) if steps.size >= 3 else 0.0
    return max(least, usual) if math.isfinite(least) else 0.0


def _beyond(y: Float[np.ndarray, " time"], run: Run, sign: float, dt: float, apart: Sequence[_Apart]) -> bool:
    """True where it went beyond its limit: by the other column, or by the motion before and after.

    A rate decides against the motion of its coordinate: a machine at a stop comes and goes as fast.
    """
    before, after = y[max(run.first - _PARABOLA_ROWS, 0) : run.first], y[run.end : run.end + _PARABOLA_ROWS]
    if np.isfinite(before).sum() < 5 or np.isfinite(after).sum() < 5:
        return False
    if apart:
        moves = _moves(y, run, apart, dt, sign)
        if moves or not apart[0].rate:
            return moves
    trusted = 3  # rows that a parabola through `_PARABOLA_ROWS` rows is trusted beyond its end
    rows = np.arange(1, math.ceil(min(run.length / 2, trusted)) + 1)
    spread, coarse = reading_noise(y[None]), 4 * quantum(y)
    sure = 3.0  # standard deviations of such a prediction, on either side, by which a reading lies beyond a limit
    for side in (before, after[::-1]):
        expected, uncertainty = _ahead(side, rows, spread)
        if np.all(sign * (expected - y[run.first]) <= sure * uncertainty + coarse):
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
