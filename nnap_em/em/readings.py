"""First motion and rest of readings, from the logs alone."""

import numpy as np
from jaxtyping import Bool, Float, Int

from ..data.noise import reading_noise

OVER, ROWS_BEFORE = 5, 30
"""Rows over which a change counts as motion, and the rows at rest before the first motion that are kept: as many as
show where the machine rests."""
RESTS = 0.35
"""Share of rows at rest from which on a log determines hardly more of friction than its size: machines that were shaken
for the purpose rest in 0 to 0.2 of the rows, those that stick in 0.5 to 0.8."""


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
