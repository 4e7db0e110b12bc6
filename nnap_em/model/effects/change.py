"""Numbers that moved since a fit: friction of a joint, an estimated number of the machine.

Where friction and numbers are learned from the same logs these are no candidates: the fit holds them.
"""

from functools import partial
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp

from .base import AbstractEffect, JointEffect, Scalar, a, known, one

PROBED, PRIOR_STD = 0.05, 0.5
"""Torque of a probe, and standard deviation of a change, in the typical torque of the joint."""


class CoulombChange(JointEffect):
    """Coulomb friction of a joint differs from that of the fit: -change sign(w)."""

    meaning: ClassVar[str] = "Coulomb friction is not what it was when the machine was fitted."
    confirm: ClassVar[str] = "Turn the joint slowly both ways and log the torques that it takes."
    units: ClassVar[dict[str, str]] = {"change": "N m"}
    arguments: ClassVar[tuple[str, ...]] = ("rate",)
    change: Scalar
    knee: Scalar = known()
    """Rate over which the sign is smoothed [rad/s]."""

    @classmethod
    def candidates(cls, around):
        learned = around.joints if around.moved is not None and around.learned else ()
        # Rate over which Coulomb friction changes its sign, in the largest rate of the joint: as `Weights` has it
        sizes = [(j, 0.01 * float(around.speed[j - 1]), float(around.torque[j - 1])) for j in learned]
        return [one(partial(cls, knee=a(k), joint=j), 0.0, PROBED * n, PRIOR_STD * n) for j, k, n in sizes]

    def phrase(self, sizes):
        return f"the Coulomb friction of joint {self.joint} by {sizes['change']}"

    def force(self, scene, memory):
        return self.at(scene, -self.change * jnp.tanh(self.own(scene.v) / self.knee))


class ViscousChange(JointEffect):
    """Viscous friction of a joint differs from that of the fit: -change w."""

    meaning: ClassVar[str] = "Viscous friction is not what it was when the machine was fitted."
    confirm: ClassVar[str] = "Turn the joint at two speeds and log the torques that it takes."
    units: ClassVar[dict[str, str]] = {"change": "N m s/rad"}
    arguments: ClassVar[tuple[str, ...]] = ("rate",)
    change: Scalar

    @classmethod
    def candidates(cls, around):
        slopes = zip(around.joints, map(float, around.torque / around.speed), strict=True)
        learned = around.moved is not None and around.learned
        return [one(partial(cls, joint=j), 0.0, PROBED * slope, PRIOR_STD * slope) for j, slope in slopes if learned]

    def phrase(self, sizes):
        return f"the viscous friction of joint {self.joint} by {sizes['change']}"

    def force(self, scene, memory):
        return self.at(scene, -self.change * self.own(scene.v))


class NumberChange(AbstractEffect):
    """An estimated number of the machine differs from that of the fit."""

    name: ClassVar[str] = "change"
    meaning: ClassVar[str] = "A number of the machine is not what it was when the machine was fitted."
    confirm: ClassVar[str] = "Measure it."
    units: ClassVar[dict[str, str]] = {"change": "unit of the number"}
    change: Scalar
    number: str = eqx.field(static=True)
    unit: str = eqx.field(static=True)

    @classmethod
    def candidates(cls, around):
        numbers = around.moved or ()
        return [one(partial(cls, number=name, unit=unit), 0.0, PROBED * size, size) for name, unit, size in numbers]

    def inputs_named(self):
        return (self.number,)

    def phrase(self, sizes):
        return f"{self.number} by {sizes['change']}"

    def units_on(self, system):
        return {"change": self.unit}

    def physics(self, system, time):
        return system.with_parameters({self.number: system.parameter(self.number) + self.change})
