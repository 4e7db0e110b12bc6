"""A machine from its owner's file: any tree of hinges and slides on a fixed base."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..machine import SENSE_UNITS, Machine, machine_unit, unpacked
from ..units import quantities
from .base import AbstractSystem
from .bodies import LoadPoint, carried_by, kept_physical, load, numbers, spots, with_load
from .frames import laid
from .recursion import Inertia, composite, motions, newton_euler, posed, solved, united
from .sensing import seen
from .spatial import Scalar, Three, Turn, minus, plus, times

KNEE = 0.01
"""Velocity at which dry friction of the file has three quarters of its size [rad/s or m/s]."""


class Tree(AbstractSystem):
    """Rigid bodies on hinges and slides, as an MJCF or URDF file has them; the recursions are in `recursion.py`.

    The file's numbers are part of the program; those that are estimated stand in `values`.
    """

    coordinates: tuple[str, ...] = eqx.field(static=True)
    rates: tuple[str, ...] = eqx.field(static=True)
    angles: tuple[bool, ...] = eqx.field(static=True)
    text: str = eqx.field(static=True)  # The compiled file, as `packed` writes it
    values: dict[str, Float[Array, ""]]  # Numbers that are not the file's, under their names in `[model.uncertain]`
    joints: tuple[int, ...] = eqx.field(static=True)
    loads: dict[int, Inertia] = eqx.field(default_factory=dict)
    """Loads of bodies beside their own mass, by their place, about the origins of their frames."""

    @classmethod
    def declared(cls, parameters, joints, machine):
        compiled = unpacked(machine)
        dof = len(compiled.joints)
        angles = tuple(not joint.slide for joint in compiled.joints)
        return cls(
            coordinates=compiled.states[:dof],
            rates=compiled.states[dof:],
            angles=angles,
            text=machine,
            values=dict(parameters),
            joints=joints,
        )

    @property
    def machine(self) -> Machine:
        return unpacked(self.text)

    def parameter(self, name):
        return self.values[name]

    def with_parameters(self, values: Mapping[str, Array]):
        return replace(self, values={**self.values, **values})

    def least(self, name):
        return 0.0 if name.endswith(".armature") else -math.inf

    def reached_from(self, before: "Tree"):
        values = kept_physical(self.machine, before.values, self.values)
        return replace(self, values={name: jnp.maximum(value, self.least(name)) for name, value in values.items()})

    @property
    def sensors(self) -> dict[str, str]:
        return {sensor.name: SENSE_UNITS[sensor.kind] for sensor in self.machine.sensors}

    @property
    def gears(self):
        return self.machine.gears

    def neighbours(self, joint):
        before = [frame.before + 1 for frame in laid(self.text).frames]
        near = (j for j, parent in enumerate(before, 1) if parent == joint or j in (joint, before[joint - 1]))
        return tuple(near)

    @property
    def variations(self) -> dict[tuple[str, int], tuple[Callable[..., Any], Callable[..., Any]]]:
        return {
            ("payload", joint): (
                lambda tree, mass, joint=joint: tree.loaded(joint, mass, jnp.zeros(3, mass.dtype)),
                lambda _, spot=spot: spot.mass,
            )
            for joint, spot in self.spots.items()
        }

    @property
    def spots(self) -> dict[int, LoadPoint]:
        return spots(self.machine, laid(self.text))

    def loaded(self, joint, mass, moment):
        spot = self.spots[joint]
        added = load(spot, mass, (moment[0], moment[1], moment[2]))
        held = self.loads.get(spot.body)
        return replace(self, loads={**self.loads, spot.body: added if held is None else united(held, added)})

    def body_numbers(self, place: int) -> tuple[Scalar, Three, Turn]:
        """Mass [kg], centre of mass [m] and inertia about it [kg m^2] of a body with its load, in the body's frame."""
        unloaded = numbers(self.machine.bodies[place], self.values)
        return with_load(unloaded, self.loads[place]) if place in self.loads else unloaded

    def __str__(self) -> str:
        numbers = {name: float(value) for name, value in self.values.items()}
        shown = quantities(numbers, lambda name: machine_unit(self.text, name)) or "all as in the file"
        driven = ", ".join(map(str, self.joints)) or "none"
        return f"Tree of {self.machine.file}, joints {', '.join(self.coordinates)}: {shown}; driven joints: {driven}"

    def mass(self, q: Float[Array, " dof"]) -> Float[Array, "dof dof"]:
        return jnp.stack([_stacked(row, q) for row in self._mass(self._poses(q))])

    def bias(self, q: Float[Array, " dof"], v: Float[Array, " dof"]) -> Float[Array, " dof"]:
        return _stacked(self._bias(self._poses(q), q, v), q)

    def acceleration(self, q, v, force):
        return _acceleration(self, q, v, force)

    def senses(self, q, v, a):
        layout, rates = laid(self.text), [v[i] for i in range(len(self.coordinates))]
        poses = self._poses(q)
        moving = motions(layout.frames, poses, rates, a, self.machine.gravity)
        return [jnp.zeros_like(q[0]) + seen(sensor, layout, poses, moving) for sensor in self.machine.sensors]

    def needed(self, q: Float[Array, " dof"], v: Float[Array, " dof"], a: Sequence[Scalar]) -> list[Scalar]:
        """Generalised force that gives an acceleration [N m, or N]: inverse dynamics, M(q) a + c(q, v)."""
        held = [times(self._armature(i), one) for i, one in enumerate(a)]
        return [plus(*pair) for pair in zip(self._bias(self._poses(q), q, v, a), held, strict=True)]

    def solve(self, q: Float[Array, " dof"], force: Sequence[Scalar]) -> tuple[Scalar, ...]:
        """Solution a of M(q) a = force."""
        return tuple(solved(self._mass(self._poses(q)), force))

    def _armature(self, i: int) -> Scalar:
        joint = self.machine.joints[i]
        return self.values.get(f"{joint.name}.armature", joint.armature)

    def _poses(self, q):
        return posed(laid(self.text).frames, [minus(q[i], joint.zero) for i, joint in enumerate(self.machine.joints)])

    def _bodies(self):
        return carried_by(self.machine, laid(self.text), self.values, self.loads)

    def _mass(self, poses) -> list[list[Scalar]]:
        rows = composite(laid(self.text).frames, poses, self._bodies())
        for i in range(len(rows)):
            rows[i][i] = plus(rows[i][i], self._armature(i))
        return rows

    def _bias(self, poses, q, v, a: Sequence[Scalar] | None = None) -> list[Scalar]:
        """Force that gives the acceleration `a`, which is 0 where it is left out; inertia of armatures aside."""
        rates, still = [v[i] for i in range(len(self.coordinates))], [0.0] * len(self.coordinates)
        out = newton_euler(laid(self.text).frames, poses, self._bodies(), rates, a or still, self.machine.gravity)
        for i, joint in enumerate(self.machine.joints):
            stiffness = self.values.get(f"{joint.name}.stiffness", joint.stiffness)
            out[i] = plus(out[i], times(stiffness, minus(q[i], joint.rest)))
            if self.machine.rubs:
                out[i] = plus(out[i], times(joint.damping, v[i]))
                out[i] = plus(out[i], times(joint.dry, jnp.tanh(v[i] / KNEE)) if joint.dry else 0.0)
        return out


@eqx.filter_custom_jvp
def _acceleration(tree: Tree, q, v, force) -> tuple[Scalar, ...]:
    poses = tree._poses(q)
    net = [minus(force[i], bias) for i, bias in enumerate(tree._bias(poses, q, v))]
    return tuple(solved(tree._mass(poses), net))


@_acceleration.def_jvp
def _acceleration_jvp(primals, tangents):
    """da = M^-1 (dF - d(M a + c)) at fixed a: neither composite bodies nor the solution are differentiated."""
    (tree, q, v, force), (dtree, dq, dv, dforce) = primals, tangents
    a = _acceleration(tree, q, v, force)
    _, change = eqx.filter_jvp(lambda tree, q, v: tuple(tree.needed(q, v, a)), (tree, q, v), (dtree, dq, dv))
    zero = jnp.zeros_like(q[0])
    change = [zero if one is None else one for one in change]
    net = [(zero if dforce is None else dforce[i]) - one for i, one in enumerate(change)]
    return a, tree.solve(q, net)


def _stacked(values: Sequence[Scalar], like: Float[Array, " dof"]) -> Float[Array, " dof"]:
    return jnp.stack([jnp.zeros_like(like[0]) + x if isinstance(x, float) else x for x in values])
