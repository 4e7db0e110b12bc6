"""Closing the loop: find what a fitted model lacks, add it, fit again, and look once more.

The horizon grows as in EM: a strong effect loses the hidden joint within seconds, so it is looked for where every
track still holds; a weak one needs the whole length.  At every horizon the score test proposes, short refits of the
few best compete, and the winner must also predict sequences that it was not fitted to.
"""

import math
from typing import NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, PRNGKeyArray

from .augment import augment, without
from .data import Dataset, horizon
from .effects import AbstractEffect, Candidate, fields
from .effects.sensor import SensorQuantization, grid_step
from .em import EMState, FitError, Schedule, e_step, fit, start_state
from .gaussian import Gaussian
from .identify import Identified, identify
from .look import (
    RULES,
    Found,
    Key,
    Refitted,
    Rules,
    Say,
    Search,
    Step,
    bar,
    held_out_gain,
    key_of,
    look,
    replaced,
    rest_of,
    significance,
    trimmed,
    words,
)
from .model import StateSpaceModel
from .mstep import ScoringMStep, kept
from .refit import Trial, refit
from .rig import Rig
from .smoother import CubatureSmoother

Stages = dict[int, tuple[EMState, Bool[np.ndarray, " seq"]]]
"""State of a fit at the end of each of its horizons, and the sequences used."""


class Closed(NamedTuple):
    """The outcome."""

    before: Identified
    after: Identified
    found: tuple[Found, ...]
    steps: tuple[Step, ...]


def _followed(
    now: Search, data: Dataset, before: Identified, rules: Rules
) -> tuple[Gaussian, Bool[np.ndarray, " seq"], Bool[np.ndarray, " seq"], Dataset]:
    """Smoothed paths, the sequences that are followed whole and those used, and the data of the latter.

    A sequence that is lost tells most where it is being lost: it is used until a little later, as late as it can be.
    """
    smoother = CubatureSmoother(before.bank.padded(now.model.log_q.shape[0]))
    posterior = e_step(now.model, data, smoother, key=before.state.key)
    whole = np.asarray(kept(posterior, data))
    if whole.all():
        return posterior.state, whole, whole, data
    dof = len(now.model.system.coordinates)
    kick = np.mean(np.asarray(posterior.kick), axis=2) / np.exp(0.5 * np.asarray(now.model.log_q))
    loud = ~(np.abs(kick[..., dof : 2 * dof]).max(axis=-1) < rules.loud)
    first = np.where(loud.any(axis=1), loud.argmax(axis=1), data.t.shape[1])
    row = np.arange(data.t.shape[1])
    used, cut = whole, data
    for later in rules.later:
        early = data.valid & jnp.asarray(row < first[:, None] + later)
        cut = cut._replace(valid=jnp.where(jnp.asarray(used)[:, None], cut.valid, early))
        posterior = e_step(now.model, cut, smoother, key=before.state.key)
        used = np.asarray(kept(posterior, cut))
        if used.all():
            break
    return posterior.state, whole, used, cut


def _chi2_tail(x: float, df: int) -> float:
    """P(chi^2_df > x)."""
    return float(jax.scipy.special.gammaincc(jnp.asarray(0.5 * df), jnp.asarray(0.5 * max(x, 0.0))))


def _settle(
    now: Search, before: Identified, data: Dataset, length: int, sound: list[Refitted], rules: Rules, say: Say
) -> tuple[Refitted, EMState | None, dict[Key, float]]:
    """The winner; where the next ones are near, each is followed to a longer horizon, where the wrong ones fail.

    With it the fit to that horizon, and how many nats each rival fell behind there.
    """
    rivals = [e for e in sound if e.net > rules.rivals * sound[0].net][:3]
    longest = _longest(data)
    if len(rivals) == 1 or length == longest:
        return sound[0], None, {}
    further = _further(length, longest)
    say(f"  {len(rivals)} of them are near: followed to {further * before.rig.dt:.2f} s")
    states: list[tuple[Refitted, EMState]] = []
    for rival in rivals:
        try:
            states.append((rival, _grow(_taken(now, rival), data, before, length, further, say)))
        except FitError:
            continue
    if not states:
        return sound[0], None, {}
    ahead = lambda a, b: trimmed(np.nan_to_num(a.top, nan=-1e3) - np.nan_to_num(b.top, nan=-1e3))  # noqa: E731
    winner, state = states[0]
    for rival, other in states[1:]:
        if ahead(other, state) > 0:
            winner, state = rival, other
    return winner, state, {key_of(rival.effect): ahead(state, other) for rival, other in states}


