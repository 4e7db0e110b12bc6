"""Closing the loop: find what a fitted model lacks, add it, fit again, and look once more.

The search measures and proposes; whether something is believed is asked of a rule (`accept.py`).
"""

import functools
import math
from typing import NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, PRNGKeyArray
from scipy import stats

from ..data.dataset import Dataset, horizon
from ..data.rig import Rig
from ..effects import AbstractEffect, Candidate
from ..effects.sensor import SensorQuantization, grid_step
from ..em.identify import Identified, finished, identify
from ..em.loop import EMState, FitError, Schedule, e_step, fit, start_state
from ..em.mstep import kept
from ..em.noise import white_readings
from ..model.state_space import StateSpaceModel
from ..numerics.programs import let_go
from .accept import SHORT, AbstractRule, LikelihoodRule, ShareRule
from .evidence import Question, Worth, lazy, readings
from .hypothesis import Found, Hypothesis
from .interventions import Intervention, untouched
from .keys import Key, key_of, replaced, rest_of, words
from .look import EFFORT, Case, Effort, Look, Say, Step, alike, look, open_loop_error, significance, trimmed
from .refit import refit
from .residual import white_innovations

Stages = dict[int, tuple[EMState, Bool[np.ndarray, " seq"]]]
"""State of a fit at the end of each of its horizons, and the sequences used."""


class Closed(NamedTuple):
    """The outcome."""

    before: Identified
    after: Identified
    found: tuple[Found, ...]
    steps: tuple[Step, ...]
    interventions: tuple[Intervention, ...] = ()
    """Touches from outside, which no fit saw."""


class Loop(NamedTuple):
    """What does not change while the loop runs."""

    before: Identified
    stages: Stages
    data: Dataset
    rule: AbstractRule
    effort: Effort
    say: Say

    @property
    def longest(self) -> int:
        """Rows of the longest sequence."""
        return int(np.max(np.sum(np.asarray(self.data.valid), axis=1)))

    @property
    def bare(self) -> Hypothesis:
        """The declared model."""
        return Hypothesis(self.before.model, self.before.m_step)


def _part(data: Dataset, length: int) -> Dataset:
    """The first `length` rows."""
    part = horizon(data, length)
    return jax.tree.map(lambda a: a[:, :SHORT], part) if length <= SHORT else part


# --- asking


def _asked(loop: Loop, now: Hypothesis, every: Dataset) -> tuple[Question, Bool[np.ndarray, " seq"]]:
    """The question along the smoothed paths of `now`, and the sequences that are followed whole.

    A sequence that is lost tells most where it is being lost: it is used until a little later, as late as it can be.
    """
    before, rows = loop.before, loop.data.t.shape[1]
    smoother = before.smoother
    posterior = e_step(now.model, every, smoother, key=before.state.key)
    whole = np.asarray(kept(posterior, every))
    question = Question(loop.bare, now, posterior.state, every, whole, rows)
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
    return question._replace(path=posterior.state, data=cut, used=used), whole


# --- growing


LOOSER = 3.0
"""What is added to the log of the process noise where every track is lost."""


def _grow(loop: Loop, now: Hypothesis, first: int, length: int, state: EMState | None = None) -> EMState:
    """EM of the model as it stands, from the horizon where it was found (or from `state`) to a longer one."""
    before, part = loop.before, _part(loop.data, length)
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
    reach = f"{length * before.rig.dt:.2f} s"
    loop.say(f"  fitted over {reach} in {state.epoch - 1} epochs: {state.loglik[-1]:.1f} nat per sequence")
    return state


def _further(length: int, longest: int) -> int:
    """The horizon of a playoff."""
    return min(longest, SHORT if length < SHORT else round(2.5 * length))


def _taken(now: Hypothesis, case: Case, found: Found | None = None) -> Hypothesis:
    """The hypothesis with a case in it, under the hold on process noise of the old one."""
    m_step = eqx.tree_at(lambda r: r.tie, case.after.m_step, now.m_step.tie)
    after = case.after._replace(m_step=m_step)
    return after if found is None else after.because(-1, found)


