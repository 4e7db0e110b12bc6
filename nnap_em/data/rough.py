"""Readings that no sensor took: spikes, a stuck, late or saturated sensor; and the inputs of rows that a log lost.

Each finding needs a reason beyond its look: neighbours on both sides that agree without a spike and with no jump or
kink in its place, another column or a jump that contradicts a stuck sensor, a trend that goes on beyond a limit.
"""

import math
from collections.abc import Collection, Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from .plausible import Columns, bridge

FULL = "saturated"
SPIKE = 6.0  # standard deviations of a reading from what its neighbours tell
LONGEST = 3  # rows of a spike
STILL = 5  # equal rows in a run that may be a stuck sensor
_SIDE, _NEAR = 5, 3  # rows on either side of a spike that are asked, and where the signal is too quick for these
_MARGIN = 9.0  # twice the log-likelihood by which a spike must explain better than a jump or a kink
_END = 5.0  # times as large it must be in the first and last three rows, which have neighbours on one side
_PAIR = 2.5  # times as large it must be where another row near by has to be left out to see it
_AROUND = 10  # rows before and after a spike that say how restless the signal is
_RESTLESS = 5.0  # times its own jerks that a spike must be
_LEAST = 0.015  # of the standard deviation of the column: a smaller spike does no harm, and machines make small wiggles
_QUICK = 3.0  # times what the curve of `_SIDE` neighbours misses that a spike from that of `_NEAR` must be
_DOUBT = 10.0  # of a curve that fits ill, over its degrees of freedom: two of them tell little
_SHORT = 5.0  # times as large a run must be as a single reading: machines make short wiggles too
_ORDER = 16  # of the linear prediction of an input
_TRIALS = 40  # gaps that are made on purpose to see how well an input is told


class Rough(NamedTuple):
    """Rows of a column that hold no reading, and why."""

    kind: str
    """`spike`, `stuck`, `late start` or `saturated`."""
    column: str
    rows: Int[np.ndarray, " row"]


class _Run(NamedTuple):
    """Equal readings in the rows from `first` to before `end`; some may be missing."""

    first: int
    end: int

    @property
    def length(self) -> int:
        return self.end - self.first


def rough(readings: Columns, dt: float, limits: Collection[tuple[str, float]] = ()) -> list[Rough]:
    """What is no reading in the columns of one sequence, sampled every `dt` [s]; NaN is a missing sample.

    `limits` are columns and values at which they are known to saturate.
    """
    first = {name: spikes(values) for name, values in readings.items()}
    rest = {name: _without(values, first[name]) for name, values in readings.items()}
    found = []
    for name, values in rest.items():
        frozen = list(_frozen(name, rest, dt, [value for column, value in limits if column == name]))
        found += [Rough(kind, name, rows[np.isfinite(values[rows])]) for kind, rows in frozen]
        y = _without(values, *(rows for _, rows in frozen))
        rows = np.sort(np.concatenate([first[name], spikes(y)])) if frozen else first[name]
        found += [Rough("spike", name, rows)] * bool(rows.size)
    return found


def _without(y: Float[np.ndarray, " time"], *rows: Int[np.ndarray, "_"]) -> Float[np.ndarray, " time"]:
    """The readings, those of some rows as missing."""
    out = np.array(y)
    out[np.concatenate([np.zeros(0, int), *rows])] = np.nan
    return out


# --- spikes


def spikes(y: Float[np.ndarray, " time"]) -> Int[np.ndarray, " row"]:
    """Rows of single readings or short runs that leave the trend of the readings before and after them."""
    y, out = np.array(y), []
    while True:
        sigma = max(noise(y), 1e-9 * float(np.nanmax(np.abs(y), initial=0.0)), 1e-300)
        tried = list(_candidates(y, sigma))
        alone = [int(run[0]) for run in tried if run.size == 1]
        taken = [run for run in tried if _is_spike(y, run, alone, sigma)]
        if not taken:
            return np.array(sorted(out), int)
        for run in taken:
            out += [int(row) for row in run if np.isfinite(y[row])]
            y[run] = np.nan


def noise(y: Float[np.ndarray, " time"]) -> float:
    """Standard deviation of a reading about its neighbours' cubic, by the median; at least a third of a step."""
    left = _left(np.flatnonzero(np.isfinite(y)), y, 1)
    step = np.abs(np.diff(y[np.isfinite(y)]))
    least = float(np.min(step, where=step > 0, initial=math.inf)) / 3
    spread = float(np.median(np.abs(left.miss) / left.factor)) / 0.6745 if left.miss.size else 0.0
    return max(spread, least if math.isfinite(least) else 0.0)


