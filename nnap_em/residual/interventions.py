"""Touches from outside: a force for a moment that nothing repeats.  A hand, a collision, a cable that catches.

The smoothed kicks are auxiliary residuals: where something pushed that the model does not know, they stand out for
as long as it pushed [Harvey & Koopman 1992, J. Bus. Econ. Stat. 10, 377; de Jong & Penzer 1998, J. Am. Stat. Assoc.
93, 796].  On a machine they stand out elsewhere too: friction, backlash, an input that jumps.  So a touch is held
against what the same recordings do at all other times, and against what was felt by whoever came by the same state:
what others feel there too is a law of the machine, and no touch.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from ..data.dataset import Dataset
from ..em.build import measure_scales
from ..em.identify import Identified
from ..em.loop import FitError
from .residual import Names, Residual, names_of, residual

WIDTHS = (0.2, 0.4, 0.8)
"""Lengths [s] of the bells over which forces are averaged; half of it at half height.  Chatter of gears is shorter."""
STEP = 0.03
"""Time [s] between the bells that are looked at."""
LEVEL = 4.0
"""From where on a force is a touch, in standard deviations: a normal one is so large once in some thousand bells."""
MORE = 0.8
"""Part of it that is enough where another touch is certain already."""
ALONE = 2.0
"""Times it that is asked where nobody else came by."""
SMALL = 0.05
"""Part of the typical torque of a joint below which nothing is called a touch."""
NEAR, WITNESSES = 1.2, 5
"""Distance of a state that counts as the same, in radians, or rms of rates and inputs; how many such are asked."""
VIEW, OTHERS = 0.5, 10
"""The same where a law of a single joint is looked for."""
REPEATED = 0.5
"""Share of the force that, felt by the others in the mean, makes it a law."""
APART = 1.0
"""Time [s] after which a recording is a witness for itself, and which counts as one."""
EDGE = 0.25
"""Share of its peak at which a touch begins and ends."""
MARGIN, LEAST = 0.1, 0.5
"""Time [s] left out before and after a touch; length [s] of a piece between two that is of use."""
ROUNDS = 3
"""Fits anew at most: a fit that was spared one touch sees another better."""


class Intervention(NamedTuple):
    """A push on one joint that no law explains."""

    sequence: int
    joint: int
    """Counted from 1."""
    first: int
    """First row."""
    last: int
    """Last row."""
    from_s: float
    to_s: float
    """On the clock of the log [s]."""
    size: float
    """Largest mean over a bell [N m, or N]."""
    std: float
    """How large such means are where nothing touches."""
    unit: str


class Bell(NamedTuple):
    """Means of the missing force over bells of one length."""

    mean: Float[np.ndarray, "seq time dof"]
    """NaN where a bell does not fit inside its recording."""
    std: Float[np.ndarray, "seq time dof"]
    """What such a mean is where nothing touches."""


def averaged(a: Float[np.ndarray, "seq time column"], rows: int) -> Float[np.ndarray, "seq time column"]:
    """Means over bells of `rows` rows; NaN where one does not fit."""
    if not a.size:
        return a
    kernel = np.hanning(rows + 2)[1:-1]
    kernel = kernel / kernel.sum()
    over = lambda a: np.apply_along_axis(lambda row: np.convolve(row, kernel, "same"), 1, a)  # noqa: E731
    known = np.isfinite(a)
    return np.where(over(known.astype(float)) > 0.99, over(np.where(known, a, 0.0)), np.nan)


def level(a: Float[np.ndarray, "seq bell"]) -> Float[np.ndarray, "seq 1"]:
    """Standard deviation that no touch of some tenths of the time moves.

    That of all recordings, by the 80 % quantile, since the tails are heavy, or that of the recording, by its median.
    """
    size = np.abs(a)
    if not np.isfinite(size).any():
        return np.full((len(a), 1), np.inf)
    own = [1.4826 * np.nanmedian(one) if np.isfinite(one).any() else 0.0 for one in size]
    return np.maximum(np.nanquantile(size, 0.8) / 1.2816, np.asarray(own))[:, None] + 1e-300


def bell(force: Float[np.ndarray, "seq time dof"], rows: int) -> Bell:
    """Averages over `rows` rows; they are less sure where the force scatters, as where gears chatter."""
    mean = averaged(force, rows)
    scatter = np.sqrt(np.maximum(averaged(force**2, rows) - mean**2, 0.0)) + 1e-300
    std = np.full(mean.shape, np.nan)
    for j in range(mean.shape[-1]):
        m, s = mean[..., j], scatter[..., j]
        if np.isfinite(m).any():
            loud = s >= np.nanquantile(s, 0.9)
            std[..., j] = np.maximum(level(m), 1.4826 * np.nanmedian(np.abs(m[loud]) / s[loud]) * s)
    return Bell(mean, std)


class Places(NamedTuple):
    """The bells that are looked at, and the states in which they are."""

    seq: Int[np.ndarray, " place"]
    row: Int[np.ndarray, " place"]
    state: Float[np.ndarray, "place feature"]
    """All that a law may depend on, in units in which a distance of `NEAR` is small."""
    views: tuple[Float[np.ndarray, "place feature"], ...]
    """What a law of one joint may depend on: its angle and rate; the input and rate."""

    def away(self, at: int, apart: int) -> Bool[np.ndarray, " place"]:
        """Those that are not of the same moment."""
        return (self.seq != self.seq[at]) | (np.abs(self.row - self.row[at]) >= apart)


def places(found: Residual, names: Names, dt: float) -> Places:
    """Every `STEP` of all sequences, where the state is known."""
    dof = len(names.coordinates)
    q, v, u = found.state[..., :dof], found.state[..., dof:], averaged(found.u, max(3, round(WIDTHS[0] / dt)))
    seq, row = np.nonzero(np.isfinite(np.concatenate([q, v, u], axis=-1)).all(-1) & found.valid)
    keep = row % max(1, round(STEP / dt)) == 0
    seq, row = seq[keep], row[keep]

    def scaled(a):
        a = a[seq, row]
        return a / (np.sqrt(np.mean(a**2, axis=0)) + 1e-300)

    v, u = scaled(v), scaled(u)
    angle = [
        np.stack([np.sin(x), np.cos(x)], axis=1) if turns else scaled(q[..., j : j + 1] - np.mean(x))
        for j, (x, turns) in enumerate(zip(q[seq, row].T, names.rotary, strict=True))
    ]
    views = [np.concatenate([angle[j], v[:, j : j + 1]], axis=1) for j in range(dof)]
    views += [np.stack([u[:, i], v[:, joint - 1]], axis=1) for i, joint in enumerate(names.joints)]
    return Places(seq, row, np.concatenate([*angle, v, u], axis=1), tuple(views))


def witnesses(here: Places, apart: int) -> tuple[Int[np.ndarray, "place near"], Bool[np.ndarray, "place near"]]:
    """The places nearest to each, and which of them count: of another moment, and one of every moment."""
    count = len(here.seq)
    near = min(128, count)
    distance, place = KDTree(here.state).query(here.state, k=near, distance_upper_bound=NEAR)
    distance, place = (a.reshape(count, near) for a in (distance, place))
    known = np.isfinite(distance)
    place = np.where(known, place, 0)
    seq, row = here.seq[place], here.row[place]
    known &= (seq != here.seq[:, None]) | (np.abs(row - here.row[:, None]) >= apart)
    moment = seq * (1 + here.row.max(initial=0) // apart) + row // apart
    counts = np.zeros(place.shape, bool)
    for k in range(near):
        twice = np.any(counts[:, :k] & (moment[:, :k] == moment[:, k : k + 1]), axis=1)
        counts[:, k] = known[:, k] & ~twice & (counts.sum(axis=1) < WITNESSES)
    return place, counts


def repeated(mean: Float[np.ndarray, " place"], here: Places, at: int, apart: int) -> float:
    """The largest share of a force that is felt wherever the signals of one joint are the same."""
    away = here.away(at, apart) & np.isfinite(mean)
    shares = [0.0]
    for view in here.views:
        distance = np.where(away, np.linalg.norm(view - view[at], axis=1), np.inf)
        order = np.argsort(distance)[:OTHERS]
        order = order[distance[order] < VIEW]
        if order.size > 2:
            shares.append(float(np.mean(mean[order]) / mean[at]))
    return max(shares)


def touches(
    found: Residual, names: Names, dt: float, least: Float[np.ndarray, " dof"], bar: float = LEVEL
) -> tuple[Intervention, ...]:
    """What stands out of the force that a model lacks, and is new; in the order of files and times.

    Both have to be so: the geometric mean of how far the force stands out, and of how far it does beyond what was
    felt in the same state at other moments, is at least `bar` standard deviations.  `least`: sizes [N m, or N] below
    which nothing is told.
    """
    known = found.valid & found.used[:, None] & np.isfinite(found.state).all(axis=-1)
    force = np.where(known[..., None], found.force, np.nan)
    force[:, 0] = np.nan  # of the start, which nothing before it tells
    here, apart = places(found._replace(valid=known), names, dt), max(1, round(APART / dt))
    if not here.seq.size:
        return ()
    place, counts = witnesses(here, apart)
    lengths = list(dict.fromkeys(max(3, round(w / dt)) for w in WIDTHS))
    bells = [bell(force, rows) for rows in lengths]
    out: list[Intervention] = []
    for j in range(force.shape[-1]):
        means = [b.mean[here.seq, here.row, j] for b in bells]
        stds = [b.std[here.seq, here.row, j] for b in bells]
        sure = np.stack([_sure(m, s, here, place, counts) for m, s in zip(means, stds, strict=True)])
        sure = np.where(np.abs(np.stack(means)) >= least[j], sure, 0.0) / np.where(counts.any(axis=1), 1.0, ALONE)
        while sure.max() >= bar:
            k, at = np.unravel_index(sure.argmax(), sure.shape)
            i, row, size, std = int(here.seq[at]), int(here.row[at]), float(means[k][at]), float(stds[k][at])
            first, last = _extent(bells[0].mean[i, :, j], row, math.copysign(1.0, size))
            beside = np.maximum(min(first, row) - here.row, here.row - max(last, row))
            reach = np.asarray(lengths)[:, None] // 2  # of a bell: what stands beside it feels the same push
            sure = np.where((here.seq == i) & (beside[None] <= reach), 0.0, sure)
            clock = float(found.t[i, first]), float(found.t[i, last])
            touch = Intervention(i, j + 1, first, last, *clock, size, std, names.force_unit(j + 1))
            again = any(_overlap(touch, other) for other in out)
            if not again and repeated(means[k], here, int(at), apart) < REPEATED:
                out.append(touch)
    return tuple(sorted((t for t in out if not any(_again(t, other, apart) for other in out)), key=_order))


def _again(touch: Intervention, other: Intervention, apart: int) -> bool:
    """Whether another push on the same joint is so near that both are a swing of the machine."""
    if (touch.sequence, touch.joint) != (other.sequence, other.joint) or touch is other:
        return False
    return max(touch.first - other.last, other.first - touch.last) < apart


def _order(touch: Intervention) -> tuple[int, int, int]:
    return touch.sequence, touch.first, touch.joint


def _sure(mean, std, here: Places, place, counts) -> Float[np.ndarray, " place"]:
    """Standard deviations of every bell of one length from what is usual and from what others felt."""
    felt = np.where(counts & np.isfinite(mean[place]), mean[place], 0.0).sum(axis=1) / np.maximum(counts.sum(axis=1), 1)
    new = mean - felt
    table = np.full((here.seq.max() + 1, here.row.max() + 1), np.nan)
    table[here.seq, here.row] = new
    product = mean / std * new / level(table)[here.seq, 0]
    small = (np.abs(felt) > REPEATED * np.abs(mean)) & (felt * mean > 0)
    return np.where(small, 0.0, np.sqrt(np.maximum(np.nan_to_num(product), 0.0)))


def _extent(mean: Float[np.ndarray, " time"], row: int, sign: float) -> tuple[int, int]:
    """First and last row about `row` at which the force is more than a share of its peak."""
    small = ~(sign * mean > EDGE * sign * mean[row])
    before, after = np.flatnonzero(small[:row]), np.flatnonzero(small[row:])
    return int(before[-1] + 1) if before.size else 0, int(row + max(after[0] - 1, 0)) if after.size else mean.size - 1


def interventions(fitted: Identified, data: Dataset, bar: float = LEVEL) -> tuple[Intervention, ...]:
    """Touches in `data`, by the smoother of the fit; none where a coordinate is not measured.

    A hidden joint answers whatever pushes the others, so that nothing can be told there.
    """
    rig, system = fitted.rig, fitted.model.system
    if not set(system.coordinates) <= set(rig.measured):
        return ()
    least = SMALL * measure_scales(rig, system, data).torque
    return touches(residual(fitted, data), names_of(fitted), rig.dt, least, bar)


def without(
    data: Dataset, found: tuple[Intervention, ...], dt: float, *, restart: bool = True
) -> tuple[Dataset, tuple[int, ...]]:
    """`data` cut at the touches, and the recording of every piece.

    What lies between two touches becomes a sequence of its own, if it is long enough.

    Without `restart`, where the state of the first row is declared and holds there alone, only what lies before the
    first touch of each recording stays.
    """
    margin, least = round(MARGIN / dt), max(2, round(LEAST / dt))
    pieces: list[tuple[int, int, int]] = []
    for i, valid in enumerate(np.asarray(data.valid)):
        use = np.append(valid, False)
        for touch in found:
            if touch.sequence == i:
                use[max(0, touch.first - margin) : touch.last + margin + 1] = False
        edges = np.flatnonzero(np.diff(np.concatenate([[False], use]).astype(int)))
        runs = [(i, int(a), int(b)) for a, b in edges.reshape(-1, 2)]
        if not restart:
            runs = [run for run in runs if run[1] == 0]
        pieces += [run for run in runs if run[2] - run[1] >= min(least, valid.sum())]
    if not pieces:
        return data, ()
    rows = max(b - a for _, a, b in pieces)
    t, u, y, _ = (np.asarray(part) for part in data)

    def cut(values: Float[np.ndarray, "seq time *column"], filler: float | None) -> np.ndarray:
        parts = [values[i, a:b] for i, a, b in pieces]
        pad = [np.full((rows - len(p), *p.shape[1:]), p[-1] if filler is None else filler) for p in parts]
        return np.stack([np.concatenate(both) for both in zip(parts, pad, strict=True)])

    length = np.asarray([b - a for _, a, b in pieces])
    valid: Bool[np.ndarray, "seq time"] = np.arange(rows) < length[:, None]
    return Dataset(cut(t, None), cut(u, 0.0), cut(y, np.nan), valid), tuple(i for i, _, _ in pieces)


def untouched(
    fit: Callable[[Dataset], Identified], fitted: Identified, data: Dataset
) -> tuple[Identified, Dataset, tuple[Intervention, ...], tuple[int, ...]]:
    """A fit of `data` without the touches in it, the sequences that it saw, the touches, and the recording that each
    sequence is a piece of; `fitted` saw all.
    """
    used, found, pieces = data, interventions(fitted, data), tuple(range(len(data.t)))
    for _ in range(ROUNDS if found else 0):
        cut, of = without(data, found, fitted.rig.dt, restart=not fitted.rig.start)
        try:
            fitted = fit(cut) if of else fitted
        except FitError:  # what is left is too little: the fit that saw the touches stays
            break
        used, pieces = (cut, of) if of else (used, pieces)
        more = [t for t in interventions(fitted, data, MORE * LEVEL) if not any(_overlap(t, old) for old in found)]
        if not more:
            break
        found = tuple(sorted([*found, *more], key=_order))
    return fitted, used, found, pieces


def _overlap(a: Intervention, b: Intervention) -> bool:
    return (a.sequence, a.joint) == (b.sequence, b.joint) and a.first <= b.last and b.first <= a.last
