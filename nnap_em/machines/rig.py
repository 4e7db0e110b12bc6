"""Declaration of a rig: `rig.toml` in, `Rig` out, every mistake refused with its remedy."""

import dataclasses
import functools
import json
import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from ..base.files import replace_text
from ..errors import RigError, RigWarning
from .limits import UNBOUNDED, Bounds, read_bounds, read_range
from .machine import machine_unit, unpacked
from .servo import AT, TORQUE, Inputs, key_of, read_inputs
from .table import HOLD, SMOOTH, Declared, Table, every, nearest, toml_text, whole_table, written
from .units import UNITS, factor, named_unit, parameter_unit, quantities, with_names


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
    declare: "Callable[[Table], Declaration] | None" = None
    """Declaration by the file that rig.toml names and by the whole table, for a system with names from a file."""


class Declaration(NamedTuple):
    """Declaration of [model] and [input]."""

    spec: SystemSpec
    parameters: Mapping[str, Declared]
    """Those of the drives are added."""
    inputs: Inputs
    machine: str = ""
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
            return self._along(name.rpartition(".")[0], key.unit)
        if self.equations:
            return _units(self.equations).get(name, "")
        return machine_unit(self.machine, name) if self.machine else parameter_unit(name)

    @property
    def time_unit(self) -> str:
        """Unit of all times: s; of equations as [model.units] time declares it, or none where nothing has a unit."""
        return _units(self.equations).get("time", "s") if self.equations else "s"

    @property
    def ns(self) -> float:
        """Nanoseconds in a unit of time; those of a second where its unit is not known."""
        return 1e9 * UNITS.get(self.time_unit, 1.0)

    def column_unit(self, name: str) -> str:
        """The unit in which a column of the logs is read; empty where any may be meant."""
        if self.equations or name in self.measured:
            return self.unit(name)
        kind = self.kinds.get(name, "")
        if kind == TORQUE and self.machine and unpacked(self.machine).gears[self.input_columns.index(name)] != 1:
            return ""
        unit = {TORQUE: "N m", "position": "rad", "velocity": "rad/s", "voltage": "V"}.get(kind, "")
        return self._along(name, unit) if unit else ""

    def _along(self, column: str, unit: str) -> str:
        """A unit of an input that drives an angle, or the one on a slide; without a file, by the names of readings."""
        joint = self.input_joints[self.input_columns.index(column)] - 1
        if self.machine:
            slide = unpacked(self.machine).joints[joint].slide
        else:
            slide = all(parameter_unit(name).startswith("m") for name in self.measured)
        return unit.replace("N m", "N").replace("rad", "m") if slide else unit

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
        joints = zip(words.items(), self.input_joints, strict=True)
        inputs = [f"{name}{word}" + ("" if self.equations else f" on joint {j}") for (name, word), j in joints]
        inputs += [f"{name} by {' and '.join(scale)}" for name, scale in self.input_scales.items()]
        noise = {name: f"{std:.2g} {self.unit(name)}" for name, std in self.noise_std.items()}
        reads = [f"{name} (noise {noise.get(name, 'to be estimated')})" for name in self.measured]
        lines = [
            f"Rig {self.name!r}: {self.system}, a row every {self.dt:g} {self.time_unit}",
            f"parameters: {quantities(self.parameters, self.unit) or 'as in the file'}",
            f"inputs: {', '.join(inputs) or 'none'}",
            f"reads: {', '.join(reads)}",
            f"start: {quantities(self.start, self.unit) or 'from the readings'}",
            f"friction: {'to be learned' if self.friction else 'none'}",
        ]
        return "\n  ".join(lines)


# --- the file as a rig


def read_rig(path: Path | str, systems: Mapping[str, SystemSpec]) -> Rig:
    """`nnap_em.read_rig` for some registered machines, by name.

    Raises RigError with all mistakes, a line each; those of readings, starts and limits, which depend on the model,
    follow once that is right.
    """
    root = whole_table(Path(path))
    root.check(("format", "name", "model", "sampling", "measurement"), ("input", "start", "limits", "import"))
    if root.number("format") != 1:
        root.refuse("format")
    model, sampling = root.table("model"), root.table("sampling")
    system = model.choice("type", systems)
    rows = {
        "dt": Table.positive,
        "input_hold": partial(Table.choice, known=(HOLD, SMOOTH)),
        "clock": partial(Table.choice, known=("sequence", "session")),
    }
    rows |= {"horizon": Table.positive} if "horizon" in sampling.items else {}
    reads: dict[str, Callable[[], Any]] = {
        "name": partial(root.text, "name"),
        "of": partial(systems[system].declare or partial(_declared, spec=systems[system]), root),
        "keys": partial(sampling.check, tuple(rows)),
    }
    first = every(reads | {key: partial(read, sampling, key) for key, read in rows.items()})
    spec, parameters, inputs, *texts = first.pop("of")
    fields = dict(zip(Declaration._fields[3:], texts, strict=True))
    formulas = bool(fields["equations"])
    second = every({
        "friction": lambda: not formulas and model.choice("friction", ("unknown", "none")) != "none",
        "keys": lambda: None if formulas else sampling.check([key for key in rows if key != "horizon"]),
        "start": lambda: root.each("start", Table.declared, spec.states),
        "readings": lambda: _measurement(root.table("measurement"), spec, formulas),
        "limits": lambda: read_bounds(root, inputs.columns, spec.states),
    })  # fmt: skip
    rig = Rig(
        system=system, parameters={**parameters, **inputs.numbers}, input_columns=inputs.columns,
        input_joints=inputs.joints, input_kinds=inputs.kinds, input_scales=inputs.scales, **fields, **first,
        **second.pop("readings"), **second,
    )  # fmt: skip
    for column in (*rig.logged_inputs, *rig.measured):
        named, unit = named_unit(column, brackets=True)[1], rig.column_unit(column)
        if named and factor(named, unit) not in (1.0, None):
            hint = f'call it otherwise, and let `nnap-em import` read it: [import.columns] NAME = "{column}"'
            raise RigError(f"{path}: column {column!r}: in {named} by its name, but read in {unit}; {hint}")
    return rig


