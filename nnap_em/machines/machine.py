"""A machine from its owner's file as plain numbers: all that the physics needs, without the file and its parser."""

import json
from collections.abc import Collection
from functools import lru_cache
from typing import Any, NamedTuple

from .servo import TORQUE
from .units import state_unit

Vector = tuple[float, float, float]
Rotation = tuple[Vector, Vector, Vector]
"""Rows; takes a vector of the inner frame to the outer one."""


class Body(NamedTuple):
    """A rigid body in its own frame, which stands in that of its parent as declared when all joints are at zero."""

    name: str
    parent: int  # Place of the parent in the list of bodies; -1: the world
    place: Vector  # Origin in the frame of the parent [m]
    turn: Rotation
    mass: float  # [kg]
    centre: Vector  # Centre of mass [m]
    inertia: Rotation  # About the centre of mass, along the axes of the frame [kg m^2]


AXES = "xyz"
PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
"""Entries of an inertia."""
OF_BODY = ("mass", *(f"com.{axis}" for axis in AXES), *(f"inertia.{AXES[i]}{AXES[j]}" for i, j in PAIRS))
"""The numbers of a body by name, in its frame, the inertia about its centre of mass: kg, m, kg m^2."""


def of_body(body: Body) -> tuple[float, ...]:
    """Values in the order of `OF_BODY`."""
    return body.mass, *body.centre, *(body.inertia[i][j] for i, j in PAIRS)


class Joint(NamedTuple):
    """A hinge or a slide, and what stands about it in the file."""

    name: str
    body: int  # The body that it moves; several joints of one body act in the order of the list
    slide: bool
    axis: Vector  # Unit vector in the frame of the body
    anchor: Vector  # A point of the axis in the frame of the body [m]
    zero: float  # Coordinate at which the body stands as declared [rad or m]
    stiffness: float  # Stiffness of its spring [N m/rad or N/m]
    rest: float  # Coordinate at which the spring is at rest
    armature: float  # Inertia of what turns with it, as of a rotor [kg m^2 or kg]
    damping: float  # [N m s/rad or N s/m]
    dry: float  # Dry friction of the file [N m or N]
    range: tuple[float, float] | None  # Positions of its stops


class Motor(NamedTuple):
    """An actuator: gear times the input acts on the joint, or gear times the torque that a servo makes of it."""

    name: str
    joint: int
    gear: float
    kind: str = TORQUE  # One of `servo.KINDS`
    numbers: tuple[tuple[str, float], ...] = ()  # Numbers of the servo, by their keys


class JointSensor(NamedTuple):
    """A sensor that reads a joint."""

    name: str
    joint: int
    rate: bool  # True where it reads the velocity


class Site(NamedTuple):
    """A marked point of a body."""

    name: str
    body: int
    place: Vector  # [m]


class Sensor(NamedTuple):
    """A component of a sensor at a site; its column is called as the sensor with the component behind a dot."""

    name: str
    kind: str  # `gyro`, `accelerometer` or `framepos`; of what is not read here, MuJoCo's name for it
    axis: int
    body: int  # -1: the world
    place: Vector  # Position of the site in the frame of the body [m]
    turn: Rotation  # Orientation of the site in the frame of the body


SENSE_UNITS = {"gyro": "rad/s", "accelerometer": "m/s^2", "framepos": "m"}
"""Sensors that are read beside those of joints, and their units."""


class Machine(NamedTuple):
    """A tree of bodies on a fixed base."""

    file: str
    gravity: Vector  # [m/s^2]
    bodies: tuple[Body, ...]
    joints: tuple[Joint, ...]
    motors: tuple[Motor, ...]
    joint_sensors: tuple[JointSensor, ...]
    sites: tuple[Site, ...]
    states: tuple[str, ...] = ()  # Names of the coordinates, then of the rates, in the logs
    gears: tuple[float, ...] = ()  # Torque of a unit of every input column
    motored: bool = False  # True where the inputs are motors of the file; False where rig.toml names joints
    rubs: bool = False  # True where friction of the file acts, because none is learned
    sensors: tuple[Sensor, ...] = ()  # All sensors of a file, measured ones of a rig
    part: tuple[tuple[str, ...] | None, tuple[tuple[str, float], ...]] | None = None
    """The joints that rig.toml names, and those that it holds with their values; None where all of the file move."""


def packed(machine: Machine) -> str:
    """The machine as one text, the same for the same machine."""
    return json.dumps(machine, separators=(",", ":"))


@lru_cache(maxsize=64)
def unpacked(text: str) -> Machine:
    """The machine in a text of `packed`."""
    kinds = {"bodies": Body, "joints": Joint, "motors": Motor, "joint_sensors": JointSensor, "sites": Site}
    fields: dict[str, Any] = dict(zip(Machine._fields, map(_tuples, json.loads(text)), strict=True))
    for name, kind in (kinds | {"sensors": Sensor}).items():
        fields[name] = tuple(kind(*one) for one in fields[name])
    return Machine(**fields)


def _tuples(value):
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


def machine_unit(text: str, name: str) -> str:
    """The SI unit of a state, sensor or parameter of the machine in a text of `packed`."""
    machine = unpacked(text)
    for sensor in machine.sensors:
        if name == sensor.name:
            return SENSE_UNITS[sensor.kind]
    dof, (owner, _, quantity) = len(machine.joints), name.partition(".")
    if name in machine.states:
        place = machine.states.index(name)
        return state_unit(not machine.joints[place % dof].slide, rate=place >= dof)
    slide = next((joint.slide for joint in machine.joints if joint.name == owner), False)
    per_joint = {"armature": "kg" if slide else "kg m^2", "stiffness": "N/m" if slide else "N m/rad"}
    return per_joint.get(quantity) or {"mass": "kg", "com": "m"}.get(quantity.partition(".")[0], "kg m^2")


def states(machine: Machine, columns: Collection[str] = ()) -> tuple[str, ...]:
    """Coordinates and rates by the names of the joints, or of the sensors whose columns are there."""
    names = [joint.name for joint in machine.joints]
    names += [f"d{name}" for name in names]
    for sensor in machine.joint_sensors:
        if sensor.name in columns:
            names[sensor.joint + len(machine.joints) * sensor.rate] = sensor.name
    return tuple(names)
