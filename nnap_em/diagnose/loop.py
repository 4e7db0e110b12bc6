"""Closing the loop: find what a fitted model lacks, add it, fit again, and look once more.

The search measures and proposes; whether something is believed is asked of a rule (`accept.py`).
"""

import functools
import math
from typing import Any, NamedTuple, cast

import jax
import numpy as np
from jaxtyping import Bool, PRNGKeyArray
from scipy import stats

from ..data.dataset import Dataset
from ..data.rig import Rig
from ..effects import AbstractEffect
from ..em.identify import Identified, identify
from ..em.loop import EMState, FitError
from ..em.noise import white_readings
from ..model.state_space import StateSpaceModel
from ..numerics.programs import let_go
from ..residual.innovations import white_innovations
from ..residual.undisturbed import disturbance_free
from ..systems import AbstractSystem
from .accept import AbstractRule, LikelihoodRule, ShareRule
from .case import Case, trimmed
from .evidence import Question
from .grow import Loop, Stages, asked, grow, playoff, settle, taken
from .hypothesis import Found, Hypothesis
from .keys import Key, key_of, replaced, rest_of, words
from .look import EFFORT, Effort, Look, Say, alike, look, suspects
from .outcome import Closed, Step
from .quantised import quantised
from .refit import refit
from .rivals import EVEN, apart
from .undo import Difference, concluded, needed

SAME = 0.01
"""Share of an effect's information that an equivalent one may leave unexplained."""


def _search(loop: Loop, now: Hypothesis, length: int, steps: list[Step]) -> tuple[Hypothesis, EMState | None]:
    """Look at one horizon until nothing more is found; a fit to a longer one, where a playoff made it."""
    say, been = loop.say, {_names(now)}
    while len(now.found) < loop.effort.most:
        let_go()
        question, whole = asked(loop, now, length)
        say(f"horizon {length * loop.before.rig.dt:.2f} s: {whole.sum()} of {whole.size} sequences followed")
        if not question.used.any():
            break
        if loop.rule.multistep and now.found:
            question = question._replace(left=Difference(loop, loop.bare, now, math.nan).error)
            say(f"  {question.left:.0%} of the open-loop error of the declared model is left")
        rule, seen, winner, further, behind = _choice(loop, now, question, length)
        steps.append(seen.step)
        if winner is None:
            if not seen.step.rivals:
                candidates = [screened.candidate for screened in seen.screen.screened]
                chance = functools.partial(rule.chance, question, candidates)
                steps[-1] = seen.step._replace(suspects=suspects(seen, rule, chance))
            break
        key = key_of(winner.effect)
        found = _found(rule, winner, seen, behind, length)
        plain = _plain(question, winner, rule, loop.effort)
        if plain is not None:
            following, dropped = plain
            say(f"  {words(key_of(dropped))} was a part of it")
            following, further = following.because(-1, found), None
        else:
            following = taken(now, winner, found)
        if _names(following) in been:
            say(f"  {words(key)} only takes the place of what was there: no further")
            break
        now, steps[-1] = following, seen.step._replace(accepted=key)
        been.add(_names(now))
        say(f"  added {words(key)}")
        if further is not None:
            return now, further
    return now, None


class Choice(NamedTuple):
    """What came of a look."""

    rule: AbstractRule
    seen: Look
    winner: Case | None
    further: EMState | None
    """A fit to a longer horizon, where a playoff made it."""
    behind: dict[Key, float]
    """How many nats each rival fell behind in it."""


def _choice(loop: Loop, now: Hypothesis, question: Question, length: int) -> Choice:
    """Who is believed, by the rule or, where that believes nobody, by the one beyond it."""
    rule, none = loop.rule, None
    while rule is not None:
        seen = look(question, loop.before.rig, rule, loop.effort, loop.say)
        none = none or Choice(rule, seen, None, None, {})
        if seen.sound:
            rivals = tuple(key_of(case.effect) for case in _rivals(seen.sound, rule, now.model.system))
            if rivals:
                loop.say(f"  cannot tell: {', '.join(map(words, rivals))} explain the same; none is added")
                return Choice(rule, seen._replace(step=seen.step._replace(rivals=rivals)), None, None, {})
            best, further, behind = settle(loop._replace(rule=rule), now, length, seen.sound)
            winner = _believed(best, seen.sound, rule, loop.say)
            if winner is not None:
                return Choice(rule, seen, winner, further, behind)
        rule = rule.beyond()
    assert none is not None
    return none


