"""Constants of a search by multi-step errors, and its long steps: smooth a hypothesis, fit it over the whole length."""

import math
from collections.abc import Sequence
from typing import NamedTuple, cast

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from ...base.digits import counted
from ...base.log import Log
from ...errors import FitError
from ...estimate.em.loop import SCHEDULE, EMState, Schedule, e_step, fit, later_state, start_state
from ...estimate.em.mstep import ScoringMStep, not_diverged
from ...estimate.em.multistep import JUDGED, LEAST_FALL, errors, followed, ratio
from ...estimate.em.recorded import Risen
from ...estimate.identify import Identified, begin
from ...logs.dataset import Dataset, horizon
from ...model.effects import Candidate
from ...model.effects.sensor import SensorQuantization, grid_step
from ...model.state_space import StateSpaceModel
from .hypothesis import Evidence, Hypothesis
from .smoothed import SmoothedFit
from .verdict import COARSE, FOLLOWED, RISEN

Stages = dict[int, tuple[EMState, Bool[np.ndarray, " seq"]]]
"""State of a fit at the end of each of its horizons, and the sequences used."""

SHORT = 150
"""Rows of the shortest horizons at which a search for what moves a hidden joint begins."""
LARGE_KICK, LATER = 5.0, (8, 3, 1)
"""Kick [its standard deviations] from which on a sequence counts as diverged; rows after it that still count."""


class SearchContext(NamedTuple):
    """Constants of a search."""

    before: Identified
    stages: Stages
    data: Dataset
    log: Log
    origin: SmoothedFit | None = None
    """The fit from which the search began along its own recordings, where the question is what changed since."""
    change: bool = False
    """True where that is the question: the declared model is a fit, and its laws stay."""
    white: bool = False
    """True where readings carry white noise, which short horizons of hidden joints need."""
    risen: Risen | None = None
    """Test of whether errors have risen since that fit; None where its recordings are not at hand."""

    @property
    def functions(self) -> bool:
        """True where free functions may be named: since a fit only if errors have risen, as they fit any chance."""
        return self.risen is None or bool(self.risen.p_value < RISEN)

    @property
    def longest(self) -> int:
        """Rows of the longest sequence."""
        return int(np.max(np.sum(np.asarray(self.data.valid), axis=1)))


def lengths_of(context: SearchContext) -> list[int]:
    """Rows of the first rounds: all, or if most sequences diverge before, as many as most keep. Where a joint is hidden
    they begin along the growing fit, in which noise and friction are not yet free to take a law for their own: at the
    last horizon before the whole length, where a spring at a joint of a real arm that no sensor reads removes half of
    the error, and no law more than 0.03 over the whole length; where readings are white at the two shortest, and one in
    the middle: on a simulated arm a spring explains 0.38 of the error over 0.6 s, less than 0.09 over 5 s; on real arms
    those name wrong laws.
    """
    longest = context.longest
    growing = [length for length in sorted(context.stages) if length < longest]
    if context.before.model.hides:
        middle = [length for length in growing if longest / 3 < length < 0.7 * longest]
        short = [length for length in growing if length <= SHORT][:2] + middle[:1]
        return [*dict.fromkeys(short if context.white else growing[-1:]), longest]
    followed = {length: np.mean(used) for length, (_, used) in context.stages.items()}
    most = [length for length, share in followed.items() if share >= FOLLOWED]
    first = max(most, default=min(followed, default=longest))
    return [first, longest] if first < longest else [longest]


def smooth(context: SearchContext, hypothesis: Hypothesis, length: int) -> tuple[SmoothedFit, Bool[np.ndarray, " seq"]]:
    """`hypothesis` along its smoothed paths over `length` rows, and the sequences that are followed whole. A diverged
    sequence is most informative around its divergence: it is used up to `LATER` rows after that moment, the longest
    stretch that the smoother still follows.
    """
    before = context.before
    smoother, every = before.smoother, horizon(context.data, length)  # uncut: the program of the fit serves
    posterior = e_step(hypothesis.model, every, smoother, key=before.state.key)
    whole = np.asarray(not_diverged(posterior, every))
    fit = SmoothedFit(before.model, hypothesis, posterior.state, every, whole, context.longest)
    if whole.all():
        return fit, whole
    dof = len(hypothesis.model.system.coordinates)
    kick = np.mean(np.asarray(posterior.kick), axis=2) / np.exp(0.5 * np.asarray(hypothesis.model.log_q))
    large = ~(np.abs(kick[..., dof : 2 * dof]).max(axis=-1) < LARGE_KICK)
    first = np.where(large.any(axis=1), large.argmax(axis=1), every.t.shape[1])
    row, used, cut = np.arange(every.t.shape[1]), whole, every
    for later in LATER:
        early = np.asarray(every.valid) & (row < first[:, None] + later)
        cut = cut._replace(valid=np.where(used[:, None], cut.valid, early))
        posterior = e_step(hypothesis.model, cut, smoother, key=before.state.key)
        used = np.asarray(not_diverged(posterior, cut))
        if used.all():
            break
    return fit._replace(path=posterior.state, data=cut, used=used), whole


