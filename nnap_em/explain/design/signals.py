"""Inputs that a machine can play: families of signals with free shapes, within limits of torque and of its change."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .limits import Limits

Shape = Float[np.ndarray, " shape"]
"""Numbers from 0 to 1 that shape a signal."""
Time = Float[np.ndarray, " time"]
"""Time [s], or a signal between -1 and 1."""


def multisine(z: Shape, t: Time) -> Time:
    """Five tones of free frequency, phase and size."""
    tone, phase, size = z[:15].reshape(3, 5)
    wave = np.sin(2 * np.pi * (_frequency(tone, t)[:, None] * t + phase[:, None]))
    return np.clip(1.5 * size @ wave / size.sum(), -1.0, 1.0)


def chirp(z: Shape, t: Time) -> Time:
    """A tone whose frequency and size go from one value to another, about a level."""
    share = (t - t[0]) / (t[-1] - t[0])
    frequency = _frequency(z[0] + (z[1] - z[0]) * share, t)
    size = z[2] + (z[3] - z[2]) * share
    wave = np.sin(2 * np.pi * (np.cumsum(frequency) * (t[1] - t[0]) + z[4]))
    return np.clip(size * wave + (2 * z[5] - 1) * (1 - size), -1.0, 1.0)


def steps(z: Shape, t: Time) -> Time:
    """Levels that are held in turn."""
    place = np.minimum((z.size * (t - t[0]) / (t[-1] - t[0])).astype(int), z.size - 1)
    return 2 * z[place] - 1


def ramps(z: Shape, t: Time) -> Time:
    """Straight lines between seven levels."""
    return np.interp(t, np.linspace(t[0], t[-1], 7), 2 * z[:7] - 1)


def _frequency(z: Shape, t: Time) -> Shape:
    """Frequency from one wave in the whole to one in ten samples, evenly in its logarithm [Hz]."""
    slow, fast = 1.0 / (t[-1] - t[0]), 0.1 / (t[1] - t[0])
    return slow * (fast / slow) ** z


FAMILIES = (multisine, chirp, steps, ramps)


class Proposal(NamedTuple):
    """A sequence to be played, as numbers between 0 and 1; leading axes are proposals."""

    family: np.ndarray
    """Place in `FAMILIES`."""
    shape: Float[np.ndarray, "*proposal input shape"]
    """The last number is the size of the whole."""
    start: Float[np.ndarray, "*proposal readable"]
    """Between the first and the last state in which a sequence may begin."""


def drawn(rng: np.random.Generator, count: int, inputs: int, states: int) -> Proposal:
    """Proposals of every family in turn."""
    shape = rng.uniform(size=(count, inputs, 18 + 1))  # numbers between 0 and 1 that shape the signal of one input
    return Proposal(np.arange(count) % len(FAMILIES), shape, rng.uniform(size=(count, states)))


def mutated(rng: np.random.Generator, parent: Proposal, reach: float) -> Proposal:
    """`parent`, every number moved by about `reach` and reflected at 0 and 1."""

    def moved(z):
        z = np.abs(z + reach * rng.standard_normal(z.shape))
        return 1.0 - np.abs(1.0 - z % 2.0)

    return Proposal(parent.family, moved(parent.shape), moved(parent.start))


def played(
    proposal: Proposal, limits: Limits, t: Float[np.ndarray, " time"]
) -> Float[np.ndarray, "proposal time input"]:
    """Inputs of some proposals, within the limits of torque and of its change; they begin and end at 0."""
    z = proposal.shape
    wave = np.stack([[FAMILIES[f](z[:-1], t) for z in each] for f, each in zip(proposal.family, z, strict=True)])
    middle, half = 0.5 * (limits.high + limits.low), 0.5 * (limits.high - limits.low)
    goal = z[..., -1:] * (middle[:, None] + half[:, None] * wave)
    most, out = limits.rate * (t[1] - t[0]), np.zeros_like(goal)
    rest = np.clip(0.0, limits.low, limits.high)
    value = np.broadcast_to(rest, goal.shape[:-1])
    for k in range(t.size):
        left = (t.size - k) * most  # to be back at rest in the end
        value = np.clip(goal[..., k], value - most, value + most)
        value = np.clip(value, np.maximum(limits.low, rest - left), np.minimum(limits.high, rest + left))
        out[..., k] = value
    return np.swapaxes(out, 1, 2)


def starts(proposal: Proposal, limits: Limits) -> Float[np.ndarray, "proposal readable"]:
    """States in which they begin."""
    return limits.first + proposal.start * (limits.last - limits.first)
