"""Multi-step errors of a fitted model about its smoothed paths, and what candidates would change of them.

A smoothed path has absorbed part of a missing force as process noise.  The errors are therefore open-loop errors of the
filter, whose gains take out of the columns what they take out of the errors.
"""

from collections.abc import Iterator
from typing import Any, ClassVar, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from ..data.dataset import whole_step
from ..em import multistep
from ..em.multistep import HORIZONS, JUDGED, SHORT_HORIZONS
from ..numerics.gaussian import Gaussian
from .columns import Blocks, candidate_columns, tracks
from .hypothesis import Hypothesis
from .refit import Refit
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


class MultiStep(eqx.Module):
    """Open-loop errors of the measured coordinates some time ahead, by band of horizons. Where noise is not as
    modelled, missing forces appear here: their effect adds up over many steps, that of bad readings does not. On fast
    machines, whose errors saturate early, they appear at the shorter horizons only.
    """

    measure: ClassVar[str] = "share of the squared multi-step error"
    """Name of the share that the screen computes, as a figure labels it."""
    bands: tuple[tuple[float, ...], ...] = eqx.field(static=True, default=(HORIZONS, SHORT_HORIZONS))
    """Horizons [s] whose errors are screened together, in the order of precedence."""
    judged: tuple[tuple[float, ...], ...] = eqx.field(static=True, default=(JUDGED, SHORT_HORIZONS))
    """Horizons [s] at which a law that a band shows is judged after its refit."""

    def remaining_share(self, fit: SmoothedFit) -> float:
        """Product of what each refit left: a later law must remove the floor of the first error, not of the rest."""
        removed = [evidence.removed for evidence in fit.hypothesis.evidence if evidence is not None]
        return float(np.prod([1 - share for share in removed if np.isfinite(share)]))

    def linearise(self, fit: SmoothedFit, blocks: Blocks) -> Iterator[tuple[Linearised, ...]]:
        """Errors from a start every 50 ms, and derivatives, by band, for one block of candidates at a time."""
        model, path, data = fit.model, fit.path, fit.data
        weights = fit.m_step.weights(model)
        machine = eqx.tree_at(lambda m: m.unknown, fit.declared.model, model.unknown)  # on which candidates act
        every = tuple(sorted(set(sum(self.bands, ()))))
        bands = [[every.index(h) for h in band] for band in self.bands]
        follows = multistep.followed(model, weights.prior, path, data)
        rows = multistep.grid_along(model, data, every).starts(data.t.shape[1])
        track = jax.tree.map(np.asarray, tracks(model, path, follows.linear.seq.inputs))
        error, own = multistep.errors(follows, every), weights.nodes.size + weights.prior.size
        size = whole_step(max(sum(len(one.probes) for one in block) for block in blocks))  # columns of 0 fill them up
        full = whole_step(fit.rows)
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

    def finish(self, fit: SmoothedFit, trial: Refit) -> Refit:
        """A `trial` after Gauss-Newton steps on the multi-step errors, which follow its fit by likelihood."""
        along = multistep.finish(trial.model, trial.m_step, trial.path, fit.data, fit.used)
        return trial._replace(model=along.model, along=along)

    def along(self, fit: SmoothedFit, hypothesis: Hypothesis, path: Gaussian) -> Refit:
        """`hypothesis` as it is, along a path of the sequences of `fit`."""
        model, rule = hypothesis.model, hypothesis.m_step
        errors_from = multistep.followed(model, rule.prior, path, fit.data)
        return Refit(model, rule, path, np.zeros(0), jnp.zeros((0, 0)), errors_from)

    def ratio(self, null: Refit, full: Refit, fit: SmoothedFit, band: int, see: tuple[int, ...] = ()) -> float:
        """Squared error of one fit over that of another, on the sequences that `fit` uses, at a band of horizons.
        Squares are robust, each fit along its own smoothed paths; of the readings `see`, or those that are compared.
        """
        before, after = (multistep.errors(cast(Any, t.along), self.judged[band], see) for t in (null, full))
        return multistep.ratio(before, after, fit.used)


def _flat(a: np.ndarray) -> np.ndarray:
    """Horizons and channels as one axis."""
    return a.reshape(*a.shape[:2], a.shape[2] * a.shape[3], *a.shape[4:])
