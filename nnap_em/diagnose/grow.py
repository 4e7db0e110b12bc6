"""Asking and fitting at longer and longer horizons: what the search and its undoing both do."""

import math
from typing import NamedTuple, TypeVar, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from ..data.dataset import Dataset, horizon
from ..em.identify import Identified
from ..em.loop import EMState, FitError, Schedule, e_step, fit, start_state
from ..em.mstep import kept
from ..model.state_space import StateSpaceModel
from .accept import SHORT, AbstractRule
from .case import Case, open_loop_error, trimmed
from .evidence import Question
from .hypothesis import Found, Hypothesis
from .keys import Key, key_of
from .look import Effort, Say

_Tree = TypeVar("_Tree")

Stages = dict[int, tuple[EMState, Bool[np.ndarray, " seq"]]]
"""State of a fit at the end of each of its horizons, and the sequences used."""


class Loop(NamedTuple):
    """What does not change while the loop runs."""

    before: Identified
    stages: Stages
    data: Dataset
    rule: AbstractRule
    effort: Effort
    say: Say
    pieces: tuple[int, ...] = ()
    """Of which recording every sequence is a piece; empty: each is one."""

    @property
    def longest(self) -> int:
        """Rows of the longest sequence."""
        return int(np.max(np.sum(np.asarray(self.data.valid), axis=1)))

    @property
    def bare(self) -> Hypothesis:
        """The declared model."""
        return Hypothesis(self.before.model, self.before.m_step)


def beginning(data: Dataset, length: int) -> Dataset:
    """The first `length` rows."""
    return _cut(horizon(data, length), length)


def _cut(tree: _Tree, length: int) -> _Tree:
    """All of it, over no more rows than a short horizon needs."""
    return jax.tree.map(lambda a: np.asarray(a)[:, :SHORT], tree) if length <= SHORT else tree  # a view, no program


def asked(loop: Loop, now: Hypothesis, length: int) -> tuple[Question, Bool[np.ndarray, " seq"]]:
    """The question along the smoothed paths of `now` over `length` rows, and the sequences that are followed whole.

    A sequence that is lost tells most where it is being lost: it is used until a little later, as late as it can be.
    """
    before, rows = loop.before, loop.data.t.shape[1]
    smoother, every = before.smoother, horizon(loop.data, length)  # uncut: the program of the fit serves
    posterior = e_step(now.model, every, smoother, key=before.state.key)
    whole = np.asarray(kept(posterior, every))
    told = _cut(posterior.state, length), _cut(every, length)
    question = Question(loop.bare, now, *told, whole, rows, loop.pieces)
    if whole.all():
        return question, whole
    dof = len(now.model.system.coordinates)
    kick = np.mean(np.asarray(posterior.kick), axis=2) / np.exp(0.5 * np.asarray(now.model.log_q))
    loud = ~(np.abs(kick[..., dof : 2 * dof]).max(axis=-1) < loop.effort.loud)
    first = np.where(loud.any(axis=1), loud.argmax(axis=1), every.t.shape[1])
    row, used, cut = np.arange(every.t.shape[1]), whole, every
    for later in loop.effort.later:
        early = every.valid & jnp.asarray(row < first[:, None] + later)
        cut = cut._replace(valid=jnp.where(jnp.asarray(used)[:, None], cut.valid, early))
        posterior = e_step(now.model, cut, smoother, key=before.state.key)
        used = np.asarray(kept(posterior, cut))
        if used.all():
            break
    return question._replace(path=_cut(posterior.state, length), data=_cut(cut, length), used=used), whole


LOOSER = 3.0
"""What is added to the log of the process noise where every track is lost."""


