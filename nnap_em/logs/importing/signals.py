"""A quantity at times of its own: read at rows, and the stretches of time in which several are present."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

SAME_TIME = 1e-3
"""Share of a row by which times may differ and still be one: clocks count in ns, and rows are rounded."""
SLOW = 1.5
"""Rows from one reading to the next from which on readings stand in their nearest row, with empty rows between."""

FEWEST_ROWS = 50
"""Rows of a sequence, where no shortest one is declared."""

Spans = Float[np.ndarray, "_ 2"]
"""Starts and ends [s] of stretches of time that follow each other."""


@dataclass(frozen=True)
class Signal:
    """Values [SI] at times [s] that rise."""

    topic: str
    t: Float[np.ndarray, " message"]
    y: Float[np.ndarray, " message"]
    jumps: Int[np.ndarray, " jump"] = field(default_factory=lambda: np.zeros(0, int))
    """Values before which a counter has started over."""
    longest: float = np.inf
    """Silence from which on it has a gap [s]; infinite for commands that hold until the next."""

    @cached_property
    def interval(self) -> float:
        """Median time from one value to the next [s]."""
        return float(np.median(np.diff(self.t), overwrite_input=True)) if self.t.size > 1 else np.inf


def held(signal: Signal, at: Float[np.ndarray, " row"], dt: float) -> Float[np.ndarray, " row"]:
    """The value given last, at the row or before it."""
    return signal.y[_before(signal, at + SAME_TIME * dt)]


def straight(signal: Signal, at: Float[np.ndarray, " row"], dt: float) -> Float[np.ndarray, " row"]:
    """The value on the line from the one given last to the next."""
    return np.interp(at, signal.t, signal.y)


def averaged(signal: Signal, at: Float[np.ndarray, " row"], dt: float) -> Float[np.ndarray, " row"]:
    """The mean from each row to the next of a signal that is held between its values."""
    before = np.append(0.0, np.cumsum(signal.y[:-1] * np.diff(signal.t)))

    def integral(x: Float[np.ndarray, " row"]) -> Float[np.ndarray, " row"]:
        i = _before(signal, x)
        return before[i] + signal.y[i] * (x - signal.t[i])

    return (integral(at + dt) - integral(at)) / dt


def interpolated(signal: Signal, at: Float[np.ndarray, " row"], dt: float) -> Float[np.ndarray, " row"]:
    """Straight lines between neighbours; NaN where there is no value.

    There is none where a jump lies between neighbours, nor, where these are further apart than rows, in rows that are
    nearest to no reading.  Between readings of noise sigma a value has less: from sigma / sqrt(2) on.
    """
    t, slack = signal.t, SAME_TIME * dt
    right = np.clip(np.searchsorted(t, at), 1, max(t.size - 1, 1))
    width = t[right] - t[right - 1]
    x = np.clip(at, t[0], t[-1])
    exact = np.minimum(np.abs(x - t[right]), np.abs(x - t[right - 1])) <= slack
    across = np.isin(right, signal.jumps)
    near = np.searchsorted(t, at + dt / 2) > np.searchsorted(t, at - dt / 2)
    known = (at >= t[0] - slack) & (at <= t[-1] + slack) & ((~across & (near | (width <= SLOW * dt))) | exact)
    share = (x - t[right - 1]) / width
    share = np.where(across, np.round(share), share)
    y = signal.y[right - 1] * (1 - share) + signal.y[right] * share
    return np.where(known, y, np.nan)


def _before(signal: Signal, at: Float[np.ndarray, " x"]) -> np.ndarray:
    return np.clip(np.searchsorted(signal.t, at, side="right") - 1, 0, signal.t.size - 1)


class Stretch(NamedTuple):
    """Rows that become one file, or are dropped."""

    start: float
    """Time of the first row on the clock of the log [s]."""
    rows: int
    missing: Mapping[str, int] = {}
    """Empty fields of readings."""
    why: str = ""
    """Reason why it is dropped."""


def longest_silence(signal: Signal, dt: float, declared: float | None) -> float:
    """Shortest silence that is a gap of a topic [s]."""
    # Silence of so many of its own intervals, and of so many rows, is a gap of a topic where none is declared
    return 5 * max(signal.interval, dt) if declared is None else declared


def sent_on_change(signal: Signal, dt: float) -> bool:
    """True for commands without a rate, each of which holds until the next: a few, or set points.

    Set points have a median interval of more than a row: no drive waits so long.
    """
    return signal.t.size <= 10 or signal.interval >= max(0.5, 1.5 * dt)


def present(signal: Signal, hold: float = 0.0) -> Spans:
    """Stretches without a gap; a command is held for `hold` [s] after the last value of each, not to its end."""
    places = np.flatnonzero(np.diff(signal.t) > signal.longest)
    ends = signal.t[np.append(places, signal.t.size - 1)]
    return np.stack([signal.t[np.append(0, places + 1)], ends + hold], axis=1)


def hold(signal: Signal, dt: float) -> float:
    """Time for which a command is known after its last value [s]."""
    return max(signal.interval, dt) - 2 * SAME_TIME * dt


def covered(parts: Sequence[Spans], least: int) -> Spans:
    """Stretches of time that lie in at least so many of the parts."""
    edges = np.concatenate([np.zeros(0), *(part.T.ravel() for part in parts)])
    signs = np.concatenate([np.zeros(0, int), *(np.repeat((1, -1), len(part)) for part in parts)])
    order = np.lexsort((-signs, edges))  # what begins where another part ends touches it
    depth = np.cumsum(signs[order])
    first = np.flatnonzero((depth >= least) & (depth - signs[order] < least))
    last = np.flatnonzero((depth < least) & (depth - signs[order] >= least))
    return np.stack([edges[order][first], edges[order][last]], axis=1)


def runs(spans: Spans, fastest: Signal, dt: float) -> list[Stretch]:
    """Rows `dt` apart in each span, from a reading of the fastest topic on if there is one near.

    Readings as regular as the rows are taken as they are.  Spans less than a row apart are one.
    """
    apart = np.flatnonzero(spans[1:, 0] - spans[:-1, 1] > dt)
    start, end = spans[:, 0][np.append(0, apart + 1)[: len(spans)]], spans[:, 1][np.append(apart, -1)[: len(spans)]]
    reading = np.append(fastest.t, np.inf)[np.searchsorted(fastest.t, start - SAME_TIME * dt)]
    start = np.where(reading < start + max(fastest.interval, dt), reading, start)
    rows = np.floor((end - start) / dt + SAME_TIME).astype(int) + 1
    return [Stretch(first, n) for first, n in zip(start.tolist(), rows.tolist(), strict=True) if n > 0]


def cut(runs: Sequence[Stretch], dt: float, shortest: int, longest: int) -> list[Stretch]:
    """The runs of rows, the long ones in equal parts, the short ones marked as dropped."""
    out = []
    for run in runs:
        places = np.round(np.linspace(0, run.rows, -(-run.rows // longest) + 1)).astype(int).tolist()
        why = "" if run.rows >= shortest else f"shorter than {shortest} rows"
        out += [Stretch(run.start + a * dt, b - a, why=why) for a, b in pairwise(places)]
    return out
