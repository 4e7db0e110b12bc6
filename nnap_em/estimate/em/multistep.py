"""Multi-step prediction errors, how everything that is estimated would move them, and a fit to them.

Open-loop predictions begin from the filter at regular starts, up to which sensitivities are those of the filter.
"""

import itertools
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ...base.gaussian import Gaussian
from ...base.parallel import each
from ...logs.dataset import Dataset
from ...model.state_space import StateSpaceModel
from ..smoother.kalman import CUBATURE, kalman_filter
from .mstep import ScoringMStep
from .prior import ParameterPrior
from .quadratic import Local, friction_columns, locals_along, reading_columns
from .weights import Weights, friction_prior

HORIZONS = (0.25, 0.5)
"""Horizons [s] at which errors are compared."""
JUDGED = (*HORIZONS, 1.0)
"""Horizons [s] at which a model is judged: what only bends the first half second fails later."""
SHORT_HORIZONS = (0.05, 0.1)
"""Horizons [s] over which even a fast machine remains predictable."""
SPACING = 0.05
"""Time [s] between starts."""
SLOPE_WIDTH = 0.1
"""Spread over which slopes are taken, in rms speeds: as wide as predictions err."""
HUBER_STD = 2.0
"""Errors of more robust standard deviations weigh less."""
FARTHEST = 30.0
"""Errors of more standard deviations count as this many: a simulation that runs away has no size."""


class Columns(NamedTuple):
    """Additions along a path."""

    force: Float[Array | np.ndarray, "*seq column time dof"]
    """Generalised force held over the step [N m]."""
    reading: Float[Array | np.ndarray, "*seq column time obs"]


class Grid(eqx.Module):
    """Rows between starts, and rows from a start to every horizon."""

    stride: int = eqx.field(static=True)
    ages: tuple[int, ...] = eqx.field(static=True)

    def starts(self, rows: int) -> Int[np.ndarray, " start"]:
        """Rows of a sequence of `rows` samples at which a prediction begins."""
        return np.arange(self.stride, rows - self.ages[-1], self.stride)


class OpenLoop(NamedTuple):
    """Errors after every start, at every horizon, and the sensitivity of the predictions."""

    error: Float[np.ndarray, "seq start horizon obs"]
    """Reading minus open-loop prediction [rad, or m]; NaN where there is none."""
    columns: Float[np.ndarray, "seq start horizon obs column"]
    """Derivatives by friction nodes, by parameters, then by the extra columns."""
    overlap: Float[np.ndarray, " horizon"]
    """Number of predictions that cover one moment."""


def channels(model: StateSpaceModel) -> tuple[int, ...]:
    """Places in y of the readings compared: measured coordinates and sensors, or where there are none all."""
    dof = len(model.system.coordinates)
    rates = range(dof, 2 * dof)
    return tuple(i for i, s in enumerate(model.measured) if s not in rates) or tuple(range(len(model.measured)))


class Followed(NamedTuple):
    """A model along smoothed paths, and the filter about them: what its multi-step errors begin from."""

    model: StateSpaceModel
    data: Dataset
    linear: Local
    middle: Float[Array, "seq time state"]
    """States halfway between a path and its next state by the model."""
    state: Float[Array, "seq time state"]
    """Filtered means."""
    gain: Float[Array, "seq time obs state"]


def followed(model: StateSpaceModel, prior: ParameterPrior, path: Gaussian, data: Dataset) -> Followed:
    """`model` along the paths of all sequences."""
    linear = _wide(model, prior, path, data)
    state, gain = each(_filtered, (model.log_q, model.log_r, model.start), linear.filtered_from)
    middle = jax.device_put(0.5 * (np.asarray(path.mean) + np.asarray(linear.ahead)))
    return Followed(model, data, linear, middle, state, gain)


NUMBERS = 1 << 23
"""Numbers of the columns of the sequences that are worked on at once: 67 MB, and what follows from them."""


