"""Laws without a form: unknown functions of some signals, as radial basis functions; periodic forces."""

import itertools
import math
from abc import abstractmethod
from collections.abc import Callable, Sequence
from functools import partial
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...machines.systems.base import AbstractSystem
from .base import AbstractEffect, Candidate, Curve, JointEffect, OperatingPoint, Scalar, SearchScales, a, input_of


class AbstractAxis(eqx.Module):
    """One axis of the function: what it reads, and where its basis functions stand."""

    responds_to_feedback: ClassVar[bool]
    """True for an input."""
    names: tuple[str, ...] = eqx.field(static=True)
    low: Scalar = eqx.field(converter=a)
    high: Scalar = eqx.field(converter=a)
    turns: bool = eqx.field(static=True)
    """True for an angle that goes round: the basis is periodic."""
    count: int = eqx.field(static=True)

    @abstractmethod
    def value(self, scene: OperatingPoint) -> Scalar:
        """Argument of the function."""

    @abstractmethod
    def unit(self, system: AbstractSystem) -> str:
        """Unit of the argument."""

    def signals(self, system: AbstractSystem) -> tuple[str, ...]:
        return self.names

    def acts(self, system: AbstractSystem) -> int | None:
        """The joint where a function of it may act; None: at any."""
        return None

    def of_states(self, system: AbstractSystem) -> set[str]:
        return set(self.names) & {*system.coordinates, *system.rates}

    def centres(self) -> Float[Array, " basis"]:
        return jnp.linspace(self.low, self.high, self.count, endpoint=not self.turns)

    def basis(self, value: Scalar) -> Float[Array, " basis"]:
        """Basis functions at a value; beyond the ends, where nothing was learned, those of the end."""
        centres = self.centres().astype(value.dtype)
        width = (self.high - self.low) / (self.count - (not self.turns))
        inside = jnp.clip(value, self.low.astype(value.dtype), self.high.astype(value.dtype))
        away = 2 * jnp.sin(0.5 * (value - centres)) if self.turns else inside - centres
        return jnp.exp(-0.5 * (away / width) ** 2)


class Axis(AbstractAxis):
    """A coordinate, a rate, the time, or a sum of angles."""

    responds_to_feedback: ClassVar[bool] = False

    def value(self, scene):
        system = scene.system
        signals = dict(zip(system.coordinates + system.rates, (*scene.q, *scene.v), strict=True))
        signals["time"] = scene.time
        return jnp.sum(jnp.stack([signals[name] for name in self.names]))

    def unit(self, system):
        return system.unit(self.names[0])


class InputAxis(AbstractAxis):
    """An input by its column, as it reaches its joint [N m]."""

    responds_to_feedback: ClassVar[bool] = True
    index: int = eqx.field(static=True, kw_only=True)
    """Place among the inputs of the rig, counted from 0."""

    def value(self, scene):
        return scene.drive[scene.system.joints[self.index] - 1]

    def unit(self, system):
        return system.force_unit(system.joints[self.index])

    def signals(self, system):
        return (input_of(system.joints[self.index]),)

    def acts(self, system):
        return system.joints[self.index]


