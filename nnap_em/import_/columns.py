"""Addresses of the columns of a rig in a log: as declared, or by their names, in the unit that these end in."""

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from ..data.dataset import DataError
from ..data.formats import refuse
from ..data.rig import Rig, nearest
from ..data.units import UNITS, factor, named_unit
from ..numerics.digits import counted
from .recording import OTHER, Address, Topic, places


def resolve(
    path: Path, topics: Sequence[Topic], inputs: Sequence[str], measured: Sequence[str], declared: Mapping[str, Address]
) -> dict[str, Address]:
    """Address of each column of the rig; DataError with the nearest names where one is absent."""
    return {
        name: declared_at(path, topics, declared[name], name) if name in declared else _by_name(path, topics, name)
        for name in (*inputs, *measured)
    }


def declared_at(path: Path, topics: Sequence[Topic], address: Address, column: str) -> Address:
    """The address as the file has it: names may hold a colon, end in a unit, and count an entry that has a name."""
    where, at = f"column {column!r} from {str(address)!r}", address.path
    for topic in topics:
        there = str(address).removeprefix(f"{topic.name}:" if topic.name else "")
        alike = [field for field in topic.fields if there in (field, named_unit(field, brackets=True)[0])]
        if there in topic.fields or len(alike) == 1:
            return address._replace(topic=topic.name, path=there if there in topic.fields else alike[0])
    topic = next((topic for topic in topics if topic.name == address.topic), None)
    if topic is None:
        hint = nearest(address.topic, [topic.name for topic in topics])
        raise DataError(f"{path}: {where}: there is no topic {address.topic!r}; {hint}")
    if not topic.fields:
        refuse(path, where, f"topic {topic.name!r} ({topic.kind}) holds no numbers that can be read", OTHER)
    match = re.fullmatch(r"(.*)\[(\d+)\]", at)
    row = [name for name in topic.fields if match and re.fullmatch(re.escape(match[1]) + r"\[[^\]]*\]", name)]
    if match and int(match[2]) < len(row):
        return address._replace(path=row[int(match[2])])
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
