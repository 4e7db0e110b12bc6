"""A force that repeats itself in time, of any waveform."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .base import Candidate, Curve, JointEffect, Scalar, a

OVERTONES = 7
"""Harmonics of the waveform, once its period is known: they hold 95 % of the power of a square wave."""


class PeriodicForce(JointEffect):
    """sum_h s_h sin(2 pi h f t) + c_h cos(2 pi h f t): its period is found first, then its waveform."""

    name: ClassVar[str] = "periodic_force"
    reported_as: ClassVar[str] = "unknown_function"
    confirm: ClassVar[str] = (
        "Log the motion at rest with the drives off: what pushes in time with the machine beside it?"
    )
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
        """Root mean square of the force, and how often it comes."""
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
        """Two periods of the waveform, its mean taken away."""
        x, count = np.linspace(0.0, 2.0, 121), self.harmonics
        angle = 2 * np.pi * x[:, None] * np.arange(1, count + 1)
        basis = np.concatenate([np.sin(angle), np.cos(angle)], axis=1)
        block = cov[: 2 * count, : 2 * count]
        std = np.sqrt(np.maximum(np.einsum("xi,ij,xj->x", basis, block, basis), 0.0))
        mean = basis @ np.concatenate([self.sine, self.cosine])
        time = x / float(self.frequency)
        return Curve("time", "s", self.joint, system.force_unit(self.joint), False, time, mean, std)

    def force(self, scene, memory):
        return self.at(scene, self.waveform(self.frequency * scene.time))


def _at(joint: int | None, frequency: float, count: int, around, known: PeriodicForce | None = None) -> Candidate:
    """A waveform of `count` harmonics, beginning from one that is `known`."""
    assert joint is not None
    size, span = float(around.torque[joint - 1]), around.duration[1] - around.duration[0]
    start = np.zeros((2, count))
    if known is not None:
        start[:, : known.harmonics] = known.sine, known.cosine
    make = lambda w, f: PeriodicForce(jnp.asarray(w[0]), jnp.asarray(w[1]), a(f), harmonics=count, joint=joint)  # noqa: E731
    probes = tuple(make(start + 0.05 * size * row.reshape(2, count), frequency) for row in np.eye(2 * count))
    spread = make(np.full((2, count), 3.0 * size), 0.3 / span)
    return Candidate(make(start, frequency), probes, spread)
