"""A linear slide: one mass, one force, friction."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .base import AbstractSystem


class Slide(AbstractSystem):
    """m x'' = u + tau; x is the position [m]."""

    coordinates: ClassVar[tuple[str, ...]] = ("x",)
    rates: ClassVar[tuple[str, ...]] = ("dx",)
    angles: ClassVar[tuple[bool, ...]] = (False,)

    variations: ClassVar[dict[tuple[str, int], tuple[Callable[..., Any], Callable[..., Any]]]] = {
        ("payload", 1): (lambda slide, mass: replace(slide, m=slide.m + mass), lambda slide: slide.m)
    }

    m: Float[Array, ""]
    """Moving mass [kg]."""
    joints: tuple[int, ...] = eqx.field(static=True)

    def mass(self, q: Float[Array, " dof"]) -> Float[Array, "dof dof"]:
        return self.m[None, None] + jnp.zeros_like(q)[:, None]

    def bias(self, q: Float[Array, " dof"], v: Float[Array, " dof"]) -> Float[Array, " dof"]:
        return jnp.zeros_like(q)

    def shake(self, q: Float[Array, " dof"]) -> Float[Array, " dof"]:
        return -self.m * jnp.ones_like(q)
