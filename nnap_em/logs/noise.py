"""Noise and codes of a reading, from the logs alone."""

import math

import numpy as np
from jaxtyping import Float


def resolution(signal: Float[np.ndarray, "seq time"]) -> float:
    """Step between the codes of a reading that repeats them; 0 where neighbours hardly ever are equal."""
    change = np.abs(np.concatenate([np.diff(y[np.isfinite(y)]) for y in signal]))
    moved = change[change > 0]
    if not 0 < moved.size < (1 - 0.02) * change.size:  # share of them from which on readings are counted as codes
        return 0.0
    step = float(np.quantile(moved, 0.02))  # the smallest, but for a share of rounding
    multiple = 0.05  # median distance of changes from multiples of that step; a quarter where they are none [steps]
    return step if np.median(np.abs(moved / step - np.round(moved / step))) < multiple else 0.0


def reading_noise(signal: Float[np.ndarray, "seq time"], order: int = 3) -> float:
    """Standard deviation of white noise on a smooth signal, from its third differences (var = 20 sigma^2).

    [Gasser, Sroka & Jennen-Steinmetz 1986, Biometrika 73(3), for the idea] Of another `order` n, var = (2n over n)
    sigma^2. The median makes it blind to jumps. Equal readings in a row, one more than the order, are one code of a
    sensor at rest, and no sample of its noise, which is at least that of rounding to its codes, step / sqrt(12).
    """
    differences = []
    for y in signal:  # missing samples are bridged: held readings may be none in adjacent rows
        steps = np.diff(y[np.isfinite(y)])
        if steps.size >= order:
            moves = np.convolve(steps != 0, np.ones(order), "valid") > 0
            differences.append(np.diff(steps, order - 1)[moves])
    d = np.concatenate([np.zeros(0), *differences])
    smooth = float(np.median(np.abs(d)) / 0.6745 / math.sqrt(math.comb(2 * order, order))) if d.size else 0.0
    return max(smooth, resolution(signal) / math.sqrt(12))


def fast_reading_noise(signal: Float[np.ndarray, "seq time"]) -> float:
    """The smaller of two orders: eighth differences have a thousandth of a period of nine rows, third ones a tenth."""
    return min(reading_noise(signal), reading_noise(signal, 8))