def _settle(
    loop: Loop, now: Hypothesis, length: int, sound: list[Case]
) -> tuple[Case, EMState | None, dict[Key, float]]:
    """The winner; where the next ones are near, each is followed to a longer horizon, where the wrong ones fail.

    With it the fit to that horizon, and how many nats each rival fell behind there.
    """
    rule, longest = loop.rule, loop.longest
    rivals = [case for case in sound if rule.worth(case) > rule.near * rule.worth(sound[0])][:3]
    if len(rivals) == 1 or length == longest:
        return sound[0], None, {}
    further = _further(length, longest)
    loop.say(f"  {len(rivals)} of them are near: followed to {further * loop.before.rig.dt:.2f} s")
    states: list[tuple[Case, EMState]] = []
    for rival in rivals:
        try:
            states.append((rival, _grow(loop, _taken(now, rival), length, further)))
        except FitError:
            continue
    if not states:
        return sound[0], None, {}
    winner, state = states[0]
    for rival, other in states[1:]:
        if _ahead(other, state) > 0:
            winner, state = rival, other
    return winner, state, {key_of(rival.effect): _ahead(state, other) for rival, other in states}


def _ahead(a: EMState, b: EMState) -> float:
    """Log-likelihood of one fit over another [nat]; a sixth of the sequences is trimmed at either end."""
    return trimmed(np.nan_to_num(a.top, nan=-1e3) - np.nan_to_num(b.top, nan=-1e3))


# --- searching


EVEN = 5.0
"""Alternatives whose refit is within this many nats of the winner cannot be told from it."""
SAME = 0.01
"""Share of an effect's information that an equivalent one may leave unexplained."""


def _search(
    loop: Loop, now: Hypothesis, every: Dataset, length: int, steps: list[Step]
) -> tuple[Hypothesis, EMState | None]:
    """Look at one horizon until nothing more is found; a fit to a longer one, where a playoff made it."""
    rule, say, been = loop.rule, loop.say, {_names(now)}
    while len(now.found) < loop.effort.most:
        let_go()
        question, whole = _asked(loop, now, every)
        say(f"horizon {length * loop.before.rig.dt:.2f} s: {whole.sum()} of {whole.size} sequences followed")
        if not question.used.any():
            break
        seen = look(question, loop.before.rig, rule, loop.effort, say)
        steps.append(seen.step)
        if not seen.sound:
            break
        winner, further, behind = _settle(loop, now, length, seen.sound)
        key, verdict = key_of(winner.effect), rule.believes(winner)
        say(f"  best: {words(key)}, worth {rule.worth(winner):.3g}, {verdict.reason}")
        if not verdict.believed:
            break
        found = _found(rule, winner, seen, behind, length)
        plain = _plain(question, winner, rule, loop.effort)
        if plain is not None:
            following, dropped = plain
            say(f"  {words(key_of(dropped))} was a part of it")
            following, further = following.because(-1, found), None
        else:
            following = _taken(now, winner, found)
        if _names(following) in been:
            say(f"  {words(key)} only takes the place of what was there: no further")
            break
        now, steps[-1] = following, seen.step._replace(accepted=key)
        been.add(_names(now))
        say(f"  added {words(key)}")
        if further is not None:
            return now, further
    return now, None


def _names(now: Hypothesis) -> frozenset[Key]:
    return frozenset(key_of(effect) for effect in now.model.effects)


def _found(rule: AbstractRule, winner: Case, seen: Look, behind: dict[Key, float], length: int) -> Found:
    """Why the winner is believed, and what cannot be told from it."""
    p_value = min(1.0, float(stats.chi2.sf(2 * max(winner.gain, 0.0), winner.directions)) * seen.step.tried)
    rivals = {key_of(case.effect): case for case in seen.sound if case is not winner}
    far = {key for key, case in rivals.items() if not rule.even(winner, case)}
    far |= {key for key, lost in behind.items() if lost > EVEN}
    told = [key for key, part in alike(winner, seen.screen) if part < SAME or part * winner.gain < EVEN]
    same = dict.fromkeys(key for key in (*told, *rivals) if key not in far)
    share = winner.screened.share
    return Found(
        winner.screened.candidate,
        winner.gain,
        winner.__dict__.get("_held_out", math.nan),
        p_value,
        length,
        tuple(same),
        math.nan if share is None else share.left_out,
    )


def _plain(
    question: Question, winner: Case, rule: AbstractRule, effort: Effort
) -> tuple[Hypothesis, AbstractEffect] | None:
    """With an unnamed law in place of a named one and its rest, where the named one says the lesser part."""
    now, used = question.now, question.used
    place = rest_of(winner.effect, now.model)
    if place is None or replaced(winner.effect, now.model) is not None:
        return None
    less = now.without(place)
    fitted = functools.partial(refit, data=question.data, used=used, passes=effort.passes)
    bare = fitted(less.model, less.m_step.early(), question.path)
    whole, own = (trimmed((trial.loglik - bare.loglik)[used]) for trial in (winner.trial, winner.null))
    if own > SAYS * whole:
        return None
    full = less.refitted(bare.model).plus(winner.effect, winner.screened.candidate)
    trial = fitted(full.model, full.m_step.early(), bare.path)
    return full.refitted(trial.model), now.model.effects[place]


