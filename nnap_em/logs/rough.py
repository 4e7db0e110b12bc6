"""Readings that no sensor took: spikes, and the output of a stuck, late or saturated sensor.

A joint that rests repeats a reading as well: only its other column, or where it is right afterwards, contradicts it.
"""

import math
from collections.abc import Collection
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from .held import Run, runs
from .noise import reading_noise, resolution
from .plausible import Columns, bridge

FULL = "saturated"
SPIKE = 8.0
"""Distance of a spike from its neighbours in robust standard deviations."""
STILL = 5
"""Fewest equal rows of a stuck sensor."""
_SIDE, _NEAR = 4, 10
"""Readings on either side of a spike that show its true value, and on either side of a run that show its motion."""
_LIVE = 5.0
"""Distance of a spike from its neighbours over the upper quartile of such distances of the readings around."""
_MORE = 4.0
"""Ratio of a step, or of a disagreement of two columns, to the usual one from which on it contradicts a sensor."""


class Rough(NamedTuple):
    """Rows of a column that hold no reading, and why."""

    kind: str
    """`spike`, `stuck`, `late start` or `saturated`."""
    column: str
    rows: Int[np.ndarray, " row"]


def rough(readings: Columns, dt: float, limits: Collection[tuple[str, float]] = ()) -> list[Rough]:
    """Implausible readings in the columns of one sequence, sampled every `dt` [s]; NaN is a missing sample.

    `limits` are columns and values at which they are known to saturate.
    """
    entries, left = [], {name: np.array(y) for name, y in readings.items()}
    rates = {name: name[1:] for name in readings if name.startswith("d") and name[1:] in readings}
    for name, y in readings.items():  # a rate from counts may jump by two of them
        if (rows := spikes(y, 2 * resolution(readings[rates[name]][None]) / dt if name in rates else 0.0)).size:
            entries.append(Rough("spike", name, rows))
            left[name][rows] = np.nan
    for name in sorted(readings, key=lambda name: name in rates):  # coordinates first: rates are held to them
        y = left[name]
        dead = np.isfinite(readings[rates[name]]) & np.isnan(left[rates[name]]) if name in rates else np.zeros(y.size)
        for kind, rows in _constant(name, left, dt, [value for column, value in limits if column == name], dead):
            entries.append(Rough(kind, name, rows))
            left[name][rows] = np.nan
    return entries


def spikes(y: Float[np.ndarray, " time"], least: float = 0.0) -> Int[np.ndarray, " row"]:
    """Rows of single readings farther than `least` from the cubic through the others around.

    They are `SPIKE` standard deviations away: of the noise, and of what the cubic leaves of the others, which is much
    at a jump or a kink.
    """
    k = np.flatnonzero(np.isfinite(y))
    if k.size < 2 * _NEAR:
        return k[:0]
    x, noise, out = y[k], reading_noise(y[None]), []
    off = np.pad(np.abs(np.convolve(x, [1, -4, 6, -4, 1], "valid")) / 6, 2)  # from the cubic through two on either side
    # a smaller one does no harm, and machines make small wiggles
    least = max(least, SPIKE * noise, 0.015 * float(np.std(x)), 1e-9 * float(np.max(np.abs(x))))
    right = (off <= least) | (off < np.maximum(np.append(off[1:], 0.0), np.append(0.0, off[:-1])))
    for i in np.flatnonzero(~right):
        near = np.flatnonzero(right[max(i - _SIDE, 0) : i + _SIDE + 1]) + max(i - _SIDE, 0)
        if min(np.sum(near < i), np.sum(near > i)) < 3 or np.ptp(k[near]) > 6 * _SIDE:
            continue
        base = np.vander((k[near] - k[i]) / _SIDE, 4)
        inverse = np.linalg.pinv(base)
        residual = x[near] - base @ (inverse @ x[near])
        spread = max(noise, math.sqrt(residual @ residual / (near.size - 4)))
        miss = x[i] - inverse[-1] @ x[near]
        sides = [x[i] - np.polyfit(k[one] - k[i], x[one], 2)[-1] for one in (near[near < i][-3:], near[near > i][:3])]
        lively = np.concatenate([off[max(i - _NEAR, 0) : max(i - 2, 0)], off[i + 3 : i + _NEAR + 1]])
        far = max(SPIKE * spread, _LIVE * float(np.quantile(lively, 0.75)), least)
        if abs(miss) > far and np.min(np.sign(miss) * np.array(sides)) > abs(miss) / 2:  # a corner belongs to one side
            out.append(k[i])
    return np.array(out, int)


