"""Readings that are not what they stand for."""

from typing import ClassVar

import equinox as eqx

from .base import AbstractEffect, Candidate, Scalar, a


class SensorBias(AbstractEffect):
    """value + bias."""

    name: ClassVar[str] = "sensor_bias"
    units: ClassVar[dict[str, str]] = {"bias": "unit of the channel"}
    bias: Scalar
    channel: str | None = eqx.field(static=True)
    joint: int | None = eqx.field(static=True, default=None)

    @classmethod
    def candidates(cls, around):
        return [
            Candidate(cls(a(0.0), name), (cls(a(0.03 * float(size)), name),), cls(a(0.5 * float(size)), name))
            for name, size in zip(around.measured, around.reading, strict=True)
        ]

    def reading(self, value, past):
        return value + self.bias


class SensorScale(AbstractEffect):
    """scale value."""

    name: ClassVar[str] = "sensor_scale"
    units: ClassVar[dict[str, str]] = {"scale": "-"}
    excess: Scalar
    """scale - 1."""
    channel: str | None = eqx.field(static=True)
    joint: int | None = eqx.field(static=True, default=None)

    @classmethod
    def candidates(cls, around):
        return [Candidate(cls(a(0.0), name), (cls(a(0.03), name),), cls(a(0.5), name)) for name in around.measured]

    def values(self):
        return {"scale": 1 + self.excess}

    def reading(self, value, past):
        return (1 + self.excess) * value


class SensorDelay(AbstractEffect):
    """The value some time ago."""

    name: ClassVar[str] = "sensor_delay"
    units: ClassVar[dict[str, str]] = {"delay": "s"}
    delay: Scalar
    channel: str | None = eqx.field(static=True)
    joint: int | None = eqx.field(static=True, default=None)

    @classmethod
    def candidates(cls, around):
        names = (*around.measured, *(("all",) if len(around.measured) > 1 else ()))
        return [
            Candidate(cls(a(0.0), name), (cls(a(0.5 * around.dt), name),), cls(a(3 * around.dt), name))
            for name in names
        ]

    def possible(self):
        return float(self.delay) > 0

    def reading(self, value, past):
        return past(self.delay)
