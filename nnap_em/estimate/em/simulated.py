"""Errors of free simulations with their exact derivatives, and a fit to them by Levenberg-Marquardt's method.

    e(z, s) = y_{k+h} - g(x_{k+h}(z, s)),   x_k = m_k + W s the start of a window

with derivatives through the simulation, not about a smoothed path: a model of a few equations may be wrong by as much
as its signals move. [Ljung 1999, "System Identification", 2nd ed., chapter 7; More 1978, LNM 630; Bock 1983]
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from ...base.deadline import in_time
from ...base.parallel import each
from ...logs.dataset import Dataset
from ...model.base import prepare
from ...model.state_space import StateSpaceModel
from ..smoother.kalman import TANGENT, ekf
from .multistep import FARTHEST, huber
from .prior import ParameterPrior

HUBER = 3.0
"""Errors of more standard deviations weigh less: of Gaussian ones three in a thousand."""


class Windows(eqx.Module):
    """Windows of `rows` rows each, and those in a window whose errors count."""

    count: int = eqx.field(static=True)
    rows: int = eqx.field(static=True)
    every: int = eqx.field(static=True)
    settles: int = eqx.field(static=True)
    """Rows after which a start has no effect any more."""

    @property
    def row(self) -> np.ndarray:
        """Rows of a sequence by window and place."""
        return self.rows * np.arange(self.count)[:, None] + np.arange(0, self.rows, self.every)[None]


def windows(model: StateSpaceModel, data: Dataset) -> Windows:
    """Windows of the errors of a model: each sequence in equal parts."""
    rows, pace = int(np.max(np.sum(np.asarray(data.valid), axis=1))), model.pace / model.dt
    count = max(1, round(rows / (2.0 * pace)))  # simulations of two paces: a reading is one from its start on average
    # 128 errors in a pace at most, sixteen in a slowest time constant; of an error of a start, half a pace later, after
    # four slowest time constants, 2 % are left
    return Windows(count, rows // count, max(1, round(pace / 128)), round(0.5 * pace))


Errors = Float[np.ndarray, "seq window place obs"]
Counts = Bool[np.ndarray, "seq window #place #obs"]
Scale = Float[np.ndarray, "1 1 1 obs"]


class Starts(NamedTuple):
    """Prior of the states at the starts of all windows."""

    mean: Float[np.ndarray, "seq window state"]
    width: Float[np.ndarray, " state"]
    """Standard deviation: as large as the states of the filter."""


class Simulated(NamedTuple):
    """A model with the errors of its simulations."""

    model: StateSpaceModel
    prior: ParameterPrior
    z: Float[np.ndarray, " param"]
    start: Float[np.ndarray, "seq window state"]
    """Parameters and starts in standard deviations of their priors."""
    error: Errors
    """Reading minus prediction; NaN where there is none."""
    columns: Float[np.ndarray, "seq window place obs param"]
    by_start: Float[np.ndarray, "seq window place obs state"]
    """Derivatives of the predictions by z and by the start."""

    @property
    def observed(self) -> Counts:
        """Errors that have a reading."""
        return np.isfinite(self.error)


def filtered(model: StateSpaceModel, data: Dataset) -> Starts:
    """Starts of all windows by the filter of a model."""
    path = np.asarray(each(filter_path, model, jax.device_put(data))[0])
    width = np.sqrt(np.mean(path[np.asarray(data.valid)] ** 2, axis=0))
    return Starts(path[:, windows(model, data).row[:, 0]], width + 1e-9)


def filter_path(model: StateSpaceModel, seq: Dataset):
    """States that the filter of a model has along a sequence, its Jacobians of the next state and of the reading."""
    out = ekf(model, model.start, prepare(model, seq), TANGENT)
    return out.state.mean, out.affine.matrix, out.reading.rows


def simulated(model: StateSpaceModel, prior: ParameterPrior, data: Dataset, begin: Starts | None = None) -> Simulated:
    """The errors of a model, and how its estimated parameters move the predictions; from the states `begin`, or those
    that its own filter has.
    """
    begin = filtered(model, data) if begin is None else begin
    still = np.zeros_like(begin.mean)
    return SideBySide([model], [prior], data, begin).at([0], [np.asarray(prior.read(model))], [still])[0]


class SideBySide:
    """Models of one structure, from states about `begin`: what a step of a fit changes is their parameters alone."""

    def __init__(
        self, models: Sequence[StateSpaceModel], priors: Sequence[ParameterPrior], data: Dataset, begin: Starts
    ):
        """Stacks the numbers of the models, which takes longer than to simulate some."""
        every = [*zip(models, priors, strict=True)]
        numbers = (jax.tree.map(np.asarray, eqx.filter(one, eqx.is_array)) for one in every)
        self.every, self.data, self.begin, self.windows = every, data, begin, windows(models[0], data)
        self.static = eqx.filter(every[0], eqx.is_array, inverse=True)
        self.numbers = jax.tree.map(lambda *a: np.stack(a), *numbers)

    def at(self, places: Sequence[int], z: Sequence[np.ndarray], starts: Sequence[np.ndarray]) -> list[Simulated]:
        """`simulated` of the models at some places, with the parameters `z` and the starts of each."""
        out, count, most = [], len(self.data.t), 64  # models at once, so that their derivatives are not held twice
        common = self.static, self.windows, self.begin.width
        for first in range(0, len(places), most):
            some, by, begun = places[first : first + most], z[first : first + most], starts[first : first + most]
            copies, log = np.repeat(some, count), np.tile(np.arange(count), len(some))
            numbers = jax.tree.map(lambda a, copies=copies: a[copies], self.numbers)
            logs, mean = jax.tree.map(lambda a, log=log: np.asarray(a)[log], (self.data, self.begin.mean))
            batch = numbers, np.repeat(np.stack(by), count, axis=0), logs, mean, np.concatenate(begun)
            every = [np.asarray(a) for a in each(_errors, common, batch, group=16)]  # of more a step takes as long
            for i, place in enumerate(some):
                of = (a[i * count : (i + 1) * count] for a in every)
                out.append(Simulated(*self.every[place], by[i], begun[i], *of))
        return out


def _errors(common, one):
    (static, at, width), (numbers, z, seq, begin, start) = common, one
    model, prior = eqx.combine(numbers, static)
    first = at.row[:, 0]

    def predicted(both):
        moved, shift = both[: len(z)], both[len(z) :]
        changed = prior.write(model, moved)
        ready = prepare(changed, seq)
        row = lambda k: jax.tree.map(lambda a: a[k], ready.inputs)  # noqa: E731

        def step(x, h):
            inputs = row(first + h)
            return jax.vmap(changed.transition)(x, inputs), jax.vmap(changed.emission)(x, inputs)

        _, read = jax.lax.scan(step, begin + (start + shift[None]) * width[None], jnp.arange(at.rows))
        known = jnp.where(ready.observed, ready.y, jnp.nan)
        out = jnp.moveaxis(read[:: at.every], 0, 1)
        return out, known[at.row] - out

    slopes, error = jax.jacfwd(predicted, has_aux=True)(jnp.concatenate([z, jnp.zeros_like(start[0])]))
    return error, slopes[..., : len(z)], slopes[..., len(z) :]


def scale_of(of: Simulated) -> Scale:
    """Root mean square of the errors of every reading."""
    square = np.ma.masked_invalid(of.error) ** 2
    return np.sqrt(np.ma.filled(square.mean(axis=(0, 1, 2), keepdims=True), 1.0)) + 1e-12


def independent(of: Simulated) -> float:
    """Number of independent errors: n / (1 + 2 sum_k rho_k), rho_k the correlation of errors k places apart, as long as
    the sum of two neighbours is above zero [Geyer 1992, Statistical Science 7(4), 473].
    """
    unit, total = np.ma.masked_invalid(of.error) / scale_of(of), 1.0
    places = unit.shape[2]
    lagged = [np.ma.filled((unit[:, :, k:] * unit[:, :, : places - k]).mean(), 0.0) for k in range(places // 2 + 1)]
    for odd, even in zip(lagged[1::2], lagged[2::2], strict=False):
        if odd + even <= 0:
            break
        total += 2 * float(odd + even)
    return float(of.observed.sum()) / total


def costs(error: Errors, scale: Scale, counts: Counts) -> Errors:
    """Squared errors in scales; linear beyond `HUBER`, those that are no number as `FARTHEST`; 0 that do not count."""
    return np.where(counts, huber(np.where(np.isfinite(error), error, np.inf), scale, HUBER), 0.0)


def cost(error: Errors, scale: Scale, counts: Counts) -> float:
    """Sum of `costs`."""
    return float(np.sum(costs(error, scale, counts)))


def log_posterior(of: Simulated, scale: Scale, counts: Counts) -> float:
    """Log of the posterior density of a model, of unknown variance of its errors, less a constant [nat].

    -n/2 log(sum e^2 / n) - (z' z + s' s) / 2
    """
    number = max(float(np.sum(counts)), 1.0)
    prior = float(of.z @ of.z) + float(np.sum(of.start**2))
    return -0.5 * number * math.log(cost(of.error, scale, counts) / number + 1e-12) - 0.5 * prior


def _solve(a: Float[np.ndarray, "*n s s"], b: Float[np.ndarray, "*n s k"], damping: float = 0.0) -> np.ndarray:
    """Solution of a x = b of positive definite matrices, in units of their diagonals: rounding makes none singular."""
    unit = 1 / np.sqrt(np.maximum(np.einsum("...ii->...i", a), 1e-300))
    scaled = a * unit[..., :, None] * unit[..., None, :] + (damping + 1e-12) * np.eye(a.shape[-1])
    return unit[..., None] * np.linalg.solve(scaled, unit[..., None] * b)


def _eliminated(of: Simulated, scale: Scale, counts: Counts, *, damping: float = 0.0, worth: float = 1.0):
    """Damped normal equations of the parameters, the score and then their precision, with the starts of all windows
    eliminated; and these, with no parameter moved and by each. Errors that count are `worth` so many independent ones.
    """
    columns, size = np.concatenate([of.columns, of.by_start], axis=-1), len(of.z)
    keep = counts & np.isfinite(columns).all(axis=-1)
    keep = keep & (np.abs(of.error) < FARTHEST * scale)  # no NaN is; what runs away costs the same wherever it is
    variance = max(cost(of.error, scale, counts) / max(float(np.sum(counts)), 1.0), 1e-12)
    with np.errstate(invalid="ignore", divide="ignore"):
        weight = worth * np.minimum(1.0, HUBER * scale / np.abs(of.error)) / (variance * scale**2)
    every = np.concatenate([of.error[..., None], columns], axis=-1)
    every, weight = np.where(keep[..., None], every, 0.0), np.where(keep, weight, 0.0)
    every, weight = (a.reshape(-1, a.shape[2] * a.shape[3], *a.shape[4:]) for a in (every, weight[..., None]))
    sums = np.swapaxes(every[..., 1:] * weight, 1, 2) @ every  # of every window, the score first
    own, by_start = sums[:, :size, : size + 1].sum(axis=0), sums[:, size:, : size + 1]
    own += np.concatenate([-of.z[:, None], np.eye(size)], axis=1)
    own[:, 1:] *= 1 + damping * np.eye(size)
    rest = by_start - np.pad(of.start.reshape(*by_start.shape[:2], 1), ((0, 0), (0, 0), (0, size)))
    starts = _solve(sums[:, size:, size + 1 :] + np.eye(by_start.shape[1]), rest, damping)
    return own - np.einsum("wsp,wsq->pq", by_start[..., 1:], starts), starts


def _step(of: Simulated, scale: Scale, counts: Counts, damping: float) -> tuple[np.ndarray, np.ndarray]:
    """Damped Gauss-Newton step of parameters and starts."""
    normal, starts = _eliminated(of, scale, counts, damping=damping)
    step = _solve(normal[:, 1:], normal[:, :1])[:, 0]
    return step, starts[..., 0] - starts[..., 1:] @ step


def fit(
    model: StateSpaceModel,
    prior: ParameterPrior,
    data: Dataset,
    *,
    scale: Scale | None = None,
    begin: Starts | None = None,
) -> Simulated:
    """`fit_all` of one model, from the starts of its filter and in the scale of its first errors if none are given."""
    begin = filtered(model, data) if begin is None else begin
    scale = scale_of(simulated(model, prior, data, begin)) if scale is None else scale
    return fit_all([model], [prior], data, begin=begin, scale=scale)[0]


def fit_all(
    models: Sequence[StateSpaceModel],
    priors: Sequence[ParameterPrior],
    data: Dataset,
    *,
    begin: Starts,
    scale: Scale,
    counts: Counts | None = None,
    steps: int = 40,
) -> list[Simulated]:
    """Models of one structure with the parameters of the largest `log_posterior`, side by side; their noise stays.

    `counts` are the errors that count.  Raises TimeUp where a deadline (`base/deadline.py`) is over first.
    """
    in_time()
    simulations, open_ = SideBySide(models, priors, data, begin), [*range(len(models))]
    z = [np.asarray(prior.read(model)) for model, prior in zip(models, priors, strict=True)]
    best = simulations.at(open_, z, [np.zeros_like(begin.mean)] * len(models))
    known = best[0].observed & (True if counts is None else counts)
    values = [log_posterior(one, scale, known) for one in best]
    damping = [1e-2] * len(best)
    falls = 0.1  # gain in the log of the posterior [nat] below which a fit ends: laws are told apart by five
    for _ in range(steps):
        in_time()
        if not open_:
            break
        steps_of = [_step(best[i], scale, known, damping[i]) for i in open_]
        moved = [
            (best[i].z + step, best[i].start + start.reshape(best[i].start.shape))
            for i, (step, start) in zip(open_, steps_of, strict=True)
        ]
        trials = simulations.at(open_, *zip(*moved, strict=True))
        for i, trial in zip(list(open_), trials, strict=True):
            after = log_posterior(trial, scale, known)
            if after > values[i]:
                gain, best[i], values[i] = after - values[i], trial, after
                damping[i] = max(0.4 * damping[i], 1e-6)
            else:
                gain, damping[i] = math.inf, 4 * damping[i]
            if (gain < falls and damping[i] < 1.0) or damping[i] > 1e6:  # a damped step is short, whatever it gains
                open_.remove(i)
    return [one._replace(model=one.prior.write(one.model, jnp.asarray(one.z))) for one in best]


def precision(of: Simulated) -> Float[np.ndarray, "param param"]:
    """Posterior precision of the parameters, by as many errors as are independent."""
    known = of.observed
    worth = independent(of) / max(float(known.sum()), 1.0)
    return _eliminated(of, scale_of(of), known, worth=worth)[0][:, 1:]