def extend(context: SearchContext, hypothesis: Hypothesis, first: int) -> EMState:
    """EM of `hypothesis` from a horizon of `first` rows to the whole length, or, where that is likelier over the first
    horizon and predicts better in the end, from friction and noise as declared.
    """
    before, longest = context.before, context.longest
    schedule = Schedule(first=min(first, longest), growth=1.6, hold=1)
    growing = math.ceil(math.log(longest / schedule.first) / math.log(1.6)) if longest > schedule.first else 0
    rule, fits, failure = hypothesis.m_step, [], FitError("no start")
    begun = later_state(hypothesis.model, rule, key=before.state.key)
    run = lambda start, rule, **options: fit(start, context.data, before.smoother, rule, **options)  # noqa: E731
    starts = [lambda: run(begun, rule, epochs=growing + 8, schedule=schedule)]
    if afresh := _afresh(context, hypothesis):
        starts.append(lambda: run(*afresh))
    for start in starts:
        try:
            fits.append(start())
        except FitError as error:
            failure = error
    if not fits:
        raise failure
    state = _best(context, hypothesis, fits)
    reached = f"log-likelihood {np.nanmean(state.top):.1f} nat per sequence"
    context.log(f"  fitted over the whole length in {counted(state.epoch - 1, 'epoch')} ({state.stop}): {reached}")
    return state


def _afresh(context: SearchContext, hypothesis: Hypothesis) -> tuple[EMState, ScoringMStep] | None:
    """Fit over the first horizon, and its rule, with friction and noise from their start, and the same laws; None where
    `hypothesis` is likelier there, and where friction and noise are those of a fit. Friction that was fitted without a
    law may stand in its place, too steep for the step of the integration, and no step leads away from it: on an arm
    with 2.8 kg off an axis, 8 N m within 0.07 rad/s.
    """
    before = context.before
    if context.change:
        return None
    start = begin(before.rig, context.data, key=before.state.key)
    rule = eqx.tree_at(lambda rule: rule.centre, start.m_step, hypothesis.m_step.centre)  # that of the first fit
    weights = rule.weights(start.model)
    fresh = Hypothesis(weights.write(start.model, weights.middle()), rule).having(hypothesis.additions)
    state = start_state(fresh.model, fresh.m_step, key=before.state.key)
    try:
        state = fit(state, context.data, before.smoother, fresh.m_step, epochs=SCHEDULE.hold + 1)
    except FitError:
        return None
    brief = horizon(context.data, SCHEDULE.first)
    own = e_step(hypothesis.model, brief, before.smoother, key=before.state.key)
    if not likelier(state.top, np.asarray(own.loglik)):
        return None
    context.log("  friction as declared is the likelier start over the first horizon: a fit begins there, too")
    return state, fresh.m_step


def _best(context: SearchContext, hypothesis: Hypothesis, fits: Sequence[EMState]) -> EMState:
    """The fit that predicts best, or the hypothesis as it stands: EM may leave what errors of many steps taught."""
    models, left = [hypothesis.model, *(cast(StateSpaceModel, one.best) for one in fits)], []
    every = [smooth(context, hypothesis.refitted(model), context.longest) for model in models]
    before, *after = (errors(followed(a.model, a.m_step.prior, a.path, context.data), JUDGED) for a, _ in every)
    for error, (_, whole) in zip(after, every[1:], strict=True):
        both = every[0][1] & whole
        left.append(ratio(before, error, both) if both.any() else 1.0)
    place = chosen(left, [one.top for one in fits])
    if place is not None:
        return fits[place]
    begun = later_state(hypothesis.model, hypothesis.m_step, key=fits[0].key)
    schedule = Schedule(first=context.longest)
    return fit(begun, context.data, context.before.smoother, hypothesis.m_step, epochs=2, schedule=schedule)


def chosen(left: Sequence[float], tops: Sequence[Float[np.ndarray, " seq"]]) -> int | None:
    """Place of the fit to keep: of two whose squared error is nearly the same, the likelier. `left` are their errors
    over that of the hypothesis as it stands, which is kept where all predict worse.
    """
    if min(left) > 1:
        return None
    if len(left) == 2 and abs(left[1] - left[0]) <= LEAST_FALL:
        return int(likelier(tops[1], tops[0]))
    return int(np.argmin(left))


def likelier(a: Float[np.ndarray, " seq"], b: Float[np.ndarray, " seq"]) -> bool:
    """True where most sequences are likelier under one fit than under another; what diverges is least likely."""
    return bool(np.median(np.nan_to_num(a, nan=-1e3) - np.nan_to_num(b, nan=-1e3)) > 0)


def quantised(context: SearchContext, hypothesis: Hypothesis) -> tuple[Hypothesis, EMState | None]:
    """Readings that come in steps larger than their noise: seen in the numbers themselves, modelled as noise. A fit
    that took the steps for motion has lost its way: it begins again where it was short.
    """
    rig, state, first = context.before.rig, None, min(context.stages)
    certain = 12.0  # gain in log-likelihood [nat] below which steps are no effect: chance exceeds it once in 10^6
    for i, channel in enumerate(rig.measured):
        y = np.asarray(context.data.y)[..., i]
        step = grid_step(y.ravel())
        model = cast(StateSpaceModel, state.best if state else hypothesis.model)
        declared = rig.noise_std.get(channel)
        share = step**2 / 12 / (declared**2 if declared else float(jnp.exp(model.log_r[i])))
        gain = 0.5 * np.isfinite(y).sum() * (share - math.log1p(share))  # of the right variance over that without it
        if share < COARSE or gain < certain:
            continue
        context.log(f"  {channel} comes in steps of {step:.4g}")
        effect, spread = (SensorQuantization(step=jnp.asarray(s), channel=channel) for s in (step, 1e-3 * step))
        early = cast(StateSpaceModel, state.best if state else context.stages[first][0].best)
        candidate = Candidate(effect, (effect,), spread)
        hypothesis = hypothesis.refitted(early).plus(effect, candidate, Evidence(float(gain)))
        if declared:
            log_r = hypothesis.model.log_r.at[i].set(math.log(declared**2 + step**2 / 12))
            hypothesis = hypothesis.refitted(eqx.tree_at(lambda m: m.log_r, hypothesis.model, log_r))
        state = extend(context, hypothesis, first)
    return hypothesis, state
