"""A quantity at times of its own: held, averaged and interpolated exactly where it is read."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

SAME_TIME = 1e-3
"""Share of a row by which times may differ and still be one: clocks count in ns, and rows are rounded."""
SLOW = 1.5
"""Rows from one reading to the next from which on readings stand in their nearest row, with empty rows between."""


@dataclass(frozen=True)
class Signal:
    """Values [SI] at times [s] that rise."""

    topic: str
    t: Float[np.ndarray, " message"]
    y: Float[np.ndarray, " message"]
    jumps: Int[np.ndarray, " jump"] = field(default_factory=lambda: np.zeros(0, int))
    """Values before which a counter has started over."""
    longest: float = np.inf
    """Silence from which on it has a gap [s]; infinite for commands that hold until the next."""

    @cached_property
    def interval(self) -> float:
        """Median time from one value to the next [s]."""
        return float(np.median(np.diff(self.t), overwrite_input=True)) if self.t.size > 1 else np.inf


def held(signal: Signal, at: Float[np.ndarray, " row"], dt: float) -> Float[np.ndarray, " row"]:
    """The value given last, at the row or before it."""
    return signal.y[_before(signal, at + SAME_TIME * dt)]


def straight(signal: Signal, at: Float[np.ndarray, " row"], dt: float) -> Float[np.ndarray, " row"]:
    """The value on the line from the one given last to the next."""
    return np.interp(at, signal.t, signal.y)


def averaged(signal: Signal, at: Float[np.ndarray, " row"], dt: float) -> Float[np.ndarray, " row"]:
    """The mean from each row to the next of a signal that is held between its values."""
    before = np.append(0.0, np.cumsum(signal.y[:-1] * np.diff(signal.t)))

    def integral(x: Float[np.ndarray, " row"]) -> Float[np.ndarray, " row"]:
        i = _before(signal, x)
        return before[i] + signal.y[i] * (x - signal.t[i])

    return (integral(at + dt) - integral(at)) / dt


def interpolated(signal: Signal, at: Float[np.ndarray, " row"], dt: float, reach: float) -> Float[np.ndarray, " row"]:
    """Straight lines between neighbours; NaN where there is no value.

    There is none where neighbours are more than `reach` [s] apart or a jump lies between them, nor, where readings come
    slower than rows, in rows that are nearest to no reading.  Between readings of noise sigma a value has less: from
    sigma / sqrt(2) on.
    """
    t, slack = signal.t, SAME_TIME * dt
    right = np.clip(np.searchsorted(t, at), 1, max(t.size - 1, 1))
    width = t[right] - t[right - 1]
    x = np.clip(at, t[0], t[-1])
    exact = np.minimum(np.abs(x - t[right]), np.abs(x - t[right - 1])) <= slack
    across = np.isin(right, signal.jumps)
    known = (at >= t[0] - slack) & (at <= t[-1] + slack) & ((~across & (width <= reach)) | exact)
    if signal.interval > SLOW * dt:
        known &= np.searchsorted(t, at + dt / 2) > np.searchsorted(t, at - dt / 2)
    share = (x - t[right - 1]) / width
    share = np.where(across, np.round(share), share)
    y = signal.y[right - 1] * (1 - share) + signal.y[right] * share
    return np.where(known, y, np.nan)


def _before(signal: Signal, at: Float[np.ndarray, " x"]) -> np.ndarray:
    return np.clip(np.searchsorted(signal.t, at, side="right") - 1, 0, signal.t.size - 1)
