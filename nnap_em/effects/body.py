"""Bodies that are not as declared: masses, inertias, lengths; each system says how it varies."""

from functools import partial
from typing import ClassVar

import jax

from .base import Around, Candidate, JointEffect, Scalar, known, one


def varieties(around: Around, name: str) -> list[tuple[int, float]]:
    """Joints at which the system knows the variation `name`, and its typical size."""
    found = [(j, size) for (kind, j), (_, size) in around.system.variations.items() if kind == name]
    return [(j, float(size(around.system))) for j, size in found]


class Variation(JointEffect):
    """A body that differs by an amount; the machine knows what that changes."""

    amount: Scalar

    @classmethod
    def candidates(cls, around):
        return [one(partial(cls, joint=j), 0.0, 0.05 * size, size) for j, size in varieties(around, cls.name)]

    def values(self):
        return dict.fromkeys(self.units, self.amount)

    def physics(self, system, time):
        return system.vary(self.name, self.joint, self.amount)


class Payload(Variation):
    """A point mass at the tip."""

    name: ClassVar[str] = "payload"
    confirm: ClassVar[str] = "Weigh the links, with everything that is mounted on them."
    units: ClassVar[dict[str, str]] = {"mass": "kg"}


class LinkInertia(Variation):
    """A moment of inertia off by dI."""

    name: ClassVar[str] = "link_inertia"
    confirm: ClassVar[str] = "Swing the link alone about a known axis and time it."
    units: ClassVar[dict[str, str]] = {"dI": "kg m^2"}


class LinkLength(Variation):
    """A length off by dl."""

    name: ClassVar[str] = "link_length"
    confirm: ClassVar[str] = "Measure the distance between the joints."
    units: ClassVar[dict[str, str]] = {"dl": "m"}


class CenterOfMass(Variation):
    """A centre of mass off by dlc along the link."""

    name: ClassVar[str] = "center_of_mass"
    confirm: ClassVar[str] = "Balance the link on an edge."
    units: ClassVar[dict[str, str]] = {"dlc": "m"}


class PayloadStep(JointEffect):
    """A payload that comes on at a moment of the clock; the edge is some samples wide, so that a fit can move it."""

    name: ClassVar[str] = "payload_step"
    confirm: ClassVar[str] = "Ask what was mounted or lost at that moment."
    units: ClassVar[dict[str, str]] = {"mass": "kg", "time": "s"}
    mass: Scalar
    time: Scalar
    edge: Scalar = known()

    @classmethod
    def candidates(cls, around):
        if not around.session:
            return []
        first, last = around.duration
        out = []
        for j, size in varieties(around, "payload"):
            make, apart, edge = partial(cls.of, joint=j), (last - first) / 24, 3 * around.dt
            for time in (first + apart * i for i in range(1, 24)):
                probe, spread = make(0.05 * size, time, edge), make(size, apart, edge)
                out.append(Candidate(make(0.0, time, edge), (probe,), spread))
        return out

    def physics(self, system, time):
        return system.vary("payload", self.joint, self.mass * jax.nn.sigmoid((time - self.time) / self.edge))