def _rivals(sound: list[Case], rule: AbstractRule, system: AbstractSystem) -> list[Case]:
    """The best and those that explain the same by another cause, where there are any: nothing chooses among them."""
    best, *others = sound
    own = set(best.effect.signals(system))

    def unlike(case: Case) -> bool:
        """A law of another kind, and of other signals."""
        its = set(case.effect.signals(system))
        alike = case.effect.named and case.effect.name == best.effect.name
        return not alike and bool(own and its) and own.isdisjoint(its)

    rivals = [case for case in others if unlike(case) and rule.multistep and rule.even(best, case)]
    return [best, *rivals] if rivals else []


def _believed(best: Case, sound: list[Case], rule: AbstractRule, say: Say) -> Case | None:
    """The best; where what is left out of its refit speaks against it, the first of those nearly as good for which it
    speaks: an alias may promise more inside than the truth.
    """
    near = [case for case in sound if case is not best and rule.worth(case) > rule.near * rule.worth(best)]
    for case in (best, *near) if rule.multistep else (best,):
        verdict = rule.believes(case)
        say(f"  best: {words(key_of(case.effect))}, worth {rule.worth(case):.3g}, {verdict.reason}")
        if verdict.believed:
            return case
    return None


def _names(now: Hypothesis) -> frozenset[tuple[Key, Any]]:
    """The laws and their forms."""
    return frozenset((key_of(effect), jax.tree.structure(effect)) for effect in now.model.effects)


def _found(rule: AbstractRule, winner: Case, seen: Look, behind: dict[Key, float], length: int) -> Found:
    """Why the winner is believed, and what cannot be told from it."""
    p_value = min(1.0, float(stats.chi2.sf(2 * max(winner.gain, 0.0), winner.directions)) * seen.step.tried)
    rivals = {key_of(case.effect): case for case in seen.sound if case is not winner}
    far = {key for key, case in rivals.items() if not rule.even(winner, case)}
    far |= {key for key, lost in behind.items() if lost > EVEN}
    told = [key for key, part in alike(winner, seen.screen) if part < SAME or 0.0 < part * winner.gain < EVEN]
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


# --- the whole


def close(loop: Loop) -> Closed:
    """Search for what the declared model lacks."""
    longest, before = loop.longest, loop.before
    steps: list[Step] = []
    # steps in a reading come first: they spoil the noise that all else leans on
    now, state = quantised(loop, loop.bare)
    last = longest if state else 0
    ahead = [longest] if state else loop.rule.horizons(list(loop.stages), longest)
    while ahead:
        length = ahead.pop(0)
        if now.found and (state is None or last < length):
            state = grow(loop, now, last, length, state)
        own = loop.stages[length][0].best if length < longest else before.model
        now = now.refitted(cast(StateSpaceModel, state.best if state else own))
        last, known = length, now.found
        now, further = _search(loop, now, length, steps)
        if now.found is not known:  # one more, or one in the place of another
            state, ahead = further, ahead[-1:]  # what is left is seen best over the whole
            last = playoff(length, longest) if further is not None else length
    if now.found and state is None:
        state = grow(loop, now, longest, longest)
    count = len(now.found)
    now, state = needed(loop, now, state)
    if len(now.found) < count:  # what the dropped one stood for may now be seen for what it is
        now = now.refitted(cast(StateSpaceModel, state.best if state else before.model))
        more, further = _search(loop, now, longest, steps)
        if more.found is not now.found:
            now, state = more, further or grow(loop, more, longest, longest)
            now, state = needed(loop, now, state)
    return concluded(loop, now, state, steps)


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
    data = jax.device_put(data)
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
            return close(Loop(before, stages, data, rule, effort, say, pieces))
        except FitError as lost:
            say(f"  with what was added no sequence can be followed to its end ({lost}); nothing is kept of it")
            return Closed(before, before, (), ())

    before, pieces = fitted(data), ()
    if rule is not None:
        return closed(rule)
    if white_readings(data):
        outcome = closed(LikelihoodRule())
        if white_innovations(outcome.after, data):
            return apart(outcome, data)
        say("one-step errors follow each other, so that their likelihood proves nothing: multi-step errors decide")
        return closed(ShareRule())
    before, data, touches, pieces = disturbance_free(fitted, before, data)
    if touches:
        say(f"{len(touches)} touches from outside: their rows are left out")
    return closed(ShareRule())._replace(interventions=touches, pieces=pieces)
