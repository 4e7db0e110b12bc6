"""Declaration in rig.toml of a machine from a file: names, inputs, and uncertain numbers."""

import warnings
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np

from ..data.machine import OF_BODY, PAIRS, SENSE_UNITS, Machine, Motor, Sensor, of_body, packed, states
from ..data.rig import Declaration, Declared, RigWarning, SystemSpec, every, kinds_of, nearest, read_columns
from ..data.servo import TORQUE, Drive, read_drives, scaled
from ..data.servo import named as drive_numbers
from .mjcf import Part, read_file
from .spec import uncommented

OF_JOINT = ("armature", "stiffness")


def declare(root: Any) -> Declaration:
    """The machine of `[model] file`, and what is uncertain about it; `root` is the whole of rig.toml."""
    model = root.table("model")
    model.check(("type", "friction"), ("file", "uncertain", "joints", "locked"))
    line = 'file = "arm.xml" (MJCF or URDF, beside rig.toml)'
    if not isinstance(model.items.get("file"), str) or not model.items["file"]:
        model.refuse("file", None if "file" in model.items else "missing", f"write {line}")
    part = _part(model)
    path = root.path.parent / str(model.items["file"])
    machine, file = read_file(path, part)
    text = path.read_text(encoding="utf-8", errors="replace")
    possible = tuple(sensor.name for sensor in machine.sensors if sensor.kind in SENSE_UNITS)
    machine = machine._replace(
        file=str(model.items["file"]),
        states=_states(machine, root),
        rubs=model.items.get("friction") == "none",
        sensors=tuple(_sensors(machine, root)),
        part=None if part.whole else (part.joints, tuple(part.locked.items())),
    )
    _warn_of_left_out(root, machine)
    columns, joints, motored = _inputs(machine, root)
    motors = {motor.name: motor for motor in machine.motors} if motored else {}
    file_drives = {name: Drive(one.kind, {k: Declared(x, 0.0) for k, x in one.numbers}) for name, one in motors.items()}
    drives = read_drives(root.table("input", absent={}), columns, file_drives)
    gears = tuple(_gear(motors.get(column), drives[column]) for column in columns)
    spec = SystemSpec(machine.states, (), {}, len(machine.joints), sensors=possible)
    parameters = _parameters(machine, model) | drive_numbers(drives)
    machine = packed(machine._replace(gears=gears, motored=motored))
    scales = scaled(drives, ("time", *spec.states, *columns), root.table("input", absent={}))
    return Declaration(
        spec,
        parameters,
        columns,
        joints,
        machine,
        kinds_of(drives),
        scales,
        file=file,
        urdf=text if "<robot" in uncommented(path) else "",
    )


def _gear(motor: Motor | None, drive: Drive) -> float:
    """Gear of the motor of the file; 1 for an input of another kind in rig.toml, which acts on the joint itself."""
    return 1.0 if motor is None or (drive.kind != TORQUE and motor.kind != drive.kind) else motor.gear


def _part(model: Any) -> Part:
    """The joints of `[model] joints`, and the values of `[model] locked`."""
    joints = model.items.get("joints")
    if joints is not None:
        if not (isinstance(joints, list) and joints and all(type(name) is str for name in joints)):
            model.refuse("joints", hint='write the names of the joints that move, joints = ["joint1", "joint2"]')
        joints = tuple(dict.fromkeys(joints))
    locked = model.table("locked", absent={})
    for name in locked.items:
        locked.number(name)
        if joints and name in joints:
            locked.refuse(name, "it is among the joints that move", "take it out of one of the two")
    return Part(joints, {name: locked.number(name) for name in locked.items})


def _warn_of_left_out(root: Any, machine: Machine) -> None:
    """Friction of the file has no part where it is learned."""
    names = [joint.name for joint in machine.joints if joint.damping or joint.dry]
    if names and not machine.rubs:
        problem = f"damping and frictionloss of {', '.join(names)} are left out, as friction is learned"
        warnings.warn(f'{root.path}: {machine.file}: {problem}; friction = "none" takes the file\'s', RigWarning, 2)


