"""Counters that start over: readings that jump by one constant size, found and unwrapped.

A counter never leaves the range of its size, so that it jumps from one end of its readings to the other, against the
motion.  One of sign and magnitude jumps at zero, where its motion turns round.
"""

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from .noise import reading_noise
from .spikes import LONGEST_SPIKE

_JUMP = 0.4  # share of the range of the readings: sign and magnitude jump by half of theirs
_SMOOTH = 0.2  # of the size: steps that deviate by less from those around, once unwrapped
_MOST = 0.5  # share of the jumps that must look so: about the others the motion turns round, or readings are missing
_TURNS = (2 * math.pi, 360.0)
_TURN_PARTS = 400  # of a turn, one of which a counter behind a gear may cover
_FIT = 4  # readings on either side of a jump through which a cubic is laid to measure its size


class Counter(NamedTuple):
    """Jumps of a column."""

    size: float
    """Unit: that of the column."""
    turns: Int[np.ndarray, " time"]
    """Sizes to be added to each reading; of sign and magnitude 1 where the sign is set. 0 where there is no reading."""
    mirrored: bool
    """True for sign and magnitude."""
    rows: Int[np.ndarray, " jump"]
    """Rows of the readings after the jumps."""

    def __str__(self) -> str:
        return f"jumps by {self.size:.4g}" + (" at zero, where it turns round" if self.mirrored else "")


def counter(
    y: Float[np.ndarray, " time"], t: Float[np.ndarray, " time"], *, angle: bool = False, rate: bool = False
) -> Counter | None:
    """The jumps of a column at its times; None where there are none of one size.

    Those of an `angle` by a turn may begin and end anywhere: a driver that has counted turns may lose one.  A `rate`
    that was read without its sign jumps at zero; elsewhere its jumps are kicks.
    """
    k = np.flatnonzero(np.isfinite(y))
    x, t = y[k], t[k]
    if k.size < 2 * _FIT or np.max(np.abs(np.diff(x))) <= 0.5 * _JUMP * (reach := float(np.ptp(x))):
        return None
    found = _over(x, t, reach, rate) or _sign(x, t, reach) or (_lost_turn(x, t, k) if angle else None)
    levels = 32  # steps of the sensor that a counter has at least: an encoder at rest may go to and fro between two
    if found is None or found[0] < levels * _quantum(x):
        return None
    size, turns, mirrored = found
    last = np.maximum(np.searchsorted(k, np.arange(y.size), side="right") - 1, 0)
    return Counter(size, turns[last], mirrored, k[1:][np.diff(turns) != 0])


def unwrapped(y: Float[np.ndarray, " time"], found: Counter, *, rate: bool = False) -> Float[np.ndarray, " time"]:
    """The readings without the jumps: the first stays, and of a `rate`, whose zero is known, the median is near 0."""
    if found.mirrored:
        return np.where(found.turns > 0, np.copysign(found.size, y) - y, y)
    out = y + found.size * found.turns
    return out - found.size * round(float(np.nanmedian(out)) / found.size) if rate else out


_Found = tuple[float, Int[np.ndarray, " seen"], bool]
"""Size, sizes to be added, and True for sign and magnitude."""


def _miss(x: Float[np.ndarray, " seen"], t: Float[np.ndarray, " seen"]) -> Float[np.ndarray, " step"]:
    """Steps without those that the median rate of the seven around gives."""
    step, width = np.diff(x), np.diff(t)
    rate = np.lib.stride_tricks.sliding_window_view(np.pad(step / width, 3, mode="reflect"), 7)
    return step - np.median(rate, axis=1) * width


def _over(x: Float[np.ndarray, " seen"], t: Float[np.ndarray, " seen"], reach: float, rate: bool) -> _Found | None:
    """A counter that goes on at the other end of its range."""
    miss = np.abs(_miss(x, t))
    size = float(np.median(miss[jumps])) if (jumps := miss > _JUMP * reach).any() else 0.0
    full_jump = 0.9  # of the range, that a jump from one end to the other has: its step is measured from those around
    if size < full_jump * reach:
        return None
    size = max(size, reach)
    size = _measured(x, t, _turns(x, t, size), size)
    turns = _turns(x, t, size)
    z, at = x + size * turns, np.flatnonzero(np.diff(turns)) + 1
    if not at.size or not _smooth(z, t, size):
        return None
    if rate and (np.mean(_near_zero(x, z, at)) < _MOST or np.ptp(z) > size or not _sure(at.size, size, x)):
        return None
    moves = 3.0  # times the noise by which readings move over one of `spans`
    up, least = np.diff(turns)[at - 1], moves * reading_noise(z[None])
    back = (np.diff(at) <= LONGEST_SPIKE) & (up[1:] == -up[:-1])  # of a spike, or where the motion turns round
    alone = ~(np.append(back, False) | np.append(False, back))
    spans = (5, 20, 80)  # readings on either side of a jump that show the motion: slow ones need many
    ways = [[np.sign(up) * way > least for way in _travel(z, at, span)] for span in spans]
    runs_on = alone.any() and any(np.mean((before & after)[alone]) >= _MOST for before, after in ways)
    return (size, turns, False) if runs_on else None


