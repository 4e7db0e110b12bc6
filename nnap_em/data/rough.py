"""Readings that no sensor took: spikes, and the output of a stuck, late or saturated sensor."""

from collections.abc import Collection
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from .constant import constant_readings, quantum, travel
from .plausible import Columns, bridge
from .spikes import spikes

_AROUND = 10  # rows before and after a spike that show how a rate and its coordinate disagree


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
    first = {name: spikes(values) for name, values in readings.items()}
    clean = {name: _without(values, first[name]) for name, values in readings.items()}
    first = {
        name: _alone(readings[name], clean.get(name[1:] * name.startswith("d")), first[name], dt) for name in first
    }
    remaining = {name: _without(values, first[name]) for name, values in readings.items()}
    entries = []
    for name, values in remaining.items():
        still = list(constant_readings(name, remaining, dt, [value for column, value in limits if column == name]))
        entries += [Rough(kind, name, rows[np.isfinite(values[rows])]) for kind, rows in still]
        y = _without(values, *(rows for _, rows in still))
        rows = np.sort(np.concatenate([first[name], spikes(y)])) if still else first[name]
        entries += [Rough("spike", name, rows)] * bool(rows.size)
    return entries


def _alone(
    w: Float[np.ndarray, " time"], q: Float[np.ndarray, " time"] | None, rows: Int[np.ndarray, " row"], dt: float
) -> Int[np.ndarray, " left"]:
    """Spikes but those of a rate that are a step of its coordinate, or which the coordinate follows half the way."""
    if q is None or not rows.size or min(np.isfinite(q).sum(), np.isfinite(w).sum() - rows.size) < 2:
        return rows
    clean = bridge(_without(w, rows))
    miss = np.pad(bridge(q) - travel(clean, dt), 2, "edge")
    miss = miss[3:-1] - miss[:-4]  # from two rows before to the row after
    usual = np.array([np.median(np.abs(miss[max(k - _AROUND, 0) : k + _AROUND + 1])) for k in rows])
    size, way = np.abs(w - clean)[rows], miss[rows] * np.sign((w - clean)[rows])
    return rows[(size > 2 * quantum(q) / dt) & (way < np.maximum(dt / 2 * size, 6 * usual))]


def _without(y: Float[np.ndarray, " time"], *rows: Int[np.ndarray, "_"]) -> Float[np.ndarray, " time"]:
    """The readings, those of some rows as missing."""
    out = np.array(y)
    out[np.concatenate([np.zeros(0, int), *rows])] = np.nan
    return out
