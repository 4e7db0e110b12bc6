"""Motions of the machine, drawn from the posterior of its fit."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from ...base.parallel import each
from ...estimate.predict import Paths
from ...logs.dataset import Dataset
from .limits import Limits


class Motions(NamedTuple):
    """Motions under some inputs, by models drawn from the posterior."""

    lowest: Float[Array, "*proposal path readable"]
    """Lowest value of every coordinate and rate over the whole motion."""
    highest: Float[Array, "*proposal path readable"]
    x: Float[Array, "*proposal recorded time state"]
    """The first motions themselves."""


def motions(
    paths: Paths,
    limits: Limits,
    t: Float[np.ndarray, " time"],
    u: Float[np.ndarray, "proposal time input"],
    start: Float[np.ndarray, "proposal readable"],
    recorded: int,
    *,
    key: PRNGKeyArray,
) -> Motions:
    """Every proposal by every model; the same noise for all proposals, so that they can be compared."""
    angle = np.asarray(paths.model.system.angles)
    reach = (limits.highest - limits.lowest)[: angle.size]
    # Standard deviation of a start that is set by hand, over the range that the coordinate may have, or over a turn
    spread = 0.01 * np.where(angle, np.minimum(reach, 2 * np.pi), reach)
    common = paths, jnp.asarray(np.concatenate([spread, np.zeros_like(spread)])), jnp.zeros(recorded)
    keys = jax.random.split(key, 1)[np.zeros(len(u), int)]
    return each(_motions, common, (blank(t, u, len(paths.model.measured)), jnp.asarray(start), keys))


def blank(t: Float[np.ndarray, " time"], u: Float[np.ndarray, "proposal time input"], obs: int) -> Dataset:
    """Sequences that nobody has read yet."""
    shape = u.shape[:2]
    times = jnp.broadcast_to(jnp.asarray(t), shape)
    return Dataset(times, jnp.asarray(u), jnp.zeros((*shape, obs)), jnp.ones(shape, bool))


def _motions(common: tuple[Paths, Float[Array, " readable"], Float[Array, " recorded"]], one) -> Motions:
    """Motions of a proposal; `common` has the spread of the first state, and an entry for each motion to be kept."""
    (paths, spread, recorded), (seq, start, key) = common, one
    model, count = paths.model, paths.tables.shape[0]
    key_start, key_kick = jax.random.split(key)
    free = spread.shape[0]
    first = jnp.concatenate([start, model.start.mean[free:]])  # effects begin at rest
    x0 = jnp.tile(first, (count, 1)).at[:, :free].add(spread[None] * jax.random.normal(key_start, (count, free)))
    kick = jax.random.normal(key_kick, (seq.t.shape[0], *x0.shape)) * jnp.exp(0.5 * model.log_q)[None, None]

    def step(carry, slices):
        (x, low, high), (u, kick) = carry, slices
        low, high = jnp.minimum(low, x[:, :free]), jnp.maximum(high, x[:, :free])
        following, _ = paths.advance(x, u)
        return (following + kick, low, high), x[: recorded.shape[0]]

    begin = x0, x0[:, :free], x0[:, :free]
    (_, low, high), x = jax.lax.scan(step, begin, (paths.inputs(seq), kick))
    return Motions(low, high, jnp.swapaxes(x, 0, 1))


def allowed(trials: Motions, limits: Limits) -> Bool[np.ndarray, " proposal"]:
    """True where all motions stay inside the limits, and their excursions far enough for those that were not drawn."""
    low, high = np.asarray(trials.lowest), np.asarray(trials.highest)
    # Standard deviations by which the largest excursion of a motion stays inside a limit: 1 in 4000 if it is normal
    safe = 3.5
    with np.errstate(invalid="ignore", over="ignore"):
        inside = (low >= limits.lowest).all(axis=(1, 2)) & (high <= limits.highest).all(axis=(1, 2))
        below = (low.mean(axis=1) - safe * low.std(axis=1) >= limits.lowest).all(axis=1)
        above = (high.mean(axis=1) + safe * high.std(axis=1) <= limits.highest).all(axis=1)
    return inside & below & above
