"""Parts of the data that are left out in turn: motions, repetitions together, and moments of all recordings."""

import itertools

import numpy as np
from jaxtyping import Bool, Float, Int

from ..data.dataset import Dataset
from ..model.state_space import StateSpaceModel
from ..numerics.gaussian import Gaussian
from .verdict import REPEATS

MOTION_PARTS = 5
"""Parts of motions, as far as there are recordings."""
QUARTERS = 4
"""Parts of each motion, where there are fewer than three motions."""


def motions(state: Float[np.ndarray, "seq time state"], used: Bool[np.ndarray, " seq"]) -> Int[np.ndarray, " seq"]:
    """Number of the motion of every sequence; those that repeat a motion are no evidence of each other and share it."""
    size = np.nanmean(state[used] ** 2, axis=(0, 1)) + 1e-12
    scaled = state / np.sqrt(size)
    motion = np.arange(len(state))
    for i, j in itertools.combinations(np.flatnonzero(used), 2):
        known = np.isfinite(scaled[[i, j]]).all(axis=-1)
        both = known.all(axis=0)
        if 2 * both.sum() < known.sum(axis=1).max():  # too short a part of the longer one to be its repetition
            continue
        difference, square = np.mean((scaled[i] - scaled[j])[both] ** 2), np.mean(scaled[[i, j]][:, both] ** 2)
        if difference < REPEATS * square:
            motion[motion == motion[j]] = motion[i]
    return motion


def times(clock: Float[np.ndarray, "seq time"], data: Dataset, count: int) -> Int[np.ndarray, "seq time"]:
    """Part, of `count` equal ones, of its sequence that each moment of `clock` [s] lies in."""
    t = np.where(np.asarray(data.valid), np.asarray(data.t), np.nan)
    low, high = (of(t, axis=1, keepdims=True) for of in (np.nanmin, np.nanmax))
    return np.clip((count * (clock - low) / (high - low + 1e-12)).astype(int), 0, count - 1)


def fold_of(
    used: Bool[np.ndarray, " seq"], motion: Int[np.ndarray, " seq"], quarter: Int[np.ndarray, "seq time"]
) -> Int[np.ndarray, "seq time"]:
    """Part of every moment: neighbouring motions together, or quarters of the only ones."""
    different, first = np.unique(motion[used], return_index=True)
    order = np.zeros(used.size, int)
    for rank, i in enumerate(np.argsort(first)):
        order[motion == different[i]] = rank
    count = different.size
    if count >= 3:
        return np.repeat((order * min(MOTION_PARTS, count) // count)[:, None], quarter.shape[1], axis=1)
    return order[:, None] * QUARTERS + quarter


def parts(
    model: StateSpaceModel,
    path: Gaussian,
    data: Dataset,
    used: Bool[np.ndarray, " seq"],
    rows: Int[np.ndarray, " time"],
) -> tuple[Int[np.ndarray, "seq time"], Int[np.ndarray, "seq time"]]:
    """Fold and block of the moments at `rows` of every sequence."""
    state = np.where(np.asarray(data.valid)[..., None], np.asarray(path.mean), np.nan)
    motion = motions(state[..., : 2 * len(model.system.coordinates)], used)
    clock = np.asarray(data.t)[:, rows]
    time_parts = 5  # parts of time: what happens at one moment of every recording is no law
    return fold_of(used, motion, times(clock, data, QUARTERS)), times(clock, data, time_parts)
