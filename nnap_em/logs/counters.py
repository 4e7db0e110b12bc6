"""Counters that start over: readings that jump by one constant size, found and unwrapped.

A counter never leaves the range of its size, so that it jumps from one end of its readings to the other, against the
motion.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from .noise import reading_noise

_JUMP = 0.6
"""Size of a jump as a share of the range of the readings."""
_TURNS, _PARTS = (2 * math.pi, 360.0), 200
"""Turns, and the most parts of one, one of which a counter behind a gear covers."""


class Counter(NamedTuple):
    """Jumps of a column."""

    size: float
    """Unit: that of the column."""
    turns: Int[np.ndarray, " time"]
    """Sizes to be added to each reading."""
    rows: Int[np.ndarray, " jump"]
    """Rows of the readings after the jumps."""

    def __str__(self) -> str:
        return f"jumps by {self.size:.4g}"


def counter(y: Float[np.ndarray, " time"], *, angle: bool = False) -> Counter | None:
    """The jumps of a column; None where there are none of one size.

    Those of an `angle` by a turn may begin and end anywhere: a driver that has counted turns may lose one.
    """
    k = np.flatnonzero(np.isfinite(y))
    x, step = y[k], np.diff(y[k])
    if k.size < 8 or not (jumps := (np.abs(step) > _JUMP * np.ptp(x)) & (np.diff(k) <= 8)).any():
        return None
    quantum, few = float(np.min(np.diff(np.unique(x)))), 0.15  # of a turn, by which a jump may miss it
    size = _size(k, x, quantum)
    lost = [turn for turn in _TURNS if np.any((np.abs(np.abs(step) - turn) < few * turn) & (np.diff(k) <= 2))]
    if not _runs_on(x, size, jumps):
        size = next((turn for turn in lost if angle and np.median(np.abs(step)) < 0.1 * turn), 0.0)
    levels = 32  # steps of the sensor that a counter has at least: an encoder at rest may go to and fro between two
    if size < levels * quantum:
        return None
    turns = np.round((np.unwrap(x, period=size) - x) / size).astype(int)
    last = np.maximum(np.searchsorted(k, np.arange(y.size), side="right") - 1, 0)
    return Counter(size, turns[last], k[1:][np.diff(turns) != 0])


def _size(k: Int[np.ndarray, " seen"], x: Float[np.ndarray, " seen"], quantum: float) -> float:
    """Median size of the jumps beside the steps that the two before and after each give by a cubic.

    Within its error it is a power of two or a number of the sensor's steps, or a part of a turn.
    """
    step, rows = np.diff(x), np.diff(k)
    turns = np.round(step / np.ptp(x))
    speed = (step - np.ptp(x) * turns) / rows
    at = np.flatnonzero(turns[2:-2]) + 2
    if not at.size:
        return 0.0
    expected = rows[at] * (4 * (speed[at - 1] + speed[at + 1]) - speed[at - 2] - speed[at + 2]) / 6
    size = float(np.median((step[at] - expected) / turns[at]))
    if size <= 0:
        return 0.0
    error = max(12 * reading_noise(np.unwrap(x, period=size)[None]) / math.sqrt(at.size), 1e-3 * size)
    parts = [turn / min(max(round(turn / size), 1), _PARTS) for turn in _TURNS]
    exact = (quantum * 2.0 ** round(math.log2(size / quantum)), *parts, quantum * round(size / quantum))
    return next((one for one in exact if abs(one - size) <= error), size)


def _runs_on(x: Float[np.ndarray, " seen"], size: float, jumps: np.ndarray) -> bool:
    """True where the readings span the size, and without the jumps go on smoothly, at half the jumps the same way."""
    if np.ptp(x) < 0.9 * size or size < 0.9 * np.ptp(x):
        return False
    z = np.unwrap(x, period=size)
    step = np.diff(z)
    around = np.median(np.lib.stride_tricks.sliding_window_view(np.pad(step, 3, mode="reflect"), 7), axis=1)
    if np.mean(np.abs(step - around) > 0.2 * size) > 0.01:  # but for impacts and spikes
        return False
    at, span = np.flatnonzero(jumps), 20
    back = (np.diff(at) <= 3) & (np.diff(np.sign(np.diff(x)[at])) != 0)  # a spike, or where the motion turns round
    at = at[~(np.append(back, False) | np.append(False, back))]
    way = -np.sign(x[at + 1] - x[at])
    moved = 3 * reading_noise(z[None])
    before, after = z[at] - z[np.maximum(at - span, 0)], z[np.minimum(at + 1 + span, z.size - 1)] - z[at + 1]
    return at.size > 0 and bool(np.mean((way * before > moved) & (way * after > moved)) >= 0.5)
