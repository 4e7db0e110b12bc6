"""Mass matrix, bias force and acceleration of a tree of joints, by recursions from base to tips and back.

[Featherstone 2008, "Rigid Body Dynamics Algorithms": Newton-Euler ch. 5.3, composite bodies ch. 6.2, the sparse
factor ch. 6.5]  All is in the frames of `frames.py`, scalar by scalar (reason: `spatial.py`).
"""

from collections.abc import Sequence
from typing import NamedTuple

from ...base.elementary import reciprocal, sincos
from .frames import Frame
from .spatial import (
    ZERO,
    Scalar,
    Three,
    Turn,
    about,
    add,
    apply,
    cross,
    minus,
    plus,
    sandwich,
    scaled,
    subtract,
    summed,
    times,
    transposed,
)  # fmt: skip


class Inertia(NamedTuple):
    """Inertia of a rigid body about the origin of its frame."""

    mass: Scalar  # [kg]
    moment: Three  # Mass times the centre of mass [kg m]
    second: Turn  # [kg m^2]


class Pose(NamedTuple):
    """A joint's frame in that of the joint before it, at its coordinate."""

    place: Three
    turn: Turn
    back: Turn


class Motion(NamedTuple):
    """Motion of a joint's frame, in its own axes."""

    spin: Three  # Angular velocity [rad/s]
    turns: Three  # Angular acceleration [rad/s^2]
    rise: Three  # Acceleration of its origin against free fall [m/s^2]


NO_INERTIA = Inertia(0.0, ZERO, (ZERO, ZERO, ZERO))


def inertia(mass: Scalar, centre: Three, tensor: Turn) -> Inertia:
    """Inertia from that about the centre of mass."""
    moment = scaled(mass, centre)
    return Inertia(mass, moment, summed(tensor, about(scaled(0.5, moment), centre)))


def united(a: Inertia, b: Inertia) -> Inertia:
    """Inertia of two bodies that are one."""
    return Inertia(plus(a.mass, b.mass), add(a.moment, b.moment), summed(a.second, b.second))


def carried(body: Inertia, place: Three, turn: Turn) -> Inertia:
    """The same body about the origin of the frame in which its own stands so."""
    moment = apply(turn, body.moment)
    second = summed(sandwich(turn, body.second), about(moment, place))
    second = summed(second, about(scaled(times(0.5, body.mass), place), place))
    return Inertia(body.mass, add(moment, scaled(body.mass, place)), second)


def posed(frames: Sequence[Frame], q: Sequence[Scalar]) -> list[Pose]:
    """Poses of every joint's frame at the coordinates `q`."""
    poses = []
    for frame, at in zip(frames, q, strict=True):
        place, turn = frame.place, frame.turn
        if frame.slide:
            place = add(place, scaled(at, transposed(turn)[2]))
        else:
            sine, cosine = sincos(at)
            x, y, z = transposed(turn)
            ahead = add(scaled(cosine, x), scaled(sine, y))
            turn = transposed((ahead, subtract(scaled(cosine, y), scaled(sine, x)), z))
        poses.append(Pose(place, turn, transposed(turn)))
    return poses


def motions(
    frames: Sequence[Frame], poses: Sequence[Pose], v: Sequence[Scalar], a: Sequence[Scalar], gravity: Three
) -> list[Motion]:
    """Motions of the frames of all joints; that of the base stands last, so that -1 finds it."""
    chain: list[Motion] = [Motion(ZERO, ZERO, scaled(-1.0, gravity))]
    for frame, pose, rate, acceleration in zip(frames, poses, v, a, strict=True):
        spin, turns, rise = chain[frame.before]
        rise = add(rise, add(cross(turns, pose.place), cross(spin, cross(spin, pose.place))))
        spin, turns, rise = apply(pose.back, spin), apply(pose.back, turns), apply(pose.back, rise)
        velocity, gain = (0.0, 0.0, rate), (0.0, 0.0, acceleration)
        if frame.slide:
            rise = add(rise, add(scaled(2.0, cross(spin, velocity)), gain))
        else:
            turns, spin = add(turns, add(cross(spin, velocity), gain)), add(spin, velocity)
        chain.insert(-1, Motion(spin, turns, rise))
    return chain


def newton_euler(
    frames: Sequence[Frame],
    poses: Sequence[Pose],
    bodies: Sequence[Inertia],
    v: Sequence[Scalar],
    a: Sequence[Scalar],
    gravity: Three,
) -> list[Scalar]:
    """Force at every joint that gives the acceleration `a`; with `a` zero that of Coriolis, rotation and gravity."""
    forces: list[Three] = []
    moments: list[Three] = []
    for body, (spin, turns, rise) in zip(bodies, motions(frames, poses, v, a, gravity), strict=False):
        force = add(scaled(body.mass, rise), add(cross(turns, body.moment), cross(spin, cross(spin, body.moment))))
        swing = add(apply(body.second, turns), cross(spin, apply(body.second, spin)))
        forces.append(force)
        moments.append(add(swing, cross(body.moment, rise)))
    loads: list[Scalar] = [0.0] * len(frames)
    for i in reversed(range(len(frames))):
        frame, pose = frames[i], poses[i]
        loads[i] = forces[i][2] if frame.slide else moments[i][2]
        if (k := frame.before) >= 0:
            force = apply(pose.turn, forces[i])
            moments[k] = add(moments[k], add(apply(pose.turn, moments[i]), cross(pose.place, force)))
            forces[k] = add(forces[k], force)
    return loads


def composite(frames: Sequence[Frame], poses: Sequence[Pose], bodies: Sequence[Inertia]) -> list[list[Scalar]]:
    """Mass matrix by rows; 0.0 where two joints stand on different branches."""
    n = len(frames)
    subtrees = list(bodies)
    for i in reversed(range(n)):
        if (k := frames[i].before) >= 0:
            subtrees[k] = united(subtrees[k], carried(subtrees[i], poses[i].place, poses[i].turn))
    rows: list[list[Scalar]] = [[0.0] * n for _ in range(n)]
    for i, body in enumerate(subtrees):
        x, y, _ = body.moment
        if frames[i].slide:
            force, moment = (0.0, 0.0, body.mass), (y, times(-1.0, x), 0.0)
        else:
            force, moment = (times(-1.0, y), x, 0.0), transposed(body.second)[2]
        k = i
        while k >= 0:
            rows[i][k] = rows[k][i] = force[2] if frames[k].slide else moment[2]
            force = apply(poses[k].turn, force)
            moment = add(apply(poses[k].turn, moment), cross(poses[k].place, force))
            k = frames[k].before
    return rows


def solved(rows: Sequence[Sequence[Scalar]], force: Sequence[Scalar]) -> list[Scalar]:
    """Solution of M a = force by M = L' D L, from the tips to the base, so that branches stay apart."""
    n = len(rows)
    left = [list(row) for row in rows]
    inverse: list[Scalar] = [0.0] * n
    share: list[list[Scalar]] = [[0.0] * n for _ in range(n)]
    z = list(force)
    for k in reversed(range(n)):
        inverse[k] = 1.0 / left[k][k] if isinstance(left[k][k], float) else reciprocal(left[k][k])
        for i in range(k):
            share[k][i] = times(inverse[k], left[k][i])
            z[i] = minus(z[i], times(share[k][i], z[k]))
            for j in range(i + 1):
                left[i][j] = minus(left[i][j], times(share[k][i], left[k][j]))
    out: list[Scalar] = []
    for k in range(n):
        value = times(inverse[k], z[k])
        for i in range(k):
            value = minus(value, times(share[k][i], out[i]))
        out.append(value)
    return out
