"""Rows of one uniform grid, and the stretches of it in which every topic is present."""

import math
from collections.abc import Mapping
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from .signals import SAME, Signal

INTERVALS = 5
"""Silence of so many of its own intervals, and of so many rows, is a gap of a topic where none is declared."""
NEAR = 2.5
"""Intervals of a topic between neighbours that are interpolated at most: one message may be lost."""
LEAST = 50
"""Rows of a sequence, where no shortest one is declared."""


class Gap(NamedTuple):
    """A silence of a topic, between two messages [s]."""

    start: float
    end: float


class Segment(NamedTuple):
    """Rows of the grid that follow each other."""

    first: int
    end: int
    """The row after the last one."""
    why: str = ""
    """Reason why it is dropped; empty: it is used."""


def reach(signal: Signal, dt: float) -> float:
    """Largest distance of neighbours between which values are interpolated [s]."""
    return max(NEAR * signal.interval, dt)


def longest_silence(signal: Signal, dt: float, declared: float | None) -> float:
    """Shortest silence that is a gap of a topic [s]."""
    return INTERVALS * max(signal.interval, dt) if declared is None else declared


def gaps(signal: Signal, longest: float) -> list[Gap]:
    """The silences that are longer [s]."""
    places = np.flatnonzero(np.diff(signal.t) > longest)
    return [Gap(float(signal.t[k]), float(signal.t[k + 1])) for k in places]


def spans(inputs: Mapping[str, Signal], readings: Mapping[str, Signal], dt: float) -> dict[str, tuple[float, float]]:
    """Intervals in which each topic is present [s]; a command is held for one more of its intervals, not to its end."""
    intervals: dict[str, tuple[float, float]] = {}
    for signals, hold in ((inputs, True), (readings, False)):
        for s in signals.values():
            span = (float(s.t[0]), float(s.t[-1]) + (s.interval - 2 * SAME * dt if hold else 0.0))
            first, last = intervals.get(s.topic, span)
            intervals[s.topic] = (max(first, span[0]), min(last, span[1]))
    return intervals


def grid(readings: Mapping[str, Signal], start: float, end: float, dt: float) -> Float[np.ndarray, " row"]:
    """Rows from a reading of the fastest topic on, so that readings as regular as the grid are taken as they are."""
    fastest = min(readings.values(), key=lambda s: s.interval)
    t = fastest.t[fastest.t >= start - SAME * dt]
    first = float(t[0]) if t.size else start
    return first + dt * np.arange(max(math.floor((end - first) / dt + SAME) + 1, 0))


def commanded(signal: Signal, at: Float[np.ndarray, " row"], dt: float, longest: float) -> Bool[np.ndarray, " row"]:
    """Rows in which an input is known: for one interval after its last value before a gap."""
    known = np.ones(at.size, bool)
    for gap in gaps(signal, longest):
        known &= (at < gap.start + max(signal.interval, dt) - SAME * dt) | (at >= gap.end - SAME * dt)
    return known


def watched(signal: Signal, at: Float[np.ndarray, " row"], dt: float, longest: float) -> Bool[np.ndarray, " row"]:
    """Rows outside the gaps of a reading."""
    known = np.ones(at.size, bool)
    for gap in gaps(signal, longest):
        known &= (at <= gap.start + SAME * dt) | (at >= gap.end - SAME * dt)
    return known


def cut(present: Bool[np.ndarray, " row"], shortest: int, longest: int) -> list[Segment]:
    """The stretches of `present` rows, the long ones in equal parts, the short ones marked as dropped."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], present, [False]]).astype(int))).reshape(-1, 2)
    segments = []
    for first, end in edges.tolist():
        parts = -(-(end - first) // longest)
        places = np.round(np.linspace(first, end, parts + 1)).astype(int).tolist()
        why = "" if end - first >= shortest else f"shorter than {shortest} rows"
        segments += [Segment(a, b, why) for a, b in pairwise(places)]
    return segments
