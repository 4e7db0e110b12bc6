"""Multi-step errors of a fitted model about its smoothed paths, and what candidates would change of them.

A smoothed path has absorbed part of a missing force as process noise.  The errors are therefore open-loop errors of the
filter, whose gains take out of the columns what they take out of the errors.
"""

from collections.abc import Iterator
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from ...estimate.em import multistep
from ...estimate.em.multistep import HORIZONS, JUDGED, SHORT_HORIZONS, Followed
from ...logs.dataset import whole_step
from .columns import Blocks, candidate_columns, tracks
from .smoothed import SmoothedFit


class Linearised(NamedTuple):
    """Errors of a fitted model, and their derivatives; sequence by moment by output."""

    error: Float[np.ndarray, "seq time output"]
    columns: Float[np.ndarray, "seq time output column"]
    """Change that friction nodes, parameters and the probes of all candidates, in this order, take off the error."""
    weight: Float[np.ndarray, "seq time output"]
    """One over the variance of an error; 0 where it does not count."""
    overlap: float
    """Number of errors that count as one."""
    rows: Int[np.ndarray, " time"]
    """Row of the log of every moment."""


MEASURE = "share of the squared multi-step error"
"""Name of the share that a screen computes."""
BANDS = (HORIZONS, SHORT_HORIZONS)
"""Horizons [s] whose errors are screened together, in the order of precedence: fast machines, whose errors saturate
early, show what they lack at the shorter ones only."""
JUDGED_BANDS = (JUDGED, SHORT_HORIZONS)
"""Horizons [s] at which a law that a band shows is judged after its refit."""


def linearise(fit: SmoothedFit, blocks: Blocks) -> Iterator[tuple[Linearised, ...]]:
    """Errors from a start every 50 ms, and derivatives, by band, for one block of candidates at a time."""
    model, path, data = fit.model, fit.path, fit.data
    weights = fit.m_step.weights(model)
    machine = eqx.tree_at(lambda m: m.unknown, fit.declared, model.unknown)  # on which candidates act
    every = tuple(sorted(set(sum(BANDS, ()))))
    bands = [[every.index(h) for h in band] for band in BANDS]
    follows = multistep.followed(model, weights.prior, path, data)
    rows = multistep.grid_along(model, data, every).starts(data.t.shape[1])
    track = jax.tree.map(np.asarray, tracks(model, path, follows.linear.seq.inputs))
    error, own = multistep.errors(follows, every), weights.nodes.size + weights.prior.size
    size = whole_step(max(sum(len(one.probes) for one in block) for block in blocks))  # columns of 0 fill them up
    full = whole_step(data.t.shape[1])
    share = multistep.at_once(model, own + size, full)
    for block in blocks:
        along = candidate_columns(machine, block, size, full)
        extra = lambda s: along(jax.tree.map(lambda a: a[s], track))  # noqa: B023, E731
        predictions = multistep.open_loop(follows, weights, extra, every, error, share=share)
        weight = multistep.weighed(predictions._replace(columns=predictions.columns[..., :own]), fit.used)
        out = []
        for band in bands:
            e, columns, w = (_flat(a[:, :, band]) for a in (error, predictions.columns, weight))
            out.append(Linearised(e, columns, w, float(np.mean(predictions.overlap[band])), rows))
        yield tuple(out)


def ratio(
    null: Followed,
    full: Followed,
    used: Bool[np.ndarray, " seq"],
    band: int,
    see: tuple[int, ...] = (),
    *,
    own: bool = False,
) -> float:
    """Squared error of one fit over that of another, on the sequences `used`, at a band of horizons. Squares are
    robust, at the scale of the first or of the second one's `own`, each fit along its own smoothed paths; of the
    readings `see`, or those that are compared.
    """
    before, after = (multistep.errors(along, JUDGED_BANDS[band], see) for along in (null, full))
    return multistep.ratio(before, after, used, own=own)


def _flat(a: np.ndarray) -> np.ndarray:
    """Horizons and channels as one axis."""
    return a.reshape(*a.shape[:2], a.shape[2] * a.shape[3], *a.shape[4:])
