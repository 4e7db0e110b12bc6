"""Recordings in order of time beside a fit: errors, numbers that drift, and an alarm at a stated rate of false ones."""

import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
import scipy.optimize
import scipy.stats
from jaxtyping import Float

from ..data.dataset import Dataset
from ..diagnosis.keys import key_of, words
from ..diagnosis.losses import Linearised, MultiStep
from ..diagnosis.propose import surroundings
from ..diagnosis.smoothed import SmoothedFit, along
from ..effects import Candidate, flat
from ..effects.change import CoulombChange, NumberChange, ViscousChange
from ..effects.position import TorqueOffset
from ..em.build import build_system, measure_scales, start_prior
from ..em.multistep import HORIZONS, HUBER_STD, Grid, grid_of, huber
from ..em.recorded import errors_of, left_out, level, levels
from ..fit.identify import Identified
from ..numerics.gaussian import Gaussian

SHIFT = 0.5
"""Half of the shift that a chart finds soonest [standard deviations of a recording]; smaller ones take longer."""
LARGEST_STEP = 3.0
"""Largest step of a chart [standard deviations]: one odd recording is no changed machine."""
FALSE = 1e-3
"""False alarms a recording where nothing changes, of all charts together."""
MEMORY = 0.9
"""Weight of what is known of a number after one more recording: a band is that of the last ten or so."""


class Judged(NamedTuple):
    """One recording beside the fit."""

    level: float
    """Log of the root mean square of its multi-step errors, in those of the fit on recordings left out."""
    estimate: Float[np.ndarray, " number"]
    """Change of every number that this recording alone gives."""
    cov: Float[np.ndarray, "number number"]
    """Covariance of that by its noise."""

    @property
    def alone(self) -> Float[np.ndarray, " number"]:
        """Change of every number if no other changes [standard deviations]: one recording determines few together."""
        information = np.linalg.inv(self.cov)
        return information @ self.estimate / np.sqrt(np.diag(information))


