# pyright: reportCallIssue=false, reportArgumentType=false
# (pyright takes equinox's abstract fields for fields of the constructor)
"""A law without a name: an unknown function of some inputs, learned as a network of radial basis functions."""

import itertools
import math
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .base import AbstractEffect, Candidate, Scalar, a, at_joint
from .position import joints


class Axis(eqx.Module):
    """One axis of the function: a sum of signals, and where its basis functions stand."""

    names: tuple[str, ...] = eqx.field(static=True)
    low: Scalar = eqx.field(converter=a)
    high: Scalar = eqx.field(converter=a)
    turns: bool = eqx.field(static=True)
    """True for an angle that goes round: the basis is periodic."""
    count: int = eqx.field(static=True)

    def centres(self) -> Float[Array, " basis"]:
        """Places of the basis functions."""
        return jnp.linspace(self.low, self.high, self.count, endpoint=not self.turns)

    def basis(self, value: Float[Array, ""]) -> Float[Array, " basis"]:
        """Basis functions at a value."""
        centres = self.centres().astype(value.dtype)
        width = (self.high - self.low) / (self.count - (not self.turns))
        away = value - centres
        away = 2 * jnp.sin(0.5 * away) if self.turns else away
        return jnp.exp(-0.5 * (away / width) ** 2)


class UnknownFunction(AbstractEffect):
    """A torque sum_i w_i phi_i(inputs) at one joint [Broomhead & Lowe 1988]."""

    name: ClassVar[str] = "unknown_function"
    confirm: ClassVar[str] = "Repeat the motion with what stands under suspicion taken off."
    held: ClassVar[bool] = True
    weights: Float[Array, " basis"]
    axes: tuple[Axis, ...]
    joint: int | None = eqx.field(static=True)
    channel: str | None = eqx.field(static=True, default=None)

    @classmethod
    def candidates(cls, around):
        system = around.system
        limits = {}
        for i, (q, v) in enumerate(zip(system.coordinates, system.rates, strict=True)):
            limits[q,] = _range(float(around.low[i]), float(around.high[i]), system.angles[i])
            limits[v,] = (-0.7 * float(around.speed[i]), 0.7 * float(around.speed[i]), False)
        if all(system.angles) and len(system.angles) == 2:
            limits[system.coordinates] = (-np.pi, np.pi, True)
        if around.drive.size:
            limits["u",] = (-float(around.drive[0]), float(around.drive[0]), False)
        limits["time",] = (around.duration[0], around.ending, False)
        grids = [(Axis(name, *limits[name], 20),) for name in limits if name[0] not in system.rates]
        # an angle that goes round, where each turn is another place, as with a cable
        apart = [(q,) for i, q in enumerate(system.coordinates) if system.angles[i] and limits[q,][2]]
        grids += [(Axis(name, -2 * np.pi, 2 * np.pi, False, 43),) for name in apart]
        pairs = ((one, other) for one, other in itertools.combinations(limits, 2) if _apart(one, other))
        grids += [tuple(Axis(name, *limits[name], 6) for name in pair) for pair in pairs]
        out = []
        for j in joints(around):
            size = float(around.torque[j - 1])
            for axes in grids:
                number = math.prod(axis.count for axis in axes)
                make = lambda w, axes=axes, j=j: cls(jnp.asarray(w, float), axes, j)  # noqa: E731
                probes = tuple(make(0.05 * size * row) for row in np.eye(number))
                out.append(Candidate(make(np.zeros(number)), probes, make(np.full(number, 0.3 * size))))
        return out

    def values(self):
        return {}

    def inputs_named(self):
        return tuple(dict.fromkeys(name for axis in self.axes for name in axis.names))

    def torque(self, signals: dict[str, Float[Array, ""]]) -> Float[Array, ""]:
        """The learned function [N m]."""
        product = jnp.ones(1, self.weights.dtype)
        for axis in self.axes:
            value = sum((signals[name] for name in axis.names[1:]), signals[axis.names[0]])
            product = (product[:, None] * axis.basis(value)[None]).ravel()
        return self.weights @ product

    def force(self, scene, memory):
        system = scene.system
        signals = dict(zip(system.coordinates + system.rates, (*scene.q, *scene.v), strict=True))
        driven = system.joints[0] - 1 if system.joints else 0
        return at_joint(self.joint, self.torque(signals | {"u": scene.drive[driven], "time": scene.time}), scene)


def _range(low: float, high: float, angle: bool) -> tuple[float, float, bool]:
    """The range of a coordinate; once it goes round, a whole turn."""
    margin = 0.02 * (high - low)
    return (-np.pi, np.pi, True) if angle and high - low > 5.0 else (low - margin, high + margin, False)


def _apart(a: tuple[str, ...], b: tuple[str, ...]) -> bool:
    """Pairs worth a look: no sum beside its own terms, no clock or input beside another signal."""
    alone = {"u", "time"}
    return not (set(a) & set(b)) and not ({*a, *b} & alone)
