"""A first rig.toml for a machine in a file, from what its names and those of a log have in common."""

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from ...errors import DataError
from ...machines.files.locked import Part
from ...machines.files.mjcf import read_machine, stuck
from ...machines.machine import SENSE_UNITS, Machine, machine_unit, packed, states
from ...machines.servo import TORQUE
from ...machines.table import toml_key, toml_text
from ..importing.files import reader
from ..importing.recording import Address, Topic, places
from .draft import COMMAND, Draft, commands, drafted, driven, meanings


def draft_machine(path: Path, model: Path, home: Path) -> Draft:
    """The rig.toml in the folder `home` for the log `path` of the machine in `model`."""
    topics = reader(path).topics(path)
    words = {word for _, field in places(topics) for word in re.split(r"[][]", field)}
    held = stuck(model, words)
    machine = read_machine(model, Part(locked=held))
    columns, inputs = _joints(machine, topics), _inputs(machine, topics)
    if not columns:
        names = ", ".join(joint.name for joint in machine.joints)
        hint = "write rig.toml by hand, with [import.columns]"
        raise DataError(f"{path}: nothing in it is called as a joint of {model} ({names}); {hint}")
    fields = {at.path: at for at in (Address(topic.name, field) for topic in topics for field in topic.fields)}
    sensed = tuple(one for one in machine.sensors if one.kind in SENSE_UNITS and one.name in fields)
    columns |= {sensor.name: fields[sensor.name] for sensor in sensed}
    machine = machine._replace(sensors=sensed)
    machine = machine._replace(states=states(machine, columns))
    text, driving = packed(machine), {name: (at, toml_text(joint)) for name, (at, joint) in inputs.items()}
    return drafted(
        path,
        topics,
        model.stem,
        _model(machine, os.path.relpath(model, home), held),
        columns,
        driving,
        machine.states,
        lambda name: machine_unit(text, name),
        _driven(machine, {name: joint for name, (_, joint) in driving.items()}),
    )


def _first(fields: Sequence[tuple[Address, str]], names: Sequence[str]) -> Address | None:
    return next((at for name in names for at, word in fields if word == name), None)


def _joints(machine: Machine, topics: Sequence[Topic]) -> dict[str, Address]:
    """Columns of angles and rates, and where they are: by name, or else as theta1 or q0 in the order of the joints."""
    fields, kinds, out = places(topics), _kinds(topics), {}
    for rate, (d, array, kind) in enumerate((("", "position", "theta"), ("d", "velocity", "dtheta"))):
        for i, joint in enumerate(machine.joints):
            names = [one.name for one in machine.joint_sensors if (one.joint, one.rate) == (i, bool(rate))]
            at = _first(fields, [d + joint.name, f"{array}[{joint.name}]"])
            if at is None and (sensor := next((name for name in names if _first(fields, [name])), None)):
                out[sensor] = _first(fields, [sensor])
            elif at := at or kinds.get(f"{kind}{i + 1}"):
                out[d + joint.name] = at
    return out


def _kinds(topics: Sequence[Topic]) -> dict[str, Address]:
    """Meanings of names that are not in the file: `theta2`, and `input2` for a torque."""
    out: dict[str, Address] = {}
    for at, _, of in meanings(topics):
        out.setdefault(of.kind + ("" if of.kind != "input" or of.number is None else str(of.number)), at)
    return out


def _inputs(machine: Machine, topics: Sequence[Topic]) -> dict[str, tuple[Address, str]]:
    """Columns of torques, where they are, and the joint of each; a measured effort is no command of a servo."""
    fields, order = places(topics), commands(topics)
    kinds, servos = _kinds(topics), {motor.name for motor in machine.motors if motor.kind != TORQUE}
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


def _model(machine: Machine, file: str, held: Mapping[str, float]) -> Iterator[str]:
    yield from ("[model]", 'type = "mjcf"', f"file = {toml_text(file)}    # MJCF or URDF")
    if held:
        values = ", ".join(f"{toml_text(name)} = {value:g}" for name, value in held.items())
        yield f"locked = {{ {values} }}    # rad or m; held, as they move no mass or follow another"
    yield 'friction = "unknown"    # learned in every joint; "none": damping and frictionloss of the file'
    yield from ("", "[model.uncertain]    # what of the file is not trusted: take the # away, and say how far")
    for body in machine.bodies:
        if body.mass > 0:
            key = toml_key(f"{body.name}.mass")
            yield f"# {key} = {{ std = {0.1 * body.mass:.2g} }}    # kg; {body.mass:.4g} in the file"
    for joint in machine.joints:
        unit = "kg" if joint.slide else "kg m^2"
        size = f"{joint.armature:.4g} in the file" if joint.armature else "0 in the file: inertia of the rotor, geared"
        key = toml_key(f"{joint.name}.armature")
        yield f"# {key} = {{ std = {joint.armature or 0.01:.2g} }}    # {unit}; {size}"


def _driven(machine: Machine, joints: Mapping[str, str]) -> Iterator[str]:
    if not machine.motors or len(joints) != len(machine.motors):
        yield from driven(joints, joints=not machine.motors)
        return
    yield from ("", f"# [input] is left out: the inputs are the motors of the file, {', '.join(joints)}.")
    for motor in machine.motors:
        if motor.kind != TORQUE:
            yield f"# [input.{toml_text(motor.name)}]    # the goal of a {motor.kind} servo; its numbers are the file's"
            yield from (f"# {key} = {{ mean = {x:.4g}, std = {0.2 * abs(x):.2g} }}" for key, x in motor.numbers if x)
