"""Inputs of missing rows of a log, interpolated from the rows around them."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from .constant import runs


class Interpolated(NamedTuple):
    """An input with its missing rows."""

    u: Float[np.ndarray, " time"]
    error: Float[np.ndarray, " time"]
    """Interpolation error of the gap of a missing row: estimated minus true, summed, over the size of one row."""


def interpolated(u: Float[np.ndarray, " time"], missing: Bool[np.ndarray, " time"]) -> Interpolated:
    """An input with its missing rows interpolated, and the interpolation error.

    The missing rows are those that linear prediction from the rows around makes likeliest [Janssen, Veldhuis & Vries
    1986, IEEE Trans. ASSP 34(2)].  The error is the worst of gaps of the same length that are made elsewhere.
    """
    size, error = float(np.sqrt(np.mean(u[~missing] ** 2))), np.zeros(u.size)
    if size == 0.0:
        return Interpolated(np.where(missing, 0.0, u), error)
    scaled, gaps = u / size, runs(np.where(missing, 1.0, 0.0))
    weights = _prediction(scaled, missing)
    for length in {run.length for run in gaps if missing[run.first]}:
        worst = _worst(scaled, missing, weights, length)
        for run in gaps:
            if missing[run.first] and run.length == length:
                error[run.first : run.end] = worst
    return Interpolated(size * _filled(scaled, missing, weights), error)


def _worst(
    u: Float[np.ndarray, " time"], missing: Bool[np.ndarray, " time"], weights: Float[np.ndarray, " lag"], length: int
) -> float:
    """The largest error, summed over a gap, of gaps of one length made on purpose."""
    reach, errors = 3 * weights.size, []
    trials = 40  # gaps that are made on purpose to measure the error of interpolation
    for first in np.linspace(1, u.size - length - 1, trials).astype(int) if u.size > length + 2 else ():
        if not missing[first - 1 : first + length + 1].any():
            part = slice(max(first - reach, 0), first + length + reach)
            cut = (np.arange(u.size) >= first) & (np.arange(u.size) < first + length)
            errors.append(float(np.sum((_filled(u[part], (missing | cut)[part], weights) - u[part])[cut[part]])))
    return max(map(abs, errors)) if len(errors) > 3 else math.inf


def _prediction(u: Float[np.ndarray, " time"], missing: Bool[np.ndarray, " time"]) -> Float[np.ndarray, " lag"]:
    """Weights of the rows before, the nearest first, that predict an input best."""
    order = min(16, u.size // 8)  # of the linear prediction of an input
    complete = ~np.lib.stride_tricks.sliding_window_view(missing, order + 1).any(axis=1)
    rows = np.lib.stride_tricks.sliding_window_view(u, order + 1)[complete]
    if len(rows) < 2 * order:
        return np.ones(1)
    past, target = rows[:, order - 1 :: -1] if order > 1 else rows[:, :1], rows[:, order]
    return np.linalg.solve(past.T @ past + 1e-9 * len(rows) * np.eye(order), past.T @ target)


def _filled(
    u: Float[np.ndarray, " time"], missing: Bool[np.ndarray, " time"], weights: Float[np.ndarray, " lag"]
) -> Float[np.ndarray, " time"]:
    """The missing rows with which the errors of prediction are smallest."""
    order = weights.size
    ends = np.flatnonzero(np.lib.stride_tricks.sliding_window_view(missing, order + 1).any(axis=1)) + order
    errors = np.zeros((ends.size, u.size))
    at = np.arange(ends.size)
    errors[at, ends] = 1.0
    for lag, weight in enumerate(weights, 1):
        errors[at, ends - lag] = -weight
    out = np.where(missing, 0.0, u)
    out[missing] = np.linalg.lstsq(errors[:, missing], -errors @ out, rcond=None)[0]
    return out