class _Left(NamedTuple):
    """What is left of the readings of runs when the cubic through two neighbours on either side is taken off."""

    rows: Int[np.ndarray, "run row"]
    miss: Float[np.ndarray, "run row"]
    factor: Float[np.ndarray, "run row"]
    """Standard deviation of `miss` over that of a reading."""


def _left(k: Int[np.ndarray, " seen"], y: Float[np.ndarray, " time"], length: int) -> _Left:
    """Of all runs of `length` among the rows `k` that were read."""
    count = max(k.size - length - 3, 0)
    at = np.arange(count)[:, None]
    nodes, inner = k[at + np.array([0, 1, length + 2, length + 3])], k[at + 2 + np.arange(length)]
    usual = float(np.median(np.diff(k))) if k.size > 1 else 1.0
    near = nodes[:, 3] - nodes[:, 0] <= (length + 3) * usual + 4
    nodes, inner = nodes[near], inner[near]
    x, z = nodes.astype(float), inner.astype(float)
    weight = np.ones((*inner.shape, 4))
    for i in range(4):
        for j in range(4):
            if i != j:
                weight[..., i] *= (z - x[:, j : j + 1]) / (x[:, i] - x[:, j])[:, None]
    miss = y[inner] - np.einsum("rli,ri->rl", weight, y[nodes])
    return _Left(inner, miss, np.sqrt(1 + np.sum(weight**2, axis=-1)))


def _candidates(y: Float[np.ndarray, " time"], sigma: float) -> Iterator[Int[np.ndarray, " row"]]:
    """Runs whose readings all lie far from the cubic through their neighbours, and the rows at both ends."""
    k = np.flatnonzero(np.isfinite(y))
    if k.size > 4 * _SIDE:
        yield from k[[0, 1, -2, -1], None]
    for length in range(1, LONGEST + 1):
        left = _left(k, y, length)
        far = (np.abs(left.miss) > 0.9 * SPIKE * sigma * left.factor).all(axis=1)
        yield from left.rows[far]


def _is_spike(y: Float[np.ndarray, " time"], run: Int[np.ndarray, " row"], alone: list[int], sigma: float) -> bool:
    """Whether the neighbours agree without the run; one of them that may be a spike itself may be left out."""
    if _stands_out(y, run, sigma, _SIDE) or _stands_out(y, run, sigma, _NEAR):
        return True
    for other in alone:
        if 2 <= np.min(np.abs(run - other)) <= _SIDE:
            without = y.copy()
            without[other] = np.nan
            if _stands_out(without, run, sigma, _SIDE, _PAIR):
                return True
    return False


class _Fit(NamedTuple):
    """The curve through the neighbours of a run."""

    x: Float[np.ndarray, " row"]
    """Rows, the run's among them, about its middle, over their number."""
    y: Float[np.ndarray, " row"]
    base: Float[np.ndarray, "row term"]
    size: float
    """How far the nearest reading of the run lies from it."""
    rest: float
    """The least squares that it leaves."""
    freedom: int
    end: bool
    """Fewer than three neighbours on one side: at the end of the file."""


def _fit(y: Float[np.ndarray, " time"], run: Int[np.ndarray, " row"], side: int) -> _Fit:
    seen = np.flatnonzero(np.isfinite(y))
    before, after = seen[seen < run[0]][-side:], seen[seen > run[-1]][:side]
    end = min(before.size, after.size) < 3
    if end:
        before, after = seen[seen < run[0]][-_SIDE - 2 :], seen[seen > run[-1]][: _SIDE + 2]
    rows = np.concatenate([before, run, after])
    x = (rows - run.mean()) / (rows[-1] - rows[0])
    base = np.vander(x, 3 if end else 4)
    keep = ~np.isin(rows, run)
    left = y[rows] - base @ np.linalg.lstsq(base[keep], y[rows][keep], rcond=None)[0]
    rest, freedom = float(left[keep] @ left[keep]), max(int(keep.sum()) - base.shape[1], 1)
    return _Fit(x, y[rows], base, float(np.min(np.abs(left[~keep]))), rest, freedom, end)


