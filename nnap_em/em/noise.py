"""Test of readings for white noise."""

import numpy as np

from ..data.dataset import Dataset
from ..model.state_space import StateSpaceModel

READINGS = -0.55
"""Lag-1 correlation of third differences below which readings are white noise at the sampling: that has -0.75, a
filtered or quantised sensor -0.45 and more."""


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
    """True where the readings of all measured coordinates carry white noise that is sampled as it is.

    Where no coordinate is measured, one other reading is enough.  Rates and accelerations are no evidence against it:
    they may change within a sample.  White readings are no proof of right equations, whose horizons are long.
    """
    if model.system.simulated:
        return False
    lags = [third_differences(y) for y in np.moveaxis(np.asarray(data.y), -1, 0)]
    dof = len(model.system.coordinates)
    coordinates = [lag for lag, place in zip(lags, model.measured, strict=True) if place < dof]
    return max(coordinates or [min(lags, default=0.0)]) < READINGS