def _sign(x: Float[np.ndarray, " seen"], t: Float[np.ndarray, " seen"], reach: float) -> _Found | None:
    """A counter of sign and magnitude: its jumps leave from near zero, and it comes back along the way that it went."""
    at = np.flatnonzero(np.abs(_miss(x, t)) > _JUMP * reach) + 1
    ends = [0, *at.tolist(), x.size]
    at = at[[min(b - a, c - b) > _FIT for a, b, c in zip(ends, ends[1:], ends[2:], strict=False)]]
    before, after = _travel(x, at, _FIT)
    turned = (np.sign(before) == -np.sign(after)) & _near_zero(x, x, at)
    if not turned.any() or np.mean(turned) < _MOST or np.ptp(np.sign(after)[turned]):
        return None
    far = np.where(np.abs(x[at]) > np.abs(x[at - 1]), x[at], x[at - 1])
    step = (np.abs(before) + np.abs(after)) / (2 * _FIT)
    beyond = np.maximum(step - np.abs(x[at] + x[at - 1] - far), 0.0) * np.sign(after * far)
    size = float(np.median((np.abs(far) - beyond)[turned]))
    if size < reach / 3:  # it is half the range at least
        return None
    size = _simplest(size, float(np.median(step[turned])), x)
    sign = np.abs(x - np.copysign(size, far[0])) < np.abs(x)
    z = np.where(sign, np.copysign(size, x) - x, x)
    return (size, sign.astype(int), True) if _sure(int(turned.sum()), size, x) and _smooth(z, t, size) else None


def _sure(count: int, size: float, x: Float[np.ndarray, " seen"]) -> bool:
    """True for more jumps than one, or one by a power of two of the sensor's steps: a kick is neither."""
    return count > 1 or math.log2(size / _quantum(x)) % 1.0 == 0.0


def _near_zero(
    x: Float[np.ndarray, " seen"], z: Float[np.ndarray, " seen"], at: Int[np.ndarray, " jump"]
) -> Bool[np.ndarray, " jump"]:
    """Jumps of `x` with zero within two steps of one side; steps are those of `z`."""
    before, after = _travel(z, at, _FIT)
    return np.minimum(np.abs(x[at - 1]), np.abs(x[at])) <= (np.abs(before) + np.abs(after)) / _FIT


def _turns(x: Float[np.ndarray, " seen"], t: Float[np.ndarray, " seen"], size: float) -> Int[np.ndarray, " seen"]:
    """Sizes to be added so that each reading is nearest to where the last three steps lead.

    A start so quick that it looks slow the other way would shift every step by one size: the median one is the least.
    """
    turns, recent, at = [0], [0.0] * 3, float(x[0])
    for (a, b), reading in zip(pairwise(t.tolist()), x.tolist()[1:], strict=True):
        rate = sorted(recent)[1]
        turns.append(round((at + rate * (b - a) - reading) / size))
        now = reading + size * turns[-1]
        recent = [*recent[1:], (now - at) / (b - a)]
        at = now
    shift = round(float(np.median(np.diff(x + size * np.array(turns)))) / size)
    return np.array(turns) - shift * np.arange(x.size)


def _smooth(z: Float[np.ndarray, " seen"], t: Float[np.ndarray, " seen"], size: float) -> bool:
    """True where next to no step deviates from those around."""
    few = 0.01  # share of the steps that may deviate by more: impacts, spikes
    return bool(np.mean(np.abs(_miss(z, t)) > _SMOOTH * size) <= few)


def _travel(
    z: Float[np.ndarray, " seen"], at: Int[np.ndarray, " jump"], span: int
) -> tuple[Float[np.ndarray, " jump"], Float[np.ndarray, " jump"]]:
    """Motion over some readings before a jump, which ends at `at`, and after it."""
    return z[at - 1] - z[np.maximum(at - 1 - span, 0)], z[np.minimum(at + span, z.size - 1)] - z[at]


def _lost_turn(
    x: Float[np.ndarray, " seen"], t: Float[np.ndarray, " seen"], k: Int[np.ndarray, " seen"]
) -> _Found | None:
    """Jumps by a turn, where most steps are small."""
    step = np.abs(np.diff(x))
    missed = 0.15  # of a turn, by which a jump may miss it where the readings have left its range
    for turn in _TURNS:
        if np.median(step) < 0.1 * turn and np.any((np.abs(step - turn) < missed * turn) & (np.diff(k) <= 2)):
            return turn, _turns(x, t, turn), False
    return None


def _measured(
    x: Float[np.ndarray, " seen"], t: Float[np.ndarray, " seen"], turns: Int[np.ndarray, " seen"], rough: float
) -> float:
    """Size of the jumps, by a cubic and jumps through the readings around each: the median."""
    sizes = []
    for i in (np.flatnonzero(np.diff(turns)) + 1)[:_TURN_PARTS]:
        rows = slice(max(i - _FIT, 0), i + _FIT)
        base = np.vander((t[rows] - t[i]) / (t[rows][-1] - t[rows][0]), 4)
        sizes.append(-np.linalg.lstsq(np.column_stack([base, turns[rows]]), x[rows], rcond=None)[0][-1])
    if not sizes or abs((size := float(np.median(sizes))) - rough) >= _SMOOTH * rough:
        return rough
    return _simplest(size, 12 * reading_noise((x + size * turns)[None]) / math.sqrt(len(sizes)), x)


def _simplest(size: float, error: float, x: Float[np.ndarray, " seen"]) -> float:
    """The power of two of the sensor's steps, the part of a turn or the number of steps within the error of a size."""
    step = _quantum(x)
    parts = [turn / max(min(round(turn / size), _TURN_PARTS), 1) for turn in _TURNS]
    for exact in (step * 2.0 ** round(math.log2(size / step)), *parts, step * round(size / step)):
        if abs(exact - size) <= error:
            return exact
    return size


def _quantum(x: Float[np.ndarray, " seen"]) -> float:
    """Smallest difference of two readings."""
    return float(np.min(np.diff(np.unique(x))))
