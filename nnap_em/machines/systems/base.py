"""Interface of a machine: names, mass matrix and bias force."""

import dataclasses
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...base.gaussian import spd_solve
from ..units import force_unit, quantities, state_unit
from .plant import AbstractPlant, Scalar


class AbstractSystem(AbstractPlant):
    """Known rigid-body physics M(q) q'' + c(q, q') = B u + tau, in SI units.

    Fields hold the physical parameters as scalars, under the names used in `rig.toml`.
    `coordinates` names q, `rates` names q'; `angles` marks the coordinates that are angles [rad].
    """

    variations: ClassVar[dict[tuple[str, int], tuple[Callable[..., Any], Callable[..., Any]]]] = {}
    """Variations of a body: (effect, joint) to (system, amount) -> system and system -> typical amount."""

    spots: ClassVar[dict[int, Any]] = {}
    """Places (`bodies.LoadPoint`) of candidate loads of any mass and centre, by the joint that carries them, from 1."""

    @classmethod
    def declared(cls, parameters: Mapping[str, Array], joints: tuple[int, ...], machine: str) -> "AbstractSystem":
        """The machine of these numbers; `machine` is that of a file, where the rig names one."""
        names = [f.name for f in dataclasses.fields(cls) if f.name != "joints"]
        left = {n: jnp.asarray(v, float) for n, v in cls.optional.items()}
        return cls(**{n: parameters[n] if n in parameters else left[n] for n in names}, joints=joints)

    def with_parameters(self, values: Mapping[str, Array]) -> "AbstractSystem":
        return dataclasses.replace(self, **values)

    def neighbours(self, joint: int) -> tuple[int, ...]:
        """Joints, counted from 1, that share a body with this one, and itself."""
        return tuple(j for j in (joint - 1, joint, joint + 1) if 1 <= j <= len(self.coordinates))

    def __str__(self) -> str:
        values = {f.name: float(getattr(self, f.name)) for f in dataclasses.fields(self) if f.name != "joints"}
        driven = ", ".join(map(str, self.joints)) or "none"
        return f"{type(self).__name__}: {quantities(values)}; driven joints: {driven}"

    def unit(self, name: str) -> str:
        known = {"time": "s", **self.sensors}
        if name in known:
            return known[name]
        place, dof = self.states.index(name), len(self.coordinates)
        return state_unit(self.angles[place % dof], rate=place >= dof)

    def force_unit(self, joint: int) -> str:
        """SI unit of the generalised force at a joint, counted from 1."""
        return force_unit(self.angles[joint - 1])

    def port_unit(self, port: int) -> str:
        return self.force_unit(port)

    def mobility(self) -> Float[np.ndarray, " dof"]:
        """Largest acceleration of every joint by a unit of its own torque."""
        q = jnp.asarray(np.random.default_rng(0).uniform(-np.pi, np.pi, (32, len(self.coordinates))), float)
        return np.max(np.asarray(_mobility(self, q)), axis=0)

    def push_of(self, q: Float[Array, " dof"], change: Float[Array, "node dof"]) -> Float[Array, "node dof"]:
        return change @ self.mass(q).T

    @property
    def drives(self) -> list[dict[str, Any]]:
        return [{"joint": joint} for joint in self.joints]

    @abstractmethod
    def mass(self, q: Float[Array, " dof"]) -> Float[Array, "dof dof"]:
        """Mass matrix M(q) [kg m^2, or kg on a slide]."""

    @abstractmethod
    def bias(self, q: Float[Array, " dof"], v: Float[Array, " dof"]) -> Float[Array, " dof"]:
        """Coriolis, centrifugal and gravity force c(q, q') [N m, or N]."""

    def acceleration(
        self, q: Float[Array, " dof"], v: Float[Array, " dof"], force: Float[Array, " dof"]
    ) -> tuple[Float[Array, ""], ...]:
        """Accelerations of all joints under a generalised force [N m, or N], one by one (reason: `integrate`)."""
        return tuple(spd_solve(self.mass(q), force - self.bias(q, v)))

    def slopes(
        self, q: Float[Array, " dof"], v: Float[Array, " dof"], u: Float[Array, " input"], push: Float[Array, " dof"]
    ) -> tuple[Scalar, ...]:
        return *v, *self.acceleration(q, v, push)

    def sensed(
        self, q: Float[Array, " dof"], v: Float[Array, " dof"], u: Float[Array, " input"], push: Float[Array, " dof"]
    ) -> tuple[Scalar, ...]:
        return tuple(self.senses(q, v, self.acceleration(q, v, push)))

    def senses(
        self, q: Float[Array, " dof"], v: Float[Array, " dof"], a: Sequence[Float[Array, ""]]
    ) -> Sequence[Float[Array, ""]]:
        """Readings of the `sensors` in a motion with the acceleration `a`, in SI units."""
        return ()

    def vary(self, kind: str, joint: int, amount: Float[Array, ""]) -> "AbstractSystem":
        """The machine with one body changed by `amount` (an entry of `variations`)."""
        return self.variations[kind, joint][0](self, amount)

    def loaded(self, joint: int, mass: Float[Array, ""], moment: Float[Array, "3"]) -> "AbstractSystem":
        """The machine with a load: mass [kg] and first moment [kg m] about the spot of a joint (one of `spots`)."""
        raise KeyError(joint)

    def tip(self, q: Float[Array, " dof"]) -> Float[Array, " axis"] | None:
        """Place of the tip [m], where the machine has one that air could brake."""
        return None

    def shake(self, q: Float[Array, " dof"]) -> Float[Array, " dof"] | None:
        """Generalised force of a unit horizontal acceleration of the base [N m s^2/m], where the base can shake."""
        return None


@eqx.filter_jit
def _mobility(system: AbstractSystem, q: Float[Array, "pose dof"]) -> Float[Array, "pose dof"]:
    return jax.vmap(lambda q: jnp.diag(jnp.linalg.inv(system.mass(q))))(q)