def _further(length: int, longest: int) -> int:
    """The horizon of a playoff."""
    return min(longest, SHORT if length < SHORT else round(2.5 * length))


def _taken(now: Search, entry: Refitted) -> Search:
    """The search with a candidate in the model."""
    place = replaced(entry.effect, now.model)
    kept = tuple(f for i, f in enumerate(now.found) if i != place)
    return Search(entry.trial.model, now_rule(now.m_step, entry.trial.m_step), kept)


def now_rule(old: ScoringMStep, new: ScoringMStep) -> ScoringMStep:
    """The new rule with the hold on process noise of the old one."""
    return eqx.tree_at(lambda r: r.tie, new, old.tie)


def close(
    before: Identified,
    stages: Stages,
    data: Dataset,
    *,
    rules: Rules = RULES,
    say: Say = lambda text: None,
) -> Closed:
    """Search for what `before` lacks; `stages` holds the state of its fit at the end of each horizon."""
    data = Dataset(*map(jnp.asarray, data))
    longest = _longest(data)
    now, steps = Search(before.model, before.m_step, ()), []
    # steps in a reading come first: they spoil the noise that all else leans on
    now, state = _quantised(now, before, stages, data, rules, say)
    last = longest if state else 0
    for length in [longest] if state else _lengths(stages, longest):
        if now.found and (state is None or last < length):
            state = _grow(now, data, before, last, length, say, state)
        own = stages[length][0].best if length < longest else before.model
        now = now._replace(model=state.best if state else own)
        part, last, known = _part(data, length), length, now.found
        now, further = _search(now, before, part, length, data, steps, rules, say)
        if now.found is not known:  # one more, or one in the place of another
            state = further
            last = _further(length, longest) if further is not None else length
    if now.found and state is None:
        state = _grow(now, data, before, longest, longest, say)
    count = len(now.found)
    now, state = _needed(now, state, before, data, rules, say)
    if len(now.found) < count:  # what the dropped one stood for may now be seen for what it is
        now = now._replace(model=state.best if state else before.model)
        part = _part(data, longest)
        more, trial = _search(now, before, part, longest, data, steps, rules, say)
        if more.found is not now.found:
            now, state = more, trial or _grow(more, data, before, longest, longest, say)
            now, state = _needed(now, state, before, data, rules, say)
    if state is None:
        return Closed(before, before, (), tuple(steps))
    gain = trimmed(np.nan_to_num(state.top, nan=-1e3) - np.nan_to_num(before.state.top, nan=-1e3))
    stepped = any(e.read_off for e in cast(StateSpaceModel, state.best).effects)
    if gain < bar(data, rules) and not stepped:  # steps were read off the numbers themselves
        say(f"  over the whole length that gains {gain:.0f} nat only; nothing is kept of it")
        return Closed(before, before, (), tuple(steps))
    after = Identified(before.rig, state, now.m_step, before.bank.padded(state.best.log_q.shape[0]))
    return Closed(before, after, now.found, tuple(steps))


