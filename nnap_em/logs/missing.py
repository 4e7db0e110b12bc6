"""Inputs of missing rows of a log, interpolated from the rows around them."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from .held import runs


class Interpolated(NamedTuple):
    """An input with its missing rows."""

    u: Float[np.ndarray, " time"]
    error: Float[np.ndarray, " time"]
    """Three standard deviations of the sum over the gap of a missing row, over the size of one row."""


def interpolated(u: Float[np.ndarray, " time"], missing: Bool[np.ndarray, " time"]) -> Interpolated:
    """An input with its missing rows interpolated, and the interpolation error.

    The missing rows are those that linear prediction from the rows around makes likeliest [Janssen, Veldhuis & Vries
    1986, IEEE Trans. ASSP 34(2)], with the covariance of least squares.
    """
    size, error = float(np.sqrt(np.mean(u[~missing] ** 2))), np.zeros(u.size)
    out = known = np.where(missing, 0.0, u / (size or 1.0))
    if size == 0.0:
        return Interpolated(known, error)
    out, (weights, spread) = known.copy(), _prediction(known, missing)
    order = weights.size
    for run in (run for run in runs(1.0 * missing) if missing[run.first]):
        count = min(run.end, u.size - order) - (first := max(run.first - order, 0))  # predictions that need the gap
        part = slice(first, first + count + order)
        shifted = [np.eye(count, count + order, order - lag) for lag in range(order + 1)]
        errors = shifted[0] - np.tensordot(weights, shifted[1:], 1)
        solve = np.linalg.pinv(errors[:, missing[part]])
        inside = np.isin(np.flatnonzero(missing[part]) + first, np.arange(run.first, run.end))
        out[run.first : run.end] = -(solve @ errors @ known[part])[inside]
        error[run.first : run.end] = 3 * spread * np.linalg.norm(solve[inside].sum(axis=0))
    return Interpolated(size * out, error)


def _prediction(
    u: Float[np.ndarray, " time"], missing: Bool[np.ndarray, " time"]
) -> tuple[Float[np.ndarray, " lag"], float]:
    """Weights of the rows before, the nearest first, that predict an input best, and the rms error of that."""
    for order in (min(16, u.size // 8), 1):
        complete = ~np.lib.stride_tricks.sliding_window_view(missing, order + 1).any(axis=1)
        rows = np.lib.stride_tricks.sliding_window_view(u, order + 1)[complete][:, ::-1]
        past, target = rows[:, 1:], rows[:, 0]
        if order > 1 and len(rows) >= 2 * order:
            weights = np.linalg.solve(past.T @ past + 1e-9 * len(rows) * np.eye(order), past.T @ target)
            return weights, float(np.sqrt(np.mean((target - past @ weights) ** 2)))
    return np.ones(1), float(np.sqrt(np.mean(np.diff(rows, axis=1) ** 2))) if len(rows) else np.inf
