"""Forces of the velocity."""

from functools import partial
from typing import ClassVar

import jax
import jax.numpy as jnp

from .base import AbstractEffect, JointEffect, Scalar, one


class AirDrag(AbstractEffect):
    """-c |w| w at a joint, or the drag of a point at the tip (joint None)."""

    name: ClassVar[str] = "air_drag"
    meaning: ClassVar[str] = "A brake that grows with the square of speed, as air does."
    confirm: ClassVar[str] = "Swing once with the tip shrouded, or once slow and once fast."
    units: ClassVar[dict[str, str]] = {"c": "N m s^2/rad^2"}
    words: ClassVar[dict[str, str]] = {"c": "drag coefficient"}
    units_free: ClassVar[dict[str, str]] = {"c": "N s^2/m^2"}
    above_zero: ClassVar[str] = "c"
    c: Scalar

    @classmethod
    def candidates(cls, around):
        sizes = [float(size) for size in around.torque / around.speed**2]
        out = [one(partial(cls, joint=j), 0.0, 0.1 * size, size) for j, size in zip(around.joints, sizes, strict=True)]
        tip = around.system.tip(jnp.zeros(len(sizes)))
        return out if tip is None else [*out, one(cls, 0.0, sizes[-1], 100 * sizes[-1])]

    def force(self, scene, memory):
        if self.joint is not None:
            v = scene.v[self.joint - 1]
            return jnp.zeros_like(scene.v).at[self.joint - 1].set(-self.c * jnp.abs(v) * v)
        jac = jax.jacfwd(scene.system.tip)(scene.q)
        speed = jac @ scene.v
        return -self.c * jac.T @ (speed * jnp.sqrt(jnp.sum(speed**2) + 1e-12))


class BackEmf(JointEffect):
    """The motor's torque falls by b w; a learned friction map holds it."""

    name: ClassVar[str] = "motor_back_emf"
    meaning: ClassVar[str] = "The torque of the motor falls with its speed."
    confirm: ClassVar[str] = "Log the motor current beside the command."
    units: ClassVar[dict[str, str]] = {"b": "N m s/rad"}
    words: ClassVar[dict[str, str]] = {"b": "torque lost per speed"}
    b: Scalar

    @classmethod
    def candidates(cls, around):
        sizes = ((j, float(around.torque[j - 1] / around.speed[j - 1])) for j in around.system.joints)
        return [one(partial(cls, joint=j), 0.0, 0.1 * size, size) for j, size in sizes]

    def force(self, scene, memory):
        return self.at(scene, -self.b * self.own(scene.v))
