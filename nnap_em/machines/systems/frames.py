"""Every joint of a machine as a frame whose third axis is that of the joint: what the recursions walk along."""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from ..machine import Vector, unpacked
from .spatial import Three, Turn


class Frame(NamedTuple):
    """The frame of a joint in that of the joint before it, at coordinate zero: its z is the axis of the joint."""

    before: int  # The joint that carries it; -1: the base
    place: Three  # [m]
    turn: Turn
    slide: bool


class Mount(NamedTuple):
    """Place of a body: the joint whose frame carries it, and its own frame in there."""

    joint: int  # -1: the base
    place: Three
    turn: Turn


class Layout(NamedTuple):
    """Structure of a machine."""

    frames: tuple[Frame, ...]  # Frames of every joint
    mounts: tuple[Mount, ...]  # Mounts of every body


@lru_cache(maxsize=64)
def laid(text: str) -> Layout:
    """The layout of a machine in a text of `packed`."""
    machine = unpacked(text)
    frames: list[Frame] = []
    mounts: list[tuple[int, np.ndarray, np.ndarray]] = []
    for i, body in enumerate(machine.bodies):
        at, place, turn = mounts[body.parent] if body.parent >= 0 else (-1, np.zeros(3), np.eye(3))
        place, turn = place + turn @ np.asarray(body.place), turn @ np.asarray(body.turn)
        for j, joint in enumerate(machine.joints):
            if joint.body == i:
                lined = turn @ aligned(joint.axis)
                anchor = place + turn @ np.asarray(joint.anchor)
                frames.append(Frame(at, _three(anchor), _turn(lined), joint.slide))
                at, turn = j, aligned(joint.axis).T
                place = -turn @ np.asarray(joint.anchor)
        mounts.append((at, place, turn))
    return Layout(tuple(frames), tuple(Mount(at, _three(place), _turn(turn)) for at, place, turn in mounts))


def aligned(axis: Vector) -> np.ndarray:
    """A rotation that takes z to `axis`; a mere exchange of axes where that is one of them."""
    along = np.asarray(axis, float)
    first = np.roll(np.eye(3)[int(np.argmax(np.abs(along)))], 1)
    second = np.cross(along, first)
    second = second / np.linalg.norm(second)
    return np.stack([np.cross(second, along), second, along], axis=1)


def _clean(value: float) -> float:
    nearest = float(round(value))
    rounding = 1e-14  # entries of a rotation nearer than this to 0 or 1 are 0 or 1: rounding of a quaternion
    return nearest + 0.0 if math.isclose(value, nearest, abs_tol=rounding, rel_tol=0.0) else float(value)


def _three(values: np.ndarray) -> Three:
    x, y, z = (float(value) + 0.0 for value in values)
    return x, y, z


def _turn(values: np.ndarray) -> Turn:
    x, y, z = (tuple(map(_clean, row)) for row in values)
    return x, y, z  # pyrefly: ignore[bad-return]  (three rows of three)
