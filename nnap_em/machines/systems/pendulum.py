"""A single driven pendulum."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ...base.elementary import cos, sin
from .base import AbstractSystem


class Pendulum(AbstractSystem):
    """(I + m lc^2) theta1'' + m g lc sin(theta1) = u + tau; theta1 counts from hanging down [rad]."""

    coordinates: ClassVar[tuple[str, ...]] = ("theta1",)
    rates: ClassVar[tuple[str, ...]] = ("dtheta1",)
    angles: ClassVar[tuple[bool, ...]] = (True,)

    variations: ClassVar[dict[tuple[str, int], tuple[Callable[..., Any], Callable[..., Any]]]] = {
        ("link_inertia", 1): (lambda rod, dI: replace(rod, I=rod.I + dI), lambda rod: rod.I + rod.m * rod.lc**2),
        ("center_of_mass", 1): (lambda rod, dlc: replace(rod, lc=rod.lc + dlc), lambda rod: rod.lc),
    }

    m: Float[Array, ""]  # Mass [kg]
    lc: Float[Array, ""]  # Distance of the centre of mass from the joint [m]
    I: Float[Array, ""]  # noqa: E741  (the field's own symbol)
    """Inertia about the centre of mass [kg m^2]."""
    g: Float[Array, ""]
    joints: tuple[int, ...] = eqx.field(static=True)

    def mass(self, q: Float[Array, " dof"]) -> Float[Array, "dof dof"]:
        return (self.I + self.m * self.lc**2)[None, None] + jnp.zeros_like(q)[:, None]

    def bias(self, q: Float[Array, " dof"], v: Float[Array, " dof"]) -> Float[Array, " dof"]:
        return self.m * self.g * self.lc * sin(q)

    def shake(self, q: Float[Array, " dof"]) -> Float[Array, " dof"]:
        return -self.m * self.lc * cos(q)
