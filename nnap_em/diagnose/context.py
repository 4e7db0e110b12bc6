"""Constants of a search, and its two long steps: smooth a hypothesis, and extend its fit to the whole length."""

import math
from typing import NamedTuple, TypeVar, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from ..data.dataset import Dataset, horizon
from ..em.loop import SCHEDULE, EMState, FitError, Schedule, e_step, fit, later_state, start_state
from ..em.mstep import kept
from ..fit.identify import Identified, begin
from ..model.state_space import StateSpaceModel
from ..numerics.digits import counted
from ..prediction_error.multistep import JUDGED, errors, followed, ratio
from ..storage.log import Log
from .hypothesis import Hypothesis
from .losses import AbstractLoss
from .smoothed import SmoothedFit

_Tree = TypeVar("_Tree")

Stages = dict[int, tuple[EMState, Bool[np.ndarray, " seq"]]]
"""State of a fit at the end of each of its horizons, and the sequences used."""

SHORT = 150
"""Rows to which short horizons are cut, so that they share their programs."""
LOOSER = 3.0
"""Increase of the log of the process noise where sequences diverge: a looser filter follows them."""


class Effort(NamedTuple):
    """Limits of a search."""

    shortlist: int = 8
    """Candidates that are refitted at most."""
    passes: int = 8
    """Passes of a refit."""
    most: int = 4
    """Effects at most."""
    large_kick: float = 5.0
    """Kick [its standard deviations] from which on a sequence counts as diverged."""
    later: tuple[int, ...] = (8, 3, 1)
    """Rows after that which still count; the fewer where the many are too much."""


EFFORT = Effort()


class SearchContext(NamedTuple):
    """Constants of a search."""

    before: Identified
    stages: Stages
    data: Dataset
    loss: AbstractLoss
    effort: Effort
    log: Log
    pieces: tuple[int, ...] = ()
    """Recording that every sequence is a piece of; empty: each is a recording."""
    until: float = math.inf
    """Moment of `time.monotonic()` after which no new round or refit begins."""

    @property
    def longest(self) -> int:
        """Rows of the longest sequence."""
        return int(np.max(np.sum(np.asarray(self.data.valid), axis=1)))

    @property
    def declared(self) -> Hypothesis:
        """The declared model."""
        return Hypothesis(self.before.model, self.before.m_step, (None,) * len(self.before.model.effects))


def _cut(tree: _Tree, length: int) -> _Tree:
    """All of it, over no more rows than a short horizon needs."""
    return jax.tree.map(lambda a: np.asarray(a)[:, :SHORT], tree) if length <= SHORT else tree  # a view, no program


def smooth(context: SearchContext, hypothesis: Hypothesis, length: int) -> tuple[SmoothedFit, Bool[np.ndarray, " seq"]]:
    """`hypothesis` along its smoothed paths over `length` rows, and the sequences that are followed whole.

    A diverged sequence is most informative around its divergence: it is used up to 8, 3 or 1 rows after that moment,
    the longest stretch that the smoother still follows.
    """
    before, rows = context.before, context.data.t.shape[1]
    smoother, every = before.smoother, horizon(context.data, length)  # uncut: the program of the fit serves
    posterior = e_step(hypothesis.model, every, smoother, key=before.state.key)
    whole = np.asarray(kept(posterior, every))
    both = _cut(posterior.state, length), _cut(every, length)
    fit = SmoothedFit(context.declared, hypothesis, *both, whole, rows, context.pieces)
    if whole.all():
        return fit, whole
    dof = len(hypothesis.model.system.coordinates)
    kick = np.mean(np.asarray(posterior.kick), axis=2) / np.exp(0.5 * np.asarray(hypothesis.model.log_q))
    large = ~(np.abs(kick[..., dof : 2 * dof]).max(axis=-1) < context.effort.large_kick)
    first = np.where(large.any(axis=1), large.argmax(axis=1), every.t.shape[1])
    row, used, cut = np.arange(every.t.shape[1]), whole, every
    for later in context.effort.later:
        early = every.valid & jnp.asarray(row < first[:, None] + later)
        cut = cut._replace(valid=jnp.where(jnp.asarray(used)[:, None], cut.valid, early))
        posterior = e_step(hypothesis.model, cut, smoother, key=before.state.key)
        used = np.asarray(kept(posterior, cut))
        if used.all():
            break
    return fit._replace(path=_cut(posterior.state, length), data=_cut(cut, length), used=used), whole


