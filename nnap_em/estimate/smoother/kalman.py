"""Extended Kalman filter and Rauch-Tung-Striebel smoother for one sequence.

Measurement noise is diagonal, so readings are absorbed one at a time; a missing one is skipped by its mask.
[Sarkka & Svensson 2023, "Bayesian Filtering and Smoothing", 2nd ed., chapters 7 and 13]
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ...base.gaussian import Gaussian, cholesky, lower, product, spd_solve, symmetric, upper_solve
from ...base.rows import rows
from ...model.base import Prepared
from .posterior import Posterior


class Affine(NamedTuple):
    """x_{k+1} = matrix x_k + offset + noise beyond the process noise, for every step of a sequence."""

    matrix: Float[Array, "*steps state state"]
    offset: Float[Array, "*steps state"]
    noise: Float[Array, "*steps state state"]
    """Covariance of what the affine map leaves out of the transition; 0 for a tangent."""


class Reading(NamedTuple):
    """y_k = rows x_k + offset + noise, for every row of a sequence."""

    rows: Float[Array, "*time obs state"]
    offset: Float[Array, "*time obs"]


class Filtered(NamedTuple):
    """p(x_k | y_{0:k}), its one-step prediction and the innovations, whitened one reading at a time."""

    state: Gaussian
    predicted: Gaussian
    innovation: Float[Array, "*time obs"]
    """Innovation over its standard deviation; 0 where not measured."""
    log_variance: Float[Array, "*time obs"]
    """Log innovation variance; 0 where not measured."""
    gain: Float[Array, "*time obs state"]
    affine: Affine
    reading: Reading
    loglik: Float[Array, ""]


class Smoothed(NamedTuple):
    """p(x_k | all y), with the backward gains cov(x_k, x_{k+1} | y) = gain_k cov_{k+1}."""

    state: Gaussian
    gain: Float[Array, "steps state state"]


class Tangent(eqx.Module):
    """The transition linearised at the mean, by `jax.jacfwd` [paper, eq. 14]."""

    def __call__(self, model, about: Gaussian, u: Any) -> Affine:
        """One step about the mean."""
        matrix, value = _slope(model.transition, about.mean, u)
        return Affine(matrix, value - product(matrix, about.mean), jnp.zeros_like(matrix))


def _slope(function: Callable, x: Float[Array, " state"], u: Any):
    """Jacobian and value at x."""

    def both(x):
        y = function(x, u)
        return y, y

    return jax.jacfwd(both, has_aux=True)(x)


TANGENT = Tangent()


class Cubature(eqx.Module):
    """The transition linearised over a whole Gaussian, by 2 n cubature points: the best affine map in mean square, and
    the covariance that it cannot explain. [Arasaratnam & Haykin 2009; Garcia-Fernandez, Svensson & Sarkka 2017,
    "Iterated posterior linearization smoother"]
    """

    def __call__(self, model, about: Gaussian, u: Any) -> Affine:
        """One step about the whole Gaussian."""
        rows = cholesky(about.cov)
        reach = math.sqrt(len(rows))
        spread = reach * lower(rows).T  # the points are opposite pairs along the columns of the factor
        x = jnp.concatenate([about.mean[None] + spread, about.mean[None] - spread])
        y = jax.vmap(lambda x: model.transition(x, u))(x)
        ahead, behind = jnp.split(y, 2)
        mean = jnp.mean(y, axis=0)
        slope = (ahead - behind).T / (2 * reach)  # matrix @ factor
        matrix = upper_solve(rows, slope.T).T
        bend = ((ahead + behind) / 2 - mean[None]) / reach
        noise = product(bend.T, bend)
        return Affine(matrix, mean - product(matrix, about.mean), noise)


CUBATURE = Cubature()


def linear_reading(model, x: Float[Array, " state"], u: Any) -> Reading:
    """The emission linearised at x."""
    rows, value = _slope(model.emission, x, u)
    return Reading(rows, value - product(rows, x))


def absorbed(state: Gaussian, reading: Reading, r, y, observed, gate: Any = None):
    """`state` after readings, one at a time: y_i = rows_i x + offset_i + noise of variance r_i; whitened innovations,
    their log variances and gains, 0 where nothing is `observed`, gains also beyond a `gate` [standard deviations].
    """
    mean, cov = state
    rows = reading.rows
    whitened, log_variance, gains = [], [], []
    for i in range(y.shape[0]):
        pc = product(cov, rows[i])
        s = jnp.sum(rows[i] * pc) + r[i]
        e = y[i] - reading.offset[i] - jnp.sum(rows[i] * mean)
        inside = observed[i] if gate is None else observed[i] & (e * e <= gate * gate * s)
        gain = jnp.where(inside, pc / s, 0.0)
        mean = mean + gain * e
        cov = cov - gain[:, None] * pc[None, :]
        whitened.append(jnp.where(observed[i], e / jnp.sqrt(s), 0.0))
        log_variance.append(jnp.where(observed[i], jnp.log(s), 0.0))
        gains.append(gain)
    return Gaussian(mean, symmetric(cov)), jnp.stack(whitened), jnp.stack(log_variance), jnp.stack(gains)


def moved(state: Gaussian, affine: Affine, q: Float[Array, "state state"], active) -> tuple[Affine, Gaussian]:
    """The step that is made, none where it is not `active`, and the prediction of the next row."""
    stay = jnp.eye(state.mean.shape[0], dtype=state.mean.dtype)
    identity = Affine(stay, jnp.zeros_like(state.mean), jnp.zeros_like(stay))
    affine = jax.tree.map(lambda a, b: jnp.where(active, a, b), affine, identity)
    following = Gaussian(
        product(affine.matrix, state.mean) + affine.offset,
        symmetric(product(product(affine.matrix, state.cov), affine.matrix.T))
        + affine.noise
        + jnp.where(active, q, 0.0),
    )
    return affine, following


def _filter(log_q, log_r, start: Gaussian, seq: Prepared, arguments, affine_at, reading_at) -> Filtered:
    """Kalman recursion: `affine_at(state, arguments)` gives the transition that follows a filtered state,
    `reading_at(mean, arguments)` the emission at a predicted mean; `arguments` are those of its row.
    """
    q, r = jnp.diag(jnp.exp(log_q)), jnp.exp(log_r)

    def step(predicted, slices):
        y, observed, active, arguments = slices
        reading = reading_at(predicted.mean, arguments)
        state, whitened, log_variance, gain = absorbed(predicted, reading, r, y, observed)
        affine, following = moved(state, affine_at(state, arguments), q, active)
        return following, (state, predicted, whitened, log_variance, gain, affine, reading)

    _, out = jax.lax.scan(step, start, (seq.y, seq.observed, seq.active, arguments))
    _, _, whitened, log_variance, *_ = out
    count = jnp.sum(seq.observed).astype(whitened.dtype)
    return Filtered(*out, -0.5 * (jnp.sum(whitened**2 + log_variance) + count * math.log(2 * math.pi)))


def ekf(model, start: Gaussian, seq: Prepared, linearise: Callable = TANGENT) -> Filtered:
    """Extended Kalman filter: linearised about its own filtered states; the last affine map leads out of the data."""
    affine_at, reading_at = partial(linearise, model), partial(linear_reading, model)
    return _filter(model.log_q, model.log_r, start, seq, seq.inputs, affine_at, reading_at)


def kalman_filter(
    log_q: Float[Array, " state"],
    log_r: Float[Array, " obs"],
    start: Gaussian,
    affine: Affine,
    reading: Reading,
    seq: Prepared,
) -> Filtered:
    """Kalman filter of the time-varying affine model, as linearised about a path beforehand."""
    return _filter(log_q, log_r, start, seq, (affine, reading), lambda state, both: both[0], lambda mean, both: both[1])


def linearised(model, about: Gaussian, seq: Prepared, linearise: Callable) -> tuple[Affine, Reading]:
    """All steps and emissions of `model`, linearised about a path."""
    reading = jax.vmap(partial(linear_reading, model))(about.mean, seq.inputs)
    return rows(partial(linearise, model), about, seq.inputs), reading


def relinearised(model, about: Gaussian, seq: Prepared, linearise: Callable) -> Filtered:
    """Filter of `model` with all steps linearised about a path at once [Bell 1994]."""
    affine, reading = linearised(model, about, seq, linearise)
    return kalman_filter(model.log_q, model.log_r, model.start, affine, reading, seq)


def rts(filtered: Filtered) -> Smoothed:
    """Rauch-Tung-Striebel smoother behind either filter."""

    def step(later: Gaussian, slices):
        state, predicted, gain = slices
        mean = state.mean + product(gain, later.mean - predicted.mean)
        cov = symmetric(state.cov + product(product(gain, later.cov - predicted.cov), gain.T))
        return Gaussian(mean, cov), Gaussian(mean, cov)

    last = jax.tree.map(lambda a: a[-1], filtered.state)
    earlier = jax.tree.map(lambda a: a[:-1], filtered.state)
    predicted = jax.tree.map(lambda a: a[1:], filtered.predicted)
    crossed = jax.vmap(product)(filtered.affine.matrix[:-1], earlier.cov)
    gain = jnp.swapaxes(jax.vmap(spd_solve)(predicted.cov, crossed), 1, 2)  # all times at once
    _, states = jax.lax.scan(step, last, (earlier, predicted, gain), reverse=True)
    mean, cov = jax.tree.map(lambda a, b: jnp.concatenate([a, b[None]]), states, last)
    return Smoothed(Gaussian(mean, cov), gain)


def linear_posterior(filtered: Filtered, smoothed: Smoothed, width: Float[Array, ""] | None = None) -> Posterior:
    """The posterior of a model that was linearised about a path."""
    mean, cov = smoothed.state
    affine = jax.tree.map(lambda a: a[:-1], filtered.affine)
    prev, following, kick = jax.vmap(_pair_nodes)(mean[:-1], cov[:-1], smoothed.gain, mean[1:], cov[1:], affine)
    endless = jnp.full_like(filtered.loglik, jnp.inf)
    return Posterior(smoothed.state, prev, following, kick, affine.noise, filtered.loglik, endless, width)


def _pair_nodes(mean, cov, gain, mean_next, cov_next, affine: Affine) -> list[Float[Array, "node state"]]:
    """Cubature nodes of the Gaussian p(x_k, x_{k+1} | y) and their kicks.

    x_{k+1} = m_{k+1} + L z, x_k = m_k + G L z + C w with L L' the covariance of x_{k+1}, C C' that of x_k beyond it.
    The 2 n points of (z, w) lie on its axes in opposite pairs, so that nodes are columns of these factors.
    """
    n = mean.shape[0]
    reach = math.sqrt(2 * n)
    left = cov - product(product(gain, cov_next), gain.T)
    later = reach * lower(cholesky(cov_next)).T
    alone = reach * lower(cholesky(left + 1e-14 * jnp.eye(n, dtype=mean.dtype))).T
    before = jnp.concatenate([product(later, gain.T), alone])
    after = jnp.concatenate([later, jnp.zeros_like(alone)])
    kick = mean_next - product(affine.matrix, mean) - affine.offset
    centres_and_axes = (mean, before), (mean_next, after), (kick, after - product(before, affine.matrix.T))
    return [jnp.concatenate([at[None] + axes, at[None] - axes]) for at, axes in centres_and_axes]