def _constant(
    name: str, readings: Columns, dt: float, limits: Collection[float], dead: np.ndarray
) -> list[tuple[str, Int[np.ndarray, " row"]]]:
    """Saturated, stuck and late readings: kinds and rows.  One sensor gives both columns where the other is `dead`."""
    y, found = readings[name], []
    every = runs(y)
    lengths = np.array([run.length for run in every], int)
    if lengths.max(initial=0) >= np.isfinite(y).sum():
        return []
    others = np.sort(lengths)[:-1]  # a sensor that stays stuck would be its own measure
    usual = float(np.median(np.repeat(others, others)))
    noisy = usual < 2 and np.sum((lengths > 1) & (lengths < STILL)) <= 0.002 * y.size  # more: steps of an encoder
    apart = _disagreement(name, readings, dt)
    full = np.isin(y, list(limits))
    for limit, sign in ((np.nanmax(y), 1.0), (np.nanmin(y), -1.0)):
        at_limit = [run for run in every if y[run.first] == limit and run.length >= max(3, 2 * usual)]
        if apart is not None and any(_contradicts(y, run, apart, dt, sign) for run in at_limit):
            full |= y == limit
    if full.any():
        found.append((FULL, np.flatnonzero(full)))
    for run in every:
        if run.length < max(STILL, 3 * usual) or full[run.first]:
            continue
        moved = apart is not None and _contradicts(y, run, apart, dt)
        silent = noisy and not (apart and apart.rate) and _silent(y, run)
        if moved or silent or _jumps(y, run) or 2 * np.sum(dead[run.first : run.end]) > run.length:
            late = run is every[0]
            rows = np.arange(run.first + (not late), run.end)
            found.append(("late start" if late else "stuck", rows[np.isfinite(y[rows])]))
    return found


class _Apart(NamedTuple):
    """Disagreement of a coordinate and its rate."""

    way: Float[np.ndarray, " time"]
    """Motion that the other column shows and this one does not."""
    least: Float[np.ndarray, " time"]
    """Way that shows no motion in a run from each row: steps, noise and delay."""
    walk: float
    """Standard deviation of the noise of an integrated rate over one row."""
    rate: bool
    """True where this column is the rate."""


def _disagreement(name: str, readings: Columns, dt: float) -> _Apart | None:
    """Integral of the rate against the coordinate; None where one of the two is missing."""
    rate = name.startswith("d") and name[1:] in readings
    q, w = (readings.get(other) for other in ((name[1:], name) if rate else (name, f"d{name}")))
    if q is None or w is None or min(np.isfinite(q).sum(), np.isfinite(w).sum()) < 2:
        return None
    speed, step = bridge(w), 3 * resolution(q[None])
    way = np.append(0.0, np.cumsum(dt * (speed[1:] + speed[:-1]) / 2)) - bridge(q)
    if rate:
        return _Apart(-way, np.full(q.size, step + 9 * reading_noise(q[None])), 0.0, rate)
    delay = 5  # rows by which a filtered rate may be late
    return _Apart(way, step + delay * dt * np.abs(speed), reading_noise(w[None]) * dt, rate)


def _contradicts(y: Float[np.ndarray, " time"], run: Run, apart: _Apart, dt: float, sign: float = 0.0) -> bool:
    """True where the two columns disagree within the run, in the direction `sign`, far more than they usually do."""
    length = min(run.length, (y.size - run.length) // 2)
    if length < 2:
        return False

    def away(first: int, last: int) -> Float[np.ndarray, "place row"]:
        """The way within as many rows from some of the rows `first` to `last`."""
        rows = np.unique(np.linspace(first, last, min(30, max(last - first + 1, 0))).astype(int))
        return apart.way[rows[:, None] + np.arange(length)] - apart.way[rows][:, None]

    outside = np.abs(np.concatenate([away(0, run.first - length), away(run.end, y.size - length)])).max(axis=1)
    least = float(apart.least[run.first]) + 6 * apart.walk * math.sqrt(length)
    if apart.rate:  # the step of a coarse rate, or the threshold under which it is 0
        beside = np.convolve(y == y[run.first], np.ones(3), "same") > 0
        least += float(np.nanmin(np.abs(y - y[run.first]), where=~beside, initial=math.inf)) * dt * length
    inside = away(run.first, run.end - length)
    usual = float(np.median(outside)) if outside.size else 0.0
    return float(np.max(sign * inside if sign else np.abs(inside))) > _MORE * usual + least


def _jumps(y: Float[np.ndarray, " time"], run: Run) -> bool:
    """True where the readings behind the run are and stay far from it, beside the usual steps and those near by.

    A joint that rests on both sides slips, and a filtered rate returns.
    """
    step = np.abs(np.diff(y[np.isfinite(y)]))
    before, after = (side[np.isfinite(side)][: _NEAR + 1] for side in (y[: run.first + 1][::-1], y[run.end :]))
    near = np.abs(np.concatenate([np.diff(before), np.diff(after)]))
    if not after.size or near.size < STILL or np.median(near) == 0:
        return False
    usual, jump = max(np.percentile(step[step > 0], 95), near.max()), abs(after[0] - y[run.first])
    return bool(jump > _MORE * usual and np.min(np.abs(after - y[run.first])) > jump / 2)


def _silent(y: Float[np.ndarray, " time"], run: Run) -> bool:
    """True where the readings around are noise of several steps of the sensor, which the run lacks."""
    noise, step = reading_noise(y[None]), np.abs(np.diff(y[np.isfinite(y)]))
    sides = [side[np.isfinite(side)][:_NEAR] for side in (y[: run.first][::-1], y[run.end :])]
    spread = [(np.std(np.diff(side, 2)), np.std(np.diff(side, 3))) for side in sides if side.size >= 8]
    noisy = all(bend > noise / 3 and turn > bend for bend, turn in spread)
    least = max(
        3 * float(np.min(step[step > 0])), 3e-4 * float(np.nanstd(y))
    )  # less may be that of a resampled encoder
    return len(spread) > 0 and noise > least and noisy