class Reference(NamedTuple):
    """The fit along its own recordings: what later ones are compared with."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    scale: Float[np.ndarray, "horizon obs"]
    grid: Grid
    """Horizons and starts of all errors."""
    rows: int
    own: tuple[Judged, ...]


def numbers(fitted: Identified, fit: SmoothedFit) -> list[Candidate]:
    """Numbers that may drift: friction and constant torque of every joint, and what the fit estimates."""
    around = surroundings(fitted.rig, fit.model, fit.data, fit.path, fit.rows, change=True)
    kinds = (CoulombChange, ViscousChange, TorqueOffset, NumberChange)
    return [candidate for kind in kinds for candidate in kind.candidates(around)]


def reference(fitted: Identified, fit: SmoothedFit) -> tuple[Reference, list[Candidate]]:
    """The fit along its own recordings, of which `fit` is the smoothed path."""
    candidates = numbers(fitted, fit)
    system, starts = fitted.model.system, [candidate.start for candidate in candidates]
    out = levels(left_out(fit.model, fit.m_step, fit.path, fit.data, fit.used))
    ((linearised,),) = MultiStep(bands=(HORIZONS,)).linearise(fit, [candidates])
    own = tuple(
        Judged(lv, *_estimate(linearised, i, candidates, out.scale)) for i, lv in enumerate(out.level) if fit.used[i]
    )
    lengths = np.sum(np.asarray(fit.data.valid), axis=1)
    grid = grid_of(fitted.rig.dt, int(np.median(lengths)), HORIZONS, fit.model.pace)
    names = tuple(words(key_of(start)) for start in starts)
    units = tuple(next(iter(start.units_on(system).values())) for start in starts)
    return Reference(names, units, out.scale, grid, int(lengths.max()), own), candidates


def _estimate(linearised: Linearised, i: int, candidates: Sequence[Candidate], scale: Float[np.ndarray, "horizon obs"]):
    """Change of every number by one recording, friction and the rest as the fit has them, and its covariance."""
    keep, sizes = linearised.weight[i] > 0, np.array([_probe(candidate) for candidate in candidates])
    columns = linearised.columns[i][..., -len(candidates) :][keep].astype(float) / sizes[:, 0]
    error, size = linearised.error[i][keep], np.broadcast_to(scale.ravel(), keep.shape)[keep]
    weight = np.minimum(1.0, HUBER_STD * size / np.abs(error).clip(1e-300)) / size**2 / linearised.overlap
    information = columns.T @ (weight[:, None] * columns) + np.diag(sizes[:, 1] ** -2.0)
    cov = np.linalg.inv(information)
    return cov @ (columns.T @ (weight * error)), cov


def _probe(candidate: Candidate) -> tuple[float, float]:
    """Size of the probe of a number, and standard deviation of its prior."""
    start, probe, spread = (float(flat(law)[0]) for law in (candidate.start, candidate.probes[0], candidate.prior_std))
    return probe - start, spread


def judge(fitted: Identified, reference: Reference, candidates: Sequence[Candidate], data: Dataset) -> Judged | str:
    """One recording beside the fit, or the reason why it cannot be judged."""
    grid = grid_of(fitted.rig.dt, int(np.sum(data.valid)), HORIZONS, fitted.model.pace)
    if grid.ages != reference.grid.ages:
        return f"too short to be compared: {3 * reference.grid.ages[-1] * fitted.rig.dt:.3g} s are needed"
    multiple = 64  # recordings are padded to a multiple of so many rows, so that they share their programs
    rows = multiple * math.ceil(max(reference.rows, data.t.shape[1]) / multiple)
    fills = ("edge", 0.0, np.nan, False)
    data = Dataset(*(_longer(np.asarray(part), rows, fill) for part, fill in zip(data, fills, strict=True)))
    fit = along(_starting(fitted, data), data, fitted.smoother)
    if not fit.used.all():  # it runs away: as far off as an error counts
        spread = np.diag([_probe(candidate)[1] ** 2 for candidate in candidates])
        return Judged(0.5 * math.log(float(huber(np.inf, 1.0))), np.zeros(len(candidates)), spread)
    ((linearised,),) = MultiStep(bands=(HORIZONS,)).linearise(fit, [candidates])
    size = level(errors_of(fit.model, fit.m_step, fit.path, data), reference.scale)
    return Judged(float(size[0]), *_estimate(linearised, 0, candidates, reference.scale))


def _starting(fitted: Identified, data: Dataset) -> Identified:
    """The fit with the first state of one recording, whatever others there are."""
    system, model = build_system(fitted.rig), fitted.model
    first, _ = start_prior(fitted.rig, system, data, measure_scales(fitted.rig, system, data))
    own = slice(first.mean.shape[0])  # behind it: memory of laws
    start = Gaussian(model.start.mean.at[own].set(first.mean), model.start.cov.at[own, own].set(first.cov))
    return fitted._replace(state=fitted.state._replace(best=eqx.tree_at(lambda m: m.start, model, start)))


def _longer(part: np.ndarray, rows: int, fill: Any) -> np.ndarray:
    width = [(0, 0), (0, rows - part.shape[1])] + [(0, 0)] * (part.ndim - 2)
    return np.pad(part, width, mode="edge") if fill == "edge" else np.pad(part, width, constant_values=fill)


# --- charts


@functools.cache
def threshold(rate: float, charts: int) -> float:
    """Height of a one-sided chart at which all `charts` together give `rate` false alarms a recording.

    1 / rate = (exp(2 k b) - 2 k b - 1) / (2 k^2),   b = h + 1.166     [Siegmund 1985, Sequential Analysis, ch. 2]
    """
    runs = lambda h: (math.exp(2 * SHIFT * (h + 1.166)) - 2 * SHIFT * (h + 1.166) - 1) / (2 * SHIFT**2)  # noqa: E731
    return scipy.optimize.brentq(lambda h: runs(h) - charts / rate, 0.0, 60.0)  # type: ignore[return-value]


def standardised(own: Float[np.ndarray, " own"], values: Float[np.ndarray, " new"]) -> Float[np.ndarray, " new"]:
    """Values in standard deviations of those before them, exactly normal where nothing changes; NaN has no part.

    z = Phi^-1(F_{n-1}((x - mean) / (s sqrt(1 + 1/n)))) with the mean and s of the n values before, those of the
    fit's own recordings first [Hawkins 1987, The Statistician 36, 427, for self-starting charts].
    """
    before, out = list(own[np.isfinite(own)]), []
    for value in values:
        n = len(before)
        if n < 2 or not np.isfinite(value):
            out.append(np.nan)
            continue
        far = (value - np.mean(before)) / (np.std(before, ddof=1) * math.sqrt(1 + 1 / n) + 1e-300)
        out.append(float(np.clip(scipy.stats.norm.isf(scipy.stats.t.sf(far, n - 1)), -LARGEST_STEP, LARGEST_STEP)))
        before.append(value)
    return np.asarray(out)


def cusum(z: Float[np.ndarray, " new"]) -> Float[np.ndarray, " new"]:
    """One-sided cumulative sum S = max(0, S + z - k) [Page 1954, Biometrika 41, 100]; it stands where z is NaN."""
    total, out = 0.0, []
    for step in z:
        total = max(0.0, total + step - SHIFT) if np.isfinite(step) else total
        out.append(total)
    return np.asarray(out)


class Alarm(NamedTuple):
    """The first chart that passes its threshold."""

    chart: str
    at: int
    """Recording at which it does."""
    since: int
    """First recording after the last at which the chart was 0: the change is estimated to lie before it."""


class Trend(NamedTuple):
    """All recordings together."""

    charts: dict[str, Float[np.ndarray, " recording"]]
    threshold: float
    alarm: Alarm | None
    value: Float[np.ndarray, "recording number"]
    """Every number after each recording, as a change since the fit."""
    std: Float[np.ndarray, "recording number"]


def trend(reference: Reference, judged: Sequence[Judged | None], rate: float = FALSE) -> Trend:
    """Charts of errors and numbers, and the numbers filtered; None is a recording that was not judged."""
    count, none = len(reference.names), np.full(len(reference.names), np.nan)
    own, alone = np.stack([each.estimate for each in reference.own]), np.stack([each.alone for each in reference.own])
    now = np.stack([none if each is None else each.alone for each in judged]).reshape(-1, count)
    size = np.array([np.nan if each is None else each.level for each in judged])
    charts = {"errors": cusum(standardised(np.array([each.level for each in reference.own]), size))}
    for j, name in enumerate(reference.names):
        z = standardised(alone[:, j], now[:, j])
        charts |= {f"{name} up": cusum(z), f"{name} down": cusum(-z)}
    height = threshold(rate, len(charts))
    passed = {name: int(np.argmax(s > height)) for name, s in charts.items() if (s > height).any()}
    alarm = None
    if passed:
        name = min(passed, key=lambda chart: (passed[chart], -charts[chart][passed[chart]]))
        still = np.flatnonzero(charts[name][: passed[name]] == 0)
        alarm = Alarm(name, passed[name], int(still[-1]) + 1 if still.size else 0)
    scatter = np.maximum(np.var(own, axis=0) - np.mean([np.diag(each.cov) for each in reference.own], axis=0), 0.0)
    return Trend(charts, height, alarm, *_filtered(reference, judged, np.diag(scatter)))


def _filtered(reference: Reference, judged: Sequence[Judged | None], scatter: Float[np.ndarray, "number number"]):
    """Kalman filter of the numbers over recordings, from the fit on.

    The covariance is divided by `MEMORY` before each [West & Harrison 1997, "Bayesian Forecasting and Dynamic Models",
    sec. 6.3].
    """
    known = sum(np.linalg.inv(each.cov + scatter) for each in reference.own)
    mean, cov, means, stds = np.zeros(len(scatter)), np.linalg.inv(known), [], []
    for each in judged:
        cov = cov / MEMORY
        if each is not None:
            gain = np.linalg.solve(cov + each.cov + scatter, cov).T
            mean, cov = mean + gain @ (each.estimate - mean), cov - gain @ cov
        means.append(mean)
        stds.append(np.sqrt(np.diag(cov)))
    return np.reshape(means, (-1, len(scatter))), np.reshape(stds, (-1, len(scatter)))
