"""A first rig.toml for a machine in a file, from what its names and those of a log have in common."""

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..data.dataset import DataError
from ..data.machine import SENSE_UNITS, Machine, machine_unit, packed, states
from ..data.rig import SystemSpec, dotted_key, toml_text
from ..data.servo import TORQUE
from ..import_.files import reader
from ..import_.recording import Address, Topic, places
from ..import_.text_file import plain_csv
from ..machines.locked import Part
from ..machines.mjcf import read_machine
from ..machines.source import parse
from ..machines.urdf import stuck
from .from_log import DRAFT_HEAD, Draft, driven, from_one, meaning, measurement, numbers, sampling
from .from_topics import COMMAND, addresses, columns_table, commands


def draft_machine(path: Path, model: Path, home: Path) -> Draft:
    """The rig.toml in the folder `home` for the log `path` of the machine in `model`.

    Raises DataError where the log cannot be read or no joint of the machine is in it, MachineError for `model`.
    """
    topics = reader(path).topics(path)
    words = {word for _, field in places(topics) for word in re.split(r"[][]", field)}
    held = stuck(parse(model), words)
    machine = read_machine(model, Part(locked=held))
    columns, inputs = _joints(machine, topics), _inputs(machine, topics)
    if not columns:
        names = ", ".join(joint.name for joint in machine.joints)
        hint = "write rig.toml by hand, with [import.columns]"
        raise DataError(f"{path}: nothing in it is called as a joint of {model} ({names}); {hint}")
    columns |= (sensed := _sensors(machine, topics))
    named, sensors = tuple(columns), tuple(sensor for sensor in machine.sensors if sensor.name in sensed)
    machine = machine._replace(states=_called(machine, named), sensors=sensors)
    spec, text = SystemSpec(machine.states, (), {}, len(machine.joints)), packed(machine)
    everything = columns | {column: at for column, (at, _) in inputs.items()}
    table = _table(path, everything)
    lines = [
        *_model(machine, os.path.relpath(model, home), held),
        *_driven(machine, {column: joint for column, (_, joint) in inputs.items()}),
        *sampling(table, [meaning("time")] if "time" in table else []),
        *measurement(table, named, spec, lambda name: machine_unit(text, name)),
        *addresses(topics, everything),
    ]
    return Draft("\n".join([DRAFT_HEAD.format(name=toml_text(model.stem)), *lines]) + "\n", ())


def _called(machine: Machine, columns: Sequence[str]) -> tuple[str, ...]:
    """The states, by the sensors whose columns are there."""
    names, dof = list(states(machine.joints)), len(machine.joints)
    for sensor in machine.joint_sensors:
        if sensor.name in columns:
            names[sensor.joint + dof * sensor.rate] = sensor.name
    return tuple(names)


def _first(fields: Sequence[tuple[Address, str]], names: Sequence[str]) -> Address | None:
    """Address of the first name that exists."""
    return next((at for name in names for at, word in fields if word == name), None)


def _joints(machine: Machine, topics: Sequence[Topic]) -> dict[str, Address]:
    """Columns of angles and rates, and where they are: by name, or else as theta1 or q0 in the order of the joints."""
    fields, out = places(topics), {}
    kinds = _kinds(fields)
    for rate, (d, array, kind) in enumerate((("", "position", "theta"), ("d", "velocity", "dtheta"))):
        for i, joint in enumerate(machine.joints):
            sensors = [
                sensor.name for sensor in machine.joint_sensors if (sensor.joint, sensor.rate) == (i, bool(rate))
            ]
            at = _first(fields, [d + joint.name, f"{array}[{joint.name}]"])
            if at is None and (sensor := next((name for name in sensors if _first(fields, [name])), None)):
                out[sensor] = _first(fields, [sensor])
            elif at := at or kinds.get(f"{kind}{i + 1}"):
                out[d + joint.name] = at
    return out


def _sensors(machine: Machine, topics: Sequence[Topic]) -> dict[str, Address]:
    """Components of other sensors, and where they are: by name, or as ROS calls those of the only one of its kind."""
    every, out = [Address(topic.name, field) for topic in topics for field in topic.fields], {}
    # Names of readings in a ROS message of an inertial sensor
    imu = {"gyro": "angular_velocity", "accelerometer": "linear_acceleration"}
    for sensor in machine.sensors:
        alone = sum(other.kind == sensor.kind for other in machine.sensors) == 3
        usual = f"{imu[sensor.kind]}.{'xyz'[sensor.axis]}" if alone and sensor.kind in imu else sensor.name
        at = [at for at in every if at.path == sensor.name] or [at for at in every if at.path == usual]
        if sensor.kind in SENSE_UNITS and len(at) == 1:
            out[sensor.name] = at[0]
    return out


