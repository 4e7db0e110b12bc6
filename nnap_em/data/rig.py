"""Declaration of a rig: `rig.toml` in, `Rig` out, every mistake refused with its remedy."""

import dataclasses
import difflib
import functools
import json
import math
import re
import tomllib
import warnings
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple, NoReturn

from ..storage.files import replace_text
from .limits import UNBOUNDED, Bounds, read_bounds, read_range
from .machine import machine_unit, unpacked
from .servo import AT, TORQUE, Drive, key_of, read_drives, scaled
from .servo import keys as drive_keys
from .servo import named as drive_numbers
from .units import factor, named_unit, parameter_unit, quantities, with_names

_HINTS = {  # how the line of a key or table should look
    "format": "format = 1",
    "name": 'name = "my_rig"',
    "model": 'a table [model] with type = "acrobot" and its parameters',
    "input": 'a table [input] with columns = ["u"] and joints = [2]',
    "import": "a table [import]",
    "sampling": "a table [sampling] with dt, input_hold and clock",
    "measurement": 'a table [measurement] with columns = ["theta1", "dtheta1"]',
    "noise_std": "a table [measurement.noise_std] with one number above 0 per column",
    "start": "a table [start] with lines such as theta2 = { mean = 0.0, std = 0.1 }",
    "limits": "a table [limits] with lines such as u = 0.3 or theta1 = [-2.0, 2.0]",
    "rate": "a table [limits.rate] with lines such as u = 5.0 (N m/s)",
    "type": 'type = "acrobot"',
    "friction": 'friction = "unknown" (to be learned) or friction = "none"',
    "actuated_joint": "actuated_joint = 2 (or a table [input] with columns and joints)",
    "columns": 'a list of different names, columns = ["theta1", "dtheta1"]',
    "joints": "a list of different joints, one per column, joints = [1, 2]",
    "kind": 'kind = "position" (a servo that is given a position), or kind = "torque"',
    "dt": "a number above 0, dt = 0.01 (s)",
    "g": "g = 9.81 (m/s^2)",
    "input_hold": 'input_hold = "zero-order" (a command that is held) or "first-order" (a measured signal)',
    "mean": "both numbers, { mean = 0.2, std = 0.02 }",
    "std": "both numbers, { mean = 0.2, std = 0.02 }",
    "clock": 'clock = "sequence" (time starts at 0 in each file) or clock = "session" (it runs on over all files)',
}


HOLD, SMOOTH = "zero-order", "first-order"
"""Holds of inputs: commands stay until the next row; measured signals go on from row to row."""


class RigError(ValueError):
    """A mistake in rig.toml: the message names the file, the table and key, what was found and the remedy."""


class RigWarning(UserWarning):
    """Something in rig.toml that is possible but seldom meant."""


@dataclass(frozen=True)
class Declared:
    """A declared number: mean and standard deviation, both in its SI unit; std = 0 is trusted."""

    mean: float
    std: float

    def __str__(self) -> str:
        return f"{self.mean:.6g}" + (f" +- {self.std:.2g}" if self.std else "")


@dataclass(frozen=True)
class SystemSpec:
    """Names of states and parameters of a registered system (optional ones: with default), and its joint count."""

    states: tuple[str, ...]
    parameters: tuple[str, ...]
    optional: Mapping[str, float]
    joints: int
    driven: int = 1
    """The joint of an input whose name does not determine it."""
    sensors: tuple[str, ...] = ()
    """Columns that are read beside states."""
    declare: "Callable[[_Table], Declaration] | None" = None
    """Declaration by the file that rig.toml names and by the whole table, for a system with names from a file."""


class Declaration(NamedTuple):
    """Declaration of [model] and [input]."""

    spec: SystemSpec
    parameters: Mapping[str, Declared]
    input_columns: tuple[str, ...]
    input_joints: tuple[int, ...]
    machine: str = ""
    input_kinds: tuple[str, ...] = ()
    input_scales: Mapping[str, Mapping[str, float]] = {}
    equations: str = ""
    file: str = ""
    urdf: str = ""


