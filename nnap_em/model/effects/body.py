"""Bodies that are not as declared: masses, inertias, lengths; each system defines the variation."""

from functools import partial
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .base import Candidate, JointEffect, Scalar, SearchScales, a, known, one


def varieties(around: SearchScales, name: str) -> list[tuple[int, float]]:
    """Joints at which the system has the variation `name`, and its typical size."""
    sizes = [(j, size) for (kind, j), (_, size) in around.system.variations.items() if kind == name]
    return [(j, float(size(around.system))) for j, size in sizes]


class Variation(JointEffect):
    """A body that differs by an amount; the machine defines the change."""

    amount: Scalar

    @classmethod
    def candidates(cls, around):
        return [one(partial(cls, joint=j), 0.0, 0.05 * size, size) for j, size in varieties(around, cls.name)]

    def values(self):
        return dict.fromkeys(self.units, self.amount)

    def physics(self, system, time):
        return system.vary(self.name, self.joint, self.amount)


class Payload(Variation):
    """A point mass: at the tip or, on a body of a machine file, at its centre, which is estimated with it.

    In place of the centre c its first moment mass (c - point) about a known point is fitted: forces are linear in it.
    """

    meaning: ClassVar[str] = "A body carries more mass than declared."
    confirm: ClassVar[str] = "Weigh the links, with everything that is mounted on them."
    units: ClassVar[dict[str, str]] = {"mass": "kg", "centre_x": "m", "centre_y": "m", "centre_z": "m"}
    words: ClassVar[dict[str, str]] = {
        "mass": "added mass", **{f"centre_{axis}": f"its centre along {axis} of the body" for axis in "xyz"}
    }  # fmt: skip
    moment: Float[Array, "3"] | None = None
    """First moment about the point [kg m]; None: the mass is at the tip."""
    point: tuple[float, float, float] = eqx.field(static=True, default=(0.0, 0.0, 0.0))
    """Centre in the frame of the body [m]."""

    @classmethod
    def candidates(cls, around):
        spots = around.system.spots
        anywhere = [_anywhere(cls, joint, spot) for joint, spot in spots.items()]
        return [c for c in super().candidates(around) if c.start.joint not in spots] + anywhere

    def values(self):
        if self.moment is None:
            return {"mass": self.amount}
        away = self.moment / jnp.where(self.amount == 0, 1.0, self.amount)
        return {"mass": self.amount} | {f"centre_{axis}": self.point[i] + away[i] for i, axis in enumerate("xyz")}

    def physics(self, system, time):
        if self.moment is None:
            return super().physics(system, time)
        return system.loaded(self.joint, self.amount, self.moment)


def _anywhere(kind: type[Payload], joint: int, spot) -> Candidate:
    """A load of unknown mass and centre: four strengths."""
    size, make = spot.mass * spot.length, lambda mass, moment: kind(a(mass), a(moment), spot.point, joint=joint)
    probes = (make(0.05 * spot.mass, np.zeros(3)), *(make(0.0, 0.05 * size * row) for row in np.eye(3)))
    return Candidate(make(0.0, np.zeros(3)), probes, make(spot.mass, np.full(3, size)))


class LinkInertia(Variation):
    """A moment of inertia off by dI."""

    meaning: ClassVar[str] = "A link is harder (or easier) to spin than declared."
    confirm: ClassVar[str] = "Swing the link alone about a known axis and time it."
    units: ClassVar[dict[str, str]] = {"dI": "kg m^2"}
    words: ClassVar[dict[str, str]] = {"dI": "added inertia"}


class LinkLength(Variation):
    """A length off by dl."""

    meaning: ClassVar[str] = "A link is longer (or shorter) than declared."
    confirm: ClassVar[str] = "Measure the distance between the joints."
    units: ClassVar[dict[str, str]] = {"dl": "m"}
    words: ClassVar[dict[str, str]] = {"dl": "added length"}


class CenterOfMass(Variation):
    """A centre of mass off by dlc along the link."""

    meaning: ClassVar[str] = "The centre of mass of a link is not where declared."
    confirm: ClassVar[str] = "Balance the link on an edge."
    units: ClassVar[dict[str, str]] = {"dlc": "m"}
    words: ClassVar[dict[str, str]] = {"dlc": "shift outwards"}


class PayloadStep(JointEffect):
    """A payload that comes on at a moment of the clock; the edge is some samples wide, so that a fit can move it."""

    meaning: ClassVar[str] = "The payload changed at a moment of the session."
    confirm: ClassVar[str] = "Ask what was mounted or lost at that moment."
    units: ClassVar[dict[str, str]] = {"mass": "kg", "time": "s"}
    words: ClassVar[dict[str, str]] = {"mass": "added mass", "time": "moment"}
    mass: Scalar
    time: Scalar
    edge: Scalar = known()

    @classmethod
    def candidates(cls, around):
        if not around.session:
            return []
        first, interval = around.duration[0], (around.duration[1] - around.duration[0]) / 24
        times = [first + interval * i for i in range(1, 24)]
        joints = [(partial(cls, edge=a(3 * around.dt), joint=j), size) for j, size in varieties(around, "payload")]
        return [one(make, 0.0, 0.05 * size, size, (time, interval)) for make, size in joints for time in times]

    def physics(self, system, time):
        return system.vary("payload", self.joint, self.mass * jax.nn.sigmoid((time - self.time) / self.edge))
