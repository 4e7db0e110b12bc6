"""Delay between topics: the shift by which their signals fit each other best."""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .signals import Signal, between, integrals

REACH = 0.25
"""Longest delay that is looked for [s]."""


class Pair(NamedTuple):
    """Two signals of which the second follows the first."""

    cause: str
    effect: str
    order: int
    """Number of integrations from the first to the second: 1 from a torque to a rate, 2 to an angle, 0 for one
    quantity."""
    held: bool
    """True where the first is held between its values, as a command is."""


class Delay(NamedTuple):
    """Delay of the second signal after the first [s]."""

    cause: str
    """The column, and its topic."""
    cause_topic: str
    effect: str
    effect_topic: str
    seconds: float
    """Delay [s]; NaN: unknown."""
    std: float
    correlation: float


def pairs(
    inputs: Mapping[str, int], states: Sequence[str], signals: Mapping[str, Signal], duplicates: Sequence[str]
) -> list[Pair]:
    """Pairs of signals on different topics, the second after the first: motion after its torque, an angle its rate, a
    quantity itself.

    `inputs` are columns and their joints, from 1; `states` coordinates, then rates; a duplicate of a column is called
    as it is, with a '.
    """
    dof, out = len(states) // 2, []

    def on_two_topics(one: str, two: str) -> bool:
        return (
            one in signals and two in signals and signals[one].topic != signals[two].topic and signals[one].t.size > 1
        )

    for name, joint in inputs.items():
        moved = ((states[dof + joint - 1], 1), (states[joint - 1], 2)) if joint <= dof else ()
        out += [Pair(name, state, order, True) for state, order in moved if on_two_topics(name, state)][:1]
    for q, v in zip(states[:dof], states[dof:], strict=True):
        out += [Pair(v, q, 1, False)] if on_two_topics(v, q) else []
    return out + [Pair(name, f"{name}'", 0, False) for name in duplicates if on_two_topics(name, f"{name}'")]


def delay(pair: Pair, signals: Mapping[str, Signal], around: Sequence[str]) -> Delay:
    """The shift at which the n-th difference of the effect is most like that of the n-fold integral of the cause.

    Differences and integrals are over the same stretches, so that no derivative of noise is taken and nothing is
    late by half a sample.  What the columns `around` explain of both (gravity, friction, couplings) is taken out first;
    the correlation of the rest, over shifts, is the generalised cross-correlation [Knapp & Carter 1976].
    """
    cause, effect = signals[pair.cause], signals[pair.effect]
    regressors = [signals[name] for name in around if name in signals]
    least = max(round(max(2 * cause.interval, 4 * effect.interval) / effect.interval), 1)
    # Differences are over so many times the shortest stretch that shows anything; the most significant is used
    widths = (1, 2, 4, 8)
    estimates = [
        _over(pair, cause, effect, regressors, least * times) for times in widths[: 1 if pair.order == 0 else None]
    ]
    sure = [each for each in estimates if each.std > 0]
    best = min(sure, key=lambda each: each.std) if sure else max(estimates, key=lambda each: each.correlation)
    return Delay(pair.cause, cause.topic, pair.effect, effect.topic, *best)


class _Best(NamedTuple):
    """A shift [s], its standard deviation, and the correlation there."""

    seconds: float
    std: float
    correlation: float


def _over(pair: Pair, cause: Signal, effect: Signal, around: Sequence[Signal], wide: int) -> _Best:
    """The best shift for differences over so many readings: the wider, the less noise and the less detail.

    It is the mean of those of parts of the readings, and known as well as they agree.
    """
    every = _liveliest(cause, effect)
    parts = [_part(pair, cause, effect, around, wide, at) for at in np.array_split(every, 3)]  # their delays must agree
    shifts, like = np.array([shift for shift, _ in parts]), float(np.mean([r for _, r in parts]))
    if np.isnan(shifts).any() or np.ptp(shifts) > 0.01:  # largest difference between the delays of the parts [s]
        return _Best(math.nan, math.nan, like)
    bias = 0.25  # intervals of the readings that parts which agree may all be wrong by; a third was observed for angles
    std = math.hypot(float(np.std(shifts, ddof=1)) / math.sqrt(len(parts)), bias * effect.interval)
    return _Best(float(shifts.mean()), std, like)


