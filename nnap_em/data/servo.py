"""Drives that rig.toml declares: an input is a torque, or the command of a servo with a law of its own."""

from collections.abc import Collection, Mapping
from typing import Any, NamedTuple

TORQUE = "torque"
"""The kind of a column that is the torque itself [N m, or N on a slide]."""


class Key(NamedTuple):
    """A number of a servo."""

    unit: str
    """Unit on a rotary joint."""
    needed: bool = False
    """True where no servo is one without it."""
    least: float | None = None
    """The smallest value that is possible; None: any."""
    open: bool = False
    """True where the smallest value itself is not possible."""


def _gain(unit: str) -> Key:
    return Key(unit, needed=True, least=0.0, open=True)


_COMMON = {"bias": Key("N m"), "limit": Key("N m", least=0.0, open=True), "delay": Key("s", least=0.0)}
KINDS: Mapping[str, Mapping[str, Key]] = {
    TORQUE: {},
    "position": {"kp": _gain("N m/rad"), "kd": Key("N m s/rad", least=0.0), **_COMMON},
    "velocity": {"kv": _gain("N m s/rad"), **_COMMON},
    "voltage": {"k": _gain("N m/A"), "R": _gain("ohm"), **_COMMON},
    "damper": {"kv": _gain("N m s/rad"), **_COMMON},
    "affine": {"gain": Key("N m", needed=True), "kp": Key("N m/rad"), "kd": Key("N m s/rad"), **_COMMON},
}
"""The kinds of an input and the numbers of each; `model/servo.py` has their laws."""
KEYS = tuple(dict.fromkeys(key for keys in KINDS.values() for key in keys))
RESERVED = ("columns", "joints", "kind", *KEYS)
"""Keys of [input]: a column that is called so can have no table of its own."""
_LINE = 'kind = "position"'
AT = "at"
"""Key of the columns that a number is proportional to."""


class Drive(NamedTuple):
    """The kind of an input, and its numbers, of class `Declared`, by their keys."""

    kind: str
    numbers: Mapping[str, Any]
    scales: Mapping[str, Mapping[str, float]] = {}
    """Columns that a number is proportional to, by its key, each with the value at which it is as declared."""


def read_drives(table: Any, columns: Collection[str], of_file: Mapping[str, Drive] | None = None) -> dict[str, Drive]:
    """The drive of every column of the table [input]; `of_file` are those of a machine file.

    Keys of [input] hold for every column that has such a number, those of [input.COLUMN] for one.
    Refused are unknown kinds and keys, a servo without its gain, and numbers that no drive has.
    """
    _refuse_unknown(table, columns)
    drives = {column: _drive(table, column, (of_file or {}).get(column, Drive(TORQUE, {}))) for column in columns}
    kinds = {drive.kind for drive in drives.values()}
    for key in table.items:
        if key in KEYS and not any(key in KINDS[kind] for kind in kinds):
            problem = f"no input has a {key} (kinds: {', '.join(sorted(kinds)) or 'none'})"
            table.refuse(key, problem, f"write {_LINE} beside it, or take it out")
    return drives


def _drive(table: Any, column: str, of_file: Drive) -> Drive:
    """The drive of one column, by its own table, then by [input], then by the file."""
    section = table.table("" if column in RESERVED else column, absent={})
    section.check((), ("kind", *KEYS))
    kind = _kind(section) or _kind(table) or of_file.kind
    for key in section.items:
        if key != "kind" and key not in KINDS[kind]:
            keys = ", ".join(KINDS[kind])
            hint = f"possible are {keys}" if keys else f"write {_LINE} if it is the command of a servo"
            section.refuse(key, f"an input of kind {kind!r} has no {key}", hint)
    numbers, scales = dict(of_file.numbers) if of_file.kind == kind else {}, {}
    for place in (table, section):
        for key in KINDS[kind]:
            if key in place.items:
                numbers[key], scales[key] = _number(place, key, KINDS[kind][key]), _scale(place, key)
    for key, about in KINDS[kind].items():
        if about.needed and key not in numbers:
            problem = f"missing: the input {column!r} of kind {kind!r} needs its {key}"
            hint = f"write {key} = {{ mean = 10.0, std = 5.0 }} [{about.unit}], or the number where it is known"
            (section if section.items else table).refuse(key, problem, hint)
    return Drive(kind, numbers, {key: scale for key, scale in scales.items() if scale})


def keys(table: Any) -> tuple[str, ...]:
    """Keys allowed in [input], tables of single columns among it, which `read_drives` looks at."""
    return (*RESERVED, *(key for key, value in table.items.items() if isinstance(value, dict)))


def _refuse_unknown(table: Any, columns: Collection[str]) -> None:
    """A table of a column that is not there."""
    for key, value in table.items.items():
        if isinstance(value, dict) and key not in (*columns, *RESERVED):
            problem = f"no input column is called {key!r}"
            hint = "name it in columns and its joint in joints, or take the table out"
            table.refuse(key, problem, f"{hint}; columns are {', '.join(columns) or 'none'}")


def _kind(table: Any) -> str | None:
    return table.choice("kind", KINDS) if "kind" in table.items else None


def _number(table: Any, key: str, about: Key) -> Any:
    """A number that such a drive can have."""
    value = table.quantity(key, (AT,))
    if about.least is not None and (value.mean < about.least or (about.open and value.mean == about.least)):
        bound = f"a number above {about.least:g}" if about.open else f"{about.least:g} or more"
        table.refuse(key, f"found {value.mean:g}", f"write {bound} [{about.unit}]")
    if key == "gain" and value.mean == 0:
        table.refuse(key, "found 0", "write the torque of a unit of the command [N m]")
    return value


def _scale(table: Any, key: str) -> dict[str, float]:
    """The columns that a number is proportional to, with their values at which it is as declared."""
    value = table.items[key]
    if not isinstance(value, dict) or AT not in value:
        return {}
    pair = table.table(key)
    line = "at = { gain = 400.0 }: a column of the logs, and its value at which the number is as declared"
    at = pair.table(AT) if isinstance(value[AT], dict) and value[AT] else pair.refuse(AT, None, f"write {line}")
    if key == "delay":
        pair.refuse(AT, "a delay is the same in all rows", "take it out")
    for column in at.items:
        if at.number(column) <= 0:
            at.refuse(column, None, f"write the value of that column at which {key} is as declared, above 0")
    return {column: at.number(column) for column in at.items}


def scaled(drives: Mapping[str, Drive], reserved: Collection[str], table: Any) -> dict[str, dict[str, float]]:
    """Columns that numbers are proportional to, by the names of the numbers; refused are `reserved` ones."""
    scales = {f"{name}.{key}": dict(scale) for name, drive in drives.items() for key, scale in drive.scales.items()}
    for name, scale in scales.items():
        for column in scale:
            if column in reserved:
                hint = "name a column that holds a gain or a supply"
                table.refuse(name, f"{AT}: {column!r} is the time, a state or an input", hint)
    return scales


def named(drives: Mapping[str, Drive]) -> dict[str, Any]:
    """The numbers of all drives by the names that parameters have: the column, a dot, the key."""
    return {f"{column}.{key}": value for column, drive in drives.items() for key, value in drive.numbers.items()}


def key_of(name: str, kinds: Mapping[str, str]) -> Key | None:
    """Key of a parameter of this name among the drives of some columns; None for one of the machine."""
    column, _, key = name.rpartition(".")
    return KINDS[kinds[column]].get(key) if column in kinds else None
