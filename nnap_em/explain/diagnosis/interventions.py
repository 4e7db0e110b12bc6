"""External disturbances: a force for a moment that nothing repeats, as from a hand, a collision, a cable that catches.

The smoothed kicks are auxiliary residuals, which stand out where a force acts that the model lacks [Harvey & Koopman
1992, J. Bus. Econ. Stat. 10, 377; de Jong & Penzer 1998, J. Am. Stat. Assoc. 93, 796].  A force that recordings share
at other times, or neighbours in state space at other moments, is a law of the machine.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import convolve1d
from scipy.spatial import KDTree

from ...estimate.em.build import measure_scales
from ...estimate.identify import Identified
from ...logs.dataset import Dataset
from .residual import Names, Residual, names_of, residual

WINDOWS = (0.2, 0.4, 0.8)
"""Lengths of the Hann windows over which forces are averaged [s], each twice its width at half height."""
WINDOW_DISTANCE = 0.03
"""Time between the windows that are compared [s]."""
LEVEL, ALONE = 4.0, 2.0
"""Smallest disturbance [standard deviations]: normal noise reaches it once in some thousand windows; factor on it at a
state that has no neighbours."""
SMALL = 0.05
"""Smallest disturbance, as a share of the typical torque of its joint."""
NEIGHBOUR_DISTANCE, NEIGHBOURS = 1.2, 5
"""Largest distance of a neighbour in state space [rad, or rms of rates and inputs], and number of neighbours."""
REPEATED = 0.5
"""Share of a force from which on, as the mean of its neighbours, it is a law of the machine."""


class Intervention(NamedTuple):
    """A push on one joint that no law explains."""

    sequence: int
    joint: int
    """Counted from 1."""
    first: int
    last: int
    """First and last row."""
    from_s: float
    to_s: float
    """End on the clock of the log [s]."""
    size: float
    """Largest mean over a window [N m, or N]."""
    std: float
    """Standard deviation of such means without disturbances [N m, or N]."""
    unit: str


def averaged(a: Float[np.ndarray, "seq time column"], rows: int) -> Float[np.ndarray, "seq time column"]:
    """Means over Hann windows of `rows` rows; NaN where one does not fit."""
    if not a.size:
        return a
    kernel, known = np.hanning(rows + 2)[1:-1], np.isfinite(a)
    weights, middle = kernel / kernel.sum(), -(rows % 2 == 0)
    parts = known.astype(float), np.where(known, a, 0.0)
    share, total = (convolve1d(part, weights, axis=1, mode="constant", origin=middle) for part in parts)
    return np.where(share > 0.99, total, np.nan)


def level(a: Float[np.ndarray, "seq window"]) -> Float[np.ndarray, "seq 1"]:
    """Robust standard deviation: disturbances for some tenths of the time do not change it. The larger of two: of all
    recordings by the 80 % quantile, since tails are heavy; of one recording by its median.
    """
    size = np.abs(a)
    if not np.isfinite(size).any():
        return np.full((len(a), 1), np.inf)
    single = [1.4826 * np.nanmedian(one) if np.isfinite(one).any() else 0.0 for one in size]
    return np.maximum(np.nanquantile(size, 0.8) / 1.2816, np.asarray(single))[:, None] + 1e-300


def window_mean(
    force: Float[np.ndarray, "seq time dof"], rows: int
) -> tuple[Float[np.ndarray, "seq time dof"], Float[np.ndarray, "seq time dof"]]:
    """Means over `rows` rows, and their standard deviation without disturbances, larger where gears chatter."""
    mean = averaged(force, rows)
    scatter = np.sqrt(np.maximum(averaged(force**2, rows) - mean**2, 0.0)) + 1e-300
    std = np.full(mean.shape, np.nan)
    for j in range(mean.shape[-1]):
        m, s = mean[..., j], scatter[..., j]
        if np.isfinite(m).any():
            large = s >= np.nanquantile(s, 0.9)
            std[..., j] = np.maximum(level(m), 1.4826 * np.nanmedian(np.abs(m[large]) / s[large]) * s)
    return mean, std


class Places(NamedTuple):
    """The windows that are compared, and the state in the middle of each."""

    seq: Int[np.ndarray, " place"]
    row: Int[np.ndarray, " place"]
    state: Float[np.ndarray, "place feature"]
    """All that a law may depend on, in units in which a distance of `NEIGHBOUR_DISTANCE` is small."""


def places(residual: Residual, names: Names, dt: float) -> Places:
    """One place every `WINDOW_DISTANCE` of all sequences, where the state is known."""
    dof = len(names.coordinates)
    q, v, u = residual.state[..., :dof], residual.state[..., dof:], averaged(residual.u, max(3, round(WINDOWS[0] / dt)))
    known = residual.valid & np.isfinite(np.concatenate([q, v, u], axis=-1)).all(-1)
    known[:, np.arange(known.shape[1]) % max(1, round(WINDOW_DISTANCE / dt)) > 0] = False
    rotary, q = np.array(names.rotary, bool), q[known]
    slides = q[:, ~rotary] - np.mean(q[:, ~rotary], axis=0)
    others = np.concatenate([slides, v[known], u[known]], axis=1)
    others = others / (np.sqrt(np.mean(others**2, axis=0)) + 1e-300)
    state = np.concatenate([np.sin(q[:, rotary]), np.cos(q[:, rotary]), others], axis=1)
    seq, row = np.nonzero(known)
    return Places(seq, row, state)


def neighbours(
    samples: Places, separation: int
) -> tuple[Int[np.ndarray, "place near"], Bool[np.ndarray, "place near"]]:
    """The places nearest to each in state space; True for those that count: of another moment, and one a moment."""
    near = min(128, len(samples.seq))
    order, tree = np.arange(1, near + 1), KDTree(samples.state)
    distance, place = tree.query(samples.state, k=order, distance_upper_bound=NEIGHBOUR_DISTANCE)
    known = np.isfinite(distance)
    place = np.where(known, place, 0)
    seq, row = samples.seq[place], samples.row[place]
    known &= (seq != samples.seq[:, None]) | (np.abs(row - samples.row[:, None]) >= separation)
    moment = seq * (1 + samples.row.max(initial=0) // separation) + row // separation
    counts = np.zeros(place.shape, bool)
    for moments, choice, count in zip(moment, known, counts, strict=True):
        first = np.unique(moments[choice], return_index=True)[1]  # the nearest place of each moment
        count[np.flatnonzero(choice)[np.sort(first)[:NEIGHBOURS]]] = True
    return place, counts


def disturbances(
    residual: Residual, names: Names, dt: float, least: Float[np.ndarray, " dof"]
) -> tuple[Intervention, ...]:
    """External disturbances in the missing force, in the order of recordings and times. The geometric mean of two
    numbers is at least `LEVEL` standard deviations: the size of the force, and its difference from the force on
    neighbours in state space at other moments. `least`: smallest size for each joint [N m, or N].
    """
    known = residual.valid & residual.used[:, None] & np.isfinite(residual.state).all(axis=-1)
    force = np.where(known[..., None], residual.force, np.nan)
    force[:, 0] = np.nan  # no reading before it fixes the start
    apart = 1.0  # time between two moments of a recording from which on they are neighbours of each other [s]
    samples, separation = places(residual._replace(valid=known), names, dt), max(1, round(apart / dt))
    if not samples.seq.size:
        return ()
    place, counts = neighbours(samples, separation)
    lengths = list(dict.fromkeys(max(3, round(w / dt)) for w in WINDOWS))
    windows = [window_mean(force, rows) for rows in lengths]
    out: list[Intervention] = []
    for j in range(force.shape[-1]):
        means, stds = ([b[i][samples.seq, samples.row, j] for b in windows] for i in (0, 1))
        sure = np.stack([_sure(m, s, samples, place, counts) for m, s in zip(means, stds, strict=True)])
        sure = np.where(np.abs(np.stack(means)) >= least[j], sure, 0.0) / np.where(counts.any(axis=1), 1.0, ALONE)
        while sure.max() >= LEVEL:
            k, at = np.unravel_index(sure.argmax(), sure.shape)
            i, row, size, std = int(samples.seq[at]), int(samples.row[at]), float(means[k][at]), float(stds[k][at])
            first, last = _extent(windows[0][0][i, :, j], row, math.copysign(1.0, size))
            beside = np.maximum(min(first, row) - samples.row, samples.row - max(last, row))
            reach = np.asarray(lengths)[:, None] // 2  # of a window: those beside it average the same push
            sure = np.where((samples.seq == i) & (beside[None] <= reach), 0.0, sure)
            clock = float(residual.t[i, first]), float(residual.t[i, last])
            disturbance = Intervention(i, j + 1, first, last, *clock, size, std, names.force_unit(j + 1))
            if all(_away(disturbance, other) > 0 for other in out):
                out.append(disturbance)
    # two pushes on a joint that are near each other are a swing of the machine
    alone = (a for a in out if not any(a is not b and _away(a, b) < separation for b in out))
    return tuple(sorted(alone, key=lambda a: (a.sequence, a.first, a.joint)))


def _away(a: Intervention, b: Intervention) -> float:
    """Rows between two disturbances of one joint in one recording; not positive where they share a row."""
    same = (a.sequence, a.joint) == (b.sequence, b.joint)
    return max(a.first - b.last, b.first - a.last) if same else math.inf


def _sure(mean, std, samples: Places, place, counts) -> Float[np.ndarray, " place"]:
    """Geometric mean of the size of every window and its difference from its neighbours [standard deviations]."""
    total = np.where(counts & np.isfinite(mean[place]), mean[place], 0.0).sum(axis=1)
    nearby = total / np.maximum(counts.sum(axis=1), 1)
    new = mean - nearby
    table = np.full((samples.seq.max() + 1, samples.row.max() + 1), np.nan)
    table[samples.seq, samples.row] = new
    product = mean / std * new / level(table)[samples.seq, 0]
    small = (np.abs(nearby) > REPEATED * np.abs(mean)) & (nearby * mean > 0)
    return np.where(small, 0.0, np.sqrt(np.maximum(np.nan_to_num(product), 0.0)))


def _extent(mean: Float[np.ndarray, " time"], row: int, sign: float) -> tuple[int, int]:
    """First and last row about `row` at which the force is more than a quarter of its peak."""
    small = ~(sign * mean > 0.25 * sign * mean[row])
    before, after = np.flatnonzero(small[:row]), np.flatnonzero(small[row:])
    return int(before[-1] + 1) if before.size else 0, int(row + max(after[0] - 1, 0)) if after.size else mean.size - 1


def interventions(fitted: Identified, data: Dataset) -> tuple[Intervention, ...]:
    """External disturbances in `data`, by the smoother of the fit; none where a coordinate is not measured. A hidden
    joint answers whatever pushes the others, so that the pushes cannot be located there.
    """
    rig, system = fitted.rig, fitted.model.system
    if fitted.model.hides:
        return ()
    least = SMALL * measure_scales(rig, system, data).torque
    return disturbances(residual(fitted, data), names_of(fitted), rig.dt, least)
