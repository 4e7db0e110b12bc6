"""The base that the machine stands on: not level, or shaking."""

import math
from typing import ClassVar

import jax.numpy as jnp
import numpy as np

from .base import AbstractEffect, Scalar, a, known, one, pair


class BaseTilt(AbstractEffect):
    """Gravity acts on theta1 + angle."""

    meaning: ClassVar[str] = "The base is not level: gravity points in another direction than declared."
    confirm: ClassVar[str] = "Put a level on the base, and let the machine hang at rest: where does it read zero?"
    units: ClassVar[dict[str, str]] = {"angle": "rad"}
    words: ClassVar[dict[str, str]] = {"angle": "tilt"}
    angle: Scalar

    @classmethod
    def candidates(cls, around):
        return [one(cls, 0.0, 0.03, 0.5)] if cls.weighs(around.system) else []

    @classmethod
    def weighs(cls, system):
        """True where gravity acts on the first joint, a hinge."""
        still = jnp.zeros(len(system.coordinates))
        return system.angles[0] and bool(np.any(cls(a(0.1)).turned(system, still, still)))

    def same_as(self, system, measured):
        """A bias of the first angle the other way: nothing but gravity depends on that angle itself."""
        first = system.coordinates[0]
        return (("sensor_bias", None, first, ()),) if first in measured else ()

    def turned(self, system, q, v):
        """Change of the gravity torque by the tilt [N m]."""
        return system.bias(q, v) - system.bias(q.at[0].add(self.angle), v)

    def force(self, scene, memory):
        return self.turned(scene.system, scene.q, scene.v)


class BaseVibration(AbstractEffect):
    """Horizontal base acceleration amplitude sin(2 pi frequency t + phase)."""

    meaning: ClassVar[str] = "The base shakes, or something else forces the machine periodically."
    confirm: ClassVar[str] = "Put an accelerometer on the base."
    units: ClassVar[dict[str, str]] = {"amplitude": "m/s^2", "frequency": "Hz", "phase": "rad"}
    sine: Scalar
    cosine: Scalar
    frequency: Scalar
    slowest: Scalar = known(default=0.0)
    """Frequency of one period in the recording [Hz]: less is a base that leans."""

    @classmethod
    def candidates(cls, around):
        if around.system.shake(jnp.zeros(len(around.system.coordinates))) is None:
            return []
        span = around.duration[1] - around.duration[0]
        grid = 64  # the number of frequencies is a multiple of this, so that few programs serve all durations
        count = grid * math.ceil(min(8.0 * span / 0.4, 400) / grid)
        make = lambda *numbers: cls.of(*numbers, 1 / span)  # noqa: E731
        return [pair(make, 0.1, 5.0, (float(f), 0.3 / span)) for f in np.linspace(1 / span, 8.0, count)]

    def is_physical(self):
        return float(self.frequency) >= float(self.slowest)

    def values(self):
        amplitude = jnp.sqrt(self.sine**2 + self.cosine**2 + 1e-30)
        return {"amplitude": amplitude, "frequency": self.frequency, "phase": jnp.arctan2(self.cosine, self.sine)}

    def force(self, scene, memory):
        turn = 2 * jnp.pi * self.frequency * scene.time
        shake = scene.system.shake(scene.q)
        assert shake is not None
        return shake * (self.sine * jnp.sin(turn) + self.cosine * jnp.cos(turn))
