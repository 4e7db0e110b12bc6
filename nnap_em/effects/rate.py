# pyright: reportCallIssue=false, reportArgumentType=false
# (pyright takes equinox's abstract fields for fields of the constructor)
"""Forces of velocity, and friction that changes with position or time."""

import math
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp

from .base import AbstractEffect, Candidate, Scalar, a, at_joint
from .position import joints


class AirDrag(AbstractEffect):
    """-c |w| w at a joint, or the drag of a point at the tip (joint None)."""

    name: ClassVar[str] = "air_drag"
    confirm: ClassVar[str] = "Swing once with the tip shrouded, or once slow and once fast."
    units: ClassVar[dict[str, str]] = {"c": "N m s^2/rad^2"}
    c: Scalar
    joint: int | None = eqx.field(static=True)
    channel: str | None = eqx.field(static=True, default=None)

    @classmethod
    def candidates(cls, around):
        out = []
        for j in joints(around):
            size = float(around.torque[j - 1] / around.speed[j - 1] ** 2)
            out.append(Candidate(cls(a(0.0), j), (cls(a(0.1 * size), j),), cls(a(size), j)))
        if around.system.tip(jnp.zeros(len(around.system.coordinates))) is not None:
            size = float(around.torque[-1] / around.speed[-1] ** 2) * 100
            out.append(Candidate(cls(a(0.0), None), (cls(a(0.01 * size), None),), cls(a(size), None)))
        return out

    def possible(self):
        return float(self.c) > 0

    def force(self, scene, memory):
        if self.joint is not None:
            v = scene.v[self.joint - 1]
            return at_joint(self.joint, -self.c * jnp.abs(v) * v, scene)
        jac = jax.jacfwd(scene.system.tip)(scene.q)
        speed = jac @ scene.v
        return -self.c * jac.T @ (speed * jnp.sqrt(jnp.sum(speed**2) + 1e-12))


class BackEmf(AbstractEffect):
    """The motor's torque falls by b w; a learned friction map holds it."""

    name: ClassVar[str] = "motor_back_emf"
    confirm: ClassVar[str] = "Log the motor current beside the command."
    units: ClassVar[dict[str, str]] = {"b": "N m s/rad"}
    b: Scalar
    joint: int | None = eqx.field(static=True)
    channel: str | None = eqx.field(static=True, default=None)

    @classmethod
    def candidates(cls, around):
        out = []
        for j in around.system.joints:
            size = float(around.torque[j - 1] / around.speed[j - 1])
            out.append(Candidate(cls(a(0.0), j), (cls(a(0.1 * size), j),), cls(a(size), j)))
        return out

    def force(self, scene, memory):
        assert self.joint is not None
        return at_joint(self.joint, -self.b * scene.v[self.joint - 1], scene)


class PositionDependentFriction(AbstractEffect):
    """tau_f (1 + depth cos(n theta_j + phase))."""

    name: ClassVar[str] = "position_dependent_friction"
    confirm: ClassVar[str] = "Turn the joint slowly through its range and log the torque that it takes."
    units: ClassVar[dict[str, str]] = {"depth": "-", "n": "-", "phase": "rad"}
    cosine: Scalar
    sine: Scalar
    n: Scalar
    joint: int | None = eqx.field(static=True)
    channel: str | None = eqx.field(static=True, default=None)

    @classmethod
    def candidates(cls, around):
        out = []
        for j in joints(around):
            if not (around.system.angles[j - 1] and around.learned):
                continue
            for n in (1.0, 2.0, 3.0, 4.0, 5.0, 6.0):
                start, spread = cls(a(0.0), a(0.0), a(n), j), cls(a(1.0), a(1.0), a(0.3), j)
                probes = (cls(a(0.1), a(0.0), a(n), j), cls(a(0.0), a(0.1), a(n), j))
                out.append(Candidate(start, probes, spread))
        return out

    def values(self):
        depth = jnp.sqrt(self.sine**2 + self.cosine**2 + 1e-30)
        return {"depth": depth, "n": self.n, "phase": jnp.arctan2(-self.sine, self.cosine)}

    def friction(self, torque, scene):
        assert self.joint is not None
        angle = self.n * scene.q[self.joint - 1]
        factor = 1 + self.cosine * jnp.cos(angle) + self.sine * jnp.sin(angle)
        return torque.at[self.joint - 1].multiply(factor)


class FrictionDrift(AbstractEffect):
    """tau_f (1 + change (1 - exp(-t / tau)))."""

    name: ClassVar[str] = "friction_drift"
    confirm: ClassVar[str] = "Run the same motion cold and warm."
    units: ClassVar[dict[str, str]] = {"change": "-", "tau": "s"}
    change: Scalar
    pace: Scalar
    """Log of tau."""
    joint: int | None = eqx.field(static=True)
    channel: str | None = eqx.field(static=True, default=None)

    @classmethod
    def candidates(cls, around):
        if not around.learned:
            return []
        span = around.duration[1] - around.duration[0]
        out = []
        for j in joints(around):
            for share in (0.05, 0.15, 0.4, 1.0):
                pace = a(float(jnp.log(share * span)))
                out.append(Candidate(cls(a(0.0), pace, j), (cls(a(0.1), pace, j),), cls(a(1.0), a(1.0), j)))
        return out

    def values(self):
        return {"change": self.change, "tau": jnp.exp(self.pace)}

    def friction(self, torque, scene):
        assert self.joint is not None
        grown = 1 - jnp.exp(-scene.time * jnp.exp(-self.pace))
        return torque.at[self.joint - 1].multiply(1 + self.change * grown)


GRID = 64
"""The number of frequencies is a multiple of this, so that few programs serve all durations."""


class BaseVibration(AbstractEffect):
    """Horizontal base acceleration amplitude sin(2 pi frequency t + phase)."""

    name: ClassVar[str] = "base_vibration"
    confirm: ClassVar[str] = "Put an accelerometer on the base."
    units: ClassVar[dict[str, str]] = {"amplitude": "m/s^2", "frequency": "Hz", "phase": "rad"}
    sine: Scalar
    cosine: Scalar
    frequency: Scalar
    joint: int | None = eqx.field(static=True, default=None)
    channel: str | None = eqx.field(static=True, default=None)

    @classmethod
    def candidates(cls, around):
        if around.system.shake(jnp.zeros(len(around.system.coordinates))) is None:
            return []
        span = around.duration[1] - around.duration[0]
        count = GRID * math.ceil(min(8.0 * span / 0.4, 400) / GRID)
        step = 8.0 / count
        out = []
        for i in range(1, count + 1):
            start = cls(a(0.0), a(0.0), a(i * step))
            probes = (cls(a(0.1), a(0.0), a(i * step)), cls(a(0.0), a(0.1), a(i * step)))
            out.append(Candidate(start, probes, cls(a(5.0), a(5.0), a(0.3 / span))))
        return out

    def values(self):
        amplitude = jnp.sqrt(self.sine**2 + self.cosine**2 + 1e-30)
        return {"amplitude": amplitude, "frequency": self.frequency, "phase": jnp.arctan2(self.cosine, self.sine)}

    def force(self, scene, memory):
        turn = 2 * jnp.pi * self.frequency * scene.time
        shake = scene.system.shake(scene.q)
        assert shake is not None
        return shake * (self.sine * jnp.sin(turn) + self.cosine * jnp.cos(turn))
