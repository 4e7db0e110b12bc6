"""Limits of a machine for designed inputs: the table [limits] of `rig.toml`."""

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from functools import partial

from .table import Table

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


def read_bounds(root: Table, inputs: Collection[str], states: Collection[str]) -> Bounds:
    """The table [limits] of a `rig.toml`: a number is a bound both ways, a pair the lowest and the highest."""
    limits = root.table("limits", absent={})
    return Bounds(
        root.each("limits", read_range, (*inputs, *states), apart=("rate", "start")),
        limits.each("rate", read_range, inputs),
        limits.each("start", partial(read_range, place=True), states),
    )


def read_range(table: Table, key: str, *, place: bool = False) -> Range:
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
