"""Open-loop errors of a model with their exact derivatives, and a fit to them by Levenberg-Marquardt's method.

    e(z) = y_{k+h} - g(x_{k+h}(z)),   x_k the state that a filter has at row k

The derivatives go through the simulation, unlike those of `multistep`, which are linear about a smoothed path: a model
of a few equations may be wrong by as much as its signals move, and its parameters move by as much as they are large.
Over the horizons here a start hardly matters: it is filtered once, and again when the parameters have moved.
[Ljung 1999, "System Identification", 2nd ed., chapter 7, for prediction errors; More 1978, "The Levenberg-Marquardt
algorithm", LNM 630]
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..data.dataset import Dataset
from ..em.prior import ParameterPrior
from ..model.base import prepare
from ..model.state_space import StateSpaceModel
from ..numerics.parallel import each
from ..smoother.kalman import TANGENT, ekf
from .multistep import Grid

HORIZONS = (0.5, 1.0)
"""Horizons of the errors, in the pace of the model: four and eight of its slowest time constants, or as declared. Fits
to nearer ones trade parameters for errors of the start: on two tanks without their overflow .12 and .25 more made a
free simulation worse by a tenth."""
APART = 1 / 8
"""Distance of independent errors, in the pace of the model: one slowest time constant."""
HUBER = 3.0
"""Errors of more standard deviations weigh less."""
FALLS = 1e-4
"""Share by which a step must lower the squared error for another one to follow."""
STEPS, PASSES = 30, 3
"""Steps at most from the same starts, and how often these are filtered."""

Errors = Float[np.ndarray, "seq start horizon obs"]


class Simulated(NamedTuple):
    """A model with its open-loop errors."""

    model: StateSpaceModel
    prior: ParameterPrior
    z: Float[np.ndarray, " param"]
    """Parameters in standard deviations of their prior."""
    error: Errors
    """Reading minus prediction; NaN where there is none."""
    columns: Float[np.ndarray, "seq start horizon obs param"]
    """Derivatives of the predictions by z."""
    reach: float
    """Longest horizon [s]."""


def grid(model: StateSpaceModel, data: Dataset) -> Grid:
    """Starts and horizons of the errors: starts so far apart that errors are independent."""
    rows = int(np.max(np.sum(np.asarray(data.valid), axis=1)))
    stride = max(1, round(APART * model.pace / model.dt))
    longest = max(1, rows // 2 // stride)
    return Grid(stride, tuple(stride * min(longest, max(1, round(h / APART))) for h in HORIZONS))


Starts = Float[Array | np.ndarray, "seq start state"]


def filtered(model: StateSpaceModel, data: Dataset) -> Starts:
    """States at all starts by the filter of a model."""
    return each(_filtered, (model, grid(model, data)), jax.device_put(data))


def _filtered(common, seq: Dataset) -> Float[Array, "start state"]:
    model, grid = common
    return ekf(model, model.start, prepare(model, seq), TANGENT).state.mean[grid.starts(seq.t.shape[0])]


def simulated(model: StateSpaceModel, prior: ParameterPrior, data: Dataset, begin: Starts | None = None) -> Simulated:
    """The open-loop errors of a model, and how its estimated parameters move the predictions; from the states `begin`,
    or those that its own filter has.
    """
    begin = filtered(model, data) if begin is None else begin
    return together([model], [prior], data, begin)[0]


GROUPS = (1, 16, 64)
"""Numbers of models whose errors are computed at once, a program for each: a simulation is a long loop, whose steps
take as long for one as for many."""


def together(
    models: Sequence[StateSpaceModel], priors: Sequence[ParameterPrior], data: Dataset, begin: Starts
) -> list[Simulated]:
    """`simulated` of models of one structure."""
    at, count = grid(models[0], data), len(data.t)
    numbers = [eqx.filter((m, p, p.read(m)), eqx.is_array) for m, p in zip(models, priors, strict=True)]
    static = eqx.filter((models[0], priors[0], jnp.zeros(0)), eqx.is_array, inverse=True)
    out = []
    for first in range(0, len(models), GROUPS[-1]):
        some = numbers[first : first + GROUPS[-1]]
        size = next(size for size in GROUPS if size >= len(some))
        stacked = jax.tree.map(_stacked(size, count), *some)
        tiled = jax.tree.map(lambda a, size=size: np.concatenate([np.asarray(a)] * size), (tuple(data), begin))
        error, columns = each(_errors, (static, at), (stacked, Dataset(*tiled[0]), tiled[1]))
        for i, (_, _, z) in enumerate(some):
            part = slice(i * count, (i + 1) * count)
            model, prior = models[first + i], priors[first + i]
            values = np.asarray(error[part]), np.asarray(columns[part])
            out.append(Simulated(model, prior, np.asarray(z), *values, at.ages[-1] * model.dt))
    return out


def _stacked(size: int, count: int) -> Callable[..., np.ndarray]:
    """Arrays of some models as one of `size`, the last repeated, each for `count` sequences."""
    return lambda *each_one: np.repeat(
        np.stack([np.asarray(a) for a in (*each_one, *each_one[-1:] * (size - len(each_one)))]), count, axis=0
    )


def _errors(common, one) -> tuple[Float[Array, "start horizon obs"], Float[Array, "start horizon obs param"]]:
    (static, grid), (numbers, seq, begin) = common, one
    model, prior, z = eqx.combine(numbers, static)
    starts = grid.starts(seq.t.shape[0])

    def predicted(z):
        changed = prior.write(model, z)
        ready = prepare(changed, seq)
        row = lambda k: jax.tree.map(lambda a: a[k], ready.inputs)  # noqa: E731

        def step(x, h):
            x = jax.vmap(changed.transition)(x, row(starts + h))
            return x, jax.vmap(changed.emission)(x, row(starts + h + 1))

        _, read = jax.lax.scan(step, begin, jnp.arange(grid.ages[-1]))
        known = jnp.where(ready.observed, ready.y, jnp.nan)
        out = jnp.stack([read[age - 1] for age in grid.ages], axis=1)
        return out, jnp.stack([known[starts + age] for age in grid.ages], axis=1) - out

    columns, error = jax.jacfwd(predicted, has_aux=True)(z)
    return error, columns


def scale_of(error: Errors) -> Float[np.ndarray, "1 1 horizon obs"]:
    """Root mean square of the errors at every horizon."""
    square = np.ma.masked_invalid(error) ** 2
    return np.sqrt(np.ma.filled(square.mean(axis=(0, 1), keepdims=True), 1.0)) + 1e-12


def cost(error: Errors, scale, counts: Bool[np.ndarray, "seq start #horizon #obs"] | None = None) -> float:
    """Squared errors in scales; linear beyond `HUBER` [Huber 1964]."""
    size = np.where(np.isfinite(error), np.minimum(np.abs(error) / scale, 30.0), 30.0)
    each_one = np.where(size < HUBER, size**2, HUBER * (2 * size - HUBER))
    return float(np.sum(np.where(counts if counts is not None else True, each_one, 0.0)))


def observed(of: Simulated) -> Bool[np.ndarray, "seq start horizon obs"]:
    """Errors that have a reading."""
    return np.isfinite(of.error)


def normal(
    of: Simulated, scale, counts: Bool[np.ndarray, "seq start horizon obs"]
) -> tuple[Float[np.ndarray, " param"], Float[np.ndarray, "param param"]]:
    """Score and information of the parameters by the errors that count, without the prior."""
    keep = counts & np.isfinite(of.error) & np.isfinite(of.columns).all(axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        weight = np.minimum(1.0, HUBER * scale / np.abs(of.error)) / scale**2
    columns, error, weight = of.columns[keep], of.error[keep], weight[keep]
    return columns.T @ (weight * error), (columns * weight[:, None]).T @ columns


def fit(
    model: StateSpaceModel,
    prior: ParameterPrior,
    data: Dataset,
    *,
    scale: Float[np.ndarray, "1 1 horizon obs"] | None = None,
    counts: Bool[np.ndarray, "seq start #horizon #obs"] | None = None,
    steps: int = STEPS,
    begin: Starts | None = None,
) -> Simulated:
    """`model` with the parameters of the smallest open-loop errors under their prior; noise and start stay.

    `counts` are the starts whose errors count; a `scale` of the errors that is not given is that of the first model.
    Without states to `begin` from they are filtered, `PASSES` times.
    """
    if begin is None:
        for _ in range(PASSES):
            begin = filtered(model, data)
            best = fit(model, prior, data, scale=scale, counts=counts, steps=steps, begin=begin)
            model = best.model
        return simulated(model, prior, data)
    return fit_all([model], [prior], data, scale=scale, counts=counts, steps=steps, begin=begin)[0]


def fit_all(
    models: Sequence[StateSpaceModel],
    priors: Sequence[ParameterPrior],
    data: Dataset,
    *,
    begin: Starts,
    scale: Float[np.ndarray, "1 1 horizon obs"] | None = None,
    counts: Bool[np.ndarray, "seq start #horizon #obs"] | None = None,
    steps: int = STEPS,
) -> list[Simulated]:
    """`fit` of models of one structure, side by side."""
    best = together(models, priors, data, begin)
    known = observed(best[0]) & (counts if counts is not None else True)
    scale = scale_of(best[0].error) if scale is None else scale
    loss = lambda one: cost(one.error, scale, known) + float(one.z @ one.z)  # noqa: E731
    values, damping, open_ = [loss(one) for one in best], [1e-2] * len(best), list(range(len(best)))
    for _ in range(steps):
        ahead = []
        for i in open_:
            score, information = normal(best[i], scale, known)
            score, information = score - best[i].z, information + np.eye(len(best[i].z))
            step = np.linalg.solve(information + damping[i] * np.diag(np.diag(information)), score)
            ahead.append(best[i].prior.write(best[i].model, jnp.asarray(best[i].z + step)))
        trials = together(ahead, [priors[i] for i in open_], data, begin) if open_ else []
        for i, trial in zip(list(open_), trials, strict=True):
            after = loss(trial)
            if after < values[i]:
                gain, best[i], values[i] = 1 - after / values[i], trial, after
                damping[i] = max(0.2 * damping[i], 1e-6)
            else:
                gain, damping[i] = math.inf, 8 * damping[i]
            if gain < FALLS or damping[i] > 1e5:
                open_.remove(i)
    return best


def precision(of: Simulated, scale) -> Float[np.ndarray, "param param"]:
    """Posterior precision of the parameters."""
    return normal(of, scale, observed(of))[1] + np.eye(len(of.z))
