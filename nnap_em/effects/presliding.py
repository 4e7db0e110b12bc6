# pyright: reportCallIssue=false, reportArgumentType=false
# (pyright takes equinox's abstract fields for fields of the constructor)
"""Friction with memory: the contact winds up before it slides."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .base import AbstractEffect, Candidate, Scalar, a, at_joint
from .position import joints


class PreslidingFriction(AbstractEffect):
    """The LuGre bristle: s' = -sigma0 (w + |w| s / g(w)), whose rest over all motion is the learned map.

    [Canudas de Wit, Olsson, Astrom & Lischinsky 1995, eqs. 1 to 3, written in the bristle's torque s]
    """

    name: ClassVar[str] = "presliding_friction"
    confirm: ClassVar[str] = "Push the joint at rest with a small torque and see whether it springs back."
    units: ClassVar[dict[str, str]] = {"sigma0": "N m/rad"}
    memory: ClassVar[int] = 1
    linear: ClassVar[bool] = False
    log_sigma: Scalar
    knee: float = eqx.field(static=True)
    """Speed [rad/s] below which the map is read at this speed: it is smooth near rest, the bristle is not."""
    size: float = eqx.field(static=True)
    fastest: float = eqx.field(static=True)
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
            make = lambda log_s, j=j, knee=knee, size=size: cls(a(log_s), knee, size, 2.0 / around.dt, j)  # noqa: E731
            for s in (2.0, 10.0):
                out.append(Candidate(make(np.log(1e4 * size)), (make(np.log(s * size)),), make(1.0)))
        return out

    def values(self):
        return {"sigma0": jnp.exp(self.log_sigma)}

    def memory_scale(self):
        return jnp.asarray([0.1 * self.size])

    def _level(self, scene):
        assert self.joint is not None
        v = scene.v[self.joint - 1]
        fast = jnp.sign(v) * jnp.sqrt(v**2 + self.knee**2)
        away = scene.v.at[self.joint - 1].set(jnp.where(v == 0, self.knee, fast))
        torque = scene.map(away)[self.joint - 1] - scene.map(-away)[self.joint - 1]
        return jnp.abs(0.5 * torque) + 1e-9

    def force(self, scene, memory):
        assert self.joint is not None
        return at_joint(self.joint, memory[0] - scene.friction[self.joint - 1], scene)

    def drift(self, scene, memory):
        assert self.joint is not None
        v, level = scene.v[self.joint - 1], self._level(scene)
        sigma = jnp.exp(self.log_sigma)
        relax = jnp.minimum(sigma * jnp.abs(v) / level, self.fastest)
        return jnp.stack([-jnp.sign(v) * relax * level - relax * memory[0]])
