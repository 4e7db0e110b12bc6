"""The table `[import]` of rig.toml: where each column of the data set comes from, and how a log is cut."""

import math
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

from ..data.rig import RigError, nearest
from .recording import Address, address

INPUTS = ("hold", "mean")


class Plan(NamedTuple):
    """Parameters of resampling logs to one grid."""

    columns: Mapping[str, Address]
    """Addresses of columns; an absent one is found by its name."""
    duplicates: Mapping[str, Address]
    """The quantity of a column on another topic, used for their delay only."""
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
_KEYS = ("columns", "duplicates", "input", "gap", "shortest", "longest")


def read_plan(path: Path, columns: tuple[str, ...]) -> Plan:
    """Import that rig.toml, accepted by `read_rig`, declares; `columns` are those of the rig.

    Raises RigError at the first mistake.
    """
    table = tomllib.loads(path.read_bytes().decode("utf-8-sig")).get("import", {})
    if not isinstance(table, dict):
        _refuse(path, "import", f"found {table!r}", "write a table [import]")
    for key in table:
        if key not in _KEYS:
            _refuse(path, f"[import] {key}", "unknown table or key", nearest(key, _KEYS))
    mode = table.get("input", INPUTS[0])
    if mode not in INPUTS:
        _refuse(path, "[import] input", f"found {mode!r}", nearest(str(mode), INPUTS))
    return Plan(
        _addresses(path, table, "columns", columns),
        _addresses(path, table, "duplicates", columns),
        mode == INPUTS[1],
        _seconds(path, table, "gap"),
        _seconds(path, table, "shortest"),
        _seconds(path, table, "longest"),
    )


def _addresses(path: Path, table: Mapping[str, Any], key: str, columns: tuple[str, ...]) -> dict[str, Address]:
    items = table.get(key, {})
    if not isinstance(items, dict):
        _refuse(path, f"[import] {key}", f"found {items!r}", f"write a table [import.{key}]")
    for name in items:
        if name not in columns:
            _refuse(path, f"[import.{key}] {name}", "no column of this rig", nearest(name, columns))
    return {name: _address(path, f"[import.{key}] {name}", value) for name, value in items.items()}


def _address(path: Path, where: str, value: Any) -> Address:
    hint = 'write "topic:field", such as "/joint_states:position[0]", or { from = "topic:field", scale = 0.0174533 }'
    entry = value if isinstance(value, dict) else {"from": value}
    text, scale = entry.get("from"), entry.get("scale", 1.0)
    if not isinstance(text, str) or not address(text)[1] or set(entry) - {"from", "scale"}:
        _refuse(path, where, f"found {value!r}", hint)
    if isinstance(scale, bool) or not isinstance(scale, int | float) or not math.isfinite(scale) or scale == 0:
        _refuse(path, where, f"scale is {scale!r}", "write a finite number, SI unit per unit of the log")
    return Address(*address(text), float(scale))


def _seconds(path: Path, table: Mapping[str, Any], key: str) -> float | None:
    value = table.get(key)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not value > 0:
        _refuse(path, f"[import] {key}", f"found {value!r}", f"write seconds above 0, {key} = 0.5")
    return float(value)


def _refuse(path: Path, where: str, problem: str, hint: str) -> NoReturn:
    raise RigError(f"{path}: {where}: {problem}; {hint}")