def _search(
    now: Search,
    before: Identified,
    every: Dataset,
    length: int,
    data: Dataset,
    steps: list[Step],
    rules: Rules,
    say: Say,
) -> tuple[Search, EMState | None]:
    """Look at one horizon until nothing more is found; a fit to a longer one, where a playoff made it."""
    while len(now.found) < rules.most:
        path, whole, used, part = _followed(now, every, before, rules)
        say(f"horizon {length * before.rig.dt:.2f} s: {whole.sum()} of {whole.size} sequences followed")
        step, sound, null = look(now, before, path, part, used, data.t.shape[1], rules, say)
        steps.append(step)
        if not sound or null is None:
            break
        winner, further, behind = _settle(now, before, data, length, sound, rules, say)
        held_out = held_out_gain(null, winner.trial, part, used)
        say(f"  best: {words(key_of(winner.effect))}, {winner.net:.0f} nat net, {held_out:.0f} held out")
        if held_out < max(bar(part, rules) / 2, rules.repeats * winner.net):
            break
        count = len(fields(winner.candidate.start))
        p_value = min(1.0, _chi2_tail(2 * winner.gain, count) * step.tried)
        refitted = {key_of(e.effect): winner.gain - e.gain for e in sound}
        told = {key: max(lost, behind.get(key, 0.0)) for key, lost in refitted.items()}
        same = dict.fromkeys(k for k, lost in winner.alike if max(lost, told.get(k, 0.0)) < rules.even)
        found = Found(winner.candidate, winner.gain, held_out, p_value, length, tuple(same))
        plain = _plain(now, winner, null, path, part, used, rules)
        if plain is not None:
            now, dropped = plain
            say(f"  {words(key_of(dropped))} was a part of it")
            further = None
        else:
            now = _taken(now, winner)
        now = now._replace(found=(*now.found, found))
        steps[-1] = step._replace(accepted=key_of(winner.effect))
        say(f"  added {words(key_of(winner.effect))}")
        if further is not None:
            return now, further
    return now, None


def _plain(
    now: Search, winner: Refitted, null: Trial, path: Gaussian, part: Dataset, used, rules: Rules
) -> tuple[Search, AbstractEffect] | None:
    """The search with an unnamed law in place of a named one and its rest, where the named one says the lesser part."""
    place = rest_of(winner.effect, now.model)
    if place is None or replaced(winner.effect, now.model) is not None:
        return None
    model, rule = without(now.model, now.m_step, place)
    bare = refit(model, rule.early(), path, part, used, passes=rules.passes)
    whole, own = (trimmed((trial.loglik - bare.loglik)[used]) for trial in (winner.trial, null))
    if own > rules.says * whole:
        return None
    model, rule = augment(bare.model, rule, winner.effect, winner.candidate)
    trial = refit(model, rule.early(), bare.path, part, used, passes=rules.passes)
    found = tuple(f for i, f in enumerate(now.found) if i != place)
    return Search(trial.model, rule, found), now.model.effects[place]


def _needed(now: Search, state: EMState | None, before: Identified, data: Dataset, rules: Rules, say: Say):
    """The search without the effects that later ones made needless."""
    while state is not None and now.found:
        model = cast(StateSpaceModel, state.best)
        losses = [_loss(f, model, now.m_step, state.hessian, i) for i, f in enumerate(now.found)]
        least = int(np.argmin(losses))
        if losses[least] > bar(data, rules):
            break
        say(f"  {words(key_of(now.found[least].candidate.start))} is needless now: {losses[least]:.0f} nat")
        model, rule = without(model, now.m_step, least)
        now = Search(model, rule, tuple(f for i, f in enumerate(now.found) if i != least))
        state = _grow(now, data, before, _longest(data), _longest(data), say) if now.found else None
    return now, state


def _loss(found: Found, model: StateSpaceModel, m_step: ScoringMStep, hessian, place: int) -> float:
    """Log-likelihood that goes with an effect [nat]; none with one whose value makes no sense, all with steps seen."""
    effect = model.effects[place]
    if effect.read_off:
        return math.inf
    return 0.5 * significance(found.candidate, model, m_step, hessian, place) ** 2 if effect.possible() else 0.0


def _longest(data: Dataset) -> int:
    return int(np.max(np.sum(np.asarray(data.valid), axis=1)))


