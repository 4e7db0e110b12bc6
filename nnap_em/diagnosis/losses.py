"""Losses of a fitted model that are quadratic about its smoothed paths, and what candidates would change of them.

Each loss gives its errors and their derivatives by friction, parameters and candidates in one form, on which the one
screen of `screen.py` works.

A smoothed path has absorbed part of a missing force as process noise.  The errors are therefore innovations and
open-loop errors of the filter, and every derivative passes through the same gains: what the filter takes out of the
errors is taken out of the columns, too.
"""

from abc import abstractmethod
from collections.abc import Iterator
from typing import ClassVar, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..data.dataset import Dataset
from ..effects import flat
from ..em.local import locals_along
from ..em.multistep import (
    HORIZONS,
    JUDGED,
    SHORT_HORIZONS,
    Followed,
    errors,
    finish,
    followed,
    open_loop,
    ratio,
    sensitivities,
    starts,
    weighed,
)
from ..em.quadratic import whitened_sensitivities
from ..model.state_space import StateSpaceModel
from ..numerics.gaussian import Gaussian
from ..numerics.parallel import batches, each
from ..smoother.kalman import CUBATURE, kalman_filter
from .columns import Blocks, columns_by_block, tracks
from .hypothesis import Hypothesis
from .refit import Refit, refit
from .smoothed import SmoothedFit
from .verdict import EQUIVALENT, EQUIVALENT_NATS, MULTI_STEP, ONE_STEP, PRICE, Bars


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


class AbstractLoss(eqx.Module):
    """Errors by which candidates are judged, and the end of a fit to them."""

    bars: ClassVar[Bars]
    bands: eqx.AbstractVar[tuple[tuple[float, ...], ...]]
    """Horizons [s] whose errors are screened together, in the order of precedence."""
    measure: ClassVar[str]
    """Name of the share that the screen computes, as a figure labels it."""
    multi_step: ClassVar[bool] = False
    """True where multi-step errors decide, and not the likelihood."""

    def remaining_share(self, fit: SmoothedFit) -> float:
        """Share of the declared model's squared error that the accepted laws left; 1 where it does not matter."""
        return 1.0

    @abstractmethod
    def linearise(self, fit: SmoothedFit, blocks: Blocks) -> Iterator[tuple[Linearised, ...]]:
        """Errors and derivatives along the smoothed paths of `fit`, by band, for one block of candidates at a time."""

    def finish(self, fit: SmoothedFit, trial: Refit) -> Refit:
        """A `trial` after the steps of this loss, which follow its fit by likelihood."""
        return trial

    @abstractmethod
    def along(self, fit: SmoothedFit, hypothesis: Hypothesis, path: Gaussian) -> Refit:
        """`hypothesis` as it is, along a path of the sequences of `fit`."""

    @abstractmethod
    def ratio(self, null: Refit, full: Refit, fit: SmoothedFit, band: int) -> float:
        """Squared error of one fit over that of another, on the sequences that `fit` uses, at a band of horizons."""

    @abstractmethod
    def lead(self, null: Refit, full: Refit, other: Refit, fit: SmoothedFit) -> float:
        """Distance by which one law explains more than another in its place, both beside a fit without either, over
        that within which they explain the same.
        """


class MultiStep(AbstractLoss):
    """Open-loop errors of the measured coordinates some time ahead, by band of horizons.

    Where noise is not as modelled, missing forces appear here: their effect adds up over many steps, that of bad
    readings does not.  On fast machines, whose errors saturate early, they appear at the shorter horizons only.
    """

    bars: ClassVar[Bars] = MULTI_STEP
    measure: ClassVar[str] = "share of the squared multi-step error"
    multi_step: ClassVar[bool] = True
    bands: tuple[tuple[float, ...], ...] = eqx.field(static=True, default=(HORIZONS, SHORT_HORIZONS))
    judged: tuple[tuple[float, ...], ...] = eqx.field(static=True, default=(JUDGED, SHORT_HORIZONS))
    """Horizons [s] at which a law that a band shows is judged after its refit."""

    def remaining_share(self, fit: SmoothedFit) -> float:
        """Product of what each refit left: a later law must remove the floor of the first error, not of the rest."""
        removed = [evidence.removed for evidence in fit.hypothesis.evidence if evidence is not None]
        return float(np.prod([1 - share for share in removed if np.isfinite(share)]))

    def linearise(self, fit: SmoothedFit, blocks: Blocks) -> Iterator[tuple[Linearised, ...]]:
        """Errors of predictions that begin from the filter every 50 ms, with robust weights."""
        model, path, data = fit.model, fit.path, fit.data
        weights = fit.m_step.weights(model)
        every = tuple(sorted(set(sum(self.bands, ()))))
        bands = [[every.index(h) for h in band] for band in self.bands]
        follows, rows = followed(model, weights.prior, path, data), starts(model, data, every)
        track = jax.tree.map(np.asarray, tracks(model, path, follows.linear.seq.inputs))
        error, own = errors(follows, every), weights.nodes.size + weights.prior.size
        for along in columns_by_block(_machine(fit), blocks):
            extra = lambda s: along(jax.tree.map(lambda a: a[s], track))  # noqa: B023, E731
            predictions = open_loop(follows, weights, extra, every, error)
            weight = weighed(predictions._replace(columns=predictions.columns[..., :own]), fit.used)
            yield tuple(
                Linearised(
                    _flat(error[:, :, band]),
                    _flat(predictions.columns[:, :, band], 1),
                    _flat(weight[:, :, band]),
                    float(np.mean(predictions.overlap[band])),
                    rows,
                )
                for band in bands
            )

    def finish(self, fit: SmoothedFit, trial: Refit) -> Refit:
        """The trial after Gauss-Newton steps on the multi-step errors."""
        along = finish(trial.model, trial.m_step, trial.path, fit.data, fit.used)
        return trial._replace(model=along.model, along=along)

    def along(self, fit: SmoothedFit, hypothesis: Hypothesis, path: Gaussian) -> Refit:
        """Its multi-step errors."""
        model, rule = hypothesis.model, hypothesis.m_step
        errors_from = followed(model, rule.prior, path, fit.data)
        return Refit(model, rule, path, np.zeros(0), jnp.zeros((0, 0)), errors_from)

    def ratio(self, null: Refit, full: Refit, fit: SmoothedFit, band: int) -> float:
        """Ratio of robust squares, each fit along its own smoothed paths."""
        before, after = (errors(cast(Followed, t.along), self.judged[band]) for t in (null, full))
        return ratio(before, after, fit.used)

    def lead(self, null: Refit, full: Refit, other: Refit, fit: SmoothedFit) -> float:
        """Difference of the shares that both remove."""
        own, its = (1 - self.ratio(null, one, fit, 0) for one in (full, other))
        return (its - own) / max((1 - EQUIVALENT) * max(own, its), 1e-12)


