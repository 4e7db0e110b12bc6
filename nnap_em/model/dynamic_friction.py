"""Friction with one hidden state per joint: how the contact winds up is learned, and the static map is its limit."""

import math
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..effects.base import Candidate, JointEffect, Scalar, known

SHAPES = 5
"""Numbers of the learned stiffness curve: the degree of its Bernstein polynomial."""


class DynamicFriction(JointEffect):
    """C (l(v) sat(v / knee) - s) - damper on top of the learned map, with s' = v Phi(s sign(v) / l(v)) / distance.

    The state s is the torque of the contact over its Coulomb level C.  In steady sliding s = l(v) sign(v), and friction
    is the learned map; with C = 0, or a distance of 0, it is the map alone.  The level rises towards rest, and Phi
    falls from 1 where the contact unwinds to 0 where it slides:

        l(v) = 1 + rise exp(-(v / velocity)^2)
        Phi(p) = sum_i c_i B_i,n((1 + p) / 2),  c_0 = 1 >= c_1 >= ... >= c_n = 0
        damper = damping Phi v  while the contact winds up, else 0

    A Bernstein polynomial falls with its coefficients and reaches every falling curve [Lorentz 1986, "Bernstein
    Polynomials", sec. 1.7].  Dahl's model and LuGre's bristle have c_i = 1 - i / n, an elastic contact that yields has
    c_i = 1 up to the last but one [Dahl 1968; Canudas de Wit, Olsson, Astrom & Lischinsky 1995; Dupont, Hayward,
    Armstrong & Altpeter 2002].  A closed cycle of s takes the energy

        C distance  integral over s > 0 of  s (1 / Phi(s / l) - 1 / Phi(-s / l'))  >= 0,  and alike for s < 0,

    whatever the levels l and l' on both ways, since Phi falls; the damper takes more.  All is odd in v and s.
    """

    name: ClassVar[str] = "dynamic_friction"
    confirm: ClassVar[str] = "Push the joint at rest with a small torque and see whether it springs back."
    units: ClassVar[dict[str, str]] = {
        "coulomb": "N m",
        "breakaway": "N m",
        "stribeck_velocity": "rad/s",
        "stiffness": "N m/rad",
        "distance": "rad",
        "damping": "N m s/rad",
    }
    memory: ClassVar[int] = 1
    linear: ClassVar[bool] = False
    log_level: Scalar
    """Log of C [N m]."""
    log_distance: Scalar
    """Log of C over the stiffness of a contact that unwinds [rad]."""
    log_damping: Scalar
    """Log of the damping of a contact that unwinds [N m s/rad]."""
    log_rise: Scalar
    log_velocity: Scalar
    """[log rad/s]"""
    shape: Float[Array, " shape"]
    """Logits of the falls c_i - c_(i+1)."""
    knee: Scalar = known()
    """Rate up to which the learned map is a straight line [rad/s]: there the contact takes the place of the sign."""
    stiffest: Scalar = known()
    """Largest stiffness that the integrator bears [N m/rad]."""
    fastest: Scalar = known()
    """Largest relaxation rate that it bears [1/s]."""

    @classmethod
    def candidates(cls, around):
        """Dahl's contacts of every joint, from the travel within two samples after a reversal to a tenth of the range.

        The damper is a fifth of critical.
        """
        out = []
        masses = np.linalg.inv(np.asarray(around.system.mass(jnp.zeros(len(around.system.coordinates)))))
        distances = 4  # presliding distances from which a contact is tried
        # Prior standard deviations of the numbers of a contact, in their order
        numbers_std = (1.0, 2.0, 1.0, 1.5, 1.5, 1.5)
        for j in around.joints if around.learned else ():
            level, speed, inertia = around.dry[j - 1], around.speed[j - 1], 1 / masses[j - 1, j - 1]
            shortest = 2 * around.dt**2 * around.torque[j - 1] / inertia
            longest = max(0.1 * (around.high - around.low)[j - 1], 2 * shortest)
            places = {
                "knee": 0.01 * speed,
                "stiffest": inertia / around.dt**2,  # a radian of its own vibration in an integration step
                "fastest": 2 / around.dt,  # within the stability of Runge and Kutta's method, 2.78
                "joint": j,
            }
            spread = cls.of(*numbers_std[:-1], shape=jnp.full(SHAPES, numbers_std[-1]), **places)
            for distance in np.geomspace(shortest, longest, distances):
                damping = 0.4 * math.sqrt(level * inertia / distance)
                rise, stribeck = (
                    0.1,
                    0.05,
                )  # of the level towards rest, and the velocity over which it falls, over `speed`
                numbers = np.log([level, distance, damping, rise, stribeck * speed])
                faint = numbers + math.log(1e-5) * np.array([1, 0, 1, 0, 0])  # level and damping of none
                none, probe = (cls.of(*each, shape=jnp.zeros(SHAPES), **places) for each in (faint, numbers))
                out.append(Candidate(none, (probe,), spread))
        return out

    def beside(self, model):
        """The map is a straight line where the contact takes the place of the sign of the rate.

        A joint passes there within a sample or two at each reversal: a network would be free to have any peak.
        """
        network = model.unknown
        rest = jnp.zeros_like(network.scale) if network.rest is None else network.rest
        rest = rest.at[self.joint - 1].set(self.knee)
        return eqx.tree_at(lambda m: m.unknown.rest, model, rest, is_leaf=lambda leaf: leaf is None)

    def values(self):
        """Level, stiffness and damping at s = 0, and the distance over which that stiffness reaches the level."""
        level, start = jnp.exp(self.log_level), 0.5 * self._ahead(jnp.full_like(self.log_level, 0.5))
        return {
            "coulomb": level,
            "breakaway": level * (1 + jnp.exp(self.log_rise)),
            "stribeck_velocity": jnp.exp(self.log_velocity),
            "stiffness": level * start / self._distance(),
            "distance": self._distance() / start,
            "damping": jnp.exp(self.log_damping) * start,
        }

    def memory_scale(self):
        """Scale of the state's start, half a level, and of its noise."""
        return jnp.full(1, 5.0, self.log_level.dtype)

    def level(self, v: Scalar) -> Scalar:
        """Level l of steady sliding, over the Coulomb level."""
        return 1 + jnp.exp(self.log_rise - (v * jnp.exp(-self.log_velocity)) ** 2)

    def _distance(self) -> Scalar:
        """Distance over which the contact unwinds, no shorter than the integrator bears [rad]."""
        return jnp.exp(self.log_distance) + jnp.exp(self.log_level) / self.stiffest

    def _ahead(self, x: Scalar) -> Scalar:
        """Phi / (1 - x) at x = (1 + s sign(v) / l) / 2: 1 for Dahl's model."""
        n, falls = self.shape.shape[0], jax.nn.softmax(self.shape)
        c = jnp.asarray(np.triu(np.ones((n, n))), falls.dtype) @ falls
        return c @ jnp.stack([math.comb(n, i) * x**i * (1 - x) ** (n - 1 - i) for i in range(n)])

    def winding(self, s: Scalar, sign: Scalar, level: Scalar) -> Scalar:
        """Relaxation of the state towards the level, per angle [1/rad]."""
        x = jnp.clip(0.5 * (1 + s * sign / level), 0.0, 1.0)
        return 0.5 * self._ahead(x) / (level * self._distance())

    def drift(self, scene, memory):
        """Rate of the state [1/s]."""
        return self._slope(memory[0], self.own(scene.v))[None]

    def _slope(self, s: Scalar, v: Scalar) -> Scalar:
        sign, level = jnp.sign(v), self.level(v)
        relax = jnp.abs(v) * self.winding(s, sign, level)
        relax = relax / (1 + (relax / self.fastest) ** 4) ** 0.25
        return relax * (level * sign - s)

    def force(self, scene, memory):
        """Torque of the contact beyond that of steady sliding [N m]."""
        v, s = self.own(scene.v), memory[0]
        winds = jnp.maximum(self._slope(s, v) * jnp.sign(v), 0.0) * jnp.sign(v)
        damper = jnp.exp(self.log_damping) * self._distance() * winds
        return self.at(scene, jnp.exp(self.log_level) * (self.level(v) * self._line(v) - s) - damper)

    def sliding(self, v):
        """Below the knee the map is a straight line, and the state rests at the level of the rate."""
        rate = v[self.joint - 1]
        torque = jnp.exp(self.log_level) * self.level(rate) * (self._line(rate) - jnp.sign(rate))
        return jnp.zeros_like(v).at[self.joint - 1].set(torque)

    def _line(self, v: Scalar) -> Scalar:
        return jnp.clip(v / self.knee, -1.0, 1.0)


class Hysteresis(NamedTuple):
    """Torque of the contact over one closed cycle of its angle."""

    angle: Float[Array, " row"]
    """[rad]"""
    torque: Float[Array, " row"]
    """[N m]"""


def hysteresis(friction: DynamicFriction, amplitude: float, rows: int = 201) -> Hysteresis:
    """Slow cycle between -amplitude and amplitude [rad], after others from rest that wind the contact up."""
    half = jnp.linspace(-1.0, 1.0, rows // 2 + 1, dtype=friction.log_level.dtype)
    way = amplitude * jnp.concatenate([half, half[::-1][1:]])
    level = friction.level(jnp.zeros_like(friction.log_level))

    def step(s, move):
        sign = jnp.sign(move)
        return s - (level * sign - s) * jnp.expm1(-jnp.abs(move) * friction.winding(s, sign, level)), s

    def cycle(s, _):
        return jax.lax.scan(step, s, jnp.diff(way))

    start, _ = jax.lax.scan(step, jnp.zeros_like(level), 0.5 * jnp.diff(way[: rows // 2 + 1][::-1]))
    last, before = jax.lax.scan(cycle, start, None, length=10)
    return Hysteresis(way, -jnp.exp(friction.log_level) * jnp.append(before[-1], last))