def _stands_out(
    y: Float[np.ndarray, " time"], run: Int[np.ndarray, " row"], sigma: float, side: int, strict: float = 1.0
) -> bool:
    """Whether the run is far from the curve of `side` neighbours, and a jump, a kink or both explain the rows worse."""
    fit = _fit(y, run, side)
    excess = max(fit.rest / fit.freedom - _MARGIN / 3 * sigma**2, 0.0)
    spread = max(sigma, math.sqrt(fit.rest / fit.freedom), (1.0 + _DOUBT / fit.freedom) * math.sqrt(excess))
    size = fit.size / strict / (_END if fit.end else 1.0 if run.size == 1 else _SHORT)
    if size < 1.1 * SPIKE * spread or size < _LEAST * float(np.std(y[np.isfinite(y)])):
        return False
    if size < _RESTLESS * _activity(y, run, sigma):
        return False
    if fit.end:
        return True
    if side < _SIDE and size < _QUICK * math.sqrt((wide := _fit(y, run, _SIDE)).rest / wide.freedom):
        return False
    worse = _broken(fit.x, fit.base, fit.y) > 1.5 * fit.rest + _MARGIN * sigma**2
    return worse and _in_two(fit.x, fit.y) > 1.5 * fit.rest


def _in_two(x: Float[np.ndarray, " row"], y: Float[np.ndarray, " row"]) -> float:
    """The least squares that two parabolas leave, one up to a row and one from the next: an impact, a reversal."""
    least = math.inf
    for k in range(3, x.size - 2):
        parts = [(np.vander(x[part], 3), y[part]) for part in (slice(k), slice(k, None))]
        miss = [v - base @ np.linalg.lstsq(base, v, rcond=None)[0] for base, v in parts]
        least = min(least, sum(float(m @ m) for m in miss))
    return least


def _broken(x: Float[np.ndarray, " row"], base: Float[np.ndarray, "row term"], y: Float[np.ndarray, " row"]) -> float:
    """The least squares that the curve and one jump or one kink, anywhere between the rows, leave."""
    corner = np.concatenate([x[1:-1], 0.5 * (x[1:] + x[:-1])])[:, None]
    breaks = np.concatenate([(x > corner) * 1.0, np.maximum(x - corner, 0.0)])
    unit = np.linalg.qr(base)[0]
    left, beyond = y - unit @ (unit.T @ y), breaks - (breaks @ unit) @ unit.T
    size = np.sum(beyond**2, axis=1)
    explained = (beyond @ left) ** 2 / np.maximum(size, 1e-12)
    return float(left @ left - np.max(explained[size > 1e-9], initial=0.0))


def _activity(y: Float[np.ndarray, " time"], run: Int[np.ndarray, " row"], sigma: float) -> float:
    """How far readings around the run lie from the cubic through their neighbours, as far as noise does not explain it.

    The upper quartile: one more spike near by does not hide this one.
    """
    first = max(run[0] - _AROUND, 0)
    there = y[first : run[-1] + _AROUND + 1].copy()
    there[run - first] = np.nan
    left = _left(np.flatnonzero(np.isfinite(there)), there, 1)
    beside = (left.rows < run[0] - first - 2) | (left.rows > run[-1] - first + 2)
    bend = (np.abs(left.miss) / left.factor)[beside]
    return max(float(np.percentile(bend, 75)) - 1.5 * sigma, 0.0) if bend.size else math.inf


# --- equal readings


def _frozen(
    name: str, readings: Columns, dt: float, limits: Collection[float]
) -> Iterator[tuple[str, Int[np.ndarray, " row"]]]:
    """Saturated, stuck and late: kinds and rows."""
    y = readings[name]
    runs = _runs(y)
    first, end = np.array(runs, int).reshape(-1, 2).T
    lengths = end - first
    if lengths.max(initial=0) >= np.isfinite(y).sum():
        return
    usual = float(np.median(np.repeat(lengths, lengths)))
    full = np.zeros(y.size, bool)
    for limit, sign in ((np.nanmax(y), 1.0), (np.nanmin(y), -1.0)):
        there = [runs[i] for i in np.flatnonzero((y[first] == limit) & (lengths >= max(3, 2 * usual)))]
        if limit in limits or any(_beyond(name, readings, run, sign, dt) for run in there):
            full |= _closed(y == limit) & np.isfinite(y)
    if full.any():
        yield FULL, np.flatnonzero(full)
    lively = bool(np.sum((lengths > 1) & (lengths < STILL) & ~full[first]) <= 0.002 * y.size)
    for run in (runs[i] for i in np.flatnonzero((lengths >= max(STILL, 3 * usual)) & ~full[first])):
        if _stuck(name, readings, run, dt, lively):
            late = run.first == np.flatnonzero(np.isfinite(y))[0]
            yield "late start" if late else "stuck", np.arange(run.first + (not late), run.end)


