"""Addresses of the columns of a rig in a log, as rig.toml declares them or by their names, with units and the options
of `[import]`.
"""

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ...base.digits import counted
from ...errors import DataError
from ...machines.rig import Rig, nearest, whole_table
from ...machines.units import UNITS, factor, named_unit
from ..formats import refuse
from .recording import OTHER, Address, Topic, address, places


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


def resolve(
    path: Path, topics: Sequence[Topic], inputs: Sequence[str], measured: Sequence[str], declared: Mapping[str, Address]
) -> dict[str, Address]:
    """Address of each column of the rig; DataError with the nearest names where one is absent."""
    return {
        name: declared_at(path, topics, declared[name], name) if name in declared else _by_name(path, topics, name)
        for name in (*inputs, *measured)
    }


def declared_at(path: Path, topics: Sequence[Topic], declared: Address, column: str) -> Address:
    """The address as the file has it: names may hold a colon, end in a unit, and count an entry that has a name."""
    where, at = f"column {column!r} from {str(declared)!r}", declared.path
    for topic in topics:
        there = str(declared).removeprefix(f"{topic.name}:" if topic.name else "")
        alike = [field for field in topic.fields if there in (field, named_unit(field, brackets=True)[0])]
        if there in topic.fields or len(alike) == 1:
            return declared._replace(topic=topic.name, path=there if there in topic.fields else alike[0])
    topic = next((topic for topic in topics if topic.name == declared.topic), None)
    if topic is None:
        hint = nearest(declared.topic, [topic.name for topic in topics])
        raise DataError(f"{path}: {where}: there is no topic {declared.topic!r}; {hint}")
    if not topic.fields:
        refuse(path, where, f"topic {topic.name!r} ({topic.kind}) holds no numbers that can be read", OTHER)
    match = re.fullmatch(r"(.*)\[(\d+)\]", at)
    row = [name for name in topic.fields if match and re.fullmatch(re.escape(match[1]) + r"\[[^\]]*\]", name)]
    if match and int(match[2]) < len(row):
        return declared._replace(path=row[int(match[2])])
    if match and row:
        problem = f"{match[1]!r} of {topic.name!r} has {counted(len(row), 'value')}"
        refuse(path, where, problem, f"count from 0 to {len(row) - 1}")
    owner = f"topic {topic.name!r}" if topic.name else "the table"
    refuse(path, where, f"{owner} has no field {at!r}", nearest(at, topic.fields))


def in_unit(path: Path, column: str, at: Address, rig: Rig) -> tuple[Address, str]:
    """The address with its scale, that of the unit in its name where none is declared, and a note where that counts.

    Raises DataError where the unit is of another quantity than the column.
    """
    named, unit = named_unit(at.path)[1], rig.column_unit(column)
    times = factor(named, unit) if named and at.scale is None else None
    single = len(named) < 2 or named in UNITS  # x_s, tau_m: a letter may mean anything
    sure = not single or bool(named_unit(at.path, brackets=True)[1])
    if times is not None and math.isnan(times) and sure:
        hint = f'write [import.columns] {column} = {{ from = "{at}", scale = ... }} with {unit} per {named}'
        current = ', or [input] kind = "affine" with its gain' if column in rig.input_columns else ""
        where, problem = f"column {column!r} from {str(at)!r}", f"in {named} by its name, but {unit} is read"
        refuse(path, where, problem, hint + current)
    if times is not None and not math.isnan(times):
        return at._replace(scale=times), f"{column} from {str(at)!r}: {times:.6g} {unit} per {named}" * (times != 1)
    other = re.search(r"\s[\[(]([^][()]+)[\])]$", at.path) if at.scale is None and unit and not named else None
    odd = other[1] if other and other[1] != unit else ""
    note = f"{column} from {str(at)!r}: taken in {unit}, since the unit {odd!r} is not known" if odd else ""
    return at._replace(scale=at.scale or 1.0), note


def _by_name(path: Path, topics: Sequence[Topic], column: str) -> Address:
    """The one field that is called as the column, or whose path ends so."""
    every = [Address(topic.name, field) for topic in topics for field in topic.fields]
    addresses = [at for at in every if at.path == column]
    addresses = addresses or [at._replace(scale=None) for at, word in places(topics) if word == column]
    hint = f'write [import.columns] {column} = "topic:field" in rig.toml'
    if not addresses:
        raise DataError(
            f"{path}: column {column!r}: nothing is called so; {hint}; {nearest(column, list(map(str, every)))}"
        )
    if len(addresses) > 1:
        several = " and ".join(repr(str(each)) for each in addresses[:4])
        raise DataError(f"{path}: column {column!r}: may be {several}; {hint}")
    return addresses[0]
