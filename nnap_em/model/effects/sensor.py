"""Readings that are not what they stand for."""

from functools import partial
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from .base import Scalar, SensorEffect, one
from .mounting import BaseTilt


class SensorBias(SensorEffect):
    """value + bias."""

    meaning: ClassVar[str] = "A sensor is off by a constant."
    confirm: ClassVar[str] = "Bring what it reads, as a joint, to a known value and read the sensor."
    units: ClassVar[dict[str, str]] = {"bias": "unit of the channel"}
    bias: Scalar

    @classmethod
    def candidates(cls, around):
        sizes = zip(around.measured, map(float, around.reading), strict=True)
        return [one(partial(cls, channel=name), 0.0, 0.03 * size, 0.5 * size) for name, size in sizes]

    def same_as(self, system, measured):
        """A tilt of the base the other way, for the first angle."""
        tilts = self.channel in system.coordinates[:1] and BaseTilt.weighs(system)
        return (("base_tilt", None, None, ()),) if tilts else ()

    def reading(self, value, past):
        return value + self.bias


class SensorScale(SensorEffect):
    """scale value."""

    meaning: ClassVar[str] = "A sensor reads too large or too small, in a fixed proportion."
    confirm: ClassVar[str] = "Change what it reads, as an angle, by a known amount and compare."
    units: ClassVar[dict[str, str]] = {"scale": "-"}
    words: ClassVar[dict[str, str]] = {"scale": "reading / value"}
    excess: Scalar
    """scale - 1."""

    @classmethod
    def candidates(cls, around):
        return [one(partial(cls, channel=name), 0.0, 0.03, 0.5) for name in around.measured]

    def values(self):
        return {"scale": 1 + self.excess}

    def reading(self, value, past):
        return (1 + self.excess) * value


class SensorDelay(SensorEffect):
    """The value some time ago."""

    meaning: ClassVar[str] = "A sensor reports late."
    confirm: ClassVar[str] = "Tap the link, or make a step, and compare the sensor with a second one on the same clock."
    units: ClassVar[dict[str, str]] = {"delay": "s"}
    above_zero: ClassVar[str] = "delay"
    delay: Scalar

    @classmethod
    def candidates(cls, around):
        names = (*around.measured, *(("all",) if len(around.measured) > 1 else ()))
        return [one(partial(cls, channel=name), 0.0, 0.5 * around.dt, 3 * around.dt) for name in names]

    def reading(self, value, past):
        return past(self.delay)


class SensorQuantization(SensorEffect):
    """The value rounded to a multiple of step: as noise, of variance step^2 / 12.

    The score test cannot see it; `grid_step` reads it off the numbers themselves.
    """

    meaning: ClassVar[str] = "A sensor reads in steps."
    confirm: ClassVar[str] = "Look up the counts per turn of the encoder."
    units: ClassVar[dict[str, str]] = {"step": "unit of the channel"}
    read_off: ClassVar[bool] = True
    step: Scalar


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
