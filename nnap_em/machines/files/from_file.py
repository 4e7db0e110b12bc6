"""Declaration in rig.toml of a machine from a file: names, inputs, and uncertain numbers."""

import warnings
from collections.abc import Collection
from functools import partial

import numpy as np

from ...errors import RigWarning
from ..machine import OF_BODY, PAIRS, SENSE_UNITS, Machine, Motor, Sensor, of_body, packed, states
from ..rig import Declaration, SystemSpec, every, nearest
from ..servo import TORQUE, Drive, read_inputs
from ..table import Declared, Table
from .mjcf import Part, read_file
from .spec import uncommented

OF_JOINT = ("armature", "stiffness")


def declare(root: Table) -> Declaration:
    """The machine of `[model] file`, and what is uncertain about it; `root` is the whole of rig.toml."""
    model = root.table("model")
    model.check(("type", "friction"), ("file", "uncertain", "joints", "locked"))
    name = model.items.get("file")
    if not isinstance(name, str) or not name:
        line = 'file = "arm.xml" (MJCF or URDF, beside rig.toml)'
        model.refuse("file", None if "file" in model.items else "missing", f"write {line}")
    part, path = _part(model), root.path.parent / str(name)
    machine, file = read_file(path, part)
    measurement = root.table("measurement")
    columns = measurement.items.get("columns")
    columns = columns if isinstance(columns, list) else []
    rubs, names = model.items.get("friction") == "none", states(machine, columns)
    if twice := [state for state in names if names.count(state) > 1]:
        measurement.refuse("columns", f"{twice[0]!r} names two states", "rename the sensor in the file")
    left_out = [joint.name for joint in machine.joints if joint.damping or joint.dry]
    if left_out and not rubs:
        problem = f"damping and frictionloss of {', '.join(left_out)} are left out, as friction is learned"
        warnings.warn(f'{root.path}: {name}: {problem}; friction = "none" takes the file\'s', RigWarning, 2)
    if not machine.motors and "input" not in root.items:
        hint = "write the torque columns and their joints, or columns = [] and joints = [] where nothing drives it"
        root.refuse("input", f"{name} has no actuator", hint)
    motors = {motor.name: motor for motor in machine.motors}
    drives = {
        motor.name: (motor.joint + 1, Drive(motor.kind, {key: Declared(x, 0.0) for key, x in motor.numbers}))
        for motor in machine.motors
    }
    inputs = read_inputs(root.table("input", absent={}), names, [joint.name for joint in machine.joints], drives)
    parameters = _parameters(machine, model)
    gears = [_gear(motors.get(column) if inputs.motored else None, drive) for column, drive in inputs.drives.items()]
    text = path.read_text(encoding="utf-8", errors="replace") if "<robot" in uncommented(path) else ""
    seen = tuple(sensor.name for sensor in machine.sensors if sensor.kind in SENSE_UNITS)
    machine = machine._replace(
        file=str(name),
        states=names,
        rubs=rubs,
        sensors=_sensors(machine, measurement, columns),
        part=None if part.whole else (part.joints, tuple(part.locked.items())),
        gears=tuple(gears),
        motored=inputs.motored,
    )
    spec = SystemSpec(names, (), {}, len(machine.joints), sensors=seen)
    return Declaration(spec, parameters, inputs, packed(machine), file=file, urdf=text)


def _gear(motor: Motor | None, drive: Drive) -> float:
    """Gear of the motor of the file; 1 for an input of another kind in rig.toml, which acts on the joint itself."""
    return 1.0 if motor is None or (drive.kind != TORQUE and motor.kind != drive.kind) else motor.gear


def _part(model: Table) -> Part:
    joints = model.items.get("joints")
    if joints is not None:
        if not (isinstance(joints, list) and joints and all(type(name) is str for name in joints)):
            model.refuse("joints", hint='write the names of the joints that move, joints = ["joint1", "joint2"]')
        joints = tuple(dict.fromkeys(joints))
    locked = model.table("locked", absent={})
    if both := [name for name in joints or () if name in locked.items]:
        locked.refuse(both[0], "it is among the joints that move", "take it out of one of the two")
    return Part(joints, {name: locked.number(name) for name in locked.items})


def _sensors(machine: Machine, table: Table, columns: Collection[str]) -> tuple[Sensor, ...]:
    for column in columns:
        for sensor in machine.sensors:
            own = sensor.name.rpartition(".")[0] in (column, str(column).rpartition(".")[0])
            if own and sensor.kind not in SENSE_UNITS:
                hint = f"read are joints, and {', '.join(SENSE_UNITS)} of a site: take the column out"
                table.refuse("columns", f"{column!r} is of a sensor of type {sensor.kind}", hint)
    return tuple(sensor for column in columns for sensor in machine.sensors if sensor.name == column)


def _parameters(machine: Machine, model: Table) -> dict[str, Declared]:
    table = model.table("uncertain", absent={}).flattened()
    bodies = {body.name: dict(zip(OF_BODY, of_body(body), strict=True)) for body in machine.bodies}
    owners = {joint.name: {what: float(getattr(joint, what)) for what in OF_JOINT} for joint in machine.joints}
    owners |= {name: owners.get(name, {}) | numbers for name, numbers in bodies.items()}

    def declared(name: str) -> Declared:
        owner, _, quantity = name.partition(".")
        if owner not in owners:
            table.refuse(name, f"no body or joint of {machine.file} is called {owner!r}", nearest(owner, owners))
        if quantity not in owners[owner]:
            table.refuse(name, f"{owner!r} has no {quantity!r}", nearest(quantity, owners[owner]))
        value = table.quantity(name, mean=owners[owner][quantity])
        if (value.mean < 0 and quantity in ("mass", *OF_JOINT)) or (quantity == "mass" and not value.mean):
            table.refuse(name, f"found mean = {value.mean:g}", "write a number above 0")
        return value

    out = every({name: partial(declared, name) for name in table.items})
    for body, values in bodies.items():
        own = {what: out[f"{body}.{what}"].mean for what in OF_BODY if f"{body}.{what}" in out}
        if own:
            _check_inertia(table, body, values | own)
    return out


def _check_inertia(table: Table, body: str, values: dict[str, float]) -> None:
    inertia = np.empty((3, 3))
    for (i, j), what in zip(PAIRS, OF_BODY[4:], strict=True):
        inertia[i, j] = inertia[j, i] = values[what]
    low, middle, high = np.linalg.eigvalsh(inertia)
    if low + middle < (1 - 1e-9) * high:
        problem = f"principal inertias of {low:.3g}, {middle:.3g} and {high:.3g} kg m^2"
        table.refuse(f"{body}.inertia", problem, "write means of which the largest is at most the sum of the others")
