"""Friction with memory: the contact winds up before it slides."""

from typing import ClassVar

import jax.numpy as jnp
import numpy as np

from .base import Candidate, JointEffect, Scalar, known


class PreslidingFriction(JointEffect):
    """The LuGre bristle: s' = -sigma0 (w + |w| s / g(w)), friction s + sigma1 s' / sigma0 - b w.

    In steady sliding that is the learned map: g is what the map holds beyond its viscous part.
    [Canudas de Wit, Olsson, Astrom & Lischinsky 1995, eqs. 1 to 3, written in the bristle's torque s]
    """

    name: ClassVar[str] = "presliding_friction"
    meaning: ClassVar[str] = "Friction with memory: before it slides, the joint gives like a spring."
    confirm: ClassVar[str] = "Push the joint at rest with a small torque and see whether it springs back."
    units: ClassVar[dict[str, str]] = {"sigma0": "N m/rad"}
    words: ClassVar[dict[str, str]] = {"sigma0": "stiffness"}
    memory: ClassVar[int] = 1
    linear: ClassVar[bool] = False
    log_sigma: Scalar
    damping: Scalar
    """sigma1 [N m s/rad]."""
    viscous: Scalar
    """b [N m s/rad]."""
    knee: Scalar = known()
    """Speed [rad/s] below which the map is read at this speed: it is smooth near rest, the bristle is not."""
    size: Scalar = known()
    fastest: Scalar = known()
    """Largest relaxation rate that the integrator bears [1/s]."""

    @classmethod
    def candidates(cls, around):
        if not around.learned:
            return []
        out = []
        for j in around.joints:
            size, speed, b = (float(values[j - 1]) for values in (around.torque, around.speed, around.viscous))
            fixed = (0.02 * speed, size, 2.0 / around.dt)
            for s in (0.5, 2.0, 8.0, 32.0):
                inner = 0.4 * np.sqrt(s * size * around.inertia(j))  # a fifth of critical
                stiff, soft = (cls.of(np.log(k * size), inner, b, *fixed, joint=j) for k in (1e4, s))
                spread = cls.of(1.0, inner, 0.5 * b + 0.01 * size / speed, *fixed, joint=j)
                out.append(Candidate(stiff, (soft,), spread))
        return out

    def values(self):
        return {"sigma0": jnp.exp(self.log_sigma)}

    def memory_scale(self):
        return 0.1 * self.size[None]

    def _level(self, scene):
        v = self.own(scene.v)
        fast = jnp.sign(v) * jnp.sqrt(v**2 + self.knee**2)
        away = scene.v.at[self.joint - 1].set(jnp.where(v == 0, self.knee, fast))
        total = jnp.abs(0.5 * self.own(scene.map(away) - scene.map(-away)))
        return jnp.maximum(total - self.viscous * jnp.abs(fast), 0.1 * total) + 1e-9

    def force(self, scene, memory):
        torque = memory[0] + self.damping * jnp.exp(-self.log_sigma) * self.drift(scene, memory)[0]
        return self.at(scene, torque - self.viscous * self.own(scene.v) - self.own(scene.friction))

    def drift(self, scene, memory):
        v, level = self.own(scene.v), self._level(scene)
        relax = jnp.minimum(jnp.exp(self.log_sigma) * jnp.abs(v) / level, self.fastest)
        return jnp.stack([-jnp.sign(v) * relax * level - relax * memory[0]])