def extend(context: SearchContext, hypothesis: Hypothesis, first: int) -> EMState:
    """EM of `hypothesis` from a horizon of `first` rows to the whole length."""
    before, longest = context.before, context.longest
    schedule = Schedule(first=min(first, longest), growth=1.6, hold=1)
    growing = math.ceil(math.log(longest / schedule.first) / math.log(1.6)) if longest > schedule.first else 0

    def run(model: StateSpaceModel) -> EMState:
        begun = later_state(model, hypothesis.m_step, key=before.state.key)
        return fit(begun, context.data, before.smoother, hypothesis.m_step, epochs=growing + 8, schedule=schedule)

    def looser(model: StateSpaceModel) -> StateSpaceModel:
        return eqx.tree_at(lambda m: m.log_q, model, model.log_q + LOOSER)

    try:
        state = run(hypothesis.model)
    except FitError:
        state = run(looser(hypothesis.model))
    if np.isfinite(before.state.top).sum() > np.isfinite(state.top).sum():
        try:  # sequences that the model without it follows diverge
            other = run(looser(cast(StateSpaceModel, state.best)))
            state = other if ahead(other.top, state.top) > 0 else state
        except FitError:
            pass
    other = _afresh(context, hypothesis)
    state = other if other is not None and ahead(other.top, state.top) > 0 else state
    if context.loss.predicts:
        state = _predicting(context, hypothesis, state)
    reached = np.nanmean(state.top)
    epochs = counted(state.epoch - 1, "epoch")
    context.log(f"  fitted over the whole length in {epochs}: log-likelihood {reached:.1f} nat per sequence")
    return state


def _afresh(context: SearchContext, hypothesis: Hypothesis) -> EMState | None:
    """Fit with friction and noise from their start, and the same laws; None where `hypothesis` is likelier at first.

    Friction that was fitted without a law may stand in its place, too steep for the step of the integration, and no
    step leads away from it: on an arm with 2.8 kg off an axis, 8 N m within .07 rad/s.
    """
    before = context.before
    declared = begin(before.rig, context.data, key=before.state.key)
    rule = eqx.tree_at(lambda rule: rule.centre, declared.m_step, hypothesis.m_step.centre)  # that of the first fit
    weights = rule.weights(declared.model)
    fresh = Hypothesis(weights.write(declared.model, weights.middle()), rule).having(hypothesis.additions)
    brief = horizon(context.data, SCHEDULE.first)
    state = start_state(fresh.model, fresh.m_step, key=before.state.key)
    try:
        state = fit(state, context.data, before.smoother, fresh.m_step, epochs=SCHEDULE.at_first)
        own = e_step(hypothesis.model, brief, before.smoother, key=before.state.key)
        if ahead(state.top, np.asarray(own.loglik)) <= 0:
            return None
        context.log("  friction as declared is the likelier start over the first horizon: the fit begins there")
        return fit(state, context.data, before.smoother, fresh.m_step)
    except FitError:
        return None


def _predicting(context: SearchContext, hypothesis: Hypothesis, state: EMState) -> EMState:
    """A fit, or that of the model it began from where that predicts better.

    EM, by one-step likelihood, may go away from what the errors of many steps had taught.
    """
    reached = hypothesis.refitted(cast(StateSpaceModel, state.best))
    (a, one), (b, other) = (smooth(context, each, context.longest) for each in (hypothesis, reached))
    if not (one & other).any():
        return state
    before, after = (errors(followed(f.model, f.m_step.prior, f.path, context.data), JUDGED) for f in (a, b))
    if ratio(before, after, one & other) <= 1:
        return state
    begun = later_state(hypothesis.model, hypothesis.m_step, key=state.key)
    schedule = Schedule(first=context.longest)
    return fit(begun, context.data, context.before.smoother, hypothesis.m_step, epochs=2, schedule=schedule)


def ahead(a: Float[np.ndarray, " seq"], b: Float[np.ndarray, " seq"]) -> float:
    """Log-likelihood of one fit over another [nat]; a sixth at either end counts as the mean of the others."""
    gain = np.sort(np.nan_to_num(a, nan=-1e3) - np.nan_to_num(b, nan=-1e3))
    cut = gain.size // 6
    return float(np.mean(gain[cut : gain.size - cut]) * gain.size)
