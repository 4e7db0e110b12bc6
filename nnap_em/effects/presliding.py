# pyright: reportCallIssue=false, reportArgumentType=false
# (pyright takes equinox's abstract fields for fields of the constructor)
"""Friction with memory: the contact winds up before it slides."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .base import AbstractEffect, Candidate, Scalar, a, at_joint, known
from .position import joints


class PreslidingFriction(AbstractEffect):
    """The LuGre bristle: s' = -sigma0 (w + |w| s / g(w)), friction s + sigma1 s' / sigma0 - b w.

    In steady sliding that is the learned map: g is what the map holds beyond its viscous part.
    [Canudas de Wit, Olsson, Astrom & Lischinsky 1995, eqs. 1 to 3, written in the bristle's torque s]
    """

    name: ClassVar[str] = "presliding_friction"
    confirm: ClassVar[str] = "Push the joint at rest with a small torque and see whether it springs back."
    units: ClassVar[dict[str, str]] = {"sigma0": "N m/rad"}
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
    joint: int | None = eqx.field(static=True)
    channel: str | None = eqx.field(static=True, default=None)

    @classmethod
    def candidates(cls, around):
        if not around.learned:
            return []
        out = []
        for j in joints(around):
            size, knee = float(around.torque[j - 1]), 0.02 * float(around.speed[j - 1])
            rest = (knee, size, 2.0 / around.dt, j)
            b = float(around.viscous[j - 1])
            inertia = float(around.system.mass(jnp.zeros(len(around.system.coordinates)))[j - 1, j - 1])
            for s in (0.5, 2.0, 8.0, 32.0):
                inner = 0.4 * np.sqrt(s * size * inertia)  # a fifth of critical
                stiff, soft = (cls(a(np.log(k * size)), a(inner), a(b), *rest) for k in (1e4, s))
                spread = cls(a(1.0), a(inner), a(0.5 * b + 0.01 * size / float(around.speed[j - 1])), *rest)
                out.append(Candidate(stiff, (soft,), spread))
        return out

    def values(self):
        return {"sigma0": jnp.exp(self.log_sigma)}

    def memory_scale(self):
        return 0.1 * self.size[None]

    def _level(self, scene):
        assert self.joint is not None
        v = scene.v[self.joint - 1]
        fast = jnp.sign(v) * jnp.sqrt(v**2 + self.knee**2)
        away = scene.v.at[self.joint - 1].set(jnp.where(v == 0, self.knee, fast))
        torque = scene.map(away)[self.joint - 1] - scene.map(-away)[self.joint - 1]
        whole = jnp.abs(0.5 * torque)
        return jnp.maximum(whole - self.viscous * jnp.abs(fast), 0.1 * whole) + 1e-9

    def force(self, scene, memory):
        assert self.joint is not None
        i = self.joint - 1
        torque = memory[0] + self.damping * jnp.exp(-self.log_sigma) * self.drift(scene, memory)[0]
        return at_joint(self.joint, torque - self.viscous * scene.v[i] - scene.friction[i], scene)

    def drift(self, scene, memory):
        assert self.joint is not None
        v, level = scene.v[self.joint - 1], self._level(scene)
        sigma = jnp.exp(self.log_sigma)
        relax = jnp.minimum(sigma * jnp.abs(v) / level, self.fastest)
        return jnp.stack([-jnp.sign(v) * relax * level - relax * memory[0]])
