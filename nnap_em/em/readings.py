"""Noise, codes and first motion of readings, from the logs alone."""

import math

import numpy as np
from jaxtyping import Bool, Float, Int

EQUAL_NEIGHBOURS, CODE = 0.02, 0.02
"""Share of equal neighbours from which on readings are counted as codes, and the quantile of the other changes that is
the step between two codes: the smallest, but for a share of rounding."""
MULTIPLE = 0.05
"""Median distance of changes from multiples of that step; a quarter where they are none [steps]."""


def resolution(signal: Float[np.ndarray, "seq time"]) -> float:
    """Step between the codes of a reading that repeats them; 0 where neighbours hardly ever are equal."""
    change = np.abs(np.concatenate([np.diff(y[np.isfinite(y)]) for y in signal]))
    moved = change[change > 0]
    if not 0 < moved.size < (1 - EQUAL_NEIGHBOURS) * change.size:
        return 0.0
    step = float(np.quantile(moved, CODE))
    return step if np.median(np.abs(moved / step - np.round(moved / step))) < MULTIPLE else 0.0


def reading_noise(signal: Float[np.ndarray, "seq time"]) -> float:
    """Standard deviation of white noise on a smooth signal, from its third differences (var = 20 sigma^2).

    [Gasser, Sroka & Jennen-Steinmetz 1986, Biometrika 73(3), for the idea] The median makes it blind to jumps. Four
    equal readings are one code of a sensor at rest, and no sample of its noise, which is at least that of rounding to
    its codes, step / sqrt(12).
    """
    third = []
    for y in signal:  # missing samples are bridged: held readings may be none in adjacent rows
        steps = np.diff(y[np.isfinite(y)])
        still = (steps[2:] == 0) & (steps[1:-1] == 0) & (steps[:-2] == 0)
        third.append(np.diff(steps, 2)[~still])
    d = np.concatenate(third)
    smooth = float(np.median(np.abs(d)) / 0.6745 / np.sqrt(20.0)) if d.size else 0.0
    return max(smooth, resolution(signal) / math.sqrt(12))


OVER, MOVES, ROWS_BEFORE = 5, 6.0, 30
"""Rows over which a change counts as motion, from how many standard deviations of the noise on, and the rows at rest
before the first motion that are kept: as many as show where the machine rests."""
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
    return np.abs(whole[:, OVER:] - whole[:, :-OVER]) > MOVES * noise


def at_rest(signal: Float[np.ndarray, "seq time"]) -> float:
    """Share of the readings of a position at rest."""
    inside = np.isfinite(signal[:, :-OVER])
    return float(np.mean(~_moves(signal)[inside])) if inside.any() else 0.0


def onset(y: Float[np.ndarray, "seq time obs"]) -> Int[np.ndarray, " seq"]:
    """Rows of every sequence before its first motion, less `ROWS_BEFORE`; 0 where it moves at once or never."""
    moved = np.any([_moves(signal) for signal in np.moveaxis(y, -1, 0)], axis=0)
    return np.where(moved.any(axis=1), np.maximum(moved.argmax(axis=1) - ROWS_BEFORE, 0), 0)
