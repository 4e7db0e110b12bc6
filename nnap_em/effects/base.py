"""What an effect is: a named law that changes force, drive, body, friction or reading, with parameters and units.

A new effect is one new file in this folder; the catalogue finds it.
"""

import dataclasses
from collections.abc import Callable
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..systems.base import AbstractSystem

Scalar = Float[Array, ""]


class Scene(NamedTuple):
    """What an effect sees of the machine at one moment."""

    system: AbstractSystem
    q: Float[Array, " dof"]
    v: Float[Array, " dof"]
    drive: Float[Array, " dof"]
    """Generalised force of the inputs [N m]."""
    time: Scalar
    friction: Float[Array, " dof"]
    """Torque of the learned map at v [N m]."""
    map: Callable[[Float[Array, " dof"]], Float[Array, " dof"]]
    """The learned map itself."""


class Around(NamedTuple):
    """Sizes that candidates are built from, all read off the logs and the declared physics."""

    system: AbstractSystem
    torque: Float[np.ndarray, " dof"]
    """Typical torque of gravity and drive [N m]."""
    speed: Float[np.ndarray, " dof"]
    """Largest velocity [rad/s]."""
    viscous: Float[np.ndarray, " dof"]
    """Slope of the learned friction map at speed [N m s/rad]."""
    low: Float[np.ndarray, " dof"]
    """Smallest and largest coordinate on the smoothed paths [rad]."""
    high: Float[np.ndarray, " dof"]
    drive: Float[np.ndarray, " input"]
    """Largest input [N m]."""
    measured: tuple[str, ...]
    reading: Float[np.ndarray, " obs"]
    """Typical size of each reading."""
    dt: float
    duration: tuple[float, float]
    """First and last time on the clock [s]."""
    ending: float
    """Last time of the whole recording, of which a part is looked at [s]."""
    session: bool
    """True where the clock runs on over all sequences."""
    learned: bool
    """True where a friction map is learned."""


class Candidate(NamedTuple):
    """An effect to be tried, without a value yet."""

    start: "AbstractEffect"
    """Strengths zero (linear), inner parameters at one place of their grid."""
    probes: tuple["AbstractEffect", ...]
    """The effect with one strength each at a typical size: the directions that the score test looks along."""
    spread: "AbstractEffect"
    """Prior standard deviation of every parameter."""


class AbstractEffect(eqx.Module):
    """A law that the declared physics may lack.  The hooks say what it changes.

    Array fields are its parameters, but for `known` ones.
    """

    name: ClassVar[str]
    """Key of the vocabulary."""
    confirm: ClassVar[str] = ""
    """What to look at on the machine to be sure."""
    units: ClassVar[dict[str, str]] = {}
    """Reported parameters and their units on a rotary joint."""
    memory: ClassVar[int] = 0
    """States of its own."""
    substeps: ClassVar[int] = 1
    """Integration steps per sample that it needs."""
    place: ClassVar[bool] = False
    """True for a force that depends on the position of its own joint alone."""
    linear: ClassVar[bool] = True
    """False where a probe itself, not its multiple, is the place to start a fit from."""
    held: ClassVar[bool] = False
    """True for a force with many parameters: their sensitivity is that of a force held over the step."""
    read_off: ClassVar[bool] = False
    """True for what is seen in the numbers themselves, before any fit."""

    joint: eqx.AbstractVar[int | None]
    """The joint that it acts on, counted from 1; None: all, or no joint."""
    channel: eqx.AbstractVar[str | None]
    """The reading that it acts on."""

    @classmethod
    def candidates(cls, around: Around) -> list[Candidate]:
        """What of this kind is to be tried on a machine; nothing where the machine cannot have it."""
        return []

    def values(self) -> dict[str, Scalar]:
        """The reported parameters under the vocabulary's names."""
        return {name: getattr(self, name) for name in self.units}

    def possible(self) -> bool:
        """Whether a fitted value makes physical sense."""
        return True

    def inputs_named(self) -> tuple[str, ...]:
        """Of what it is a function, for laws without a name."""
        return ()

    @property
    def named(self) -> bool:
        """False for a law without a name."""
        return not self.inputs_named()

    def memory_scale(self) -> Float[Array, " memory"]:
        """Typical size of its own states."""
        return jnp.ones(self.memory)

    def input(self, u: Float[Array, " time"], dt: float) -> Float[Array, " time"]:
        """What reaches the joint of the commanded input, mean over each sample."""
        return u

    def physics(self, system: AbstractSystem, time: Scalar) -> AbstractSystem:
        """The machine as it truly is."""
        return system

    def friction(self, torque: Float[Array, " dof"], scene: Scene) -> Float[Array, " dof"]:
        """The friction torque as it truly is."""
        return torque

    def force(self, scene: Scene, memory: Float[Array, " memory"]) -> Float[Array, " dof"]:
        """Generalised force that comes on top [N m]."""
        return jnp.zeros_like(scene.v)

    def drift(self, scene: Scene, memory: Float[Array, " memory"]) -> Float[Array, " memory"]:
        """Time derivative of its own states."""
        return memory

    def reading(self, value: Scalar, past: Callable[[Scalar], Scalar]) -> Scalar:
        """What the sensor of its channel reads; `past(delay)` is the value some seconds ago."""
        return value


def known(**options):
    """A field with a number that no fit moves; an array all the same, so that another number is no other program."""
    return eqx.field(converter=a, metadata={"known": True}, **options)


def fields(effect: AbstractEffect) -> tuple[str, ...]:
    """Names of the parameters, in the order of a fit."""
    free = (f.name for f in dataclasses.fields(effect) if "known" not in f.metadata)
    return tuple(name for name in free if eqx.is_array(getattr(effect, name)))


def flat(effect: AbstractEffect) -> Float[Array, " param"]:
    """All parameters as one vector, in the order of a fit."""
    return jnp.concatenate([jnp.ravel(getattr(effect, name)) for name in fields(effect)])


def at_joint(joint: int | None, value: Scalar, scene: Scene) -> Float[Array, " dof"]:
    """A generalised force at one joint."""
    assert joint is not None
    return jnp.zeros_like(scene.v).at[joint - 1].set(value)


def a(value: float | Scalar) -> Scalar:
    """A number as an array of the default precision."""
    return jnp.asarray(value, float)
