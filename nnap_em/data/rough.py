"""Readings that no sensor took: spikes, and the output of a stuck, late or saturated sensor."""

from collections.abc import Collection
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from .constant import constant_readings, quantum
from .plausible import Columns, bridge
from .spikes import spikes


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
    for name in first:  # of a rate from counts, one count more is none
        if first[name].size and (q := readings.get(name[1:] * name.startswith("d"))) is not None:
            off = readings[name] - bridge(_without(readings[name], first[name]))
            first[name] = first[name][np.abs(off[first[name]]) > 2 * quantum(q) / dt]
    remaining = {name: _without(values, first[name]) for name, values in readings.items()}
    entries = []
    for name in sorted(readings, key=lambda name: name[1:] in readings):  # coordinates first: rates are held to them
        values = remaining[name]
        still = list(
            constant_readings(name, remaining, readings, dt, [value for column, value in limits if column == name])
        )
        entries += [Rough(kind, name, rows[np.isfinite(values[rows])]) for kind, rows in still]
        y = _without(values, *(rows for _, rows in still))
        remaining[name] = y
        rows = np.sort(np.concatenate([first[name], spikes(y)])) if still else first[name]
        entries += [Rough("spike", name, rows)] * bool(rows.size)
    return entries


def _without(y: Float[np.ndarray, " time"], *rows: Int[np.ndarray, "_"]) -> Float[np.ndarray, " time"]:
    """The readings, those of some rows as missing."""
    out = np.array(y)
    out[np.concatenate([np.zeros(0, int), *rows])] = np.nan
    return out