SAYS = 0.8
"""Share of a force that a named law must say to stay when its rest is found."""


# --- looking back


CLEAR = 100.0
"""Loss by the curvature of the fit [nat] from which on no refit is needed to see that an effect is needed."""


class Difference(Worth):
    """What one hypothesis has over another that it contains, both as they are fitted."""

    def __init__(self, loop: Loop, less: Hypothesis, full: Hypothesis, gain: float):
        self.loop, self.less, self.full, self.gain = loop, less, full, gain
        self.readings = readings(loop.data)

    @lazy
    def error(self) -> float:
        """Squared open-loop error of the one over that of the other."""
        (a, _), (b, _) = (_asked(self.loop, each, self.loop.data) for each in (self.less, self.full))
        return open_loop_error(a, b, self.loop.data, a.used & b.used)


def _needed(loop: Loop, now: Hypothesis, state: EMState | None) -> tuple[Hypothesis, EMState | None]:
    """Without the effects that later ones made needless.

    The curvature of the fit names the least; a fit without it decides: curvature alone has struck effects whose loss
    was hundreds of nats.
    """
    while state is not None and now.found:
        now = now.refitted(cast(StateSpaceModel, state.best))
        losses = [_loss(now, state, i) for i in range(len(now.found))]
        least = int(np.argmin(losses))
        if losses[least] > CLEAR:
            break
        less = now.without(least)
        path = _asked(loop, less, loop.data)[0]
        trial = refit(less.model, less.m_step, path.path, loop.data, path.used, passes=loop.effort.passes)
        gain = trimmed((np.nan_to_num(state.top, nan=-1e3) - trial.loglik)[path.used])
        verdict = loop.rule.keeps(Difference(loop, less.refitted(trial.model), now, gain))
        if verdict.believed and now.model.effects[least].possible():
            break
        loop.say(f"  {words(key_of(now.model.effects[least]))} is needless now: it {verdict.reason}")
        now = less.refitted(trial.model)
        state = _grow(loop, now, loop.longest, loop.longest) if now.found else None
    return now, state


def _loss(now: Hypothesis, state: EMState, place: int) -> float:
    """Log-likelihood that goes with an effect [nat]; none with one whose value makes no sense, all with steps seen."""
    effect, found = now.model.effects[place], now.found[place]
    if effect.read_off or found is None:
        return math.inf
    if not effect.possible():
        return 0.0
    return 0.5 * significance(found.candidate, now, state.hessian, place) ** 2


def _quantised(loop: Loop, now: Hypothesis) -> tuple[Hypothesis, EMState | None]:
    """Readings that come in steps larger than their noise: seen in the numbers themselves, modelled as noise.

    A fit that took the steps for motion has lost its way: it begins again where it was short.
    """
    rig, state, first = loop.before.rig, None, min(loop.stages)
    for i, channel in enumerate(rig.measured):
        y = np.asarray(loop.data.y)[..., i]
        step = grid_step(y.ravel())
        model = cast(StateSpaceModel, state.best if state else now.model)
        told, now_r = rig.noise_std.get(channel), float(jnp.exp(model.log_r[i]))
        share = step**2 / 12 / (told**2 if told else max(now_r - step**2 / 12, 0.25 * now_r))
        gain = 0.5 * np.isfinite(y).sum() * (share - math.log1p(share))  # of the right variance over that without it
        if share < 0.1 or gain < LikelihoodRule().margin:
            continue
        loop.say(f"  {channel} comes in steps of {step:.4g}")
        effect = SensorQuantization(step=jnp.asarray(step), channel=channel)
        spread = SensorQuantization(step=jnp.asarray(1e-3 * step), channel=channel)
        candidate = Candidate(effect, (effect,), spread)
        found = Found(candidate, float(gain), float(gain), 0.0, loop.data.t.shape[1])
        early = cast(StateSpaceModel, state.best if state else loop.stages[first][0].best)
        now = now.refitted(early).plus(effect, candidate, found)
        if told:
            log_r = now.model.log_r.at[i].set(math.log(told**2 + step**2 / 12))
            now = now.refitted(eqx.tree_at(lambda m: m.log_r, now.model, log_r))
        state = _grow(loop, now, first, loop.longest)
    return now, state