def _part(
    pair: Pair, cause: Signal, effect: Signal, around: Sequence[Signal], wide: int, at: Float[np.ndarray, " x"]
) -> tuple[float, float]:
    """The best shift for the readings at these times, NaN where there is none, and the correlation there."""
    if at.size < 20 * wide:
        return math.nan, 0.0
    cause, *around = (between(signal, at[0] - REACH, at[-1] + REACH) for signal in (cause, *around))
    target = _difference(np.interp(at, effect.t, effect.y), pair.order, wide)
    first = (0, wide // 2, wide)[pair.order]
    unexplained = _Rest(_explained(at[first : first + target.size], around))
    target = unexplained(target)
    size = math.sqrt(target @ target)

    def likeness(shift: float) -> float:
        predicted = unexplained(
            _difference(integrals(cause, at - shift, pair.order, steps=pair.held), pair.order, wide)
        )
        return float(predicted @ target) / max(math.sqrt(predicted @ predicted) * size, 1e-300)

    coarse = max(min(effect.interval, 0.005), REACH / 50)
    shifts = np.arange(-REACH, REACH + coarse / 2, coarse)
    correlations = np.array([likeness(shift) for shift in shifts])
    k = int(np.argmax(correlations))
    sure = 0.3  # smallest correlation of the residual signals at which a delay is reported
    if correlations[k] < sure or k in (0, shifts.size - 1):
        return math.nan, float(correlations[k])
    best, fine = float(shifts[k]), coarse
    for _ in range(4):
        fine /= 3
        best = max((best + j * fine for j in range(-3, 4)), key=likeness)
    return best, likeness(best)


def _liveliest(cause: Signal, effect: Signal) -> Float[np.ndarray, " x"]:
    """Times of readings, where both signals are known for every shift: the stretch in which the cause varies most."""
    step, first = effect.interval, max(cause.t[0], effect.t[0]) + REACH
    end = min(cause.t[-1], effect.t[-1]) - REACH
    count = int((end - first) / step) if end > first else 0
    most = 12_000  # readings used for a delay at most: those around the liveliest input
    if count <= most:
        return first + step * np.arange(max(count, 0))
    starts = np.linspace(first, end - most * step, 20)
    ends = np.searchsorted(cause.t, starts + most * step)
    places = zip(np.searchsorted(cause.t, starts).tolist(), ends.tolist(), strict=True)
    spread = [float(np.std(cause.y[a:b])) if b > a + 1 else 0.0 for a, b in places]
    return starts[int(np.argmax(spread))] + step * np.arange(most)


def _difference(y: Float[np.ndarray, " x"], order: int, wide: int) -> Float[np.ndarray, " less"]:
    for _ in range(order):
        y = y[wide:] - y[:-wide]
    return y


def _explained(at: Float[np.ndarray, " x"], around: Sequence[Signal]) -> Float[np.ndarray, "x regressor"]:
    """Functions of the state that forces may be of."""
    columns = [np.ones(at.size)]
    for signal in around:
        y = np.interp(at, signal.t, signal.y)
        columns += [y, np.sin(y), np.cos(y), np.tanh(4 * y / max(float(np.std(y)), 1e-300))]
    return np.stack(columns, axis=-1)


class _Rest:
    """Residual of a signal after regression on some columns."""

    def __init__(self, columns: Float[np.ndarray, "x regressor"]):
        u, s, _ = np.linalg.svd(columns, full_matrices=False)
        self.basis = u[:, s > 1e-9 * s[0]]

    def __call__(self, y: Float[np.ndarray, " x"]) -> Float[np.ndarray, " x"]:
        return y - self.basis @ (self.basis.T @ y)