def grow(loop: Loop, now: Hypothesis, first: int, length: int, state: EMState | None = None) -> EMState:
    """EM of the model as it stands, from the horizon where it was found (or from `state`) to a longer one."""
    before, part = loop.before, beginning(loop.data, length)
    if state is not None:
        now = now.refitted(cast(StateSpaceModel, state.best))
    schedule = Schedule(first=min(first, length), growth=1.6, hold=1)
    growing = math.ceil(math.log(length / schedule.first) / math.log(1.6)) if length > schedule.first else 0
    smoother = before.smoother
    epochs = growing + (8 if length == loop.longest else 3)

    def run(model: StateSpaceModel) -> EMState:
        begun = start_state(model, now.m_step, key=before.state.key)._replace(epoch=1)
        return fit(begun, part, smoother, now.m_step, epochs=epochs, schedule=schedule)

    try:
        state = run(now.model)
    except FitError:  # a looser filter keeps a track that a tight one loses
        state = run(eqx.tree_at(lambda m: m.log_q, now.model, now.model.log_q + LOOSER))
    if length == loop.longest and np.isfinite(before.state.top).sum() > np.isfinite(state.top).sum():
        try:  # tracks that the model without it keeps are lost: from looser noise, as above
            other = run(eqx.tree_at(lambda m: m.log_q, state.best, cast(StateSpaceModel, state.best).log_q + LOOSER))
            state = other if ahead(other, state) > 0 else state
        except FitError:
            pass
    if loop.rule.multistep and length == loop.longest:
        state = _predicting(loop, now, state)
    reach = f"{length * before.rig.dt:.2f} s"
    loop.say(f"  fitted over {reach} in {state.epoch - 1} epochs: {state.loglik[-1]:.1f} nat per sequence")
    return state


def _predicting(loop: Loop, now: Hypothesis, state: EMState) -> EMState:
    """A fit, or that of the model it began from as it stands, where that predicts better: by one-step likelihood EM may
    go away from what the errors of many steps had taught.
    """
    reached = now.refitted(cast(StateSpaceModel, state.best))
    (a, one), (b, other) = (asked(loop, each, loop.longest) for each in (now, reached))
    if not (one & other).any() or open_loop_error(a, b, loop.data, one & other) <= 1:
        return state
    begun = start_state(now.model, now.m_step, key=state.key)._replace(epoch=1)
    schedule = Schedule(first=loop.longest)
    return fit(begun, loop.data, loop.before.smoother, now.m_step, epochs=2, schedule=schedule)


def playoff(length: int, longest: int) -> int:
    """The horizon of a playoff."""
    return min(longest, SHORT if length < SHORT else round(2.5 * length))


def taken(now: Hypothesis, case: Case, found: Found | None = None) -> Hypothesis:
    """The hypothesis with a case in it, under the hold on process noise of the old one."""
    m_step = eqx.tree_at(lambda r: r.tie, case.after.m_step, now.m_step.tie)
    after = case.after._replace(m_step=m_step)
    return after if found is None else after.because(-1, found)


def settle(
    loop: Loop, now: Hypothesis, length: int, sound: list[Case]
) -> tuple[Case, EMState | None, dict[Key, float]]:
    """The winner; where the next ones are near, each is followed to a longer horizon, where the wrong ones fail.

    With it the fit to that horizon, and how many nats each rival fell behind there.
    """
    rule, longest = loop.rule, loop.longest
    rivals = [case for case in sound if rule.worth(case) > rule.near * rule.worth(sound[0])][:3]
    if len(rivals) == 1 or length == longest:
        return sound[0], None, {}
    further = playoff(length, longest)
    loop.say(f"  {len(rivals)} of them are near: followed to {further * loop.before.rig.dt:.2f} s")
    states: list[tuple[Case, EMState]] = []
    for rival in rivals:
        try:
            states.append((rival, grow(loop, taken(now, rival), length, further)))
        except FitError:
            continue
    if not states:
        return sound[0], None, {}
    winner, state = states[0]
    for rival, other in states[1:]:
        if ahead(other, state) > 0:
            winner, state = rival, other
    return winner, state, {key_of(rival.effect): ahead(state, other) for rival, other in states}


def ahead(a: EMState, b: EMState) -> float:
    """Log-likelihood of one fit over another [nat]; a sixth of the sequences is trimmed at either end."""
    return trimmed(np.nan_to_num(a.top, nan=-1e3) - np.nan_to_num(b.top, nan=-1e3))
