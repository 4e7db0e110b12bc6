"""Forces that depend on the position: springs, cogging, stops, magnets of a brake."""

import itertools
from functools import partial
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .base import Candidate, JointEffect, Scalar, a, known, one, pair


class TorsionalSpring(JointEffect):
    """-k (theta_j - theta0), which may stiffen or soften with the angle.

    Inside a cubic in the angle, which is linear in what is estimated: k is its slope where it pulls to neither side.
    """

    meaning: ClassVar[str] = "A joint is pulled back to a rest position, as by a cable or a spring."
    confirm: ClassVar[str] = "Move the unpowered joint by hand: does a cable, hose or spring pull back to one angle?"
    units: ClassVar[dict[str, str]] = {"k": "N m/rad", "theta0": "rad"}
    words: ClassVar[dict[str, str]] = {"k": "stiffness", "theta0": "rest position"}
    arguments: ClassVar[tuple[str, ...]] = ("position",)
    slope: Scalar
    moment: Scalar
    """Stiffness [N m/rad] and torque [N m] at zero."""
    square: Scalar
    cube: Scalar
    """[N m/rad^2] and [N m/rad^3]."""
    reach: Scalar = known(default=1e3)
    """Angle [rad] beyond which it was never seen: from there on it is straight, and never pushes outward more."""

    @classmethod
    def candidates(cls, around):
        out = []
        for j in around.joints:
            reach = max(abs(around.low[j - 1]), abs(around.high[j - 1]), 1e-3)
            size = float(around.torque[j - 1]) / reach
            make = lambda *numbers, j=j, reach=reach: cls.of(*numbers, 1.2 * reach, joint=j)  # noqa: E731
            bend = 0.3 * size / reach
            spread = make(size, size * reach, bend, bend / reach)
            # its moment at zero too: where friction may not be even, nothing else would hold a rest that is far off
            probes = make(0.1 * size, 0.0, 0.0, 0.0), make(0.0, 0.1 * size * reach, 0.0, 0.0)
            out.append(Candidate(make(0.0, 0.0, 0.0, 0.0), probes, spread))
        return out

    def values(self):
        at = self.moment / jnp.where(self.slope == 0, 1.0, self.slope)
        for _ in range(3):  # Newton's steps to where it pulls to neither side
            slope = self._slope(at)
            at = at + self._pull(at) / jnp.where(slope == 0, 1.0, slope)
        return {"k": self._slope(at), "theta0": at}

    def is_physical(self):
        return float(self.values()["k"]) > 0

    def _pull(self, angle):
        return self.moment - angle * (self.slope + angle * (self.square + angle * self.cube))

    def _slope(self, angle):
        return self.slope + angle * (2 * self.square + 3 * angle * self.cube)

    def force(self, scene, memory):
        angle = self.own(scene.q)
        inside = jnp.clip(angle, -self.reach, self.reach)
        return self.at(scene, self._pull(inside) - jnp.maximum(self._slope(inside), 0.0) * (angle - inside))


class Cogging(JointEffect):
    """amplitude sin(k theta_j + phase), and an overtone of twice k: detents are seldom pure."""

    meaning: ClassVar[str] = "A torque that repeats with the angle, as from magnets or gear teeth."
    confirm: ClassVar[str] = "Turn the joint slowly by hand and count the detents of a turn."
    units: ClassVar[dict[str, str]] = {"amplitude": "N m", "k": "-", "phase": "rad"}
    words: ClassVar[dict[str, str]] = {"amplitude": "amplitude", "k": "periods per turn", "phase": "phase"}
    arguments: ClassVar[tuple[str, ...]] = ("position",)
    sine: Scalar
    cosine: Scalar
    k: Scalar
    near: Scalar = known(default=1.0)
    """Value of k at which it was found; far from it the law is a different one."""
    sine2: Scalar = eqx.field(default=0.0, converter=a)
    cosine2: Scalar = eqx.field(default=0.0, converter=a)

    @classmethod
    def candidates(cls, around):
        out = []
        for j in around.turning:
            size = float(around.torque[j - 1])
            for k in (*np.arange(1.0, 8.1, 0.5), 9.0, 10.0, 11.0, 12.0, 14.0, 16.0, 18.0, 20.0, 24.0):
                none, *probes = (cls.of(s * size, c * size, k, k, joint=j) for s, c in ((0, 0), (0.05, 0), (0, 0.05)))
                spread = cls.of(0.5 * size, 0.5 * size, 0.1, k, 0.1 * size, 0.1 * size, joint=j)
                out.append(Candidate(none, tuple(probes), spread))
        return out

    def values(self):
        amplitude = jnp.sqrt(self.sine**2 + self.cosine**2 + 1e-30)
        return {"amplitude": amplitude, "k": self.k, "phase": jnp.arctan2(self.cosine, self.sine)}

    def is_physical(self):
        return float(self.k) > 0.7 and abs(float(self.k) - float(self.near)) < 0.3

    def visible(self, around):
        return self.repeats(self.near, around)

    def force(self, scene, memory):
        angle = self.k * self.own(scene.q)
        tone = self.sine * jnp.sin(angle) + self.cosine * jnp.cos(angle)
        tone = tone + self.sine2 * jnp.sin(2 * angle) + self.cosine2 * jnp.cos(2 * angle)
        return self.at(scene, tone)