def at_once(model: StateSpaceModel, columns: int, rows: int) -> int:
    """Sequences of `rows` samples on which a device works at once."""
    return max(1, NUMBERS // max(1, columns * rows * (len(model.system.ports) + len(model.measured))))


def open_loop(
    along: Followed,
    weights: Weights,
    extra: Callable[[Int[np.ndarray, " sequence"]], Columns] | None = None,
    horizons: tuple[float, ...] = HORIZONS,
    error: Float[np.ndarray, "seq start horizon obs"] | None = None,
    *,
    share: int = 0,
) -> OpenLoop:
    """Multi-step errors, or `error` if known, and their derivatives; `extra` gives columns by sequences, of which a
    device works on at most `share` at once.
    """
    (rows, obs), ports = along.data.y.shape[1:], len(along.model.system.ports)
    grid, see, out = grid_along(along.model, along.data, horizons), channels(along.model), []
    none = lambda indices: Columns(*(np.zeros((indices.size, 0, rows, n)) for n in (ports, obs)))  # noqa: E731
    share = share or at_once(along.model, weights.nodes.size + weights.prior.size, rows)
    count, devices = len(along.state), jax.device_count()
    every, size = jax.tree.map(np.asarray, (along.linear, along.gain, along.middle)), min(share * devices, count)
    for first in range(0, count, size):  # the results of all, with many columns, would not fit the memory
        some = np.minimum(np.arange(first, first + size), count - 1)
        part = jax.tree.map(lambda a: a[some], every)  # noqa: B023
        out.append(np.asarray(each(_sensitivities, (weights.nodes, grid), (*part, (extra or none)(some))))[..., see, :])
    columns, overlap = np.concatenate(out)[:count], np.asarray(grid.ages) / grid.stride
    return OpenLoop(errors(along, horizons) if error is None else error, columns, overlap)


def errors(
    along: Followed, horizons: tuple[float, ...] = HORIZONS, see: tuple[int, ...] = ()
) -> Float[np.ndarray, "seq start horizon obs"]:
    """The errors alone [rad, or m], of the readings `see` or those that are compared; NaN where there is none."""
    grid, rows = grid_along(along.model, along.data, horizons), along.state.shape[1]
    ages = np.pad(grid.ages, (0, max(0, len(HORIZONS + SHORT_HORIZONS) - len(grid.ages))), mode="edge")
    numbers = along.model, np.arange(grid.stride, rows, grid.stride), np.asarray(ages)  # one program for all horizons
    batch = along.state, along.linear.seq
    if _single_enough(along):
        numbers, batch = _single((numbers, batch))
    error = np.asarray(each(_errors, numbers, batch), float)
    return error[:, : len(grid.starts(rows)), : len(grid.ages), see or channels(along.model)]


def _single_enough(along: Followed) -> bool:
    """True where 32 bits hold readings to a hundredth of their noise, times to one of a row, coordinates to 1e-4."""
    largest = lambda a, axis: np.nanmax(np.abs(np.asarray(a)), axis=axis, initial=0.0)  # noqa: E731
    fine, spacing = 0.01, 2.0**-24  # some hundred roundings on the way add up to a tenth
    noise, dof = np.exp(0.5 * np.asarray(along.model.log_r)), len(along.model.system.coordinates)
    read = largest(along.data.y, (0, 1)) * spacing < fine * noise
    timed = largest(along.data.t, None) * spacing < fine * along.model.dt
    return bool(np.all(read) and timed and np.all(largest(along.state, (0, 1))[:dof] < 1e3))


def _single(tree: Any) -> Any:
    """A tree with its numbers in 32 bits."""
    return jax.tree.map(lambda a: np.asarray(a, np.float32) if eqx.is_inexact_array(a) else a, tree)


def grid_along(model: StateSpaceModel, data: Dataset, horizons: tuple[float, ...] = HORIZONS) -> Grid:
    """Starts and horizons, in the pace of the model [s], as far as logs are long, for its predictions."""
    dt, rows = model.dt / model.pace, int(np.median(np.sum(np.asarray(data.valid), axis=1)))
    stride = max(1, round(SPACING / dt))
    longest = max(1, rows // 3 // stride)
    return Grid(stride, tuple(stride * min(longest, max(1, round(h / dt / stride))) for h in horizons))


def _wide(model: StateSpaceModel, prior: ParameterPrior, path: Gaussian, data: Dataset) -> Local:
    """The model along its paths, with slopes as wide as predictions err, through the exact transition."""
    dof, states = len(model.system.coordinates), len(model.system.states)
    mean = np.asarray(path.mean)
    rates = np.where(np.asarray(data.valid)[..., None], mean[..., dof:states], np.nan)
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # of sequences that are nowhere known
        width = SLOPE_WIDTH * np.sqrt(np.nanmean(rates**2, axis=(0, 1)))
    spread = np.concatenate([HORIZONS[0] * width, width, np.full(mean.shape[-1] - states, 1e-6)])
    wide = Gaussian(path.mean, jax.device_put(np.broadcast_to(np.diag(spread**2), path.cov.shape)))
    linear = locals_along(model, prior, wide, data, CUBATURE)
    offset = np.asarray(linear.ahead) - np.einsum("stij,stj->sti", linear.affine.matrix, mean)
    none = np.zeros(linear.affine.noise.shape, mean.dtype)
    return linear._replace(affine=linear.affine._replace(offset=offset, noise=none))  # pyrefly: ignore[bad-argument-type]


def _filtered(common, one):
    """Filtered means and gains of one sequence about its path."""
    filtered = kalman_filter(*common, *one)
    return filtered.state.mean, filtered.gain


def _errors(common, one) -> Float[Array, "start horizon obs"]:
    """Open-loop errors of one sequence some rows after every start; of what ends beyond it, no matter what."""
    (model, starts, ages), (state, seq) = common, one
    at = lambda a, k: a[jnp.minimum(k, len(state) - 1)]  # noqa: E731
    row = lambda k: jax.tree.map(lambda a: at(a, k), seq.inputs)  # noqa: E731

    def step(h, carry):
        x, read = carry
        x = jax.vmap(model.transition)(x, row(starts + h))
        seen = jax.vmap(model.emission)(x, row(starts + h + 1))
        return x, jnp.where((ages == h + 1)[:, None, None], seen, read)

    nothing = jnp.zeros((len(ages), len(starts), seq.y.shape[1]), state.dtype)
    _, read = jax.lax.fori_loop(0, ages[-1], step, (state[starts], nothing))
    known = jnp.where(seq.observed, seq.y, jnp.nan)
    return jnp.moveaxis(at(known, starts[None] + ages[:, None]) - read, 0, 1)


def sensitivities(
    nodes: Float[Array, "dof count"], linear: Local, middle: Float[Array, "time motion"], columns: Columns
) -> tuple[Float[Array, "time state column"], Float[Array, "time obs column"]]:
    """Change of next states and of readings of one sequence by friction nodes, parameters and further `columns`."""
    dof = nodes.shape[0]
    torque = jax.vmap(lambda v, b: friction_columns(nodes, v[None], b))(middle[:, dof : 2 * dof], linear.by_force)
    moved = jnp.einsum("tsd,ctd->tsc", linear.by_force, columns.force)
    estimated = reading_columns(nodes, middle[:, None, dof : 2 * dof], linear)
    read = jnp.moveaxis(columns.reading, 0, -1)
    if linear.reading_by_force is not None:
        read = read + jnp.einsum("tod,ctd->toc", linear.reading_by_force, columns.force)
    return jnp.concatenate([torque, linear.by_parameter, moved], axis=-1), jnp.concatenate([estimated, read], axis=-1)


def _sensitivities(common, one) -> Float[Array, "start horizon obs column"]:
    """Change of the predictions of one sequence by every column."""
    (nodes, grid), (linear, gain, middle, columns) = common, one
    single = lambda tree: jax.tree.map(lambda a: a.astype(jnp.float32), tree)  # noqa: E731
    push, read = sensitivities(nodes, linear, middle, columns)
    push = jnp.where(linear.seq.active[:, None, None], push, 0.0)
    matrix, rows, gain, push, read = single((linear.affine.matrix, linear.reading.rows, gain, push, read))

    def absorb(s, slices):
        matrix, rows, gain, push, read = slices
        for i in range(rows.shape[0]):  # one reading at a time, as in the filter
            s = s - gain[i][:, None] * (rows[i] @ s + read[i])[None]
        return matrix @ s + push, s

    _, known = jax.lax.scan(absorb, jnp.zeros_like(push[0]), (matrix, rows, gain, push, read))
    starts = grid.starts(push.shape[0])

    def ahead(one):
        s, start = one
        out = []
        for first, last in itertools.pairwise((0, *grid.ages)):
            step = lambda s, h: (matrix[start + h] @ s + push[start + h], None)  # noqa: E731
            s, _ = jax.lax.scan(step, s, jnp.arange(first, last))
            out.append(rows[start + last] @ s + read[start + last])
        return jnp.stack(out)

    return jax.lax.map(ahead, (known[starts], jnp.asarray(starts)))


def robust_scale(error: Float[np.ndarray, "seq start horizon obs"]) -> Float[np.ndarray, "seq 1 horizon obs"]:
    """Standard deviation of every sequence at every horizon, by medians; 1 where there is no error.

    The geometric mean of its own, by which one with hardly any motion counts as much as any, and that of all, by which
    a few recordings with large errors decide alone.
    """
    if not error.size:
        return np.ones((error.shape[0], 1, *error.shape[2:]))
    size = np.ma.masked_invalid(np.abs(error))
    whole, single = (np.ma.median(size, axis=over, keepdims=True) for over in ((0, 1), 1))
    whole = np.ma.filled(whole, 1 / 1.4826)
    single = np.where(np.ma.getmaskarray(single), whole, np.ma.filled(single, 1.0))
    return 1.4826 * np.sqrt(whole * single) + 1e-12


def huber(error, scale, bend: float = HUBER_STD):
    """Squared error in scales, beyond `bend` of them a straight line [Huber 1964], or as `FARTHEST`."""
    size = np.minimum(np.abs(error) / scale, FARTHEST)
    return np.where(size < bend, size**2, bend * (2 * size - bend))


def ratio(before, after, used: Bool[np.ndarray, " seq"], *, own: bool = False) -> float:
    """Robust squared error of one model over that of another on the same starts, the mean over the horizons; robust at
    the scale of the first, or the second one's `own`.
    """
    before, after = before[used], after[used]
    known, scale = np.isfinite(before), robust_scale(after if own else before)
    if not known.any():
        return 1.0
    after = np.where(np.isfinite(after), after, np.inf)
    first, second = (np.where(known, huber(np.where(known, e, 0.0), scale), 0.0) for e in (before, after))
    first, second = (np.sum(a, axis=(0, 1, 3)) for a in (first, second))
    return float(np.mean(second[first > 0] / first[first > 0])) if (first > 0).any() else 1.0


def weighed(predictions: OpenLoop, used: Bool[np.ndarray, " seq"]) -> Float[np.ndarray, "seq start horizon obs"]:
    """Robust weights: one over the variance of a sequence, horizon and channel, less for outliers, 0 for none."""
    error = np.where(used[:, None, None, None], predictions.error, np.nan)
    scale = robust_scale(error)
    with np.errstate(invalid="ignore", divide="ignore"):
        size = np.minimum(1.0, HUBER_STD * scale / np.abs(error))
    sound = np.isfinite(error) & np.isfinite(predictions.columns).all(axis=-1)
    return np.where(sound, size / scale**2 / predictions.overlap[:, None], 0.0)


class Linear(NamedTuple):
    """Errors, e - J d after a change d of what is estimated, and their weights; all 0 where one does not count."""

    error: Float[np.ndarray, "seq start horizon obs"]
    columns: Float[np.ndarray, "seq start horizon obs column"]
    weight: Float[np.ndarray, "seq start horizon obs"]
    overlap: Float[np.ndarray, " horizon"]
    """Number of errors that count as one."""

    def scores(self) -> Float[np.ndarray, "seq start column"]:
        """J' W e of every start."""
        return np.einsum("skhoc,skho->skc", self.columns, self.weight * self.error)

    def information(self, some: int | slice = slice(None)) -> Float[np.ndarray, "column column"]:
        """J' W J of all sequences, or of some."""
        columns = self.columns[some].reshape(-1, self.columns.shape[-1])
        return (columns * self.weight[some].reshape(-1, 1)).T @ columns

    def left_out(self, prior: Float[np.ndarray, "column column"]) -> Float[np.ndarray, "seq start horizon obs"]:
        """Errors of every sequence after the change that fits the others best, by Cook's formula for deletion.

        e_s + J_s (A - J_s' W J_s)^-1 J_s' W e_s,   A = prior + sum J' W J     [Cook 1977, Technometrics 19(1)]
        """
        whole, scores = prior + self.information(), self.scores().sum(axis=1)
        away = [np.linalg.solve(whole - self.information(s), score) for s, score in enumerate(scores)]
        return self.error + np.einsum("skhoc,sc->skho", self.columns, np.stack(away))


def linear(
    along: Followed,
    weights: Weights,
    used: Bool[np.ndarray, " seq"],
    extra: Callable[[Int[np.ndarray, " sequence"]], Columns] | None = None,
) -> Linear:
    """Errors of the sequences `used` at `HORIZONS` with their robust weights."""
    predictions = open_loop(along, weights, extra)
    keep = (weight := weighed(predictions, used)) > 0
    columns = np.where(keep[..., None], predictions.columns, 0.0).astype(float)
    return Linear(np.where(keep, predictions.error, 0.0), columns, weight, predictions.overlap)


LEAST_FALL = 0.01
"""Share by which a step must lower the error to be taken."""


def finish(
    model: StateSpaceModel,
    m_step: ScoringMStep,
    path: Gaussian,
    data: Dataset,
    used: Bool[np.ndarray, " seq"],
    *,
    shaped: bool = False,
) -> Followed:
    """`model` after up to three Gauss-Newton steps on the multi-step errors of the sequences `used`, each halved until
    it predicts better over all horizons at which a model is judged: friction, `shaped` under the prior of its shape,
    parameters and effects move. [Bohlin 2006, "Practical Grey-box Process Identification", for such fits]
    """
    best = followed(model, m_step.prior, path, data)
    error = errors(best, JUDGED)
    for _ in range(3):
        model, weights = best.model, m_step.weights(best.model)
        one = linear(best, weights, used)
        score, information = one.scores().sum(axis=(0, 1)), one.information()
        start, nodes = weights.read(model), slice(weights.nodes.size)
        if shaped and weights.known is None:
            precision, pull = friction_prior(model, weights)  # parameters have theirs in the fit
            information[nodes, nodes] += precision[nodes, nodes]
            score[nodes] -= pull[nodes]
        goal = _goal(weights, model.unknown, start, jnp.asarray(score), jnp.asarray(information))
        for share in (1.0, 0.5, 0.25):
            trial = followed(weights.write(model, start + share * (goal - start)), m_step.prior, path, data)
            trial_error = errors(trial, JUDGED)
            if ratio(error, trial_error, used) < 1 - LEAST_FALL:
                best, error = trial, trial_error
                break
        else:
            break
    return best


@eqx.filter_jit
def _goal(weights: Weights, unknown, start, score, information):
    return weights.fit(unknown, start, score, information, 30)
