"""Bodies of a machine file with what is estimated about them, as the joints carry them."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from ..machine import AXES, OF_BODY, PAIRS, Body, Machine
from .frames import Layout, Mount
from .pseudo_inertia import Numbers, stepped
from .recursion import NO_INERTIA, Inertia, carried, inertia, united
from .spatial import Scalar, Three, Turn, about, add, apply, sandwich, scaled, subtract, summed, times, transposed


def numbers(body: Body, values: Mapping[str, Scalar]) -> tuple[Scalar, Three, Turn]:
    """Mass [kg], centre of mass [m] and inertia about it [kg m^2] in the body's frame."""

    def at(what: str, default: float) -> Scalar:
        return values.get(f"{body.name}.{what}", default)

    x, y, z = (at(f"com.{axis}", body.centre[i]) for i, axis in enumerate(AXES))
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = (
        tuple(at(f"inertia.{min(a, b)}{max(a, b)}", body.inertia[i][j]) for j, b in enumerate(AXES))
        for i, a in enumerate(AXES)
    )
    return at("mass", body.mass), (x, y, z), ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))


def carried_by(
    machine: Machine, layout: Layout, values: Mapping[str, Scalar], loads: Mapping[int, Inertia]
) -> list[Inertia]:
    """Body with its load that each joint's frame carries; no number where it is not physical: no fit goes there."""
    inertias = [NO_INERTIA] * len(layout.frames)
    for place, (body, mount) in enumerate(zip(machine.bodies, layout.mounts, strict=True)):
        if mount.joint < 0:
            continue
        mass, centre, tensor = numbers(body, values)
        if any(name.startswith(f"{body.name}.") for name in values):
            mass = jnp.where(physical(mass, tensor), mass, jnp.nan)
        inertias[mount.joint] = united(inertias[mount.joint], mounted(mass, centre, tensor, mount))
        if place in loads:
            inertias[mount.joint] = united(inertias[mount.joint], carried(loads[place], mount.place, mount.turn))
    return inertias


def mounted(mass: Scalar, centre: Three, tensor: Turn, mount: Mount) -> Inertia:
    """A body as the joint's frame carries it."""
    return inertia(mass, add(mount.place, apply(mount.turn, centre)), sandwich(mount.turn, tensor))


def physical(mass: Scalar, tensor: Turn) -> Any:
    """True where some distribution of mass has this inertia: half its trace less itself, and the mass, are positive.

    [Wensing, Kim & Slotine 2018, IEEE RA-L 3(1), eq. 12: the pseudo-inertia]  By leading minors, with a margin.
    """
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = tensor
    half = 0.5 * (xx + yy + zz)
    # Share by which an inertia may leave the physical ones: rounding, and rods that have none about their axis
    margin = 1e-9
    slack = margin * half
    a, b, c = half - xx + slack, half - yy + slack, half - zz + slack
    second = a * b - xy * xy
    third = c * second - a * yz * yz - b * xz * xz - 2 * xy * xz * yz
    return (mass > 0) & (half > 0) & (a > 0) & (second > 0) & (third > 0)


def kept_physical(machine: Machine, before: Mapping[str, Scalar], after: Mapping[str, Scalar]) -> dict[str, Any]:
    """`after`, but a body that is estimated in all its numbers and cannot be so is one on the way from `before`."""
    out = dict(after)
    for body in machine.bodies:
        keys = [f"{body.name}.{what}" for what in OF_BODY]
        if not set(keys) <= set(after):
            continue
        goal = numbers(body, after)
        step = stepped(*(_together(*numbers(body, values)) for values in (before, after)))
        reached = [step.mass, *step.centre, *(step.inertia[i, j] for i, j in PAIRS)]  # in the order of `keys`
        fine = physical(goal[0], goal[2])
        out |= {name: jnp.where(fine, after[name], one) for name, one in zip(keys, reached, strict=True)}
    return out


def _together(mass: Scalar, centre: Three, tensor: Turn) -> Numbers:
    return Numbers(jnp.asarray(mass), jnp.stack(centre), jnp.stack([jnp.stack(row) for row in tensor]))


class LoadPoint(NamedTuple):
    """Place of a candidate load on the body of a joint, and its typical size."""

    body: int  # Place of the body among all
    point: tuple[float, float, float]  # Point of a load without a first moment, in the frame of the body [m]
    mass: float  # Mean mass of a moving body [kg]
    length: float  # Longest distance from a joint to what it carries [m]


def spots(machine: Machine, layout: Layout) -> dict[int, LoadPoint]:
    """Every outermost joint, counted from 1, with its spot: the first site of its bodies, else its centre of mass."""
    inner = {frame.before for frame in layout.frames}
    moving = [(body, mount) for body, mount in zip(machine.bodies, layout.mounts, strict=True) if mount.joint >= 0]
    mass = sum(body.mass for body, _ in moving) / max(len(layout.frames), 1)
    length = _longest(layout, moving)
    out = {}
    for j in range(len(layout.frames)):
        if j in inner:
            continue
        place = machine.joints[j].body
        mount, body = layout.mounts[place], machine.bodies[place]
        sites = sorted((s for s in machine.sites if layout.mounts[s.body].joint == j), key=lambda s: s.body != place)
        points = [_moved(s.place, layout.mounts[s.body], mount) if s.body != place else s.place for s in sites]
        out[j + 1] = LoadPoint(place, next(iter(points), body.centre), mass, length)
    return out


def _moved(point: Three, inside: Mount, to: Mount) -> tuple[float, float, float]:
    """A point of one body in the frame of another that the same joint carries."""
    away = subtract(add(inside.place, apply(inside.turn, point)), to.place)
    x, y, z = map(float, apply(transposed(to.turn), away))
    return x, y, z


def _longest(layout: Layout, moving: Sequence[tuple[Body, Mount]]) -> float:
    """Longest distance from a joint to the next one, or to the mass of what it carries [m]."""
    lengths = [float(np.linalg.norm(frame.place)) for frame in layout.frames if frame.before >= 0]
    for body, mount in moving:
        if body.mass > 0:
            centre = np.asarray(mount.place) + np.asarray(mount.turn) @ np.asarray(body.centre)
            lengths.append(math.sqrt(float(centre @ centre) + 0.5 * float(np.trace(body.inertia)) / body.mass))
    return max(lengths, default=0.0)


def load(spot: LoadPoint, mass: Scalar, moment: Three) -> Inertia:
    """A point mass in the frame of a body, about its origin, by its mass and its first moment about a spot.

    With h = mass (c - point) its second moment is linear but for |h|^2 / mass.  That share fades out below 0.001 of
    the typical mass, where a first moment alone means a centre of mass that is not as declared.
    """
    least = 1e-3 * spot.mass  # share of a typical mass below which a load has no inertia about its spot
    inverse = mass / jnp.square(jnp.maximum(jnp.abs(mass), least))
    share = about(scaled(times(0.5, inverse), moment), moment)
    second = summed(summed(about(scaled(times(0.5, mass), spot.point), spot.point), about(moment, spot.point)), share)
    return Inertia(mass, add(scaled(mass, spot.point), moment), second)


def with_load(body: tuple[Scalar, Three, Turn], added: Inertia) -> tuple[Scalar, Three, Turn]:
    """Mass, centre and inertia about it of a body with a load."""
    total = united(inertia(*body), added)
    centre = scaled(1.0 / total.mass, total.moment)
    steiner = about(scaled(-0.5, total.moment), centre)
    return total.mass, centre, summed(total.second, steiner)