def _states(machine: Machine, root: Any) -> tuple[str, ...]:
    """Every joint by its name, or by that of the sensor whose column is measured."""
    columns = root.table("measurement").items.get("columns")
    names = states(machine, columns if isinstance(columns, list) else ())
    for name in names:
        if names.count(name) > 1:
            root.table("measurement").refuse("columns", f"{name!r} names two states", "rename the sensor in the file")
    return names


def _sensors(machine: Machine, root: Any) -> Iterator[Sensor]:
    """The components of sensors that are measured."""
    table = root.table("measurement")
    columns = table.items.get("columns")
    for column in columns if isinstance(columns, list) else ():
        for sensor in machine.sensors:
            if sensor.name.rpartition(".")[0] not in (column, str(column).rpartition(".")[0]):
                continue
            if sensor.kind not in SENSE_UNITS:
                hint = f"read are joints, and {', '.join(SENSE_UNITS)} of a site: take the column out"
                table.refuse("columns", f"{column!r} is of a sensor of type {sensor.kind}", hint)
            if sensor.name == column:
                yield sensor


def _inputs(machine: Machine, root: Any) -> tuple[tuple[str, ...], tuple[int, ...], bool]:
    """Columns, the joint that each drives, counted from 1, and whether they are the motors of the file."""
    if not machine.motors and "input" not in root.items:
        problem = f"{machine.file} has no actuator"
        hint = "write the torque columns and their joints, or columns = [] and joints = [] where nothing drives it"
        root.refuse("input", problem, hint)
    names, motors = [joint.name for joint in machine.joints], {one.name: one.joint + 1 for one in machine.motors}
    return read_columns(root.table("input", absent={}), machine.states, names, motors)


def _parameters(machine: Machine, model: Any) -> dict[str, Declared]:
    """Every number of [model.uncertain], its mean that of the file where none is written."""
    table = model.table("uncertain", absent={}).flattened()
    bodies = {body.name: dict(zip(OF_BODY, of_body(body), strict=True)) for body in machine.bodies}
    means = {f"{body}.{what}": value for body, values in bodies.items() for what, value in values.items()}
    means |= {f"{joint.name}.{what}": float(getattr(joint, what)) for joint in machine.joints for what in OF_JOINT}
    owners = [one.name for one in (*machine.bodies, *machine.joints)]

    def declared(name: str) -> Declared:
        owner, _, quantity = name.partition(".")
        if owner not in owners:
            table.refuse(name, f"no body or joint of {machine.file} is called {owner!r}", nearest(owner, owners))
        if name not in means:
            known = [key.partition(".")[2] for key in means if key.partition(".")[0] == owner]
            problem = f"{owner!r} has no {quantity!r}" if quantity else "names no number"
            table.refuse(name, problem, nearest(quantity, known))
        value = table.quantity(name, mean=means[name])
        if (value.mean < 0 and quantity in ("mass", *OF_JOINT)) or (quantity == "mass" and not value.mean):
            table.refuse(name, f"found mean = {value.mean:g}", "write a number above 0")
        return value

    out = every(**{name: partial(declared, name) for name in table.items})
    for body, values in bodies.items():
        own = {what: out[f"{body}.{what}"].mean for what in OF_BODY if f"{body}.{what}" in out}
        if own:
            _check_inertia(table, body, values | own)
    return out


def _check_inertia(table: Any, body: str, values: dict[str, float]) -> None:
    """Raise RigError unless some distribution of mass has the declared inertia."""
    inertia = np.empty((3, 3))
    for (i, j), what in zip(PAIRS, OF_BODY[4:], strict=True):
        inertia[i, j] = inertia[j, i] = values[what]
    low, middle, high = np.linalg.eigvalsh(inertia)
    if low + middle < (1 - 1e-9) * high:
        problem = f"principal inertias of {low:.3g}, {middle:.3g} and {high:.3g} kg m^2"
        table.refuse(f"{body}.inertia", problem, "write means of which the largest is at most the sum of the others")
