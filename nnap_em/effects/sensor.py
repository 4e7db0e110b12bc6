# pyright: reportCallIssue=false, reportArgumentType=false
# (pyright takes equinox's abstract fields for fields of the constructor)
"""Readings that are not what they stand for."""

from typing import ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Float

from .base import AbstractEffect, Candidate, Scalar, a


class SensorBias(AbstractEffect):
    """value + bias."""

    name: ClassVar[str] = "sensor_bias"
    confirm: ClassVar[str] = "Bring the joint to a known position and read the sensor."
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
    confirm: ClassVar[str] = "Move the joint by a known angle and compare."
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
    confirm: ClassVar[str] = "Tap the link and compare the sensor with a second one on the same clock."
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


class SensorQuantization(AbstractEffect):
    """The value rounded to a multiple of step: as noise, of variance step^2 / 12.

    The score test cannot see it; `grid_step` reads it off the numbers themselves.
    """

    name: ClassVar[str] = "sensor_quantization"
    confirm: ClassVar[str] = "Look up the counts per turn of the encoder."
    units: ClassVar[dict[str, str]] = {"step": "unit of the channel"}
    read_off: ClassVar[bool] = True
    step: Scalar
    channel: str | None = eqx.field(static=True)
    joint: int | None = eqx.field(static=True, default=None)


def grid_step(values: Float[np.ndarray, " sample"]) -> float:
    """The step of a signal that takes only multiples of it; 0 for any other."""
    known = np.unique(values[np.isfinite(values)])
    if known.size < 3 or known.size > 0.3 * values.size:
        return 0.0
    gaps = np.diff(known)
    step = float(np.median(gaps[gaps < 1.5 * gaps[gaps > 1e-9 * np.ptp(known)].min()]))
    off = values[np.isfinite(values)] / step
    off = np.abs(off - np.round(off - np.median(off - np.round(off))) - np.median(off - np.round(off)))
    return step if np.mean(off < 0.1) > 0.99 else 0.0