# --- the whole


def close(loop: Loop) -> Closed:
    """Search for what the declared model lacks."""
    longest, before = loop.longest, loop.before
    steps: list[Step] = []
    # steps in a reading come first: they spoil the noise that all else leans on
    now, state = _quantised(loop, loop.bare)
    last = longest if state else 0
    for length in [longest] if state else loop.rule.horizons(list(loop.stages), longest):
        if now.found and (state is None or last < length):
            state = _grow(loop, now, last, length, state)
        own = loop.stages[length][0].best if length < longest else before.model
        now = now.refitted(cast(StateSpaceModel, state.best if state else own))
        last, known = length, now.found
        now, further = _search(loop, now, _part(loop.data, length), length, steps)
        if now.found is not known:  # one more, or one in the place of another
            state = further
            last = _further(length, longest) if further is not None else length
    if now.found and state is None:
        state = _grow(loop, now, longest, longest)
    count = len(now.found)
    now, state = _needed(loop, now, state)
    if len(now.found) < count:  # what the dropped one stood for may now be seen for what it is
        now = now.refitted(cast(StateSpaceModel, state.best if state else before.model))
        more, further = _search(loop, now, _part(loop.data, longest), longest, steps)
        if more.found is not now.found:
            now, state = more, further or _grow(loop, more, longest, longest)
            now, state = _needed(loop, now, state)
    return _whole(loop, now, state, steps)


def _whole(loop: Loop, now: Hypothesis, state: EMState | None, steps: list[Step]) -> Closed:
    """The outcome, where all that was found together is worth it over the whole length; if not, less of it."""
    before = loop.before
    while state is not None and now.found:
        after = finished(before._replace(state=state, m_step=now.m_step), loop.data)
        now = now.refitted(after.model)
        verdict = loop.rule.keeps(Difference(loop, loop.bare, now, _ahead(state, before.state)))
        # steps were read off the numbers themselves
        if verdict.believed or any(effect.read_off for effect in now.model.effects):
            return Closed(before, after, cast(tuple[Found, ...], now.found), tuple(steps))
        loop.say(f"  over the whole length it {verdict.reason} only: without the last law")
        now = now.without(len(now.found) - 1)
        state = _grow(loop, now, loop.longest, loop.longest) if now.found else None
    return Closed(before, before, (), tuple(steps))


def close_the_loop(
    rig: Rig,
    data: Dataset,
    *,
    key: PRNGKeyArray,
    rule: AbstractRule | None = None,
    effort: Effort = EFFORT,
    say: Say = lambda text: None,
) -> Closed:
    """Fit the declared unknowns of `rig`, find what it lacks, add that, and fit again.

    Without a `rule`: one-step likelihood where readings carry white noise and the innovations of the outcome are
    white; else, as on real machines, shares of the multi-step error, and touches from outside are left out before.
    Raises FitError when no sequence can be followed.
    """
    data = Dataset(*map(jnp.asarray, data))
    stages: Stages = {}

    def watch(state: EMState, seen: int, used: Bool[np.ndarray, " seq"]) -> None:
        stages[seen] = (state, used)
        say(f"epoch {state.epoch}, horizon {seen * rig.dt:.2f} s: {state.loglik[-1]:.1f} nat per sequence")

    if len(data.t) < 2:
        say("one sequence: only pieces of it can be left out, so that little will be believed; record at least two")

    def fitted(part: Dataset) -> Identified:
        stages.clear()
        return identify(rig, part, key=key, watch=watch)

    def closed(rule: AbstractRule) -> Closed:
        try:
            return close(Loop(before, stages, data, rule, effort, say))
        except FitError as lost:
            say(f"  with what was added no sequence can be followed to its end ({lost}); nothing is kept of it")
            return Closed(before, before, (), ())

    before = fitted(data)
    if rule is not None:
        return closed(rule)
    if white_readings(data):
        outcome = closed(LikelihoodRule())
        if white_innovations(outcome.after, data):
            return outcome
        say("one-step errors follow each other, so that their likelihood proves nothing: multi-step errors decide")
    before, data, touches = untouched(fitted, before, data)
    if touches:
        say(f"{len(touches)} touches from outside: their rows are left out")
    return closed(ShareRule())._replace(interventions=touches)
