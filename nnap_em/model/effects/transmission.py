"""Compliance and backlash between a motor and its joint."""

from abc import abstractmethod
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .base import Candidate, JointEffect, Scalar


class Transmission(JointEffect):
    """A motor of small inertia that drives its joint through something soft or loose; u acts on the motor."""

    memory: ClassVar[int] = 2
    linear: ClassVar[bool] = False
    log_inertia: eqx.AbstractVar[Scalar]
    log_damping: eqx.AbstractVar[Scalar]
    """Inertia of the motor [log kg m^2] and damping [log N m s/rad]."""

    @abstractmethod
    def torque(self, twist: Scalar, rate: Scalar) -> Scalar:
        """Torque on the joint, at a twist of motor minus joint [rad] and its rate [rad/s]."""

    def memory_scale(self):
        return jnp.asarray([0.05, 1.0])

    def _torque(self, scene, memory):
        twist, speed = memory
        return self.torque(twist, speed - self.own(scene.v))

    def force(self, scene, memory):
        return self.at(scene, self._torque(scene, memory) - self.own(scene.drive))

    def drift(self, scene, memory):
        push = self.own(scene.drive) - self._torque(scene, memory)
        return jnp.stack([memory[1] - self.own(scene.v), push * jnp.exp(-self.log_inertia)])


MOTOR = 0.05
"""A motor's inertia to begin with, over that of its joint."""


class JointFlexibility(Transmission):
    """An elastic transmission of stiffness k."""

    meaning: ClassVar[str] = "The transmission between motor and joint gives elastically."
    confirm: ClassVar[str] = "Block the link and twist the motor: the angle per torque."
    units: ClassVar[dict[str, str]] = {"k": "N m/rad"}
    words: ClassVar[dict[str, str]] = {"k": "stiffness"}
    substeps: ClassVar[int] = 5
    log_k: Scalar
    log_inertia: Scalar
    log_damping: Scalar

    @classmethod
    def candidates(cls, around):
        out = []
        for j, size in around.driven:
            inertia = MOTOR * around.inertia(j)
            for k in (2.0, 6.0, 20.0):
                springs = (s * size for s in (1e3, k))
                stiff, soft = (cls.of(*np.log([s, inertia, 0.2 * np.sqrt(s * inertia)]), joint=j) for s in springs)
                out.append(Candidate(stiff, (soft,), cls.of(1.0, 0.7, 1.0, joint=j)))
        return out

    def values(self):
        return {"k": jnp.exp(self.log_k)}

    def torque(self, twist, rate):
        return jnp.exp(self.log_k) * twist + jnp.exp(self.log_damping) * rate


class Backlash(Transmission):
    """Play of width gap, with a stiff contact at either side."""

    meaning: ClassVar[str] = "Play between motor and joint."
    confirm: ClassVar[str] = "Block the motor and wiggle the link."
    units: ClassVar[dict[str, str]] = {"gap": "rad"}
    words: ClassVar[dict[str, str]] = {"gap": "play"}
    above_zero: ClassVar[str] = "gap"
    substeps: ClassVar[int] = 10
    gap: Scalar
    log_inertia: Scalar
    log_damping: Scalar
    log_k: Scalar
    """Contact stiffness [log N m/rad]."""

    @classmethod
    def candidates(cls, around):
        out = []
        for j, size in around.driven:
            inertia, k = MOTOR * around.inertia(j), 50 * size
            numbers = np.log([inertia, 0.5 * np.sqrt(k * inertia), k])
            none, *loose = (cls.of(gap, *numbers, joint=j) for gap in (0.0, 0.03, 0.1, 0.25))
            out += [Candidate(none, (play,), cls.of(0.1, 0.7, 1.0, 0.7, joint=j)) for play in loose]
        return out

    def torque(self, twist, rate):
        half = 0.5 * jnp.maximum(self.gap, 0.0)
        deep = twist - jnp.clip(twist, -half, half)
        # the damper comes on within 0.001 rad, so that a fit can move the gap; a contact never pulls
        push = jnp.exp(self.log_k) * deep + jnp.exp(self.log_damping) * jnp.tanh(jnp.abs(deep) / 1e-3) * rate
        return jnp.where(deep > 0, jnp.maximum(push, 0.0), jnp.minimum(push, 0.0))
