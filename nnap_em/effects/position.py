# pyright: reportCallIssue=false, reportArgumentType=false
# (pyright takes equinox's abstract fields for fields of the constructor)
"""Forces that depend on the position: springs, tilt, cogging, stops, magnets of a brake."""

import itertools
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .base import AbstractEffect, Around, Candidate, Scalar, a, at_joint, known


def joints(around: Around) -> range:
    """Joints, counted from 1."""
    return range(1, len(around.system.coordinates) + 1)


class TorsionalSpring(AbstractEffect):
    """-k (theta_j - theta0), which may stiffen or soften with the angle.

    Inside a cubic in the angle, which is linear in what is estimated: k is its slope where it pulls to neither side.
    """

    name: ClassVar[str] = "torsional_spring"
    place: ClassVar[bool] = True
    confirm: ClassVar[str] = (
        "Move the unpowered joint by hand and look for a force that pulls back to one angle: a cable, a hose, a spring."
    )
    units: ClassVar[dict[str, str]] = {"k": "N m/rad", "theta0": "rad"}
    slope: Scalar
    """At zero [N m/rad]."""
    moment: Scalar
    """At zero [N m]."""
    square: Scalar
    """[N m/rad^2]"""
    cube: Scalar
    """[N m/rad^3]"""
    joint: int | None = eqx.field(static=True)
    channel: str | None = eqx.field(static=True, default=None)

    @classmethod
    def candidates(cls, around):
        out = []
        for j in joints(around):
            reach = max(abs(around.low[j - 1]), abs(around.high[j - 1]), 1e-3)
            size = float(around.torque[j - 1]) / reach
            none = a(0.0)
            start, probe = cls(none, none, none, none, j), cls(a(0.1 * size), none, none, none, j)
            bend = 0.3 * size / reach
            out.append(Candidate(start, (probe,), cls(a(size), a(size * reach), a(bend), a(bend / reach), j)))
        return out

    def values(self):
        at = self.moment / jnp.where(self.slope == 0, 1.0, self.slope)
        for _ in range(3):  # Newton's steps to where it pulls to neither side
            slope = self._slope(at)
            at = at + self._pull(at) / jnp.where(slope == 0, 1.0, slope)
        return {"k": self._slope(at), "theta0": at}

    def possible(self):
        return float(self.values()["k"]) > 0

    def _pull(self, angle):
        return self.moment - angle * (self.slope + angle * (self.square + angle * self.cube))

    def _slope(self, angle):
        return self.slope + angle * (2 * self.square + 3 * angle * self.cube)

    def force(self, scene, memory):
        assert self.joint is not None
        return at_joint(self.joint, self._pull(scene.q[self.joint - 1]), scene)


class BaseTilt(AbstractEffect):
    """Gravity acts on theta1 + angle."""

    name: ClassVar[str] = "base_tilt"
    confirm: ClassVar[str] = "Put a level on the base, and let the machine hang at rest: where does it read zero?"
    units: ClassVar[dict[str, str]] = {"angle": "rad"}
    angle: Scalar
    joint: int | None = eqx.field(static=True, default=None)
    channel: str | None = eqx.field(static=True, default=None)

    @classmethod
    def candidates(cls, around):
        if not hasattr(around.system, "g"):
            return []
        return [Candidate(cls(a(0.0)), (cls(a(0.03)),), cls(a(0.5)))]

    def force(self, scene, memory):
        tilted = scene.q.at[0].add(self.angle)
        return scene.system.bias(scene.q, scene.v) - scene.system.bias(tilted, scene.v)


class Cogging(AbstractEffect):
    """amplitude sin(k theta_j + phase), and an overtone of twice k: detents are seldom pure."""

    name: ClassVar[str] = "cogging"
    place: ClassVar[bool] = True
    confirm: ClassVar[str] = "Turn the joint slowly by hand and count the detents of a turn."
    units: ClassVar[dict[str, str]] = {"amplitude": "N m", "k": "-", "phase": "rad"}
    sine: Scalar
    cosine: Scalar
    k: Scalar
    joint: int | None = eqx.field(static=True)
    near: Scalar = known(default=1.0)
    """Where k was found; far from there it is another law in disguise."""
    sine2: Scalar = eqx.field(default=0.0, converter=a)
    cosine2: Scalar = eqx.field(default=0.0, converter=a)
    channel: str | None = eqx.field(static=True, default=None)

    @classmethod
    def candidates(cls, around):
        out = []
        for j in joints(around):
            if not around.system.angles[j - 1]:
                continue
            size = float(around.torque[j - 1])
            for k in (*np.arange(1.0, 8.1, 0.5), *range(9, 13), 14, 16, 18, 20, 24):
                make = lambda sine, cosine, k=float(k), j=j: cls(a(sine), a(cosine), a(k), j, k)  # noqa: E731
                spread = cls(a(0.5 * size), a(0.5 * size), a(0.1), j, float(k), 0.1 * size, 0.1 * size)
                out.append(Candidate(make(0.0, 0.0), (make(0.05 * size, 0.0), make(0.0, 0.05 * size)), spread))
        return out

    def values(self):
        amplitude = jnp.sqrt(self.sine**2 + self.cosine**2 + 1e-30)
        return {"amplitude": amplitude, "k": self.k, "phase": jnp.arctan2(self.cosine, self.sine)}

    def possible(self):
        return float(self.k) > 0.7 and abs(float(self.k) - float(self.near)) < 0.3

    def force(self, scene, memory):
        assert self.joint is not None
        angle = self.k * scene.q[self.joint - 1]
        tone = self.sine * jnp.sin(angle) + self.cosine * jnp.cos(angle)
        tone = tone + self.sine2 * jnp.sin(2 * angle) + self.cosine2 * jnp.cos(2 * angle)
        return at_joint(self.joint, tone, scene)


