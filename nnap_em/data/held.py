"""Sample and hold: readings that stand in several rows, because the sensor is slower than the log."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from .constant import runs

HELD = 1.5
"""Mean rows of a reading from which on the repeats are taken as missing: below, most rows hold one of their own."""
_QUANTA = 2.5  # steps of the sensor: a reading that has moved on by more would have changed every row
_CHANGES = 20  # of a moving signal, from which on the rows between them show a hold
_JITTER = 0.3  # share of the rows by which a hold varies; one at least
_REGULAR = 0.9  # share of the holds that keep to it


def hold(signals: Sequence[Float[np.ndarray, " _"]]) -> float:
    """Rows in which each reading of a column stands while it moves; 1 where it is new in every row.

    An encoder that moves slowly repeats readings too, but its steps are single ones, and the faster it moves, the fewer
    rows lie between them.  `signals` are the column in some logs of one machine.
    """
    changes = [_changes(y) for y in signals]
    sizes = np.concatenate([size for _, size in changes]) if changes else np.zeros(0)
    if not sizes.size:
        return 1.0
    moving = _QUANTA * float(np.percentile(sizes, 1))
    rows = np.concatenate([np.diff(at)[(size[1:] > moving) & (size[:-1] > moving)] for at, size in changes])
    if rows.size < _CHANGES:
        return 1.0
    typical = float(np.median(rows))
    usual = np.abs(rows - typical) <= max(_JITTER * typical, 1.0)
    mean = float(np.mean(rows[usual]))
    return mean if typical > 1 and np.mean(usual) >= _REGULAR and mean >= HELD else 1.0


def repeats(y: Float[np.ndarray, " time"], rows: float) -> Int[np.ndarray, " row"]:
    """Rows that hold a reading over again, where each stands in so many; equal readings at rest are as many as fit."""
    first, end = np.array(runs(y), int).reshape(-1, 2).T
    count = np.maximum(np.round((end - first) / rows), 1).astype(int)
    part = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    new = np.repeat(first, count) + np.round(part * np.repeat((end - first) / count, count)).astype(int)
    return np.setdiff1d(np.flatnonzero(np.isfinite(y)), new)


def _changes(y: Float[np.ndarray, " time"]) -> tuple[Int[np.ndarray, " change"], Float[np.ndarray, " change"]]:
    """Rows of new readings, and how far they are from the last."""
    k = np.flatnonzero(np.isfinite(y))
    size = np.abs(np.diff(y[k]))
    return k[1:][size > 0], size[size > 0]
