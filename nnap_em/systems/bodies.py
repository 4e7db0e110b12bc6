"""Bodies of a machine file with what is estimated about them, as the joints carry them."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import jax.numpy as jnp

from ..data.machine import Body, Machine
from .frames import Layout, Mount
from .recursion import NOTHING, Inertia, inertia, united
from .spatial import Scalar, Three, Turn, about, add, apply, sandwich, scaled, subtract, summed

AXES = "xyz"
MARGIN = 1e-9
"""Share by which an inertia may leave the physical ones: rounding, and rods that have none about their axis."""


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
    """What the frame of every joint carries; no number where a body is not physical, so that no fit goes there."""
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
    """Whether some distribution of mass has this inertia: half its trace less itself is positive, and so is the mass.

    [Wensing, Kim & Slotine 2018, IEEE RA-L 3(1), eq. 12: the pseudo-inertia]  By leading minors, with a margin.
    """
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = own
    half = 0.5 * (xx + yy + zz)
    slack = MARGIN * half
    a, b, c = half - xx + slack, half - yy + slack, half - zz + slack
    second = a * b - xy * xy
    third = c * second - a * yz * yz - b * xz * xz - 2 * xy * xz * yz
    return (mass > 0) & (half > 0) & (a > 0) & (second > 0) & (third > 0)


def with_load(tree: Any, place: int, at: Three, mass: Scalar) -> Any:
    """A point mass at a place of a body, as other mass, centre and inertia of that body."""
    body = tree.machine.bodies[place]
    old, centre, own = numbers(body, tree.values)
    total = old + mass
    away = subtract(at, centre)
    moved = scaled(mass / total, away)
    own = summed(own, about(scaled(0.5 * old * mass / total, away), away))
    centre = add(centre, moved)
    values = {f"{body.name}.mass": total}
    values |= {f"{body.name}.com.{axis}": jnp.asarray(centre[i]) for i, axis in enumerate(AXES)}
    pairs = ((i, j) for i in range(3) for j in range(i, 3))
    values |= {f"{body.name}.inertia.{AXES[i]}{AXES[j]}": jnp.asarray(own[i][j]) for i, j in pairs}
    return replace(tree, values={**tree.values, **values})


def varied(machine: Machine) -> dict[tuple[str, int], tuple[Callable[..., Any], Callable[..., Any]]]:
    """How a tree may differ: a load on every outermost body, at its first site, or else at its centre of mass."""
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
