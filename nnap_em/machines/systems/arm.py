"""The double pendulum in a vertical plane, the arm of the acrobot and of the pendubot."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ...base.elementary import cos, sin
from .base import AbstractSystem
from .plant import Scalar


def _payload(arm: "TwoLinkArm", mass: Scalar) -> "TwoLinkArm":
    """A point mass at the tip of link 2, as other mass, centre and inertia of that link."""
    total = arm.m2 + mass
    lc2 = (arm.m2 * arm.lc2 + mass * arm.l2) / total
    inertia = arm.I2 + arm.m2 * (lc2 - arm.lc2) ** 2 + mass * (arm.l2 - lc2) ** 2
    return replace(arm, m2=total, lc2=lc2, I2=inertia)


class TwoLinkArm(AbstractSystem):
    """Two rigid links; theta1 counts from hanging down, theta2 is relative to link 1 [rad].

    [Spong 1995, "The swing up control problem for the acrobot", eq. 1; the rotor terms as in INTERFACE.md]
    """

    coordinates: ClassVar[tuple[str, ...]] = ("theta1", "theta2")
    rates: ClassVar[tuple[str, ...]] = ("dtheta1", "dtheta2")
    angles: ClassVar[tuple[bool, ...]] = (True, True)
    optional: ClassVar[dict[str, float]] = {"Ir": 0.0, "gr": 1.0}

    variations: ClassVar[dict[tuple[str, int], tuple[Callable[..., Any], Callable[..., Any]]]] = {
        ("payload", 2): (_payload, lambda arm: arm.m2),
        ("link_inertia", 1): (lambda arm, dI: replace(arm, I1=arm.I1 + dI), lambda arm: arm.m1 * arm.l1**2),
        ("link_inertia", 2): (lambda arm, dI: replace(arm, I2=arm.I2 + dI), lambda arm: arm.m2 * arm.l2**2),
        ("link_length", 1): (lambda arm, dl: replace(arm, l1=arm.l1 + dl), lambda arm: arm.l1),
        ("center_of_mass", 1): (lambda arm, dlc: replace(arm, lc1=arm.lc1 + dlc), lambda arm: arm.l1),
        ("center_of_mass", 2): (lambda arm, dlc: replace(arm, lc2=arm.lc2 + dlc), lambda arm: arm.l2),
    }

    m1: Scalar  # Mass of link 1 [kg]
    m2: Scalar
    l1: Scalar  # Length of link 1 [m]
    l2: Scalar
    lc1: Scalar  # Distance of the centre of mass of link 1 from its joint [m]
    lc2: Scalar
    I1: Scalar  # Inertia of link 1 about its centre of mass [kg m^2]
    I2: Scalar
    g: Scalar  # Gravity [m/s^2]
    Ir: Scalar  # Rotor inertia of both drives [kg m^2]
    gr: Scalar  # Gear ratio of both drives [-]
    joints: tuple[int, ...] = eqx.field(static=True)

    def mass(self, q: Float[Array, " dof"]) -> Float[Array, "dof dof"]:
        rotor = self.gr**2 * self.Ir
        m22 = self.I2 + self.m2 * self.lc2**2
        coupling = self.m2 * self.l1 * self.lc2 * cos(q[1])
        m11 = self.I1 + self.m1 * self.lc1**2 + m22 + self.m2 * self.l1**2 + 2 * coupling + rotor + self.Ir
        m12 = m22 + coupling - self.gr * self.Ir
        return jnp.stack([jnp.stack([m11, m12]), jnp.stack([m12, m22 + rotor])])

    def bias(self, q: Float[Array, " dof"], v: Float[Array, " dof"]) -> Float[Array, " dof"]:
        h = self.m2 * self.l1 * self.lc2 * sin(q[1])
        gravity2 = self.m2 * self.lc2 * self.g * sin(q[0] + q[1])
        gravity1 = (self.m1 * self.lc1 + self.m2 * self.l1) * self.g * sin(q[0]) + gravity2
        return jnp.stack([gravity1 - h * v[1] * (2 * v[0] + v[1]), gravity2 + h * v[0] ** 2])

    def tip(self, q: Float[Array, " dof"]) -> Float[Array, " axis"]:
        outer = q[0] + q[1]
        return jnp.stack([self.l1 * sin(q[0]) + self.l2 * sin(outer), -self.l1 * cos(q[0]) - self.l2 * cos(outer)])

    def shake(self, q: Float[Array, " dof"]) -> Float[Array, " dof"]:
        outer = self.m2 * self.lc2 * cos(q[0] + q[1])
        return -jnp.stack([(self.m1 * self.lc1 + self.m2 * self.l1) * cos(q[0]) + outer, outer])
