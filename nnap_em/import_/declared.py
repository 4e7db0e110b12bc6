"""The table `[import]` of rig.toml: where each column of the data set comes from, and how a log is cut."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from ..data.rig import whole_table
from .recording import Address, address


class Plan(NamedTuple):
    """Parameters of resampling logs to one grid."""

    columns: Mapping[str, Address]
    """Addresses of columns; an absent one is found by its name."""
    mean: bool
    """Inputs averaged over the sample, instead of the value held at the row."""
    gap: float | None
    """A topic that is silent for longer [s] ends the sequence; None: a few of its intervals."""
    shortest: float | None
    """Shorter sequences are dropped [s]; None: 50 rows."""
    longest: float | None
    """Longer ones are cut [s]; None: `LONGEST`, or 500 rows where these last longer."""


LONGEST = 30.0
"""Sequences are cut to this, where nothing is declared [s]: a hidden joint is lost in longer ones."""


def read_plan(path: Path, columns: tuple[str, ...]) -> Plan:
    """Import that rig.toml, accepted by `read_rig`, declares; `columns` are those of the rig.

    Raises RigError at the first mistake.
    """
    table = whole_table(path).table("import", absent={})
    keys = ("columns", "input", "gap", "shortest", "longest")
    table.check((), keys)
    inputs = ("hold", "mean")
    return Plan(
        _addresses(table, columns),
        "input" in table.items and table.choice("input", inputs) == inputs[1],
        *(_seconds(table, key) for key in ("gap", "shortest", "longest")),
    )


def _addresses(table: Any, columns: tuple[str, ...]) -> dict[str, Address]:
    if not isinstance(table.items.get("columns", {}), dict):
        table.refuse("columns", hint="write a table [import.columns]")
    inside = table.table("columns", absent={})
    inside.check((), columns)
    return {name: _address(inside, name) for name in inside.items}


def _address(table: Any, name: str) -> Address:
    value = table.items[name]
    entry = value if isinstance(value, dict) else {"from": value}
    text, scale = entry.get("from"), entry.get("scale")
    if not isinstance(text, str) or not address(text)[1] or set(entry) - {"from", "scale"}:
        hint = 'write "topic:field", such as "/joint_states:position[0]", or { from = "topic:field", scale = 0.001 }'
        table.refuse(name, hint=hint)
    wrong = isinstance(scale, bool) or not isinstance(scale, int | float) or not math.isfinite(scale) or scale == 0
    if wrong and scale is not None:
        table.refuse(name, f"scale is {scale!r}", "write a finite number, SI unit per unit of the log")
    return Address(*address(str(text)), scale)


def _seconds(table: Any, key: str) -> float | None:
    """Seconds, which may be infinite; None where nothing is declared."""
    value = table.items.get(key)
    if value is not None and (type(value) not in (int, float) or not value > 0):
        table.refuse(key, hint=f"write seconds above 0, {key} = 0.5")
    return None if value is None else float(value)
