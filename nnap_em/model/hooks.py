"""The hooks of effects, run one effect after the other: the one place that the model and the score test share."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..effects.actuator import InputDelay
from ..effects.base import AbstractEffect, OperatingPoint, Scalar, Stream
from ..systems.base import AbstractSystem
from ..systems.plant import AbstractPlant
from .servo import LAWS, Servo

Effects = Sequence[AbstractEffect]


class Sampling(NamedTuple):
    """Rows of the inputs, and their course between two rows."""

    dt: float
    """Interval [s]."""
    smooth: bool = False
    """True where an input goes on from row to row; False where it is held."""

    def through(self, effect: AbstractEffect, u: Float[Array, " time"]) -> Float[Array, " time"]:
        """An input that was 0 before its first row, after a law that takes time.

        Held: its mean over each interval.  Smooth: its values in the rows, by the law of the slopes of lines between
        them; it stood before the first row as in it.
        """
        if not self.smooth or type(effect).input is AbstractEffect.input:
            return effect.input(u, self.dt)
        return jnp.concatenate([u[:1], u[:1] + jnp.cumsum(effect.input(jnp.diff(u), self.dt))])

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


def reaching(
    effects: Effects, system: AbstractPlant, u: Float[Array, "time input"], rows: Sampling
) -> Float[Array, "time input"]:
    """Torques at the joints of the commanded torques of a sequence [N m]."""
    for effect in effects:
        if (i := system.input_of(effect.joint, effect.channel)) is not None:
            late = system.late(lambda column, effect=effect: rows.through(effect, column), u[:, i])
            u = u.at[:, i].set(effect.drive(late))
    return u


def fed(
    effects: Effects,
    servos: Sequence[Servo],
    system: AbstractSystem,
    u: Float[Array, "time input"],
    rows: Sampling,
    scale: Float[Array, "time column"] | None = None,
) -> Float[Array, "time input"]:
    """Values that the commands of a sequence set in its drives, with the effects that take time (`Servo.fed`).

    `scale` are the columns that numbers of the servos are proportional to (`Servo.at`).
    """
    values = jnp.stack([servo.at(scale).fed(u[:, i], rows.through) for i, servo in enumerate(servos)], axis=1)
    return late(effects, servos, system, values, rows)


def late(
    effects: Effects, servos: Sequence[Servo], system: AbstractSystem, fed: Float[Array, "time input"], rows: Sampling
) -> Float[Array, "time input"]:
    """Values at the drives of those that commands set, with the effects that take time."""
    columns = []
    for joint, servo, column in zip(system.joints, servos, fed.T, strict=True):
        before = servo.before(column)
        for effect in effects:
            if effect.joint == joint:
                column = before + rows.through(effect, column - before)
        columns.append(column)
    return jnp.stack(columns, axis=1)


def command_stream(
    effects: Effects, servos: Sequence[Servo] | None, system: AbstractSystem, rows: Sampling
) -> CommandStream:
    """`reaching` or `fed` row by row.

    Raises ValueError where a law of the command has no form for one row.
    """
    lines = [_line(effects, servos[i] if servos else None, joint, rows) for i, joint in enumerate(system.joints)]

    def step(memory, u, first):
        scale = u[len(lines) :] if u.shape[0] > len(lines) else None
        passed = [line(own, u[i], scale, first) for i, ((_, line), own) in enumerate(zip(lines, memory, strict=True))]
        return tuple(own for own, _ in passed), jnp.stack([fed for _, fed in passed]) if passed else u

    return CommandStream(tuple(memory for memory, _ in lines), step)


def _line(effects: Effects, servo: Servo | None, joint: int, rows: Sampling) -> tuple[Any, Callable[..., Any]]:
    """Memory and step of one drive: the command as in the first row, what it set, then the memory of each law."""
    laws = [(effect, rows.stream(effect)) for effect in effects if effect.joint == joint]
    for effect, stream in laws:
        if stream is None and type(effect).input is not AbstractEffect.input:
            raise ValueError(f"{effect.name!r} has no form for one row: give it `stream` beside `input`")
    delay = rows.stream(InputDelay(servo.values["delay"], joint=0)) if servo and "delay" in servo.values else None
    streams = [stream for stream in (delay, *(stream for _, stream in laws)) if stream]

    def step(memory, u, scale, first):
        (begun, stood, *before), after = memory, []

        def through(stream, value, base):
            memory = before[len(after)]
            if rows.smooth:  # before the first row the input stood as in it
                memory = jnp.where(first, memory.at[-2:].set(value - base), memory)
            own, late = stream.step(memory, value - base)
            after.append(own)
            return base + late

        if servo:
            begun = jnp.where(first, u, begun)
            u = LAWS[servo.kind].feed(servo.at(scale).values, through(delay, u, begun) if delay else u)
            stood = jnp.where(first, u, stood) if servo.feeds_back else stood
        for effect, stream in laws:
            u = through(stream, u, stood) if stream else u
            u = u if servo else effect.drive(u)
        return (begun, stood, *after), u

    return (jnp.zeros(()), jnp.zeros(()), *(stream.memory for stream in streams)), step


def driven(
    effects: Effects,
    servos: Sequence[Servo],
    system: AbstractSystem,
    u: Float[Array, " input"],
    q: Float[Array, " dof"],
    v: Float[Array, " dof"],
    scale: Float[Array, " column"] | None = None,
) -> Float[Array, " input"]:
    """Torque of every drive at one moment, with the effects that take none [N m, before the gear]."""
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
            if effect.channel in (name, "all"):
                values = values.at[i].set(effect.reading(values[i], lambda delay, i=i: past(delay)[i]))
    return values


def _memories(
    effects: Effects, memory: Float[Array, " memory"]
) -> Iterator[tuple[AbstractEffect, Float[Array, " memory"]]]:
    """Every effect with its own part of the memory."""
    place = 0
    for effect in effects:
        yield effect, memory[place : place + effect.memory]
        place += effect.memory
