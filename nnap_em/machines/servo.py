"""Drives that rig.toml declares: an input is a torque, or the command of a servo with a law of its own."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from .table import Declared, Table, nearest

TORQUE = "torque"
"""The kind of a column that is the torque itself [N m, or N on a slide]."""


class Key(NamedTuple):
    """A number of a servo."""

    unit: str  # Unit on a rotary joint
    needed: bool = False  # True where no servo is one without it
    least: float | None = None  # The smallest value that is possible; None: any
    open: bool = False  # True where the smallest value itself is not possible


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
    """The kind of an input, and its numbers by their keys."""

    kind: str = TORQUE
    numbers: Mapping[str, Declared] = {}
    scales: Mapping[str, Mapping[str, float]] = {}
    """Columns that a number is proportional to, by its key, each with the value at which it is as declared."""


class Inputs(NamedTuple):
    """The table [input]."""

    columns: tuple[str, ...]
    joints: tuple[int, ...]  # The joint that each drives, counted from 1
    drives: Mapping[str, Drive] = {}
    motored: bool = False  # True where they are the motors of a machine file

    @property
    def kinds(self) -> tuple[str, ...]:
        """The kind of every column; nothing where all are torques."""
        kinds = tuple(drive.kind for drive in self.drives.values())
        return () if set(kinds) <= {TORQUE} else kinds

    @property
    def numbers(self) -> dict[str, Declared]:
        """The numbers of all drives by the names that parameters have: the column, a dot, the key."""
        return {f"{name}.{key}": value for name, drive in self.drives.items() for key, value in drive.numbers.items()}

    @property
    def scales(self) -> dict[str, dict[str, float]]:
        """Columns that numbers are proportional to, by the names of the numbers."""
        return {f"{name}.{key}": dict(at) for name, drive in self.drives.items() for key, at in drive.scales.items()}


def read_inputs(
    table: Table, states: Sequence[str], names: Sequence[str], motors: Mapping[str, tuple[int, Drive]] | None = None
) -> Inputs:
    """Columns of [input], the joint of each, counted from 1, by its name or number, and its drive.

    `motors` are those of a machine file, which are the inputs where no joints are declared.  Keys of [input] hold for
    every column that has such a number, those of [input.COLUMN] for one.
    """
    motors = motors or {}
    table.check((), (*RESERVED, *(key for key, value in table.items.items() if isinstance(value, dict))))
    motored = bool(motors) and "joints" not in table.items
    columns = table.distinct("columns", str) if "columns" in table.items or not motors else tuple(motors)
    table.check((), (*RESERVED, *columns))
    for column in columns:
        if column in ("time", *states):
            hint = "name torque columns only, or commands of servos; a motor by another name than its joint's"
            table.refuse("columns", f"{column!r} is the time or a state, and no torque or command", hint)
        if motored and column not in motors:
            hint = f"{nearest(column, list(motors))}; or say which joints the columns drive: joints = [...]"
            table.refuse("columns", f"{column!r} is no motor of the file", hint)
    joints = [motors[column][0] for column in columns] if motored else _joints(table, names, len(columns))
    for joint in joints:
        if joints.count(joint) > 1:
            twice = " and ".join(column for column, j in zip(columns, joints, strict=True) if j == joint)
            hint = "let one of them drive it, and log their sum"
            table.refuse("columns", f"{twice} drive one joint, {names[joint - 1]!r}", hint)
    drives = {column: _drive(table, column, motors[column][1] if motored else Drive()) for column in columns}
    kinds = {drive.kind for drive in drives.values()}
    for key in table.items:
        if key in KEYS and not any(key in KINDS[kind] for kind in kinds):
            problem = f"no input has a {key} (kinds: {', '.join(sorted(kinds)) or 'none'})"
            table.refuse(key, problem, f"write {_LINE} beside it, or take it out")
    out = Inputs(columns, tuple(joints), drives, motored)
    for name, scale in out.scales.items():
        if wrong := {"time", *states, *columns} & {*scale}:
            problem = f"{AT}: {', '.join(map(repr, wrong))} is the time, a state or an input"
            table.refuse(name, problem, "name a column that holds a gain or a supply")
    return out


def _joints(table: Table, names: Sequence[str], count: int) -> list[int]:
    given = table.value("joints")
    if not isinstance(given, list):
        table.refuse("joints")
    joints = [names.index(joint) + 1 if joint in names else joint for joint in given]
    if len(joints) != count:
        table.refuse("joints", f"found {len(joints)} joints for {count} columns")
    if not all(type(joint) is int and 1 <= joint <= len(names) for joint in joints):
        table.refuse("joints", None, f"write names of joints, or numbers from 1 to {len(names)}: {', '.join(names)}")
    return joints


def _drive(table: Table, column: str, of_file: Drive) -> Drive:
    """The drive of one column, by its own table, then by [input], then by the file."""
    section = table.table(column, absent={})
    section.check((), ("kind", *KEYS))
    kinds = [place.choice("kind", KINDS) for place in (section, table) if "kind" in place.items]
    kind = (*kinds, of_file.kind)[0]
    for key in section.items:
        if key != "kind" and key not in KINDS[kind]:
            keys = ", ".join(KINDS[kind])
            hint = f"possible are {keys}" if keys else f"write {_LINE} if it is the command of a servo"
            section.refuse(key, f"an input of kind {kind!r} has no {key}", hint)
    numbers, scales = dict(of_file.numbers) if of_file.kind == kind else {}, {}
    for key, about in KINDS[kind].items():
        for place in (table, section):
            if key in place.items:
                numbers[key], scales[key] = _number(place, key, about), _scale(place, key)
        if about.needed and key not in numbers:
            problem = f"missing: the input {column!r} of kind {kind!r} needs its {key}"
            hint = f"write {key} = {{ mean = 10.0, std = 5.0 }} [{about.unit}], or the number where it is known"
            (section if section.items else table).refuse(key, problem, hint)
    return Drive(kind, numbers, {key: scale for key, scale in scales.items() if scale})


def _number(table: Table, key: str, about: Key) -> Declared:
    value = table.quantity(key, (AT,))
    if about.least is not None and (value.mean < about.least or (about.open and value.mean == about.least)):
        bound = f"a number above {about.least:g}" if about.open else f"{about.least:g} or more"
        table.refuse(key, f"found {value.mean:g}", f"write {bound} [{about.unit}]")
    return value


def _scale(table: Table, key: str) -> dict[str, float]:
    """The columns that a number is proportional to, with their values at which it is as declared."""
    value = table.items[key]
    if not isinstance(value, dict) or AT not in value:
        return {}
    pair = table.table(key)
    if key == "delay":
        pair.refuse(AT, "a delay is the same in all rows", "take it out")
    if not isinstance(value[AT], dict) or not value[AT]:
        line = "at = { gain = 400.0 }: a column of the logs, and its value at which the number is as declared"
        pair.refuse(AT, None, f"write {line}")
    return pair.each(AT, Table.positive, [*value[AT]])


def key_of(name: str, kinds: Mapping[str, str]) -> Key | None:
    """Key of a parameter of this name among the drives of some columns; None for one of the machine."""
    column, _, key = name.rpartition(".")
    return KINDS[kinds[column]].get(key) if column in kinds else None
