"""Actuators: laws between the commanded input u and the torque at its joint."""

import math
from functools import partial
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp

from .base import JointEffect, Scalar, Stream, input_of, one


class DriveEffect(JointEffect):
    """A law of the input that drives its joint, or of equations of that which its channel names."""

    joint: int | None = eqx.field(static=True, default=None, kw_only=True)

    def units_on(self, system):
        of = {"N m": system.unit(self.channel)} if self.channel else {}
        return {name: of.get(unit, unit) for name, unit in super().units_on(system).items()}


class InputEffect(DriveEffect):
    """One that takes no time."""

    def signals(self, system):
        return (input_of(self.joint) if self.joint else str(self.channel),)


class MotorGain(InputEffect):
    """gain u."""

    meaning: ClassVar[str] = "The drive delivers more or less than commanded, in a fixed proportion."
    confirm: ClassVar[str] = "Hold the output still (block the joint) and measure what the drive gives at one command."
    units: ClassVar[dict[str, str]] = {"gain": "-"}
    words: ClassVar[dict[str, str]] = {"gain": "delivered / commanded"}
    excess: Scalar
    """gain - 1."""

    @classmethod
    def candidates(cls, around):
        return [one(partial(cls, **place), 0.0, 0.05, 1.0) for place, _ in around.drives]

    def values(self):
        return {"gain": 1 + self.excess}

    def drive(self, torque):
        return (1 + self.excess) * torque


class DeadZone(InputEffect):
    """Nothing below width, sign(u) (|u| - width) beyond."""

    meaning: ClassVar[str] = "Small commands have no effect."
    confirm: ClassVar[str] = "Raise the command slowly from zero until something moves, both ways."
    units: ClassVar[dict[str, str]] = {"width": "N m"}
    words: ClassVar[dict[str, str]] = {"width": "half width"}
    above_zero: ClassVar[str] = "width"
    linear: ClassVar[bool] = False
    width: Scalar

    @classmethod
    def candidates(cls, around):
        grid = (0.03, 0.08, 0.15, 0.25, 0.4)
        return [one(partial(cls, **place), 0.0, s * size, 0.3 * size) for place, size in around.drives for s in grid]

    def drive(self, torque):
        return torque - jnp.clip(torque, -self.width, self.width)


class Saturation(InputEffect):
    """Limited to +-limit."""

    meaning: ClassVar[str] = "The drive cannot deliver more than a limit."
    confirm: ClassVar[str] = "Block the joint and raise the command until the torque stays; look at the current limit."
    units: ClassVar[dict[str, str]] = {"limit": "N m"}
    above_zero: ClassVar[str] = "limit"
    linear: ClassVar[bool] = False
    limit: Scalar

    @classmethod
    def candidates(cls, around):
        grid, drives = (0.9, 0.75, 0.6, 0.45, 0.3, 0.2), around.drives
        return [one(partial(cls, **place), 2 * size, s * size, 0.2 * size) for place, size in drives for s in grid]

    def drive(self, torque):
        return jnp.clip(torque, -self.limit, self.limit)


class OneSidedLoss(InputEffect):
    """u on one side of zero, (1 - loss) u on the other: below zero for side = -1, above for 1."""

    reported_as: ClassVar[str] = "unknown_function"
    meaning: ClassVar[str] = "The drive delivers less one way than the other."
    confirm: ClassVar[str] = "Block the joint and measure its torque at one command, both ways."
    units: ClassVar[dict[str, str]] = {"loss": "-"}
    loss: Scalar
    side: int = eqx.field(static=True)
    column: str = eqx.field(static=True)
    """Name of the input."""

    @classmethod
    def candidates(cls, around):
        places = ((j, side) for j, _ in around.driven for side in (-1, 1))
        return [one(partial(cls, side=side, column=around.column(j), joint=j), 0.0, 0.05, 1.0) for j, side in places]

    def inputs_named(self):
        return (self.column,)

    def is_physical(self):
        return 0 < float(self.loss) < 1

    def drive(self, torque):
        return torque - self.side * self.loss * jnp.maximum(self.side * torque, 0.0)


class InputDelay(DriveEffect):
    """u acts later by any time; before the first row it was 0."""

    meaning: ClassVar[str] = "Commands act late."
    confirm: ClassVar[str] = "Log the command and what the drive gives, as its current, on one clock."
    units: ClassVar[dict[str, str]] = {"delay": "s"}
    above_zero: ClassVar[str] = "delay"
    delay: Scalar

    @classmethod
    def candidates(cls, around):
        grid, dt = (0.5, 1.5, 2.5, 4.0, 6.0, 9.0), around.dt
        return [one(partial(cls, **place), 0.0, n * dt, 3 * dt) for place, _ in around.drives for n in grid]

    def input(self, u, dt):
        late = jnp.arange(u.shape[0], dtype=u.dtype) - jnp.maximum(self.delay, 0.0) / dt
        whole = jnp.floor(late)
        share = late - whole
        padded = jnp.concatenate([jnp.zeros_like(u[:1]), u])
        take = lambda k: padded[jnp.clip(k.astype(int) + 1, 0, u.shape[0])]  # noqa: E731
        return (1 - share) * take(whole) + share * take(whole + 1)

    def stream(self, dt):
        late = max(float(self.delay), 0.0) / dt
        rows = math.ceil(late)

        def step(memory, u):
            line = jnp.append(memory, u)
            return line[1:], (1 - rows + late) * line[0] + (rows - late) * line[min(rows, 1)]

        return Stream(jnp.zeros(rows, self.delay.dtype), step)


class ActuatorLag(DriveEffect):
    """First-order lag of time constant tau, the mean over each sample of the exact response."""

    meaning: ClassVar[str] = "The drive follows its command gradually."
    confirm: ClassVar[str] = "Log the command and what the drive gives, as its current, on one clock, for a step."
    units: ClassVar[dict[str, str]] = {"tau": "s"}
    words: ClassVar[dict[str, str]] = {"tau": "time constant"}
    above_zero: ClassVar[str] = "tau"
    tau: Scalar

    @classmethod
    def candidates(cls, around):
        grid, dt = (0.7, 1.5, 3.0, 5.0, 8.0, 15.0), around.dt
        return [one(partial(cls, **place), 0.0, n * dt, 5 * dt) for place, _ in around.drives for n in grid]

    def input(self, u, dt):
        stream = self.stream(dt)
        return jax.lax.scan(stream.step, stream.memory.astype(u.dtype), u)[1]

    def stream(self, dt):
        tau = jnp.maximum(self.tau, 0.05 * dt)
        keep = jnp.exp(-dt / tau)
        share = tau / dt * (1 - keep)

        def step(torque, u):
            return u + (torque - u) * keep, u + (torque[0] - u) * share

        return Stream(jnp.zeros(1, self.tau.dtype), step)