class UnknownFunction(JointEffect):
    """A torque sum_i w_i phi_i(inputs) at one joint [Broomhead & Lowe 1988]."""

    meaning: ClassVar[str] = "A force as a function of these signals, outside the vocabulary of effects."
    named: ClassVar[bool] = False
    confirm: ClassVar[str] = "Repeat the motion with what stands under suspicion taken off."
    held: ClassVar[bool] = True
    weights: Float[Array, " basis"]
    axes: tuple[AbstractAxis, ...]

    @classmethod
    def candidates(cls, around):
        system, axes = around.system, axes_of(around)
        alone = [axes[name](20) for name in axes if name not in {(rate,) for rate in system.rates}]
        # an angle that goes round, where each turn is another place, as with a cable
        round_ = [axis.names for axis in alone if axis.turns and len(axis.names) == 1]
        turns = [Axis(names, -2 * np.pi, 2 * np.pi, False, 43) for names in round_]
        states = [name for name in axes if set(name) <= {*system.coordinates, *system.rates}]
        pairs = (pair for pair in itertools.combinations(states, 2) if set(pair[0]).isdisjoint(pair[1]))
        grids = [(axis,) for axis in (*alone, *turns)] + [(axes[one](6), axes[other](6)) for one, other in pairs]
        # states of a joint and of those next to it: what a force at it may be a function of
        pairs_of = dict(enumerate(zip(system.coordinates, system.rates, strict=True), 1))
        near = {j: {name for other in system.neighbours(j) for name in pairs_of[other]} for j in around.joints}
        places = [(j, grid) for j in around.joints for grid in grids]
        rates = [] if around.moved is None else [(j, system.rates[j - 1]) for j in around.joints]
        friction = [_function(j, (axes[rate,](20),), around) for j, rate in rates if (rate,) in axes]
        fits = lambda axis, j: axis.acts(system) in (None, j) and axis.of_states(system) <= near[j]  # noqa: E731
        return friction + [_function(j, grid, around) for j, grid in places if all(fits(axis, j) for axis in grid)]

    def inputs_named(self):
        return tuple(dict.fromkeys(name for axis in self.axes for name in axis.names))

    def signals(self, system):
        return tuple(dict.fromkeys(name for axis in self.axes for name in axis.signals(system)))

    def responds_to_feedback(self):
        return any(axis.responds_to_feedback for axis in self.axes)

    def is_physical(self):
        """A drive's torque is monotone in its input: a function that is not is a symptom of another missing effect."""
        if len(self.axes) != 1 or not self.responds_to_feedback():
            return True
        (axis,) = self.axes
        u = np.linspace(float(axis.low), float(axis.high), 8 * axis.count)
        total = u + np.asarray(jax.vmap(lambda one: self.torque([one]))(jnp.asarray(u)))
        rise = np.diff(total)
        # Share of its range by which a drive may seem to fall with its input: noise of what was learned
        return bool(-rise[rise < 0].sum() < 0.1 * np.ptp(total))

    def torque(self, values: Sequence[Scalar]) -> Scalar:
        """The learned function at a value of every axis [N m]."""
        product = jnp.ones(1, self.weights.dtype)
        for axis, value in zip(self.axes, values, strict=True):
            product = (product[:, None] * axis.basis(value)[None]).ravel()
        return self.weights @ product

    def force(self, scene, memory):
        return self.at(scene, self.torque([axis.value(scene) for axis in self.axes]))

    def curve(self, cov, system):
        return drawn(self.axes[0], self.weights, self.joint, cov, system) if len(self.axes) == 1 else None


def drawn(axis: AbstractAxis, weights, joint: int, cov, system: AbstractSystem, of: str = "force") -> Curve:
    """The function of one signal with these weights, of covariance `cov`."""
    x = np.linspace(float(axis.low), float(axis.high), 121)
    basis = np.asarray(jax.vmap(axis.basis)(jnp.asarray(x)))
    # its mean is that of the nodes, each weighted by how well it is known: what was never visited moves nothing
    variance = np.einsum("xi,ij,xj->x", basis, cov, basis)
    basis = basis - np.average(basis, axis=0, weights=1 / np.maximum(variance, 1e-12 * variance.max() + 1e-300))
    std = np.sqrt(np.maximum(np.einsum("xi,ij,xj->x", basis, cov, basis), 0.0))
    units, mean = (axis.unit(system), system.force_unit(joint)), basis @ np.asarray(weights)
    return Curve(" + ".join(axis.names), units[0], joint, units[1], axis.turns, x, mean, std, basis, of)


def free_form(effect: AbstractEffect, around: SearchScales) -> list[Candidate]:
    """The unknown functions of the same signals at the same joint: what `effect` would be, were its form not known."""
    axes = axes_of(around)
    inputs = {input_of(j): around.column(j) for j, _ in around.driven}
    names = [(inputs.get(name, name),) for name in effect.signals(around.system)]
    if effect.joint is None or not names or not all(name in axes for name in names):
        return []
    return [_function(effect.joint, tuple(axes[name](20 if len(names) == 1 else 6) for name in names), around)]


def _function(joint: int, axes: tuple[AbstractAxis, ...], around: SearchScales) -> Candidate:
    """An unknown function at a joint, a probe for every weight."""
    size, number = float(around.torque[joint - 1]), math.prod(axis.count for axis in axes)
    make = lambda w: UnknownFunction(jnp.asarray(w, float), axes, joint=joint)  # noqa: E731
    probes = tuple(make(0.05 * size * row) for row in np.eye(number))
    return Candidate(make(np.zeros(number)), probes, make(np.full(number, 0.3 * size)))


