"""Limits of a machine for designed inputs: the table [limits] of `rig.toml`."""

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

Range = tuple[float, float]


@dataclass(frozen=True)
class Bounds:
    """Lowest and highest values, by column, in SI units; absent ones are the ranges of the logs."""

    values: Mapping[str, Range] = field(default_factory=dict)
    """Ranges of inputs [N m, or N], coordinates and rates."""
    rate: Mapping[str, Range] = field(default_factory=dict)
    """Ranges of the change of inputs [N m/s]."""
    start: Mapping[str, Range] = field(default_factory=dict)
    """Ranges of the states in which a sequence may begin, set by hand."""


UNBOUNDED = Bounds()


def read_bounds(table: Any, inputs: Collection[str], states: Collection[str]) -> Bounds:
    """The table [limits] of a `rig.toml`: a number is a bound both ways, a pair the lowest and the highest.

    Refused are unknown columns, pairs that are upside down, and a bound of 0.
    """
    table.check((), (*inputs, *states, "rate", "start"))
    rate, start = table.table("rate", absent={}), table.table("start", absent={})
    rate.check((), inputs)
    start.check((), states)
    values = {name: read_range(table, name) for name in table.items if name not in ("rate", "start")}
    rates = {name: read_range(rate, name) for name in rate.items}
    return Bounds(values, rates, {name: read_range(start, name, place=True) for name in start.items})


def read_range(table: Any, key: str, *, place: bool = False) -> Range:
    """A pair as it stands; a number is that far both ways, or the one `place`."""
    value = table.items[key]
    pair = value if isinstance(value, list) else [value, value] if place else [0.0, value]
    if len(pair) != 2 or not all(type(x) in (int, float) and math.isfinite(x) for x in pair):
        table.refuse(key, hint=f"write {key} = 0.3 or {key} = [-0.3, 0.3]")
    low, high = float(pair[0]), float(pair[1])
    if not place and not isinstance(value, list):
        low = -high
    if low > high or (low == high and not place):
        table.refuse(key, hint=f"write the lower bound first, {key} = [-0.3, 0.3]; a single number is above 0")
    return low, high
