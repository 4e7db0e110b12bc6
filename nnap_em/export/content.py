"""The content of a written MJCF file as plain numbers: joints, drives, sensors, before it becomes XML."""

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

from ..data.machine import Vector
from ..systems.tree import Tree
from .friction import FrictionForm

Polynomial = tuple[float, float, float, float]
"""Coefficients of a cubic, the constant first."""
Tone = tuple[float, float, float]
"""A torque amplitude sin(k q + phase): amplitude [N m or N], k [1 or 1/m], phase [rad]."""


class Bristle(NamedTuple):
    """A LuGre bristle; its steady friction is that of the joint's form."""

    stiffness: float
    """[N m/rad or N/m]"""
    damping: float
    """[N m s/rad or N s/m]"""


class Contact(NamedTuple):
    """A spring and a damper that push back beyond either end, and never pull."""

    low: float
    high: float
    stiffness: float
    """[N m/rad or N/m]"""
    damping: float
    """[N m s/rad or N s/m]"""


class Rotor(NamedTuple):
    """A motor of its own inertia, joined to its joint by a spring and damper, or by contacts about a play."""

    inertia: float
    """[kg m^2 or kg]"""
    stiffness: float = 0.0
    """[N m/rad or N/m]"""
    damping: float = 0.0
    """[N m s/rad or N s/m]"""
    play: Contact | None = None


class JointContent(NamedTuple):
    """Forces at one joint."""

    pull: Polynomial = (0.0, 0.0, 0.0, 0.0)
    """Force of springs as a cubic of the coordinate [N m or N]."""
    drag: float = 0.0
    """Friction by v |v| [N m s^2/rad^2 or N s^2/m^2]."""
    viscous: float = 0.0
    """Viscous friction beside that of the form [N m s/rad or N s/m]."""
    form: FrictionForm = FrictionForm()
    bristle: Bristle | None = None
    tones: tuple[Tone, ...] = ()
    stop: Contact | None = None
    rotor: Rotor | None = None


class Drive(NamedTuple):
    """The way from a command to a torque: limit, delay, lag, gain, limit, in this order."""

    before: float = math.inf
    """Limit of the command, in its unit."""
    delay: float = 0.0
    """[s]"""
    lag: float = 0.0
    """Time constant [s]."""
    gain: float = 1.0
    after: float = math.inf
    """Limit of the output of the gain, in the unit of the command."""


class SensorContent(NamedTuple):
    """One reading."""

    delay: float = 0.0
    """[s]"""
    noise: float = 0.0
    """Standard deviation, in the unit of the reading."""


class Content(NamedTuple):
    """All of a file that laws may change."""

    system: Tree
    """The machine with its estimated numbers, as it is at the first moment of the clock."""
    gravity: Vector
    """[m/s^2]"""
    dt: float
    """Sample interval of the fit [s]."""
    joints: tuple[JointContent, ...]
    drives: Mapping[int, Drive] = MappingProxyType({})
    """Drives by joint, counted from 1."""
    sensors: Mapping[str, SensorContent] = MappingProxyType({})
    """Sensors by measured column."""

    def joint(self, number: int) -> JointContent:
        """Joint by its number, counted from 1."""
        return self.joints[number - 1]

    def with_joint(self, number: int, **changes) -> "Content":
        """The content with one joint changed."""
        joints = list(self.joints)
        joints[number - 1] = joints[number - 1]._replace(**changes)
        return self._replace(joints=tuple(joints))

    def with_drive(self, joint: int, **changes) -> "Content":
        """The content with the drive of one joint changed."""
        return self._replace(drives={**self.drives, joint: self.drives[joint]._replace(**changes)})

    def with_sensors(self, channel: str | None, **changes) -> "Content":
        """The content with one sensor changed, or all."""
        return self._replace(
            sensors={
                name: sensor._replace(**changes) if channel in (name, "all") else sensor
                for name, sensor in self.sensors.items()
            }
        )


def added(polynomial: Polynomial, other: Polynomial) -> Polynomial:
    """Sum of two cubics."""
    a, b, c, d = (x + y for x, y in zip(polynomial, other, strict=True))
    return a, b, c, d


def spring(stiffness: float, rest: float) -> Polynomial:
    """Pull of a linear spring."""
    return stiffness * rest, -stiffness, 0.0, 0.0