def _declared(root: Table, spec: SystemSpec) -> Declaration:
    model = root.table("model")
    reserved = ("type", "friction", "actuated_joint")
    model.check(("type", "friction", *spec.parameters), ("actuated_joint", *spec.optional))
    parameters = every({key: partial(_parameter, model, key) for key in model.items if key not in reserved})
    table = root.table("input", absent={})
    if "input" not in root.items:
        joint = model.value("actuated_joint")
        if type(joint) is not int or not 1 <= joint <= spec.joints:
            model.refuse("actuated_joint", hint=f"write actuated_joint = 1, joints count from 1 to {spec.joints}")
        table = dataclasses.replace(table, items={"columns": ["u"], "joints": [joint]})
    return Declaration(spec, parameters, read_inputs(table, spec.states, spec.states[: spec.joints]))


def _parameter(model: Table, key: str) -> Declared:
    """A number (trusted) or { mean, std }. Inertias may be negative: fits about the joint, moved to the centre, are."""
    value, unit = model.quantity(key), parameter_unit(key)
    if unit == "kg" and value.mean <= 0:
        model.refuse(key, hint="write a mass above 0 [kg]")
    if unit in ("m", "m/s^2") and value.mean < 0:
        model.refuse(key, hint=f"write 0 or more [{unit}]: directions are in the equations, not in the signs")
    if value.mean > {"m/s^2": 100.0, "m": 50.0}.get(unit, math.inf):
        problem = f"{model.path}: [model] {key}: found {value.mean:g}; is it in m{unit}? write it in {unit}"
        warnings.warn(problem, RigWarning, 2)
    return value


def _measurement(table: Table, spec: SystemSpec, formulas: bool) -> dict[str, Any]:
    """The measured columns, the noise declared for them, and the ranges of their sensors."""
    table.check(("columns",), ("noise_std", "range"))
    formulas = formulas and isinstance(table.value("columns"), dict)
    columns = tuple(table.table("columns").items) if formulas else table.distinct("columns", str)
    readable = spec.states + spec.sensors
    for column in columns or table.refuse("columns"):
        if column not in readable:
            what = "no state or sensor" if spec.sensors else "no state"
            table.refuse("columns", f"{column!r} is {what} of this system", nearest(column, readable))
    noise, ranges = table.each("noise_std", Table.positive, columns), table.each("range", read_range, columns)
    return {"measured": columns, "noise_std": noise, "ranges": ranges}


@functools.cache
def _units(equations: str) -> dict[str, str]:
    of = json.loads(equations)
    return {**of["states"], **of["inputs"], **of["units"]}


# --- a rig as its file


def write_rig(rig: Rig, path: Path | str) -> None:
    """Write a rig as rig.toml, units as comments; `read_rig` gives the same Rig back.

    Args:
        rig: what is declared.
        path: the file.

    Example:
        >>> write_rig(rig, f"{folder}/copy.toml")
        >>> nnap_em.read_rig(f"{folder}/copy.toml") == rig
        True
    """
    numbers = (*rig.parameters, *rig.start, *rig.noise_std)
    units = {"dt": rig.time_unit, "horizon": rig.time_unit} | {name: rig.unit(name) for name in numbers}
    lines = ["format = 1", f"name = {toml_text(rig.name)}", *written(_tables(rig), (), units)]
    replace_text(Path(path), "\n".join(lines) + "\n")


def _tables(rig: Rig) -> dict[str, dict[str, Any]]:
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
        model["units"] = of["units"]
        model["unknown"] = {name: {"signals": signals} for name, signals in of["terms"].items()}
        model["unknown"] |= {name: {"signals": x, "enters": port} for name, (port, x) in of["enters"].items()}
        if of["readings"]:
            columns = {name: of["readings"].get(name, name) for name in columns}
    elif rig.machine:
        machine = unpacked(rig.machine)
        joints, locked = machine.part or (None, ())
        model = {"file": machine.file, "joints": joints, "locked": dict(locked)}
        model |= {"friction": friction, "uncertain": bodies}
        inputs["joints"] = None if machine.motored else rig.input_joints
    else:
        model = bodies | {"friction": friction}
    for column, kind in rig.kinds.items():
        if kind != TORQUE:
            own = {name.rpartition("."): x for name, x in numbers.items() if name not in bodies}
            inputs[column] = {"kind": kind} | {key: x for (owner, _, key), x in own.items() if owner == column}
    return {
        "model": {"type": rig.system} | model,
        "input": inputs,
        "sampling": {"dt": rig.dt, "input_hold": rig.input_hold, "clock": rig.clock, "horizon": rig.horizon},
        "measurement": {"columns": columns, "range": rig.ranges, "noise_std": rig.noise_std},
        "start": {name: dataclasses.asdict(value) for name, value in rig.start.items()},
        "limits": {**rig.limits.values, "rate": rig.limits.rate, "start": rig.limits.start},
    }
