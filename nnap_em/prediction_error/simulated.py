"""Open-loop errors of a model with their exact derivatives, and a fit to them by Levenberg-Marquardt's method.

    e(z) = y_{k+h} - g(x_{k+h}(z)),   x_k(z) the state that the filter of the model z has at row k

The derivatives go through filter and simulation, unlike those of `multistep`, which are linear about a smoothed path:
a model of a few equations may be wrong by as much as its signals move, and its parameters move by as much as they are
large. [Ljung 1999, "System Identification", 2nd ed., chapter 7, for prediction errors; More 1978, "The
Levenberg-Marquardt algorithm", LNM 630]
"""

from typing import NamedTuple

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
from .multistep import Grid, grid_of

HORIZONS = (0.5, 1.0)
"""Horizons of the errors, in the pace of the model: four and eight of its slowest time constants, or as declared. Fits
to nearer ones trade parameters for errors of the start: on two tanks without their overflow .12 and .25 more made a
free simulation worse by a tenth."""
HUBER = 3.0
"""Errors of more standard deviations weigh less."""
FALLS = 1e-4
"""Share by which a step must lower the squared error for another one to follow."""
STEPS = 30
"""Steps at most."""

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
    overlap: float
    """Number of errors that count as one: predictions that cover one moment."""
    reach: float
    """Longest horizon [s]."""


def grid(model: StateSpaceModel, data: Dataset) -> Grid:
    """Starts and horizons of the errors."""
    rows = int(np.max(np.sum(np.asarray(data.valid), axis=1)))
    return grid_of(model.dt, rows, HORIZONS, model.pace)


def simulated(model: StateSpaceModel, prior: ParameterPrior, data: Dataset) -> Simulated:
    """The open-loop errors of a model, and how its estimated parameters move the predictions."""
    at, z = grid(model, data), prior.read(model)
    error, columns = each(_errors, (model, prior, at, z), jax.device_put(data))
    overlap = at.ages[-1] / at.stride
    return Simulated(
        model, prior, np.asarray(z), np.asarray(error), np.asarray(columns), overlap, at.ages[-1] * model.dt
    )


def _errors(common, seq: Dataset) -> tuple[Float[Array, "start horizon obs"], Float[Array, "start horizon obs param"]]:
    model, prior, grid, z = common
    starts = grid.starts(seq.t.shape[0])

    def predicted(z):
        changed = prior.write(model, z)
        ready = prepare(changed, seq)
        begin = ekf(changed, changed.start, ready, TANGENT).state.mean[starts]
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


def cost(error: Errors, scale, overlap, counts: Bool[np.ndarray, "seq start #horizon #obs"] | None = None) -> float:
    """Squared errors in scales, each as much as it is independent; linear beyond `HUBER` [Huber 1964]."""
    size = np.where(np.isfinite(error), np.minimum(np.abs(error) / scale, 30.0), 30.0)
    each_one = np.where(size < HUBER, size**2, HUBER * (2 * size - HUBER)) / overlap
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
        weight = np.minimum(1.0, HUBER * scale / np.abs(of.error)) / scale**2 / of.overlap
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
) -> Simulated:
    """`model` with the parameters of the smallest open-loop errors under their prior; noise and start stay.

    `counts` are the starts whose errors count; a `scale` of the errors that is not given is that of the first model.
    """
    best = simulated(model, prior, data)
    known = observed(best) & (counts if counts is not None else True)
    scale = scale_of(best.error) if scale is None else scale
    loss = lambda one: cost(one.error, scale, one.overlap, known) + float(one.z @ one.z)  # noqa: E731
    value, damping = loss(best), 1e-2
    for _ in range(steps):
        score, information = normal(best, scale, known)
        score, information = score - best.z, information + np.eye(len(best.z))
        step = np.linalg.solve(information + damping * np.diag(np.diag(information)), score)
        trial = simulated(prior.write(best.model, jnp.asarray(best.z + step)), prior, data)
        after = loss(trial)
        if after < value:
            gain, best, value, damping = 1 - after / value, trial, after, max(0.2 * damping, 1e-6)
            if gain < FALLS:
                break
        else:
            damping *= 8
            if damping > 1e5:
                break
    return best


def precision(of: Simulated, scale) -> Float[np.ndarray, "param param"]:
    """Posterior precision of the parameters."""
    return normal(of, scale, observed(of))[1] + np.eye(len(of.z))
