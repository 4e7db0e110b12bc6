# pyright: reportCallIssue=false, reportArgumentType=false
# (pyright takes equinox's abstract fields for fields of the constructor)
"""Bodies that are not as declared: masses, inertias, lengths; each system says how it varies."""

from typing import ClassVar

import equinox as eqx
import jax

from .base import AbstractEffect, Around, Candidate, Scalar, a, known


def varieties(around: Around, name: str) -> list[tuple[int, float]]:
    """Joints at which the system knows the variation `name`, and its typical size."""
    found = [(j, size) for (kind, j), (_, size) in around.system.variations.items() if kind == name]
    return [(j, float(size(around.system))) for j, size in found]


class Variation(AbstractEffect):
    """A body that differs by an amount; the machine knows what that changes."""

    amount: Scalar
    joint: int | None = eqx.field(static=True)
    channel: str | None = eqx.field(static=True, default=None)

    @classmethod
    def candidates(cls, around):
        return [Candidate(cls(a(0.0), j), (cls(a(0.05 * s), j),), cls(a(s), j)) for j, s in varieties(around, cls.name)]

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


class PayloadStep(AbstractEffect):
    """A payload that comes on at a moment of the clock; the edge is some samples wide, so that a fit can move it."""

    name: ClassVar[str] = "payload_step"
    confirm: ClassVar[str] = "Ask what was mounted or lost at that moment."
    units: ClassVar[dict[str, str]] = {"mass": "kg", "time": "s"}
    mass: Scalar
    time: Scalar
    joint: int | None = eqx.field(static=True)
    edge: Scalar = known()
    channel: str | None = eqx.field(static=True, default=None)

    @classmethod
    def candidates(cls, around):
        if not around.session:
            return []
        first, last = around.duration
        out = []
        for j, size in varieties(around, "payload"):
            for i in range(1, 24):
                time = first + (last - first) * i / 24
                make = lambda mass, time, j=j: cls(a(mass), a(time), j, 3 * around.dt)  # noqa: E731
                out.append(Candidate(make(0.0, time), (make(0.05 * size, time),), make(size, (last - first) / 24)))
        return out

    def physics(self, system, time):
        return system.vary("payload", self.joint, self.mass * jax.nn.sigmoid((time - self.time) / self.edge))