@dataclass(frozen=True)
class Rig:
    """All that the owner declares, in SI units; an optional parameter that the file leaves out is absent here too."""

    name: str
    system: str
    parameters: Mapping[str, Declared]
    friction: bool  # True: a map velocity -> torque in each joint, to be learned
    input_columns: tuple[str, ...]  # N m
    input_joints: tuple[int, ...]  # counted from 1
    dt: float  # s
    clock: str
    measured: tuple[str, ...]
    noise_std: Mapping[str, float]  # a measured column that is absent: to be estimated
    start: Mapping[str, Declared]
    limits: Bounds = UNBOUNDED  # of designed experiments; what is absent: as far as the logs went
    machine: str = ""  # of a system that is read from its owner's file: all of it, as `machine.packed` writes it
    input_kinds: tuple[str, ...] = ()  # of `servo.KINDS`, one per column; none given: all are torques
    # columns that a number of a servo ("goal.kp") is proportional to, each with its value where it is as declared
    input_scales: Mapping[str, Mapping[str, float]] = dataclasses.field(default_factory=dict)
    equations: str = ""  # of a plant that is written as equations: all of them, as `equations.Text.packed` writes them
    ranges: Mapping[str, tuple[float, float]] = dataclasses.field(default_factory=dict)  # ends of sensors: not read
    horizon: float | None = None  # s; how far predictions are used, of equations; None: by their time constants
    input_hold: str = HOLD  # or SMOOTH
    file: str = dataclasses.field(default="", compare=False)  # MJCF of the machine, with shapes: to be written back
    urdf: str = dataclasses.field(default="", compare=False)  # its URDF file as it was read, if it came from one

    @property
    def kinds(self) -> dict[str, str]:
        """The kind of every input column."""
        return dict(zip(self.input_columns, self.input_kinds or (TORQUE,) * len(self.input_columns), strict=True))

    @property
    def scale_columns(self) -> tuple[str, ...]:
        """Columns that numbers of servos are proportional to; they follow the inputs in a Dataset."""
        return tuple(dict.fromkeys(column for scale in self.input_scales.values() for column in scale))

    @property
    def logged_inputs(self) -> tuple[str, ...]:
        """Columns of the inputs of a Dataset."""
        return (*self.input_columns, *self.scale_columns)

    @property
    def bodies(self) -> dict[str, Declared]:
        """The parameters of the machine, without those of its drives."""
        return {name: value for name, value in self.parameters.items() if key_of(name, self.kinds) is None}

    def unit(self, name: str) -> str:
        """The SI unit of a parameter or state."""
        if (key := key_of(name, self.kinds)) is not None:
            return (
                key.unit if self._turns(name.rpartition(".")[0]) else key.unit.replace("N m", "N").replace("rad", "m")
            )
        if self.equations:
            return _units(self.equations).get(name, "")
        return machine_unit(self.machine, name) if self.machine else parameter_unit(name)

    def column_unit(self, name: str) -> str:
        """The unit in which a column of the logs is read; empty where any may be meant."""
        if self.equations or name in self.measured:
            return self.unit(name)
        kind, gear = self.kinds.get(name, ""), 1.0
        if self.machine and kind == TORQUE:
            gear = unpacked(self.machine).gears[self.input_columns.index(name)]
        units = {TORQUE: "N m" if gear == 1 else "", "position": "rad", "velocity": "rad/s", "voltage": "V"}
        unit = units.get(kind, "")
        return unit if not unit or self._turns(name) else unit.replace("N m", "N").replace("rad", "m")

    def _turns(self, column: str) -> bool:
        """True where an input drives an angle; without a file, by the names of the readings."""
        joint = self.input_joints[self.input_columns.index(column)] - 1
        if self.machine:
            return not unpacked(self.machine).joints[joint].slide
        return not all(parameter_unit(name).startswith("m") for name in self.measured)

    def pairs(self) -> list[tuple[str, str]]:
        """Measured coordinates with their measured rates, which the equations or names determine: that of x is dx."""
        if self.equations:
            of = json.loads(self.equations)
            states = {of["readings"].get(column, column): column for column in self.measured}
            return [(states[q], states[v]) for q, v in of["rates"].items() if q in states and v in states]
        return [(name, f"d{name}") for name in self.measured if f"d{name}" in self.measured]

    def named(self, text: str) -> str:
        """`text` with the name that the machine's file gives a joint behind its number."""
        states = unpacked(self.machine).states if self.machine else ()
        return with_names(text, states[: len(states) // 2])

    def __str__(self) -> str:
        words = {name: "" if kind == TORQUE else f" ({kind})" for name, kind in self.kinds.items()}
        scales = [f"{name} by {' and '.join(scale)}" for name, scale in self.input_scales.items()]
        joints = zip(words.items(), self.input_joints, strict=True)
        inputs = [f"{name}{word}" + ("" if self.equations else f" on joint {j}") for (name, word), j in joints] + scales
        noise = {name: f"{std:.2g} {self.unit(name)}" for name, std in self.noise_std.items()}
        reads = [f"{name} (noise {noise.get(name, 'to be estimated')})" for name in self.measured]
        lines = [
            f"Rig {self.name!r}: {self.system}, a row every {self.dt:g} s",
            f"parameters: {quantities(self.parameters, self.unit) or 'as in the file'}",
            f"inputs: {', '.join(inputs) or 'none'}",
            f"reads: {', '.join(reads)}",
            f"start: {quantities(self.start, self.unit) or 'from the readings'}",
            f"friction: {'to be learned' if self.friction else 'none'}",
        ]
        return "\n  ".join(lines)


def read_rig(path: Path | str, systems: Mapping[str, SystemSpec]) -> Rig:
    """`nnap_em.read_rig` for some registered machines, by name.

    Raises RigError with all mistakes, a line each; those of readings, starts and limits, which depend on the model,
    follow once that is right.
    """
    path = Path(path)
    root = whole_table(path)
    root.check(("format", "name", "model", "sampling", "measurement"), ("input", "start", "limits", "import"))
    if root.number("format") != 1:
        root.refuse("format")
    model, sampling, start = root.table("model"), root.table("sampling"), root.table("start", absent={})
    system = model.choice("type", systems)
    rows = ("dt", "input_hold", "clock")
    first = every(
        name=lambda: root.text("name"),
        of=lambda: (systems[system].declare or partial(_declared, spec=systems[system]))(root),
        keys=lambda: sampling.check(rows, ("horizon",)),
        dt=lambda: sampling.positive("dt"),
        clock=lambda: sampling.choice("clock", ("sequence", "session")),
        input_hold=lambda: sampling.choice("input_hold", (HOLD, SMOOTH)),
        horizon=lambda: sampling.positive("horizon") if "horizon" in sampling.items else None,
    )
    of: dict[str, Any] = first.pop("of")._asdict()
    spec, equations = of.pop("spec"), bool(of["equations"])
    second = every(
        friction=lambda: not equations and model.choice("friction", ("unknown", "none")) != "none",
        keys=lambda: (start.check((), spec.states), equations or sampling.check(rows)),
        readings=lambda: _measurement(root.table("measurement"), spec, equations),
        start=lambda: every(**{state: partial(start.declared, state) for state in spec.states if state in start.items}),
        limits=lambda: read_bounds(root.table("limits", absent={}), of["input_columns"], spec.states),
    )
    del first["keys"], second["keys"]
    rig = Rig(system=system, **of, **first, **second.pop("readings"), **second)
    for column in (*rig.logged_inputs, *rig.measured):
        named, unit = named_unit(column, brackets=True)[1], rig.column_unit(column)
        if named and factor(named, unit) not in (1.0, None):
            hint = f'call it otherwise, and let `nnap-em import` read it: [import.columns] NAME = "{column}"'
            raise RigError(f"{path}: column {column!r}: in {named} by its name, but read in {unit}; {hint}")
    return rig


def every(**reads: Callable[[], Any]) -> dict[str, Any]:
    """Results by name; RigError with the mistakes of all, a line each."""
    out, mistakes = {}, {}
    for name, read in reads.items():
        try:
            out[name] = read()
        except RigError as error:
            mistakes[str(error)] = error
    if mistakes:
        first, *others = mistakes.values()
        raise RigError("\n".join(mistakes)) from None if others else first
    return out


def write_rig(rig: Rig, path: Path | str) -> None:
    """Write a rig as rig.toml, units as comments; `read_rig` gives the same Rig back.

    Args:
        rig: what is declared.
        path: the file.

    Example:
        >>> nnap_em.write_rig(rig, f"{folder}/copy.toml")
        >>> nnap_em.read_rig(f"{folder}/copy.toml") == rig
        True
    """
    lines = ["format = 1", f"name = {toml_text(rig.name)}", *_written(_tables(rig), (), partial(_unit_of, rig))]
    replace_text(Path(path), "\n".join(lines) + "\n")


def _tables(rig: Rig) -> dict[str, dict[str, Any]]:
    """Content of rig.toml."""
    at = {name: {AT: dict(scale)} for name, scale in rig.input_scales.items()}
    numbers = {
        name: x.mean if x.std == 0 and name not in at else dataclasses.asdict(x) | at.get(name, {})
        for name, x in rig.parameters.items()
    }
    bodies, friction = {name: numbers[name] for name in rig.bodies}, "unknown" if rig.friction else "none"
    inputs: dict[str, Any] = {"columns": rig.input_columns, "joints": rig.input_joints}
    columns: Any = rig.measured
    if rig.equations:
        of, inputs = json.loads(rig.equations), {}
        parts = {} if of["function"] else {key: of[key] for key in ("states", "inputs", "rates")}
        model = numbers | {key: names if all(names.values()) and names else list(names) for key, names in parts.items()}
        model["units"] = {name: unit for name, unit in of["units"].items() if name in rig.parameters}
        model["unknown"] = {name: {"signals": signals} for name, signals in of["terms"].items()}
        for name, (port, signals) in of["enters"].items():
            model["unknown"][name] = {"signals": signals, "enters": port}
        if of["readings"]:
            columns = {name: of["readings"].get(name, name) for name in columns}
    elif rig.machine:
        machine = unpacked(rig.machine)
        joints, locked = machine.part or (None, ())
        model = {
            "file": machine.file,
            "joints": joints,
            "locked": dict(locked),
            "friction": friction,
            "uncertain": bodies,
        }
        inputs["joints"] = None if machine.motored else rig.input_joints
    else:
        model = bodies | {"friction": friction}
    for column, kind in rig.kinds.items():
        if kind != TORQUE:
            own = {name.rpartition("."): x for name, x in numbers.items() if name not in bodies}
            inputs[column] = {"kind": kind} | {key: x for (owner, _, key), x in own.items() if owner == column}
    measurement = {"columns": columns, "range": rig.ranges, "noise_std": rig.noise_std}
    return {
        "model": {"type": rig.system} | model,
        "input": inputs,
        "sampling": {"dt": rig.dt, "input_hold": rig.input_hold, "clock": rig.clock, "horizon": rig.horizon},
        "measurement": measurement,
        "start": {name: dataclasses.asdict(value) for name, value in rig.start.items()},
        "limits": {**rig.limits.values, "rate": rig.limits.rate, "start": rig.limits.start},
    }


def _unit_of(rig: Rig, table: tuple[str, ...], key: str) -> str:
    """Unit of a key of a table, as a comment says it; empty where it has none."""
    whole = ".".join(table)
    name = f"{table[-1]}.{key}" if whole.startswith("input.") else key
    of_numbers = whole.startswith(("model", "input")) and name in rig.parameters
    if of_numbers or whole in ("measurement.noise_std", "start"):
        return rig.unit(name)
    return "s" if whole == "sampling" and key in ("dt", "horizon") else ""


def _written(tables: Mapping[str, Any], before: tuple[str, ...], unit: Callable[..., str]) -> Iterator[str]:
    """Lines of tables, each key with its unit; what is None or an empty table is left out."""
    for name, table in tables.items():
        place, there = (
            (*before, name),
            {key: value for key, value in table.items() if value is not None and value != {}},
        )
        inner = {key: x for key, x in there.items() if isinstance(x, Mapping) and "mean" not in x}
        if there:
            yield from ("", f"[{'.'.join(map(toml_key, place))}]")
        for key in (key for key in there if key not in inner):
            yield f"{toml_key(key)} = {_value(there[key])}" + (f"    # {said}" if (said := unit(place, key)) else "")
        yield from _written(inner, place, unit)


def _value(value: Any) -> str:
    """A value as TOML has it, a table in one line."""
    if isinstance(value, Mapping):
        return f"{{ {', '.join(f'{toml_key(key)} = {_value(x)}' for key, x in value.items())} }}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_value, value))}]"
    return toml_text(value) if isinstance(value, str) else repr(value)


def toml_text(text: str) -> str:
    """A text as TOML writes it."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")  # TOML escapes as JSON does, save for DEL


def toml_key(name: str) -> str:
    """A name as a key of TOML, in quotes where it has to be."""
    return name if re.fullmatch(r"[\w-]+", name, re.ASCII) else toml_text(name)


def flat(items: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, object]]:
    """Every key with its value; dotted keys are tables inside tables, but for a number with its uncertainty."""
    for key, value in items.items():
        if isinstance(value, dict) and value and not set(value) & {"mean", "std"}:
            yield from flat(value, f"{before}{key}.")
        else:
            yield f"{before}{key}", value


def nearest(word: str, known: Collection[str]) -> str:
    """The remedy for a misspelt name: the known name nearest to it, then all that are possible."""
    same = [name for name in known if name.casefold() == word.strip().casefold()]
    close = same or difflib.get_close_matches(word, known, n=1)
    question = f"did you mean {close[0]!r}? " if close else ""
    return f"{question}possible here: {', '.join(known) or 'none'}"


@dataclass(frozen=True)
class _Table:
    """One table of the file; its readers refuse a wrong value by file, table and key."""

    path: Path
    name: str
    items: Mapping[str, object]

    def refuse(self, key: str, problem: str | None = None, hint: str | None = None) -> NoReturn:
        place = f"[{self.name}] {key}" if self.name else key
        problem = problem or f"found {self.items[key]!r}"
        raise RigError(f"{self.path}: {place}: {problem}; {hint or f'write {_HINTS[key]}'}")

    def check(self, required: Collection[str], optional: Collection[str] = ()) -> None:
        """Refuse unknown keys first: a misspelt key is also a missing one, and its name is the better hint."""
        known = (*required, *optional)
        left, unknown = [key for key in known if key not in self.items], [key for key in self.items if key not in known]
        every(**{key: partial(self.refuse, key, "unknown table or key", nearest(key, left)) for key in unknown})
        if missing := [key for key in required if key not in self.items]:
            self._missing(*missing)

    def _missing(self, key: str, *others: str) -> NoReturn:
        hint = _HINTS.get(key, f"{key} = 0.2 (trusted) or {key} = {{ mean = 0.2, std = 0.02 }}")
        problem = f"missing (found only: {', '.join(self.items) or 'nothing'})"
        self.refuse(", ".join((key, *others)), problem, f"write {hint}" + ", and so on" * bool(others))

    def value(self, key: str) -> object:
        if key not in self.items:
            self._missing(key)
        return self.items[key]

    def table(self, key: str, absent: Mapping[str, object] | None = None) -> "_Table":
        value = self.value(key) if absent is None else self.items.get(key, absent)
        if not isinstance(value, dict):
            self.refuse(key, hint=None if key in _HINTS else f"write {key} = {{ mean = 0.2, std = 0.02 }}")
        return _Table(self.path, f"{self.name}.{key}" if self.name else key, value)

    def text(self, key: str) -> str:
        value = self.value(key)
        if not isinstance(value, str) or not value:
            self.refuse(key)
        return value

    def choice(self, key: str, known: Collection[str]) -> str:
        value = self.text(key)
        if value not in known:
            self.refuse(key, hint=nearest(value, known))
        return value

    def number(self, key: str) -> float:
        value = self.value(key)
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            self.refuse(key, hint=f"write a finite number, {key} = 0.2")
        return float(value)

    def quantity(self, key: str, optional: Collection[str] = (), mean: float | None = None) -> Declared:
        """A number (trusted) or { mean, std }, which may have `optional` keys, too."""
        return (
            self.declared(key, optional, mean) if isinstance(self.value(key), dict) else Declared(self.number(key), 0.0)
        )

    def positive(self, key: str) -> float:
        value = self.number(key)
        if value <= 0:
            self.refuse(key, hint=f"write a number above 0, {key} = 0.01")
        return value

    def declared(self, key: str, optional: Collection[str] = (), mean: float | None = None) -> Declared:
        """{ mean, std }; `mean` is that of a machine file, which may be left out."""
        pair = self.table(key)
        pair.check(("mean", "std") if mean is None else ("std",), ("mean", *optional))
        if pair.number("std") < 0:
            pair.refuse("std", hint="write a standard deviation of 0 (trusted) or more")
        return Declared(pair.number("mean") if "mean" in pair.items else float(mean or 0.0), pair.number("std"))

    def flattened(self) -> "_Table":
        """The table with dotted keys joined again."""
        return dataclasses.replace(self, items=dict(flat(self.items)))

    def distinct(self, key: str, kind: type) -> tuple:
        value = self.value(key)
        if not isinstance(value, list) or not all(type(x) is kind for x in value) or len(set(value)) < len(value):
            self.refuse(key)
        return tuple(value)


@functools.cache
def _units(equations: str) -> dict[str, str]:
    """Units of all names of equations."""
    of = json.loads(equations)
    return {**of["states"], **of["inputs"], **of["units"]}


def whole_table(path: Path) -> _Table:
    """The whole of a rig.toml; RigError where it is no TOML."""
    try:
        return _Table(path, "", tomllib.loads(path.read_bytes().decode("utf-8-sig")))
    except OSError as error:
        raise RigError(f"{path}: cannot be read ({error.strerror}); a data set is a folder with a rig.toml") from None
    except UnicodeDecodeError as error:
        line = error.object[: error.start].count(b"\n") + 1
        raise RigError(f"{path}: line {line}: not UTF-8; save the file as plain UTF-8 text") from None
    except tomllib.TOMLDecodeError as error:
        raise RigError(
            f"{path}: not TOML: {error}; write key = value, texts in quotation marks, no key twice"
        ) from None


def _parameter(model: _Table, key: str) -> Declared:
    """A number (trusted) or { mean, std }. Inertias may be negative: fits about the joint, moved to the centre, are."""
    value = model.quantity(key)
    unit = parameter_unit(key)
    if unit == "kg" and value.mean <= 0:
        model.refuse(key, hint="write a mass above 0 [kg]")
    if unit in ("m", "m/s^2") and value.mean < 0:
        model.refuse(key, hint=f"write 0 or more [{unit}]: directions are in the equations, not in the signs")
    if value.mean > {"m/s^2": 100.0, "m": 50.0}.get(unit, math.inf):
        problem = f"{model.path}: [model] {key}: found {value.mean:g}"
        warnings.warn(f"{problem}; is it in m{unit}? write it in {unit}", RigWarning, 2)
    return value


def _declared(root: _Table, spec: SystemSpec) -> Declaration:
    """Declaration of a system of these parameters by [model] and [input]."""
    model = root.table("model")
    reserved = ("type", "friction", "actuated_joint")
    model.check(("type", "friction", *spec.parameters), ("actuated_joint", *spec.optional))
    parameters = every(**{key: partial(_parameter, model, key) for key in model.items if key not in reserved})
    columns, joints, drives = _input(root, model, spec)
    scales = scaled(drives, ("time", *spec.states, *columns), root.table("input", absent={}))
    return Declaration(spec, parameters | drive_numbers(drives), columns, joints, "", kinds_of(drives), scales)


def kinds_of(drives: Mapping[str, Drive]) -> tuple[str, ...]:
    """The kind of every column; nothing where all are torques."""
    kinds = tuple(drive.kind for drive in drives.values())
    return () if set(kinds) <= {TORQUE} else kinds


def _input(root: _Table, model: _Table, spec: SystemSpec) -> tuple[tuple[str, ...], tuple[int, ...], dict[str, Drive]]:
    """The input columns, the joint that each drives, and what makes torque of them."""
    if "input" in root.items:
        table, names = root.table("input"), spec.states[: spec.joints]
        columns, joints, _ = read_columns(table, spec.states, names)
        return columns, joints, read_drives(table, columns)
    joint = model.value("actuated_joint")
    if type(joint) is not int or not 1 <= joint <= spec.joints:
        model.refuse("actuated_joint", hint=f"write actuated_joint = 1, joints count from 1 to {spec.joints}")
    return ("u",), (joint,), {}


def read_columns(
    table: _Table, states: Sequence[str], names: Sequence[str], motors: Mapping[str, int] = MappingProxyType({})
) -> tuple[tuple[str, ...], tuple[int, ...], bool]:
    """Columns of [input], the joint of each, counted from 1, and whether they are `motors` of a machine file."""
    table.check((), drive_keys(table))
    columns = table.distinct("columns", str) if "columns" in table.items or not motors else tuple(motors)
    for column in columns:
        if column in ("time", *states):
            hint = "name torque columns only, or commands of servos; a motor by another name than its joint's"
            table.refuse("columns", f"{column!r} is the time or a state, and no torque or command", hint)
        if motors and "joints" not in table.items and column not in motors:
            hint = f"{nearest(column, list(motors))}; or say which joints the columns drive: joints = [...]"
            table.refuse("columns", f"{column!r} is no motor of the file", hint)
    if motored := bool(motors) and "joints" not in table.items:
        joints = [motors[column] for column in columns]
    else:
        value = table.value("joints")
        given: Sequence[Any] = value if isinstance(value, list) else table.refuse("joints")
        joints = [names.index(joint) + 1 if joint in names else joint for joint in given]
        if len(joints) != len(columns):
            table.refuse("joints", f"found {len(joints)} joints for {len(columns)} columns")
        if not all(type(joint) is int and 1 <= joint <= len(names) for joint in joints):
            table.refuse(
                "joints", None, f"write names of joints, or numbers from 1 to {len(names)}: {', '.join(names)}"
            )
    for joint in joints:
        if joints.count(joint) > 1:
            twice = " and ".join(column for column, j in zip(columns, joints, strict=True) if j == joint)
            hint = "let one of them drive it, and log their sum"
            table.refuse("columns", f"{twice} drive one joint, {names[joint - 1]!r}", hint)
    return columns, tuple(joints), motored


def _measurement(table: _Table, spec: SystemSpec, formulas: bool) -> dict[str, Any]:
    """The measured columns, the noise declared for them, and the ranges of their sensors."""
    table.check(("columns",), ("noise_std", "range"))
    formulas = formulas and isinstance(table.value("columns"), dict)
    columns = tuple(table.table("columns").items) if formulas else table.distinct("columns", str)
    if not columns:
        table.refuse("columns")
    for column in columns:
        if column not in spec.states + spec.sensors:
            what = "no state or sensor" if spec.sensors else "no state"
            table.refuse("columns", f"{column!r} is {what} of this system", nearest(column, spec.states + spec.sensors))
    noise = table.table("noise_std", absent={}).flattened()
    noise.check((), columns)
    ends = table.table("range", absent={})
    ends.check((), columns)
    return {
        "measured": columns,
        "noise_std": every(**{column: partial(noise.positive, column) for column in noise.items}),
        "ranges": every(**{column: partial(read_range, ends, column) for column in ends.items}),
    }
