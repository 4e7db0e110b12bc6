"""Interface above mechanics: states, inputs, readings, and ports, where something that is not known may push."""

import math
from abc import abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

Scalar = Float[Array, ""]


class AbstractPlant(eqx.Module):
    """Known physics x' = f(x, u, push), y = g(x, u, push).

    The state x is (q, v): coordinates and rates of a machine with joints; of equations q is all of it, and v is empty.
    A port of a machine is a joint, that of an equation its state or the name of an unknown term.
    """

    coordinates: ClassVar[tuple[str, ...]] = ()
    rates: ClassVar[tuple[str, ...]] = ()
    angles: ClassVar[tuple[bool, ...]] = ()
    optional: ClassVar[dict[str, float]] = {}

    simulated: ClassVar[bool] = False
    """True where free simulations over many time constants count: fits, predictions and errors are those of them.  The
    prediction of a machine with joints, which may be chaotic, is the mean of sample paths."""

    given: ClassVar[float] = 1.0
    """Readings before a reported error, in the pace of the model."""

    sensors: ClassVar[dict[str, str]] = {}
    """Columns of sensors that are read beside the states, in the order of `senses`, and their units."""

    joints: eqx.AbstractVar[tuple[int, ...]]
    """The joint (counted from 1) that each input drives; none of equations."""

    @property
    def states(self) -> tuple[str, ...]:
        """Coordinates, then rates."""
        return self.coordinates + self.rates

    @property
    def ports(self) -> tuple[str, ...]:
        """Places of pushes: of machines the coordinates, with generalised forces."""
        return self.coordinates

    @property
    def open_ports(self) -> tuple[str, ...]:
        """Ports that a law of any states and inputs may push; of machines none: their laws belong to joints."""
        return ()

    @property
    def readable(self) -> tuple[str, ...]:
        """All that may be measured: states, then sensors."""
        return self.states + tuple(self.sensors)

    @property
    def senses_push(self) -> bool:
        """True where a reading depends on the push at its moment."""
        return bool(self.sensors)

    def parameter(self, name: str) -> Any:
        """A parameter by the name that `rig.toml` gives it."""
        return getattr(self, name)

    @abstractmethod
    def with_parameters(self, values: Mapping[str, Array]) -> "AbstractPlant":
        """The plant with other values of some parameters."""

    def least(self, name: str) -> float:
        """Smallest value that a parameter may be estimated to have."""
        return -math.inf

    def reached_from(self, before: Any) -> "AbstractPlant":
        """This plant, or if a step of a fit from `before` led to one that cannot be, one on the way that can."""
        del before
        return self

    @abstractmethod
    def unit(self, name: str) -> str:
        """Unit of a state, a sensor or `time`."""

    @abstractmethod
    def port_unit(self, port: int) -> str:
        """Unit of the push at a port, counted from 1."""

    def split(self, x: Float[Array, " state"]) -> tuple[Float[Array, " dof"], Float[Array, " rate"]]:
        """The parts (q, v) of a state that memory of effects may follow."""
        states = len(self.states)
        places = states - len(self.rates)
        return x[:places], x[places:states]

    @property
    def gears(self) -> tuple[float, ...]:
        """Generalised force of a unit of the input of every joint that is driven."""
        return (1.0,) * len(self.joints)

    def drive(self, u: Float[Array, " input"]) -> Float[Array, " port"]:
        """Push B u of the inputs at the ports [N m, or N]; 0 where inputs stand in the equations themselves."""
        force = [jnp.zeros((), u.dtype)] * len(self.ports)
        for i, (joint, gear) in enumerate(zip(self.joints, self.gears, strict=True)):
            force[joint - 1] = force[joint - 1] + u[i] * gear
        return jnp.stack(force)

    def at_ports(self, torque: Float[Array, " dof"]) -> Float[Array, " port"]:
        """Torques of the learned maps of the joints, which equations have none of, as pushes at all ports."""
        return jnp.pad(torque, (0, len(self.ports) - torque.shape[0]))

    def push_of(self, q: Float[Array, " dof"], change: Float[Array, "node rate"]) -> Float[Array, "node rate"]:
        """Impulse that changes the rates of a machine so, or the change itself, of states of equations."""
        return change

    @property
    @abstractmethod
    def drives(self) -> list[dict[str, Any]]:
        """Joint of every input, or its name as a channel; columns behind these scale numbers of servos.

        Before the first row what drives a joint was 0, and what has a name stood as in it.
        """

    @abstractmethod
    def slopes(
        self, q: Float[Array, " dof"], v: Float[Array, " rate"], u: Float[Array, " input"], push: Float[Array, " port"]
    ) -> tuple[Scalar, ...]:
        """Derivatives of all states, one by one (reason: `integrate`)."""

    @abstractmethod
    def sensed(
        self, q: Float[Array, " dof"], v: Float[Array, " rate"], u: Float[Array, " input"], push: Float[Array, " port"]
    ) -> tuple[Scalar, ...]:
        """Readings of the `sensors`."""