class TorqueOffset(JointEffect):
    """A constant torque; a learned friction map holds it."""

    meaning: ClassVar[str] = "A constant torque at a joint."
    confirm: ClassVar[str] = "Let the unpowered joint settle from both sides and compare."
    units: ClassVar[dict[str, str]] = {"value": "N m"}
    words: ClassVar[dict[str, str]] = {"value": "torque"}
    value: Scalar

    @classmethod
    def candidates(cls, around):
        sizes = zip(around.joints, map(float, around.torque), strict=True)
        return [one(partial(cls, joint=j), 0.0, 0.05 * size, 0.5 * size) for j, size in sizes]

    def force(self, scene, memory):
        return self.at(scene, self.value)


class HardStop(JointEffect):
    """Contact with stops, as a spring and a damper of a stiffness that the sampling can follow."""

    meaning: ClassVar[str] = "A joint meets a stop."
    confirm: ClassVar[str] = "Move the joint slowly to its ends and note the angles."
    units: ClassVar[dict[str, str]] = {"upper": "rad", "lower": "rad"}
    words: ClassVar[dict[str, str]] = {"upper": "upper stop", "lower": "lower stop"}
    arguments: ClassVar[tuple[str, ...]] = ("position",)
    substeps: ClassVar[int] = 4
    linear: ClassVar[bool] = False
    upper: Scalar
    lower: Scalar
    stiffness: Scalar
    damping: Scalar
    """Logs of the stiffness [N m/rad] and of the damping [N m s/rad] of the contact."""
    reach: Scalar = known()
    """Range of the joint on the paths; stops that nearly touch each other are a spring in disguise."""
    soft: Scalar = known()
    """Log of the stiffness [N m/rad] at which a typical torque goes half a radian into a stop, which is none then."""

    @classmethod
    def candidates(cls, around):
        out = []
        for j in around.joints:
            low, high = float(around.low[j - 1]), float(around.high[j - 1])
            k, size = 20 * float(around.torque[j - 1]), 0.5 * (high - low)
            middle = 0.5 * (low + high)
            make, numbers = partial(cls.of, joint=j), (np.log(k), np.log(0.02 * k), 2 * size, np.log(0.1 * k))
            start, spread = make(1e3, -1e3, *numbers), make(0.2 * size, 0.2 * size, 1.0, 1.0, *numbers[2:])
            shares = (0.4, 0.55, 0.7, 0.85, 0.95, 1.1)
            for above, below in itertools.product(shares, shares):
                up, down = middle + above * size, middle - below * size
                out.append(Candidate(start, (make(up, down, *numbers),), spread))
        return out

    def is_physical(self):
        separate = float(self.upper - self.lower) > 0.3 * float(self.reach)
        return separate and float(self.stiffness) > float(self.soft)

    def force(self, scene, memory):
        q, v = self.own(scene.q), self.own(scene.v)
        # the damper holds back too while the joint leaves: one that lets go has no slope there, and a fit is lost
        deep = jnp.maximum(q - self.upper, 0.0) - jnp.maximum(self.lower - q, 0.0)
        touch = jnp.tanh(jnp.abs(deep) / 0.01)
        return self.at(scene, -jnp.exp(self.stiffness) * deep - jnp.exp(self.damping) * touch * v)


class EddyBrake(JointEffect):
    """-c cos^2(theta_j - center) w_j."""

    meaning: ClassVar[str] = "A brake that works at some angles, as by a magnet."
    confirm: ClassVar[str] = "Let the joint coast through a turn at one speed and look where it slows."
    units: ClassVar[dict[str, str]] = {"c": "N m s/rad", "center": "rad"}
    words: ClassVar[dict[str, str]] = {"c": "largest damping", "center": "strongest at"}
    arguments: ClassVar[tuple[str, ...]] = ("position", "rate")
    even: Scalar
    odd: Scalar
    """c cos(2 center) and c sin(2 center)."""

    @classmethod
    def candidates(cls, around):
        sizes = ((j, float(around.torque[j - 1] / around.speed[j - 1])) for j in around.turning)
        return [pair(partial(cls.of, joint=j), 0.1 * size, size) for j, size in sizes]

    def values(self):
        c = jnp.sqrt(self.even**2 + self.odd**2 + 1e-30)
        return {"c": c, "center": 0.5 * jnp.arctan2(self.odd, self.even)}

    def force(self, scene, memory):
        twice = 2 * self.own(scene.q)
        level = jnp.sqrt(self.even**2 + self.odd**2 + 1e-16)
        share = 0.5 * (level + self.even * jnp.cos(twice) + self.odd * jnp.sin(twice))
        return self.at(scene, -share * self.own(scene.v))