def _kinds(fields: Sequence[tuple[Address, str]]) -> dict[str, Address]:
    """Meanings of names that are not in the file: `theta2`, and `input2` for a torque."""
    columns = from_one([meaning(re.sub(r"\[(\d+)\]$", r"\1", word)) for _, word in fields])
    out: dict[str, Address] = {}
    for column, (at, _) in zip(columns, fields, strict=True):
        number = "" if column.kind != "input" or column.number is None else str(column.number)
        out.setdefault(column.kind + number, at)
    return out


def _inputs(machine: Machine, topics: Sequence[Topic]) -> dict[str, tuple[Address, str]]:
    """Columns of torques, where they are, and the joint of each: of the motors, or of joints where there are none.

    A measured effort is the torque of a motor, and no command of a servo.
    """
    fields, order = places(topics), commands(topics)
    kinds, servos = _kinds(fields), {motor.name for motor in machine.motors if motor.kind != TORQUE}
    motors = [(motor.name, machine.joints[motor.joint].name) for motor in machine.motors]
    motors = motors or [(f"tau_{joint.name}", joint.name) for joint in machine.joints]
    out: dict[str, tuple[Address, str]] = {}
    for i, (name, joint) in enumerate(motors):
        names = [name] if name in servos else [name, f"effort[{name}]"]
        at = _first(fields, names) or (order[i] if len(order) == len(motors) else None)
        at = at or next((at for at, word in fields if joint in word and COMMAND.search(word)), None)
        if name not in servos:
            at = at or kinds.get(f"input{i + 1}") or (kinds.get("input") if len(motors) == 1 else None)
        if at is not None:
            out[name] = at, joint
    return out


def _table(path: Path, columns: Mapping[str, Address]) -> dict[str, Float[np.ndarray, " time"]]:
    """Some of the log on uniform rows; of a CSV file its own."""
    if not plain_csv(path):
        return columns_table(path, columns)
    table = numbers(path)
    time = next((table[name] for name in table if meaning(name).kind == "time"), None)
    scaled = {name: (at.scale or 1.0) * table[at.path] for name, at in columns.items()}
    return ({} if time is None else {"time": time}) | scaled


def _model(machine: Machine, file: str, held: Mapping[str, float]) -> Iterator[str]:
    yield from ("[model]", 'type = "mjcf"', f"file = {toml_text(file)}    # MJCF or URDF")
    if held:
        values = ", ".join(f"{toml_text(name)} = {value:g}" for name, value in held.items())
        yield f"locked = {{ {values} }}    # rad or m; held, as they move no mass or follow another"
    yield 'friction = "unknown"    # learned in every joint; "none": damping and frictionloss of the file'
    yield from (
        "",
        "[model.uncertain]    # what of the file is not trusted: take the # of a line away, and say how far",
    )
    for body in machine.bodies:
        if body.mass > 0:
            key = dotted_key(f"{body.name}.mass")
            yield f"# {key} = {{ std = {0.1 * body.mass:.2g} }}    # kg; {body.mass:.4g} in the file"
    for joint in machine.joints:
        unit = "kg" if joint.slide else "kg m^2"
        size = f"{joint.armature:.4g} in the file" if joint.armature else "0 in the file: inertia of the rotor, geared"
        key = dotted_key(f"{joint.name}.armature")
        yield f"# {key} = {{ std = {joint.armature or 0.01:.2g} }}    # {unit}; {size}"


def _driven(machine: Machine, joints: Mapping[str, str]) -> Iterator[str]:
    """The inputs; no lines where they are the motors of the file."""
    if machine.motors and len(joints) == len(machine.motors):
        yield from ("", f"# [input] is left out: the inputs are the motors of the file, {', '.join(joints)}.")
        yield from _servos(machine)
        return
    yield from driven({name: toml_text(joint) for name, joint in joints.items()}, joints=not machine.motors)


def _servos(machine: Machine) -> Iterator[str]:
    """Lines with the numbers of servos of the file that may be uncertain."""
    for motor in machine.motors:
        if motor.kind == TORQUE:
            continue
        numbers = ", ".join(f"{key} = {value:.4g}" for key, value in motor.numbers if value)
        yield f"# [input.{toml_text(motor.name)}]    # the goal of a {motor.kind} servo; in the file {numbers}"
        yield from (f"# {key} = {{ mean = {x:.4g}, std = {0.2 * abs(x):.2g} }}" for key, x in motor.numbers if x)
        yield "# delay = { mean = 0.01, std = 0.01 }    # s"