def _quantised(now: Search, before: Identified, stages: Stages, data: Dataset, rules: Rules, say: Say):
    """Readings that come in steps larger than their noise: seen in the numbers themselves, modelled as noise.

    A fit that took the steps for motion has lost its way: it begins again where it was short.
    """
    rig, state = before.rig, None
    first = min(stages)
    for i, channel in enumerate(rig.measured):
        y = np.asarray(data.y)[..., i]
        step = grid_step(y.ravel())
        model = cast(StateSpaceModel, state.best if state else now.model)
        told, now_r = rig.noise_std.get(channel), float(jnp.exp(model.log_r[i]))
        share = step**2 / 12 / (told**2 if told else max(now_r - step**2 / 12, 0.25 * now_r))
        gain = 0.5 * np.isfinite(y).sum() * (share - math.log1p(share))  # of the right variance over that without it
        if gain < rules.margin or share < 0.1:
            continue
        say(f"  {channel} comes in steps of {step:.4g}")
        effect = SensorQuantization(step=jnp.asarray(step), channel=channel)
        spread = SensorQuantization(step=jnp.asarray(1e-3 * step), channel=channel)
        candidate = Candidate(effect, (effect,), spread)
        early = cast(StateSpaceModel, state.best if state else stages[first][0].best)
        full, rule = augment(early, now.m_step, effect, candidate)
        if told:
            log_r = full.log_r.at[i].set(math.log(told**2 + step**2 / 12))
            full = eqx.tree_at(lambda m: m.log_r, full, log_r)
        now = Search(full, rule, (*now.found, Found(candidate, float(gain), float(gain), 0.0, data.t.shape[1])))
        state = _grow(now, data, before, first, _longest(data), say)
    return now, state


SHORT = 150
"""Rows to which short horizons are cut, so that they share their programs."""


def _lengths(stages, longest: int) -> list[int]:
    """Horizons at which to look: the first two, one in the middle, the whole."""
    short = [h for h in sorted(stages) if h < longest]
    chosen = [h for h in short if h <= SHORT][:2] + [h for h in short if longest / 3 < h < 0.7 * longest][:1]
    return list(dict.fromkeys([*chosen, longest]))


def _part(data: Dataset, length: int) -> Dataset:
    """The first `length` rows."""
    part = horizon(data, length)
    return jax.tree.map(lambda a: a[:, :SHORT], part) if length <= SHORT else part


LOOSER = 3.0
"""What is added to the log of the process noise where every track is lost."""


def _grow(
    now: Search, data: Dataset, before: Identified, first: int, length: int, say: Say, state: EMState | None = None
) -> EMState:
    """EM of the model as it stands, from the horizon where it was found (or from `state`) to a longer one."""
    part = _part(data, length)
    if state is not None:
        now = now._replace(model=state.best)
    schedule = Schedule(first=min(first, length), growth=1.6, hold=1)
    growing = math.ceil(math.log(length / schedule.first) / math.log(1.6)) if length > schedule.first else 0
    smoother = CubatureSmoother(before.bank.padded(now.model.log_q.shape[0]))
    epochs = growing + (8 if length == _longest(data) else 3)

    def run(model: StateSpaceModel) -> EMState:
        begun = start_state(model, now.m_step, key=before.state.key)._replace(epoch=1)
        return fit(begun, part, smoother, now.m_step, epochs=epochs, schedule=schedule)

    try:
        state = run(now.model)
    except FitError:  # a looser filter keeps a track that a tight one loses
        state = run(eqx.tree_at(lambda m: m.log_q, now.model, now.model.log_q + LOOSER))
    reach = f"{length * before.rig.dt:.2f} s"
    say(f"  fitted over {reach} in {state.epoch - 1} epochs: {state.loglik[-1]:.1f} nat per sequence")
    return state


def close_the_loop(
    rig: Rig,
    data: Dataset,
    *,
    key: PRNGKeyArray,
    rules: Rules = RULES,
    say: Say = lambda text: None,
) -> Closed:
    """Fit the declared unknowns of `rig`, find what it lacks, add that, and fit again.

    Raises FitError when no sequence can be followed.
    """
    stages: Stages = {}

    def watch(state: EMState, seen: int, used: Bool[np.ndarray, " seq"]) -> None:
        stages[seen] = (state, used)
        say(f"epoch {state.epoch}, horizon {seen * rig.dt:.2f} s: {state.loglik[-1]:.1f} nat per sequence")

    if len(data.t) < 2:
        say("one sequence: nothing can be held out, so that no effect will be believed; record at least two")
    before = identify(rig, data, key=key, watch=watch)
    try:
        return close(before, stages, data, rules=rules, say=say)
    except FitError as lost:
        say(f"  with what was added no sequence can be followed to its end ({lost}); nothing is kept of it")
        return Closed(before, before, (), ())