class OneStep(AbstractLoss):
    """Whitened innovations: efficient where they are white, as modelled."""

    bars: ClassVar[Bars] = ONE_STEP
    measure: ClassVar[str] = "share of the squared one-step error"
    bands: tuple[tuple[float, ...], ...] = eqx.field(static=True, default=((),))

    def linearise(self, fit: SmoothedFit, blocks: Blocks) -> Iterator[tuple[Linearised, ...]]:
        """Innovations in standard deviations; derivatives by the sensitivity equations of the Kalman filter."""
        model, data = fit.model, fit.data
        weights = fit.m_step.weights(model)
        linear = locals_along(model, weights.prior, fit.path, data, CUBATURE)
        track = tracks(model, fit.path, linear.seq.inputs)
        common, own = (model.log_q, model.log_r, model.start, weights.nodes), weights.nodes.size + weights.prior.size
        known = np.isfinite(np.asarray(data.y)) & np.asarray(data.valid)[..., None]
        for along in columns_by_block(_machine(fit), blocks, fit.rows):
            parts = []
            for _, (local, batch) in batches(len(data.t), linear, track):  # columns of all at once fill the memory
                innovations = each(_innovations, common, (local, batch.middle, along(batch)), together=1)
                parts.append([np.asarray(a, np.float32) for a in innovations])
            error, columns = (np.concatenate(a)[: len(data.t)] for a in zip(*parts, strict=True))
            finite = np.isfinite(error).all(axis=(1, 2)) & np.isfinite(columns[..., :own]).all(axis=(1, 2, 3))
            weight = (known & (finite & fit.used)[:, None, None]).astype(float)
            yield (Linearised(error.astype(float), columns, weight, 1.0, np.arange(data.t.shape[1])),)

    def along(self, fit: SmoothedFit, hypothesis: Hypothesis, path: Gaussian) -> Refit:
        """Its log-likelihood: that of the one pass of a refit."""
        return refit(hypothesis.model, hypothesis.m_step, path, fit.data, fit.used, passes=1)

    def ratio(self, null: Refit, full: Refit, fit: SmoothedFit, band: int) -> float:
        """One minus twice the gain in log-likelihood over the readings, both of sequences that both fits follow."""
        gain = full.loglik - null.loglik
        both = fit.used & np.isfinite(gain)
        return 1.0 - 2.0 * float(np.sum(gain[both])) / max(readings(fit.data, both), 1)

    def lead(self, null: Refit, full: Refit, other: Refit, fit: SmoothedFit) -> float:
        """Difference in log-likelihood, less the price of the numbers of a law."""
        own, its = (sum(flat(effect).size for effect in one.model.effects) for one in (full, other))
        gain = float(np.nansum((other.loglik - full.loglik)[fit.used]))
        return (gain - PRICE * (its - own)) / EQUIVALENT_NATS


def readings(data: Dataset, used) -> int:
    """Number of readings of the sequences `used`."""
    return int(np.sum(np.isfinite(np.asarray(data.y)[used]) & np.asarray(data.valid)[used][..., None]))


def _machine(fit: SmoothedFit) -> StateSpaceModel:
    """The declared machine with the friction of the fit, on which candidates act."""
    return eqx.tree_at(lambda m: m.unknown, fit.declared.model, fit.model.unknown)


def _flat(a: np.ndarray, last: int = 0) -> np.ndarray:
    """Horizons and channels as one axis."""
    return a.reshape(*a.shape[:2], a.shape[2] * a.shape[3], *a.shape[4 : 4 + last])


def _innovations(common, one) -> tuple[Float[Array, "time obs"], Float[Array, "time obs column"]]:
    """Whitened innovations of one sequence and what friction nodes, parameters and candidates take off them."""
    (log_q, log_r, start, nodes), (linear, middle, columns) = common, one
    filtered = kalman_filter(log_q, log_r, start, linear.affine, linear.reading, linear.seq)
    states, read = sensitivities(nodes, linear, middle, columns)
    states = jnp.where(linear.seq.active[:, None, None], states, 0.0)
    return filtered.innovation, whitened_sensitivities(filtered, states, read, linear.seq.observed)
