"""The hooks of effects, run one effect after the other: the one place that the model and the score test share."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..machines.systems.plant import AbstractPlant
from .effects.base import AbstractEffect, OperatingPoint, Scalar, Stream
from .servo import Servo

Effects = Sequence[AbstractEffect]


class Sampling(NamedTuple):
    """Rows of the inputs, and their course between two rows."""

    dt: float
    """Interval [s]."""
    smooth: bool = False
    """True where an input goes on from row to row; False where it is held."""

    def through(self, effect: AbstractEffect, u: Float[Array, " time"], stood: bool) -> Float[Array, " time"]:
        """An input after a law that takes time; before its first row it `stood` as in it, or was 0.

        Held: its mean over each interval.  Smooth: its values in the rows, by the law of the slopes of lines between
        them; it stood before the first row as in it.
        """
        if _at_once(effect):
            return u
        if self.smooth:
            return jnp.concatenate([u[:1], u[:1] + jnp.cumsum(effect.input(jnp.diff(u), self.dt))])
        before = u[:1] if stood else jnp.zeros_like(u[:1])
        return before + effect.input(u - before, self.dt)

    def stream(self, effect: AbstractEffect) -> Stream | None:
        """`through` row by row; the memory of a smooth one ends in the value before, and in what became of it."""
        stream = effect.stream(self.dt)
        if not self.smooth or stream is None:
            return stream

        def step(memory, u):
            inner, change = stream.step(memory[:-2], u - memory[-2])
            after = memory[-1] + change
            return jnp.concatenate([inner, jnp.stack([u, after])]), after

        return Stream(jnp.concatenate([stream.memory, jnp.zeros(2, stream.memory.dtype)]), step)


class CommandStream(NamedTuple):
    """The commands of a row to what is set at the drives, with what is remembered of earlier rows."""

    memory: Any
    """Memory before the first row; arrays for every drive."""
    step: Callable[[Any, Float[Array, " column"], Any], tuple[Any, Float[Array, " input"]]]
    """Function of the memory, a row of input columns and the mask of the first row: the memory after it, and the values
    that the commands set (`Inputs.u`)."""


def _at_once(effect: AbstractEffect) -> bool:
    """True of a law that takes no time."""
    return type(effect).input is AbstractEffect.input


def arriving(
    effects: Effects,
    servos: Sequence[Servo] | None,
    system: AbstractPlant,
    u: Float[Array, "*time column"],
    through: Callable[..., Array],
) -> tuple[Float[Array, "*time input"], Float[Array, "*time column"] | None]:
    """Values at the drives by the input columns of a sequence, or of one row, with the effects that take time; beside
    them the columns that numbers of the servos are proportional to (`Servo.at`).

    They are torques at the joints [N m], or values that commands set in servos (`Servo.fed`).  `through` is that of
    `Sampling`, or the same row by row.
    """
    drives = len(system.drives)
    u, scale = u[..., :drives], u[..., drives:] if u.shape[-1] > drives else None
    if servos:
        u = jnp.stack([servo.at(scale).fed(u[..., i], through) for i, servo in enumerate(servos)], axis=-1)
    return late(effects, servos, system, u, through), scale


def late(
    effects: Effects,
    servos: Sequence[Servo] | None,
    system: AbstractPlant,
    u: Float[Array, "*time input"],
    through: Callable[..., Array],
) -> Float[Array, "*time input"]:
    """Values at the drives of those that commands set, with the effects that take time; of torques all effects."""
    columns = []
    for i, place in enumerate(system.drives):
        column, stood = u[..., i], servos[i].feeds_back if servos else "channel" in place
        for effect in effects:
            if (here := effect.at_drive(place, i)) is not None:
                column = through(here, column, stood)
                column = column if servos else here.drive(column)
        columns.append(column)
    return jnp.stack(columns, axis=-1) if columns else u


def command_stream(
    effects: Effects, servos: Sequence[Servo] | None, system: AbstractPlant, rows: Sampling
) -> CommandStream:
    """`arriving` row by row; of each law that takes time the input before the first row and its own memory are kept.

    Raises ValueError where a law of the command has no form for one row.
    """
    streams: list[Stream] = []

    def begun(effect, u, stood):
        if not _at_once(effect):
            if (stream := rows.stream(effect)) is None:
                raise ValueError(f"{effect.name!r} has no form for one row: give it `stream` beside `input`")
            streams.append(stream)
        return u

    def step(memory, u, first):
        after = []

        def through(effect, u, stood):
            if _at_once(effect):
                return u
            before, own = memory[len(after)]
            before = jnp.where(first, u, before) if stood else before
            if rows.smooth:  # before the first row the input stood as in it
                own = jnp.where(first, own.at[-2:].set(u - before), own)
            own, late = streams[len(after)].step(own, u - before)
            after.append((before, own))
            return before + late

        fed, _ = arriving(effects, servos, system, u, through)
        return tuple(after), fed

    arriving(effects, servos, system, jnp.zeros(len(system.drives)), begun)
    return CommandStream(tuple((jnp.zeros(()), stream.memory) for stream in streams), step)


def driven(
    effects: Effects,
    servos: Sequence[Servo] | None,
    system: Any,
    u: Float[Array, " input"],
    q: Float[Array, " coordinate"],
    v: Float[Array, " speed"],
    scale: Float[Array, " column"] | None = None,
) -> Float[Array, " input"]:
    """Torque of every drive at one moment, with the effects that take none [N m, before the gear]; or `u`."""
    if not servos:
        return u
    torques = []
    for i, (joint, gear, servo) in enumerate(zip(system.joints, system.gears, servos, strict=True)):
        torque = servo.at(scale).torque(u[i], gear * q[joint - 1], gear * v[joint - 1])
        for effect in effects:
            if effect.joint == joint:
                torque = effect.drive(torque)
        torques.append(torque)
    return jnp.stack(torques)


def machine(effects: Effects, system: Any, time: Scalar) -> Any:
    """The machine as it truly is at some time [s]."""
    for effect in effects:
        system = effect.physics(system, time)
    return system


def pushed(
    effects: Effects, scene: OperatingPoint, memory: Float[Array, " memory"], push: Float[Array, " port"]
) -> Float[Array, " port"]:
    """Push at every port by the inputs, all effects in the scene, and an extra `push` [N m, at a joint]."""
    return _total(effects, scene, memory, scene.drive + push)


def added(
    effects: Effects, scene: OperatingPoint, memory: Float[Array, " memory"], acceleration: Float[Array, " dof"]
) -> Float[Array, " dof"]:
    """Generalised force that the effects add to a scene without them, at a given acceleration [N m]."""
    extra = _total(effects, scene, memory, jnp.zeros_like(scene.v)) - scene.friction
    system, true = scene.system, machine(effects, scene.system, scene.time)
    if true is system:
        return extra
    slow = (system.mass(scene.q) - true.mass(scene.q)) @ acceleration
    return extra + slow + system.bias(scene.q, scene.v) - true.bias(scene.q, scene.v)


def _total(
    effects: Effects, scene: OperatingPoint, memory: Float[Array, " memory"], known: Float[Array, " port"]
) -> Float[Array, " port"]:
    """`known` with the forces of the effects, and friction as it truly is, on top [N m]."""
    torque = scene.friction
    for effect, part in _memories(effects, memory):
        torque = effect.friction(torque, scene)
        known = known + effect.force(scene, part)
    return known + torque


def drift(effects: Effects, scene: OperatingPoint, memory: Float[Array, " memory"]) -> Float[Array, " memory"]:
    """Time derivative of the memory of all effects."""
    return jnp.concatenate([memory[:0], *(effect.drift(scene, part) for effect, part in _memories(effects, memory))])


def read(
    effects: Effects,
    names: Sequence[str],
    values: Float[Array, " readable"],
    past: Callable[[Scalar], Float[Array, " readable"]],
) -> Float[Array, " readable"]:
    """Readings of sensors on `values`; `past(delay)` are the values some seconds ago."""
    for effect in effects:
        for i, name in enumerate(names):
            if (here := effect.at_reading(name, i)) is not None:
                values = values.at[i].set(here.reading(values[i], lambda delay, i=i: past(delay)[i]))
    return values


def _memories(
    effects: Effects, memory: Float[Array, " memory"]
) -> Iterator[tuple[AbstractEffect, Float[Array, " memory"]]]:
    """Every effect with its own part of the memory."""
    place = 0
    for effect in effects:
        yield effect, memory[place : place + effect.memory]
        place += effect.memory
