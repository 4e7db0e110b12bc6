"""Sample and hold: readings that stand in several rows, because the sensor is slower than the log."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

HELD_ROWS = 1.5
"""Mean rows of a reading from which on the repeats are taken as missing: below, most rows hold one of their own."""


class Run(NamedTuple):
    """Equal readings in the rows from `first` to before `end`; some may be missing."""

    first: int
    end: int

    @property
    def length(self) -> int:
        """Rows."""
        return self.end - self.first


def runs(y: Float[np.ndarray, " time"]) -> list[Run]:
    """All readings as runs of equal ones, missing samples among them left out."""
    k = np.flatnonzero(np.isfinite(y))
    new = np.append(True, np.diff(y[k]) != 0)[: k.size]
    last = np.append(new[1:], True)[: k.size]
    return [Run(a, b) for a, b in zip(k[new].tolist(), (k[last] + 1).tolist(), strict=True)]


def hold(signals: Sequence[Float[np.ndarray, " _"]]) -> float:
    """Rows in which each reading of a column stands while it moves; 1 where it is new in every row.

    An encoder that moves slowly repeats readings too, but its steps are single ones, and the faster it moves, the fewer
    rows lie between them.  `signals` are the column in some logs of one machine.
    """
    steps = [np.abs(np.diff(y[np.isfinite(y)])) for y in signals]
    changes = [(np.flatnonzero(size), size[size > 0]) for size in steps]  # readings that are new, and by how much
    sizes = np.concatenate([size for _, size in changes]) if changes else np.zeros(0)
    if not sizes.size:
        return 1.0
    quanta = 3.5  # steps of the sensor: a reading that has moved on by more would have changed every row
    moving = quanta * float(np.percentile(sizes, 1))
    rows = np.concatenate([np.diff(at)[(size[1:] > moving) & (size[:-1] > moving)] for at, size in changes])
    if rows.size < 8:  # of a moving signal, from which on the rows between them show a hold
        return 1.0
    typical = float(np.median(rows))
    usual = np.abs(rows - typical) <= max(0.3 * typical, 1.0)  # share of the rows by which a hold varies; one at least
    mean = float(np.mean(rows[usual]))
    regular = 0.9  # share of the holds that keep to it
    return mean if typical > 1 and np.mean(usual) >= regular and mean >= HELD_ROWS else 1.0


def repeats(y: Float[np.ndarray, " time"], rows: float) -> Int[np.ndarray, " row"]:
    """Rows that hold a reading over again, where each stands in so many; equal readings at rest are as many as fit."""
    k = np.flatnonzero(np.isfinite(y))
    first, end = np.array(runs(y[k]), int).reshape(-1, 2).T
    count = np.maximum(np.round((end - first) / rows), 1).astype(int)
    part = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    new = np.repeat(first, count) + np.round(part * np.repeat((end - first) / count, count)).astype(int)
    return np.delete(k, new)
