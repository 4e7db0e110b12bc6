"""First motion and rest of readings, and their noise, white or not, from the logs alone."""

import numpy as np
from jaxtyping import Bool, Float, Int

from ...logs.dataset import Dataset
from ...logs.noise import reading_noise
from ...model.state_space import StateSpaceModel

OVER, ROWS_BEFORE = 5, 30
"""Rows over which a change counts as motion, and rows at rest that are kept before the first motion."""
RESTS = 0.35
"""Share of rows at rest from which on a log determines hardly more of friction than its size: machines that were shaken
for the purpose rest in 0 to 0.2 of the rows, those that stick in 0.5 to 0.8."""
READINGS = -0.55
"""Lag-1 correlation of third differences below which readings are white noise at the sampling: that has -0.75, a
filtered or quantised sensor -0.45 and more."""


def _moves(signal: Float[np.ndarray, "seq time"]) -> Bool[np.ndarray, "seq row"]:
    """Motion from each row to `OVER` later, missing samples bridged."""
    rows, noise = np.arange(signal.shape[1]), reading_noise(signal)
    whole = np.zeros_like(signal)
    for y, known, bridged in zip(signal, np.isfinite(signal), whole, strict=True):
        if known.any():
            bridged[:] = np.interp(rows, rows[known], y[known])
    return np.abs(whole[:, OVER:] - whole[:, :-OVER]) > 6.0 * noise


def at_rest(signal: Float[np.ndarray, "seq time"]) -> float:
    """Share of the readings of a position at rest."""
    inside = np.isfinite(signal[:, :-OVER])
    return float(np.mean(~_moves(signal)[inside])) if inside.any() else 0.0


def onset(y: Float[np.ndarray, "seq time obs"]) -> Int[np.ndarray, " seq"]:
    """Rows of every sequence before its first motion, less `ROWS_BEFORE`; 0 where it moves at once or never."""
    moved = np.any([_moves(signal) for signal in np.moveaxis(y, -1, 0)], axis=0)
    return np.where(moved.any(axis=1), np.maximum(moved.argmax(axis=1) - ROWS_BEFORE, 0), 0)


def third_differences(y) -> float:
    """Lag-1 correlation of third differences of a reading, outliers cut: -0.75 for white noise on a smooth motion."""
    d: np.ndarray = np.diff(np.asarray(y, float), 3, axis=1)
    both = np.isfinite(d[:, 1:]) & np.isfinite(d[:, :-1])
    size = 3 * np.median(np.abs(d[np.isfinite(d)])) / 0.6745 if np.isfinite(d).any() else 0.0
    if not both.any() or not size > 0:
        return 0.0
    d = np.asarray(np.clip(d, -size, size), float)
    return float(np.sum((d[:, 1:] * d[:, :-1])[both]) / np.sum((d[:, 1:] ** 2)[both]))


def white_readings(data: Dataset, model: StateSpaceModel) -> bool:
    """True where the readings of all measured coordinates carry white noise that is sampled as it is, or where none is
    measured, one other: rates may change within a sample.
    """
    lags = [third_differences(y) for y in np.moveaxis(np.asarray(data.y), -1, 0)]
    dof = len(model.system.coordinates)
    coordinates = [lag for lag, place in zip(lags, model.measured, strict=True) if place < dof]
    return max(coordinates or [min(lags, default=0.0)]) < READINGS
