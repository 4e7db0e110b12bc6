"""A part of a machine: joints that are held at a value, their bodies joined to those that carry them."""

from collections.abc import Callable, Collection, Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from ..data.machine import Body, Joint, Machine, Rotation, Vector

NOTHING = 1e-13
"""Mass [kg] and inertia [kg m^2] that count as none: a hundred times the least that MuJoCo's compiler accepts."""


class Part(NamedTuple):
    """The joints of a file that move, and the values at which others are held."""

    joints: tuple[str, ...] | None = None
    """The joints that move; none given: all that are not held."""
    locked: Mapping[str, float] = MappingProxyType({})
    """Values of joints that are held [rad or m]."""

    @property
    def whole(self) -> bool:
        """True where every joint of the file moves."""
        return self.joints is None and not self.locked

    def holds(self, joint: str) -> bool:
        """True for a joint that is held, at a value or where the file has it."""
        return joint in self.locked or (self.joints is not None and joint not in self.joints)


def holding(*joints: str) -> str:
    """The line of rig.toml that holds joints."""
    return f"[model] locked = {{ {', '.join(f'{joint} = 0.0' for joint in joints)} }}"


class Follows(NamedTuple):
    """The joint that another follows, and the coefficients of the polynomial by which it does."""

    joint: str
    law: tuple[float, ...]
    zero: float = 0.0
    """Coordinate of the follower at which the polynomial counts from 0, and that of the leader."""
    of: float = 0.0

    def value(self, leader: float) -> float:
        """Coordinate of the follower."""
        return self.zero + sum(c * (leader - self.of) ** k for k, c in enumerate(self.law))


class Pose(NamedTuple):
    """A frame in another one."""

    place: np.ndarray
    turn: np.ndarray

    def of(self, inner: "Pose") -> "Pose":
        """A frame in this one, as it stands in the outer one."""
        return Pose(self.place + self.turn @ inner.place, self.turn @ inner.turn)


def lock(machine: Machine, values: Mapping[str, float], joined: Collection[int] = ()) -> Machine:
    """The machine with the joints of `values` held there [rad or m], and their bodies joined to those that carry them.

    `joined` are places of further bodies in the list, which join theirs where no joint moves them.
    """
    poses, joints = [], []
    for i, body in enumerate(machine.bodies):
        pose, remaining = _held(body, [joint for joint in machine.joints if joint.body == i], values)
        poses.append(pose)
        joints += remaining
    moved, had = {joint.body for joint in joints}, {joint.body for joint in machine.joints}
    carrier, within = {-1: -1}, {-1: Pose(np.zeros(3), np.eye(3))}
    for i, body in enumerate(machine.bodies):
        joins = i not in moved and (i in had or i in joined)
        carrier[i] = carrier[body.parent] if joins else i
        within[i] = within[body.parent].of(poses[i]) if joins else Pose(np.zeros(3), np.eye(3))
    carriers = [i for i in carrier if i >= 0 and carrier[i] == i]
    number = {-1: -1, **{i: k for k, i in enumerate(carriers)}}
    bodies = []
    for i in carriers:
        body = machine.bodies[i]
        pose = within[body.parent].of(poses[i])
        parts = [(machine.bodies[k], within[k]) for k in carrier if k >= 0 and carrier[k] == i]
        merged = _together(parts) if len(parts) > 1 else body
        parent = number[carrier[body.parent]]
        bodies.append(merged._replace(name=body.name, parent=parent, place=vector(pose.place), turn=matrix(pose.turn)))
    order = {joint.name: k for k, joint in enumerate(joints)}
    names = [joint.name for joint in machine.joints]

    def place(body: int, at: Vector) -> Vector:
        return vector(within[body].place + within[body].turn @ np.asarray(at))

    def free(parts: tuple) -> tuple:
        present = [part for part in parts if names[part.joint] in order]
        return tuple(part._replace(joint=order[names[part.joint]]) for part in present)

    return machine._replace(
        bodies=tuple(bodies),
        joints=tuple(joint._replace(body=number[joint.body]) for joint in joints),
        motors=free(machine.motors),
        joint_sensors=free(machine.joint_sensors),
        sites=tuple(
            site._replace(body=number[carrier[site.body]], place=place(site.body, site.place))
            for site in machine.sites
            if carrier[site.body] >= 0
        ),
        sensors=tuple(
            sensor._replace(
                body=number[carrier[sensor.body]],
                place=place(sensor.body, sensor.place),
                turn=matrix(within[sensor.body].turn @ np.asarray(sensor.turn)),
            )
            for sensor in machine.sensors
        ),
    )


def groups(machine: Machine, free: Callable[[int], bool]) -> list[int]:
    """A number for every body, and 0 for the world at the end: the same for bodies that nothing moves apart.

    `free` is true for a body, by its place in the list, that some joint moves.
    """
    out: list[int] = []
    for i, body in enumerate(machine.bodies):
        out.append(i + 1 if free(i) else out[body.parent] if body.parent >= 0 else 0)
    return [*out, 0]


def _held(body: Body, joints: list[Joint], values: Mapping[str, float]) -> tuple[Pose, list[Joint]]:
    """The pose of a body in its parent with some of its joints held, and the others in the frame that it then has.

    A joint that is held turns by C what comes after it.  One before it moves the body as J, J C = C (C^-1 J C).
    """
    pose, free = Pose(np.asarray(body.place), np.asarray(body.turn)), []
    for joint in joints:
        if joint.name not in values:
            free.append(joint)
            continue
        way, axis, anchor = values[joint.name] - joint.zero, np.asarray(joint.axis), np.asarray(joint.anchor)
        turn = np.eye(3) if joint.slide else _turned(axis, way)
        change = Pose(axis * way if joint.slide else anchor - turn @ anchor, turn)
        pose = pose.of(change)
        free = [
            other._replace(
                axis=vector(turn.T @ np.asarray(other.axis)),
                anchor=vector(turn.T @ (np.asarray(other.anchor) - change.place)),
            )
            for other in free
        ]
    return pose, free


def _turned(axis: np.ndarray, angle: float) -> np.ndarray:
    """The rotation about a unit vector, by Rodrigues' formula."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross


def _together(parts: list[tuple[Body, Pose]]) -> Body:
    """Bodies that do not move against each other as one, in the frame of the first: sums of mass and moments."""
    mass = sum(body.mass for body, _ in parts)
    centres = [pose.place + pose.turn @ np.asarray(body.centre) for body, pose in parts]
    if mass <= NOTHING:
        centre = centres[0]
    else:
        centre = sum((body.mass * at for (body, _), at in zip(parts, centres, strict=True)), np.zeros(3)) / mass
    inertia = np.zeros((3, 3))
    for (body, pose), at in zip(parts, centres, strict=True):
        way = at - centre
        inertia += pose.turn @ np.asarray(body.inertia) @ pose.turn.T
        inertia += body.mass * (way @ way * np.eye(3) - np.outer(way, way))
    return parts[0][0]._replace(mass=mass, centre=vector(centre), inertia=matrix(0.5 * (inertia + inertia.T)))


def vector(values: np.ndarray) -> Vector:
    """Three numbers of NumPy as a vector."""
    x, y, z = (float(value) for value in values)
    return x, y, z


def matrix(values: np.ndarray) -> Rotation:
    """Nine as a matrix."""
    a, b, c = (vector(row) for row in values)
    return a, b, c