def _runs(y: Float[np.ndarray, " time"]) -> list[_Run]:
    """All readings as runs of equal ones, missing samples among them left out."""
    k = np.flatnonzero(np.isfinite(y))
    new = np.append(True, np.diff(y[k]) != 0)[: k.size]
    last = np.append(new[1:], True)[: k.size]
    return [_Run(int(a), int(b) + 1) for a, b in zip(k[new], k[last], strict=True)]


def _closed(rows: Bool[np.ndarray, " time"], hole: int = 2) -> Bool[np.ndarray, " time"]:
    """`rows` with the holes of up to `hole` rows between them: what is let through there was chosen by its noise."""
    k = np.flatnonzero(rows)
    out = rows.copy()
    for a, b in pairwise(k.tolist()):
        if b - a <= hole + 1:
            out[a:b] = True
    return out


def _stuck(name: str, readings: Columns, run: _Run, dt: float, lively: bool) -> bool:
    """Whether equal readings are none: another column moved meanwhile, or the next reading is somewhere else.

    A `lively` column hardly ever repeats a reading: its noise tells as well.
    """
    y = readings[name]
    away = _travel(name, readings, run, dt)
    if away is not None:
        return float(np.max(np.abs(away), initial=0.0)) > 1.0 or _jumps(y, run)
    return _jumps(y, run) or (lively and _alive(y, run))


def _jumps(y: Float[np.ndarray, " time"], run: _Run) -> bool:
    """Whether the reading after the run is far from it, beside the usual steps."""
    step = np.abs(np.diff(y))
    usual = np.percentile(step[step > 0], 95) if (step > 0).any() else 0.0
    later = y[run.end : run.end + LONGEST + 1]
    later = later[np.isfinite(later)]
    return later.size > 0 and bool(abs(later[0] - y[run.first]) > 4 * usual)


def _alive(y: Float[np.ndarray, " time"], run: _Run) -> bool:
    """Whether the readings right before and right after the run are noise, as elsewhere: no creep, no steps."""
    sides = [part[np.isfinite(part)][:10] for part in (y[: run.first][::-1], y[run.end :])]
    sides = [side for side in sides if side.size >= 8]
    bend, turn = (np.array([np.std(np.diff(side, n)) for side in sides]) for n in (2, 3))
    least = max(noise(y) / 3, 3 * _quantum(y))
    return len(sides) > 0 and bool(np.all((bend > least) & (turn > bend)))


def _partner(name: str, readings: Columns) -> str | None:
    """The rate of a coordinate, or the coordinate of a rate."""
    return next((other for other in (f"d{name}", name[1:] * name.startswith("d")) if other in readings), None)


def _travel(name: str, readings: Columns, run: _Run, dt: float) -> Float[np.ndarray, " row"] | None:
    """How far the other column says that it moved while it read the same, over what noise and steps explain."""
    other = _partner(name, readings)
    if other is None:
        return None
    y, z = readings[name], readings[other]
    part = z[run.first : run.end]
    if np.isfinite(part).mean() < 0.5 or max((same.length for same in _runs(part)), default=0) >= max(
        STILL, 0.5 * run.length
    ):
        return None
    part = bridge(part)
    since = dt * np.arange(run.length)
    still = y[run.first]
    if other == f"d{name}":
        away = dt * (np.cumsum(part) - part[0])
        return away / (6 * noise(z) * dt * math.sqrt(run.length) + 3 * _quantum(y) + 1e-300)
    away = part - np.median(part[:3]) - still * since
    doubt = 9 * noise(z) + 3 * _quantum(z) + (_quantum(y) + 0.3 * abs(still)) * since[-1]
    return away / (doubt + 1e-300)


def _quantum(y: Float[np.ndarray, " time"]) -> float:
    """The smallest step of a signal."""
    step = np.abs(np.diff(y))
    least = float(np.min(step, where=step > 0, initial=math.inf))
    return least if math.isfinite(least) else 0.0


