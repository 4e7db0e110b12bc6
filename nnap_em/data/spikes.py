"""Single readings or short runs that leave the trend of their neighbours.

The neighbours on both sides agree without a spike, and no jump or kink in its place explains them.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from .noise import reading_noise

SPIKE = 6.0  # standard deviations of a reading from the value of its neighbours
LONGEST_SPIKE = 3  # rows of a spike
_SIDE, _NEAR = 5, 3  # rows on either side of a spike that are compared, and where the signal is too quick for these


def spikes(y: Float[np.ndarray, " time"]) -> Int[np.ndarray, " row"]:
    """Rows of single readings or short runs that leave the trend of the readings before and after them."""
    y, out = np.array(y), []
    while True:
        sigma = max(reading_noise(y[None]), 1e-9 * float(np.nanmax(np.abs(y), initial=0.0)), 1e-300)
        tried = list(_candidates(y, sigma))
        alone = np.array([run[0] for run in tried if run.size == 1], int)
        confirmed = [run for run in tried if _is_spike(y, run, alone, sigma)]
        if not confirmed:
            return np.array(sorted(out), int)
        for run in confirmed:
            out += [int(row) for row in run if np.isfinite(y[row])]
            y[run] = np.nan


class _Left(NamedTuple):
    """Residual of the readings of runs after the cubic through two neighbours on either side is taken off."""

    rows: Int[np.ndarray, "run row"]
    miss: Float[np.ndarray, "run row"]
    factor: Float[np.ndarray, "run row"]
    """Standard deviation of `miss` over that of a reading."""


def _left(k: Int[np.ndarray, " seen"], y: Float[np.ndarray, " time"], length: int) -> _Left:
    """Residuals of all runs of `length` among the rows `k` that were read."""
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
    for length in range(1, LONGEST_SPIKE + 1):
        left = _left(k, y, length)
        far = (np.abs(left.miss) > 0.9 * SPIKE * sigma * left.factor).all(axis=1)
        yield from left.rows[far]


def _is_spike(
    y: Float[np.ndarray, " time"], run: Int[np.ndarray, " row"], alone: Int[np.ndarray, " other"], sigma: float
) -> bool:
    """True where the neighbours agree without the run; one of them that may be a spike itself may be left out."""
    if _stands_out(y, run, sigma, _SIDE) or _stands_out(y, run, sigma, _NEAR):
        return True
    pair = 2.5  # times as large it must be where another row near by has to be left out to see it
    away = np.maximum(run[0] - alone, alone - run[-1])
    for other in alone[(away >= 2) & (away <= _SIDE)]:
        without = y.copy()
        without[other] = np.nan
        if _stands_out(without, run, sigma, _SIDE, pair):
            return True
    return False


class _Fit(NamedTuple):
    """The curve through the neighbours of a run."""

    x: Float[np.ndarray, " row"]
    """Rows, the run's among them, about its middle, over their number."""
    y: Float[np.ndarray, " row"]
    base: Float[np.ndarray, "row term"]
    size: float
    """Distance of the nearest reading of the run."""
    residual: float
    """The least squares that it leaves."""
    freedom: int
    end: bool
    """Fewer than three neighbours on one side: at the end of the file."""


def _fit(y: Float[np.ndarray, " time"], run: Int[np.ndarray, " row"], side: int) -> _Fit:
    seen = np.flatnonzero(np.isfinite(y))
    first, last = np.searchsorted(seen, [run[0], run[-1] + 1])
    end = min(first, seen.size - last) < 3
    side = _SIDE + 2 if end else side
    before, after = seen[max(first - side, 0) : first], seen[last : last + side]
    rows = np.concatenate([before, run, after])
    x = (rows - run.mean()) / (rows[-1] - rows[0])
    base = np.vander(x, 3 if end else 4)
    keep = np.full(rows.size, True)
    keep[before.size : before.size + run.size] = False
    left = y[rows] - base @ np.linalg.lstsq(base[keep], y[rows][keep], rcond=None)[0]
    residual, freedom = float(left[keep] @ left[keep]), max(int(keep.sum()) - base.shape[1], 1)
    return _Fit(x, y[rows], base, float(np.min(np.abs(left[~keep]))), residual, freedom, end)


def _stands_out(
    y: Float[np.ndarray, " time"], run: Int[np.ndarray, " row"], sigma: float, side: int, strict: float = 1.0
) -> bool:
    """True where the run is far from the curve of `side` neighbours, and a jump, a kink or both explain the rows
    worse.
    """
    fit = _fit(y, run, side)
    margin = 9.0  # twice the log-likelihood by which a spike must explain better than a jump or a kink
    excess = max(fit.residual / fit.freedom - margin / 3 * sigma**2, 0.0)
    doubt = 10.0  # of a curve that fits ill, over its degrees of freedom: two of them show little
    spread = max(sigma, math.sqrt(fit.residual / fit.freedom), (1.0 + doubt / fit.freedom) * math.sqrt(excess))
    at_end = 5.0  # times as large it must be in the first and last three rows, which have neighbours on one side
    short = 5.0  # times as large a run must be as a single reading: machines make short wiggles too
    size = fit.size / strict / (at_end if fit.end else 1.0 if run.size == 1 else short)
    # Of the standard deviation of the column: a smaller spike does no harm, and machines make small wiggles
    if size < 1.1 * SPIKE * spread or size < 0.015 * float(np.std(y[np.isfinite(y)])):
        return False
    if size < 5.0 * _activity(y, run, sigma):  # times its own jerks that a spike must be
        return False
    if fit.end:
        return True
    quick = 3.0  # times what the curve of `_SIDE` neighbours misses that a spike from that of `_NEAR` must be
    if side < _SIDE and size < quick * math.sqrt((wide := _fit(y, run, _SIDE)).residual / wide.freedom):
        return False
    worse = _broken(fit.x, fit.base, fit.y) > 1.5 * fit.residual + margin * sigma**2
    return worse and _in_two(fit.x, fit.y) > 1.5 * fit.residual


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
    """Distance of readings around the run from the cubic through their neighbours, as far as noise does not explain it.

    The upper quartile: one more spike near by does not hide this one.
    """
    around = 10  # rows before and after a spike that show the activity of the signal
    first = max(run[0] - around, 0)
    window = y[first : run[-1] + around + 1].copy()
    window[run - first] = np.nan
    left = _left(np.flatnonzero(np.isfinite(window)), window, 1)
    beside = (left.rows < run[0] - first - 2) | (left.rows > run[-1] - first + 2)
    bend = (np.abs(left.miss) / left.factor)[beside]
    return max(float(np.percentile(bend, 75)) - 1.5 * sigma, 0.0) if bend.size else math.inf