def axes_of(around: SearchScales) -> dict[tuple[str, ...], Callable[[int], AbstractAxis]]:
    """Axes that a function may have, of any number of basis functions, by the names of what they read."""
    system = around.system
    ranges = {}
    for i, (q, v) in enumerate(zip(system.coordinates, system.rates, strict=True)):
        low, high = float(around.low[i]), float(around.high[i])
        margin, round_ = 0.02 * (high - low), system.angles[i] and high - low > 5.0  # it goes round: a whole turn
        ranges[q,] = (-np.pi, np.pi, True) if round_ else (low - margin, high + margin, False)
        ranges[v,] = (-0.7 * float(around.speed[i]), 0.7 * float(around.speed[i]), False)
    for n in range(2, len(system.coordinates) + 1):  # the angle of a link in the world
        if all(system.angles[:n]):
            ranges[system.coordinates[:n]] = (-np.pi, np.pi, True)
    states = {name: partial(Axis, name, *limits) for name, limits in ranges.items() if limits[0] < limits[1]}
    inputs = {
        (around.column(j),): partial(InputAxis, (around.column(j),), -size, size, False, index=system.joints.index(j))
        for j, size in around.driven
    }
    return {**states, **inputs, ("time",): partial(Axis, ("time",), around.duration[0], around.ending, False)}


OVERTONES = 7
"""Harmonics of the waveform, once its period is known: they hold 95 % of the power of a square wave."""


class PeriodicForce(JointEffect):
    """sum_h s_h sin(2 pi h f t) + c_h cos(2 pi h f t): its period is found first, then its waveform."""

    reported_as: ClassVar[str] = "unknown_function"
    meaning: ClassVar[str] = "Something pushes the joint periodically."
    confirm: ClassVar[str] = "Log the motion at rest with the drives off: what beside the machine pushes in time?"
    units: ClassVar[dict[str, str]] = {"size": "N m", "frequency": "Hz"}
    arguments: ClassVar[tuple[str, ...]] = ("time",)
    sine: Float[Array, " harmonic"]
    cosine: Float[Array, " harmonic"]
    frequency: Scalar
    harmonics: int = eqx.field(static=True, kw_only=True)

    @classmethod
    def candidates(cls, around):
        span = around.duration[1] - around.duration[0]
        highest = 4.0  # frequency [Hz] up to which is looked: a faster force moves little
        # Frequencies that are tried: numbers shared by recordings of many lengths, for programs are compiled for them
        counts = (50, 200)
        count = next((n for n in counts if n >= highest * span / 0.4), counts[-1])
        tried = [highest / count * i for i in range(1, count + 1)]
        return [_at(j, f, 1, around) for j in around.joints for f in tried if f * span >= 1.0]  # one period at least

    def values(self):
        return {"size": jnp.sqrt(0.5 * jnp.sum(self.sine**2 + self.cosine**2) + 1e-30), "frequency": self.frequency}

    def inputs_named(self):
        return ("time",)

    def richer(self, around):
        if self.harmonics >= OVERTONES:
            return []
        return [_at(self.joint, float(self.frequency), OVERTONES, around, self)]

    def waveform(self, turns: Float[Array, "*any"]) -> Float[Array, "*any"]:
        """The force after so many periods [N m]."""
        angle = 2 * jnp.pi * jnp.tensordot(turns, jnp.arange(1, self.harmonics + 1, dtype=turns.dtype), axes=0)
        return jnp.sin(angle) @ self.sine + jnp.cos(angle) @ self.cosine

    def curve(self, cov, system):
        x, count = np.linspace(0.0, 2.0, 121), self.harmonics
        angle = 2 * np.pi * x[:, None] * np.arange(1, count + 1)
        basis = np.concatenate([np.sin(angle), np.cos(angle)], axis=1)
        block = cov[: 2 * count, : 2 * count]
        std = np.sqrt(np.maximum(np.einsum("xi,ij,xj->x", basis, block, basis), 0.0))
        mean = basis @ np.concatenate([self.sine, self.cosine])
        time = x / float(self.frequency)
        return Curve("time", system.unit("time"), self.joint, system.force_unit(self.joint), False, time, mean, std)

    def force(self, scene, memory):
        return self.at(scene, self.waveform(self.frequency * scene.time))


def _at(joint: int, frequency: float, count: int, around, known: PeriodicForce | None = None) -> Candidate:
    """A waveform of `count` harmonics, beginning from one that is `known`."""
    size, span = float(around.torque[joint - 1]), around.duration[1] - around.duration[0]
    start = np.zeros((2, count))
    if known is not None:
        start[:, : known.harmonics] = known.sine, known.cosine
    make = lambda w, f: PeriodicForce(jnp.asarray(w[0]), jnp.asarray(w[1]), a(f), harmonics=count, joint=joint)  # noqa: E731
    probes = tuple(make(start + 0.05 * size * row.reshape(2, count), frequency) for row in np.eye(2 * count))
    spread = make(np.full((2, count), 3.0 * size), 0.3 / span)
    return Candidate(make(start, frequency), probes, spread)
