"""Bodies of a machine file with what is estimated about them, as the joints carry them."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import jax.numpy as jnp

from ..data.machine import AXES, OF_BODY, PAIRS, Body, Machine
from .frames import Layout, Mount
from .pseudo_inertia import Numbers, stepped
from .recursion import NOTHING, Inertia, inertia, united
from .spatial import Scalar, Three, Turn, about, add, apply, sandwich, scaled, subtract, summed

MARGIN = 1e-9
"""Share by which an inertia may leave the physical ones: rounding, and rods that have none about their axis."""


def names(body: Body) -> list[str]:
    """All that may be estimated of a body."""
    return [f"{body.name}.{what}" for what in OF_BODY]


def numbers(body: Body, values: Mapping[str, Scalar]) -> tuple[Scalar, Three, Turn]:
    """Mass [kg], centre of mass [m] and inertia about it [kg m^2] in the body's frame."""

    def at(what: str, given: float) -> Scalar:
        return values.get(f"{body.name}.{what}", given)

    x, y, z = (at(f"com.{axis}", body.centre[i]) for i, axis in enumerate(AXES))
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = (
        tuple(at(f"inertia.{min(a, b)}{max(a, b)}", body.inertia[i][j]) for j, b in enumerate(AXES))
        for i, a in enumerate(AXES)
    )
    return at("mass", body.mass), (x, y, z), ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))


def carried_by(machine: Machine, layout: Layout, values: Mapping[str, Scalar]) -> list[Inertia]:
    """Body that the frame of every joint carries; no number where a body is not physical, so that no fit goes there."""
    found = [NOTHING] * len(layout.frames)
    for body, mount in zip(machine.bodies, layout.mounts, strict=True):
        if mount.joint < 0:
            continue
        mass, centre, own = numbers(body, values)
        if any(name.startswith(f"{body.name}.") for name in values):
            mass = jnp.where(physical(mass, own), mass, jnp.nan)
        found[mount.joint] = united(found[mount.joint], mounted(mass, centre, own, mount))
    return found


def mounted(mass: Scalar, centre: Three, own: Turn, mount: Mount) -> Inertia:
    """A body as the joint's frame carries it."""
    return inertia(mass, add(mount.place, apply(mount.turn, centre)), sandwich(mount.turn, own))


def physical(mass: Scalar, own: Turn) -> Any:
    """True where some distribution of mass has this inertia: half its trace less itself is positive, and so is the
    mass.

    [Wensing, Kim & Slotine 2018, IEEE RA-L 3(1), eq. 12: the pseudo-inertia]  By leading minors, with a margin.
    """
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = own
    half = 0.5 * (xx + yy + zz)
    slack = MARGIN * half
    a, b, c = half - xx + slack, half - yy + slack, half - zz + slack
    second = a * b - xy * xy
    third = c * second - a * yz * yz - b * xz * xz - 2 * xy * xz * yz
    return (mass > 0) & (half > 0) & (a > 0) & (second > 0) & (third > 0)


def kept_physical(machine: Machine, before: Mapping[str, Scalar], after: Mapping[str, Scalar]) -> dict[str, Any]:
    """`after`, but a body that is estimated in all its numbers and cannot be so is one on the way from `before`."""
    out = dict(after)
    for body in machine.bodies:
        own = names(body)
        if not set(own) <= set(after):
            continue
        goal = numbers(body, after)
        there = _told(stepped(*(_together(*numbers(body, values)) for values in (before, after))))
        fine = physical(goal[0], goal[2])
        out |= {name: jnp.where(fine, after[name], one) for name, one in zip(own, there, strict=True)}
    return out


def _together(mass: Scalar, centre: Three, own: Turn) -> Numbers:
    return Numbers(jnp.asarray(mass), jnp.stack(centre), jnp.stack([jnp.stack(row) for row in own]))


def _told(body: Numbers) -> list[Scalar]:
    """Numbers in the order of `names`."""
    return [body.mass, *body.centre, *(body.inertia[i, j] for i, j in PAIRS)]


def with_load(tree: Any, place: int, at: Three, mass: Scalar) -> Any:
    """A point mass at a place of a body, as other mass, centre and inertia of that body."""
    body = tree.machine.bodies[place]
    old, centre, own = numbers(body, tree.values)
    total = old + mass
    away = subtract(at, centre)
    moved = scaled(mass / total, away)
    own = summed(own, about(scaled(0.5 * old * mass / total, away), away))
    centre = add(centre, moved)
    told = [total, *centre, *(own[i][j] for i, j in PAIRS)]
    values = dict(zip(names(body), map(jnp.asarray, told), strict=True))
    return replace(tree, values={**tree.values, **values})


def varied(machine: Machine) -> dict[tuple[str, int], tuple[Callable[..., Any], Callable[..., Any]]]:
    """Variations of a tree: a load on every outermost body, at its first site, or else at its centre of mass."""
    inner = {body.parent for body in machine.bodies}
    found = {}
    for place, body in enumerate(machine.bodies):
        joints = [j for j, joint in enumerate(machine.joints, 1) if joint.body == place]
        if place in inner or not joints:
            continue
        at = next((spot.place for spot in machine.spots if spot.body == place), body.centre)
        found["payload", joints[-1]] = (
            lambda tree, mass, place=place, at=at: with_load(tree, place, at, mass),
            lambda tree, body=body: numbers(body, tree.values)[0],
        )
    return found
