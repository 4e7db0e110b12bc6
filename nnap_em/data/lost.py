"""Inputs of rows that a log lost, interpolated from the rows around them."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from .frozen import runs

_ORDER = 16  # of the linear prediction of an input
_TRIALS = 40  # gaps that are made on purpose to measure the error of interpolation


class Interpolated(NamedTuple):
    """An input with its lost rows."""

    u: Float[np.ndarray, " time"]
    doubt: Float[np.ndarray, " time"]
    """Interpolation error of the gap of a lost row: estimated minus true, summed, over the size of one row."""


def interpolated(u: Float[np.ndarray, " time"], lost: Bool[np.ndarray, " time"]) -> Interpolated:
    """An input with its lost rows interpolated, and the interpolation error.

    The lost rows are those that linear prediction from the rows around makes likeliest [Janssen, Veldhuis & Vries
    1986, IEEE Trans. ASSP 34(2)].  The error is the worst of gaps of the same length that are made elsewhere.
    """
    size, doubt = float(np.sqrt(np.mean(u[~lost] ** 2))), np.zeros(u.size)
    if size == 0.0:
        return Interpolated(np.where(lost, 0.0, u), doubt)
    whole, gaps = u / size, runs(np.where(lost, 1.0, 0.0))
    weights = _prediction(whole, lost)
    for length in {run.length for run in gaps if lost[run.first]}:
        worst = _worst(whole, lost, weights, length)
        for run in gaps:
            if lost[run.first] and run.length == length:
                doubt[run.first : run.end] = worst
    return Interpolated(size * _filled(whole, lost, weights), doubt)


def _worst(
    u: Float[np.ndarray, " time"], lost: Bool[np.ndarray, " time"], weights: Float[np.ndarray, " lag"], length: int
) -> float:
    """The largest error, summed over a gap, of gaps of one length made on purpose."""
    reach, errors = 3 * weights.size, []
    for first in np.linspace(1, u.size - length - 1, _TRIALS).astype(int) if u.size > length + 2 else ():
        if not lost[first - 1 : first + length + 1].any():
            part = slice(max(first - reach, 0), first + length + reach)
            made = (np.arange(u.size) >= first) & (np.arange(u.size) < first + length)
            errors.append(float(np.sum((_filled(u[part], (lost | made)[part], weights) - u[part])[made[part]])))
    return max(map(abs, errors)) if len(errors) > 3 else math.inf


def _prediction(u: Float[np.ndarray, " time"], lost: Bool[np.ndarray, " time"]) -> Float[np.ndarray, " lag"]:
    """Weights of the rows before, the nearest first, that predict an input best."""
    order = min(_ORDER, u.size // 8)
    whole = ~np.lib.stride_tricks.sliding_window_view(lost, order + 1).any(axis=1)
    rows = np.lib.stride_tricks.sliding_window_view(u, order + 1)[whole]
    if len(rows) < 2 * order:
        return np.ones(1)
    past, now = rows[:, order - 1 :: -1] if order > 1 else rows[:, :1], rows[:, order]
    return np.linalg.solve(past.T @ past + 1e-9 * len(rows) * np.eye(order), past.T @ now)


def _filled(
    u: Float[np.ndarray, " time"], lost: Bool[np.ndarray, " time"], weights: Float[np.ndarray, " lag"]
) -> Float[np.ndarray, " time"]:
    """The lost rows with which the errors of prediction are smallest."""
    order = weights.size
    ends = np.flatnonzero(np.lib.stride_tricks.sliding_window_view(lost, order + 1).any(axis=1)) + order
    errors = np.zeros((ends.size, u.size))
    at = np.arange(ends.size)
    errors[at, ends] = 1.0
    for lag, weight in enumerate(weights, 1):
        errors[at, ends - lag] = -weight
    out = np.where(lost, 0.0, u)
    out[lost] = np.linalg.lstsq(errors[:, lost], -errors @ out, rcond=None)[0]
    return out