class TorqueOffset(AbstractEffect):
    """A constant torque; a learned friction map holds it."""

    name: ClassVar[str] = "torque_offset"
    confirm: ClassVar[str] = "Let the unpowered joint settle from both sides and compare."
    units: ClassVar[dict[str, str]] = {"value": "N m"}
    value: Scalar
    joint: int | None = eqx.field(static=True)
    channel: str | None = eqx.field(static=True, default=None)

    @classmethod
    def candidates(cls, around):
        size = [float(t) for t in around.torque]
        return [
            Candidate(cls(a(0.0), j), (cls(a(0.05 * size[j - 1]), j),), cls(a(0.5 * size[j - 1]), j))
            for j in joints(around)
        ]

    def force(self, scene, memory):
        return at_joint(self.joint, self.value, scene)


class HardStop(AbstractEffect):
    """Contact with stops, as a spring and a damper of a stiffness that the sampling can follow."""

    name: ClassVar[str] = "hard_stop"
    place: ClassVar[bool] = True
    confirm: ClassVar[str] = "Move the joint slowly to its ends and note the angles."
    units: ClassVar[dict[str, str]] = {"upper": "rad", "lower": "rad"}
    substeps: ClassVar[int] = 4
    linear: ClassVar[bool] = False
    upper: Scalar
    lower: Scalar
    stiffness: Scalar
    """Log of the contact stiffness [N m/rad]."""
    damping: Scalar
    """Log of the contact damping [N m s/rad]."""
    joint: int | None = eqx.field(static=True)
    reach: Scalar = known()
    """Range of the joint on the paths; stops that nearly touch each other are a spring in disguise."""
    soft: Scalar = known()
    """Log of the stiffness [N m/rad] at which a typical torque goes half a radian into a stop, which is none then."""
    channel: str | None = eqx.field(static=True, default=None)

    @classmethod
    def candidates(cls, around):
        out = []
        for j in joints(around):
            low, high = float(around.low[j - 1]), float(around.high[j - 1])
            k, size = 20 * float(around.torque[j - 1]), 0.5 * (high - low)
            middle = 0.5 * (low + high)
            fixed = (j, 2 * size, np.log(0.1 * k))
            spread = cls(a(0.2 * size), a(0.2 * size), a(1.0), a(1.0), *fixed)
            start = cls(a(1e3), a(-1e3), a(np.log(k)), a(np.log(0.02 * k)), *fixed)
            shares = (0.4, 0.55, 0.7, 0.85, 0.95, 1.1)
            for above, below in itertools.product(shares, shares):
                up, down = middle + above * size, middle - below * size
                probe = cls(a(up), a(down), a(np.log(k)), a(np.log(0.02 * k)), *fixed)
                out.append(Candidate(start, (probe,), spread))
        return out

    def possible(self):
        apart = float(self.upper - self.lower) > 0.3 * float(self.reach)
        return apart and float(self.stiffness) > float(self.soft)

    def force(self, scene, memory):
        assert self.joint is not None
        q, v = scene.q[self.joint - 1], scene.v[self.joint - 1]
        above, below = jnp.maximum(q - self.upper, 0.0), jnp.maximum(self.lower - q, 0.0)
        touch = jnp.tanh((above + below) / 0.01)
        push = jnp.exp(self.stiffness) * (below - above) - jnp.exp(self.damping) * touch * v
        return at_joint(self.joint, push, scene)


class EddyBrake(AbstractEffect):
    """-c cos^2(theta_j - center) w_j."""

    name: ClassVar[str] = "eddy_brake"
    confirm: ClassVar[str] = "Let the joint coast through a turn at one speed and look where it slows."
    units: ClassVar[dict[str, str]] = {"c": "N m s/rad", "center": "rad"}
    even: Scalar
    """c cos(2 center)."""
    odd: Scalar
    """c sin(2 center)."""
    joint: int | None = eqx.field(static=True)
    channel: str | None = eqx.field(static=True, default=None)

    @classmethod
    def candidates(cls, around):
        out = []
        for j in joints(around):
            if not around.system.angles[j - 1]:
                continue
            size = float(around.torque[j - 1] / around.speed[j - 1])
            probes = (cls(a(0.1 * size), a(0.0), j), cls(a(0.0), a(0.1 * size), j))
            out.append(Candidate(cls(a(0.0), a(0.0), j), probes, cls(a(size), a(size), j)))
        return out

    def values(self):
        c = jnp.sqrt(self.even**2 + self.odd**2 + 1e-30)
        return {"c": c, "center": 0.5 * jnp.arctan2(self.odd, self.even)}

    def force(self, scene, memory):
        assert self.joint is not None
        twice = 2 * scene.q[self.joint - 1]
        level = jnp.sqrt(self.even**2 + self.odd**2 + 1e-16)
        share = 0.5 * (level + self.even * jnp.cos(twice) + self.odd * jnp.sin(twice))
        return at_joint(self.joint, -share * scene.v[self.joint - 1], scene)