def _beyond(name: str, readings: Columns, run: _Run, sign: float, dt: float) -> bool:
    """Whether it went beyond its limit: by the other column, or by the trends before and after.

    A rate denies what the trends of its coordinate say: a machine at a stop comes and goes as fast.
    """
    y = readings[name]
    before, after = y[max(run.first - 6, 0) : run.first], y[run.end : run.end + 6]
    if np.isfinite(before).sum() < 4 or np.isfinite(after).sum() < 4:
        return False
    away = _travel(name, readings, run, dt)
    if away is not None and (float(np.max(sign * away)) > 1.0 or _partner(name, readings) == f"d{name}"):
        return float(np.max(sign * away)) > 1.0
    reach = min(run.length / 2, 3.0)
    slopes = np.array([_slope(before), -_slope(after)])
    return bool(np.all(sign * slopes * reach > 4 * noise(y) + 4 * _quantum(y)))


def _slope(y: Float[np.ndarray, " row"]) -> float:
    """Change per row of a straight line through the readings."""
    k = np.flatnonzero(np.isfinite(y))
    return float(np.polyfit(k, y[k], 1)[0])


# --- the inputs of lost rows


class Told(NamedTuple):
    """An input with its lost rows."""

    u: Float[np.ndarray, " time"]
    doubt: Float[np.ndarray, " time"]
    """How wrong the gap of a lost row may be: what is told minus what was, summed, over the size of one row."""


def retell(u: Float[np.ndarray, " time"], lost: Bool[np.ndarray, " time"]) -> Told:
    """An input with its lost rows told from the others, and how far to trust them.

    The lost rows are those that linear prediction from the rows around makes likeliest [Janssen, Veldhuis & Vries
    1986, IEEE Trans. ASSP 34(2)].  The doubt is the worst of gaps of the same length that are made elsewhere.
    """
    size, doubt = float(np.sqrt(np.mean(u[~lost] ** 2))), np.zeros(u.size)
    if size == 0.0:
        return Told(np.where(lost, 0.0, u), doubt)
    whole, gaps = u / size, _runs(np.where(lost, 1.0, 0.0))
    weights = _prediction(whole, lost)
    for length in {run.length for run in gaps if lost[run.first]}:
        worst = _worst(whole, lost, weights, length)
        for run in gaps:
            if lost[run.first] and run.length == length:
                doubt[run.first : run.end] = worst
    return Told(size * _told(whole, lost, weights), doubt)


def _worst(
    u: Float[np.ndarray, " time"], lost: Bool[np.ndarray, " time"], weights: Float[np.ndarray, " lag"], length: int
) -> float:
    """The largest error, summed over a gap, of gaps of one length made on purpose."""
    reach, errors = 3 * weights.size, []
    for first in np.linspace(1, u.size - length - 1, _TRIALS).astype(int) if u.size > length + 2 else ():
        if not lost[first - 1 : first + length + 1].any():
            part = slice(max(first - reach, 0), first + length + reach)
            made = (np.arange(u.size) >= first) & (np.arange(u.size) < first + length)
            errors.append(float(np.sum((_told(u[part], (lost | made)[part], weights) - u[part])[made[part]])))
    return max(map(abs, errors)) if len(errors) > 3 else math.inf


def _prediction(u: Float[np.ndarray, " time"], lost: Bool[np.ndarray, " time"]) -> Float[np.ndarray, " lag"]:
    """Weights of the rows before, the nearest first, that predict an input best."""
    order = min(_ORDER, u.size // 8)
    whole = ~np.lib.stride_tricks.sliding_window_view(lost, order + 1).any(axis=1)
    rows = np.lib.stride_tricks.sliding_window_view(u, order + 1)[whole]
    if len(rows) < 2 * order:
        return np.ones(1)
    past, now = rows[:, order - 1 :: -1] if order > 1 else rows[:, :1], rows[:, order]
    return np.linalg.solve(past.T @ past + 1e-9 * len(rows) * np.eye(order), past.T @ now)


def _told(
    u: Float[np.ndarray, " time"], lost: Bool[np.ndarray, " time"], weights: Float[np.ndarray, " lag"]
) -> Float[np.ndarray, " time"]:
    """The lost rows with which the errors of prediction are smallest."""
    order = weights.size
    ends = np.flatnonzero(np.lib.stride_tricks.sliding_window_view(lost, order + 1).any(axis=1)) + order
    errors = np.zeros((ends.size, u.size))
    at = np.arange(ends.size)
    errors[at, ends] = 1.0
    for lag, weight in enumerate(weights, 1):
        errors[at, ends - lag] = -weight
    out = np.where(lost, 0.0, u)
    out[lost] = np.linalg.lstsq(errors[:, lost], -errors @ out, rcond=None)[0]
    return out
