"""What a machine must give to become a model: names, mass matrix and bias force."""

import dataclasses
from abc import abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..data.units import force_unit, quantities, state_unit


class AbstractSystem(eqx.Module):
    """Known rigid-body physics M(q) q'' + c(q, q') = B u + tau, in SI units.

    Fields hold the physical parameters as scalars, under the names used in `rig.toml`.
    `coordinates` names q, `rates` names q'; `angles` says which coordinates are angles [rad].
    """

    coordinates: ClassVar[tuple[str, ...]]
    rates: ClassVar[tuple[str, ...]]
    angles: ClassVar[tuple[bool, ...]]
    optional: ClassVar[dict[str, float]] = {}

    variations: ClassVar[dict[tuple[str, int], tuple[Callable[..., Any], Callable[..., Any]]]] = {}
    """How a body may differ: (effect, joint) to (system, amount) -> system and system -> typical amount."""

    joints: eqx.AbstractVar[tuple[int, ...]]
    """The joint (counted from 1) that each input drives."""

    def __str__(self) -> str:
        values = {f.name: float(getattr(self, f.name)) for f in dataclasses.fields(self) if f.name != "joints"}
        driven = ", ".join(map(str, self.joints)) or "none"
        return f"{type(self).__name__}: {quantities(values)}; driven joints: {driven}"

    def unit(self, name: str) -> str:
        """SI unit of a coordinate or rate."""
        place, dof = (self.coordinates + self.rates).index(name), len(self.coordinates)
        return state_unit(self.angles[place % dof], rate=place >= dof)

    def force_unit(self, joint: int) -> str:
        """SI unit of the generalised force at a joint, counted from 1."""
        return force_unit(self.angles[joint - 1])

    @abstractmethod
    def mass(self, q: Float[Array, " dof"]) -> Float[Array, "dof dof"]:
        """Mass matrix M(q) [kg m^2, or kg on a slide]."""

    @abstractmethod
    def bias(self, q: Float[Array, " dof"], v: Float[Array, " dof"]) -> Float[Array, " dof"]:
        """Coriolis, centrifugal and gravity force c(q, q') [N m, or N]."""

    def drive(self, u: Float[Array, " input"]) -> Float[Array, " dof"]:
        """Generalised force B u of the inputs [N m, or N]."""
        force = [jnp.zeros((), u.dtype)] * len(self.coordinates)
        for i, joint in enumerate(self.joints):
            force[joint - 1] = force[joint - 1] + u[i]
        return jnp.stack(force)

    def vary(self, kind: str, joint: int, amount: Float[Array, ""]) -> "AbstractSystem":
        """The machine with one body changed by `amount` (an entry of `variations`)."""
        return self.variations[kind, joint][0](self, amount)

    def tip(self, q: Float[Array, " dof"]) -> Float[Array, " axis"] | None:
        """Place of the tip [m], where the machine has one that air could brake."""
        return None

    def shake(self, q: Float[Array, " dof"]) -> Float[Array, " dof"] | None:
        """Generalised force of a unit horizontal acceleration of the base [N m s^2/m], where the base can shake."""
        return None
