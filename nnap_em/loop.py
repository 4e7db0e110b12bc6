"""Closing the loop: find what a fitted model lacks, add it, fit again, and look once more.

The horizon grows as in EM: a strong effect loses the hidden joint within seconds, so it is looked for where every
track still holds; a weak one needs the whole length.  At every horizon the score test proposes, short refits of the
few best compete, and the winner must also predict sequences that it was not fitted to.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, PRNGKeyArray

from .augment import augment, blocks, extended, proposals, seeded, surroundings, without
from .data import Dataset, horizon
from .effects import AbstractEffect, Candidate, fields, flat
from .effects.sensor import SensorQuantization, grid_step
from .em import EMState, FitError, Schedule, e_step, fit, start_state
from .gaussian import Gaussian
from .identify import Identified, identify
from .model import StateSpaceModel
from .mstep import ScoringMStep, kept
from .refit import Trial, refit
from .rig import Rig
from .screen import Verdict, judge, project, sheet, unlike
from .smoother import CubatureSmoother

Say = Callable[[str], None]
Key = tuple[str, int | None, str | None, tuple[str, ...]]
"""Name, joint, channel and inputs of an effect."""


class Rules(NamedTuple):
    """When an effect is believed."""

    shortlist: int = 5
    """Candidates that are refitted."""
    near: float = 0.4
    """Share of the best expected gain below which a candidate is not refitted."""
    starts: int = 3
    """Places from which a law that is not linear is refitted."""
    passes: int = 8
    """Passes of a refit."""
    margin: float = 12.0
    """Log-likelihood [nat] that must be left of a gain after paying half of log(readings) for every parameter."""
    matters: float = 0.002
    """The same for every reading: many readings make certain of what nobody would notice."""
    repeats: float = 0.3
    """Share of the gain that must be seen on sequences left out of the fit."""
    certain: float = 5.0
    """Standard deviations from zero that the strength must be."""
    most: int = 4
    """Effects at most."""
    named: float = 0.6
    """Share of the gain of an unnamed law that a named one must reach to be preferred."""
    rivals: float = 0.6
    """Share of the winner's gain from which on another one is followed further too."""
    same: float = 0.01
    """Share of an effect's information, where it was found, that an equivalent one may leave unexplained."""
    even: float = 5.0
    """Alternatives whose refit is within this many nats of the winner cannot be told from it."""


RULES = Rules()


class Refitted(NamedTuple):
    """A candidate after its refit."""

    candidate: Candidate
    verdict: Verdict
    trial: Trial
    gain: float
    """Log-likelihood over the model without it, after as many passes [nat]."""
    net: float
    """The gain after paying for its parameters."""
    alike: tuple[tuple[Key, float], ...] = ()
    """What would be lost with others in its place, by the overlap of their sensitivities [nat]."""

    @property
    def effect(self) -> AbstractEffect:
        """The effect with its fitted parameters."""
        return self.trial.model.effects[-1]


class Found(NamedTuple):
    """An effect that was accepted."""

    candidate: Candidate
    gain: float
    held_out: float
    """Gain on sequences that had no part in the fit, both halves together [nat]."""
    p_value: float
    """Of the likelihood ratio, times the number of candidates tried."""
    horizon: int
    """Rows of each sequence on which it was found."""
    equivalent: tuple[Key, ...] = ()
    """Effects that the data cannot tell from it."""


class Step(NamedTuple):
    """What was seen at one look, for the report."""

    horizon: int
    screened: tuple[tuple[Key, float], ...]
    """Best of every kind with its net expected gain [nat]."""
    refitted: tuple[tuple[Key, float], ...]
    accepted: Key | None
    tried: int
    """Candidates screened."""


class Closed(NamedTuple):
    """The outcome."""

    before: Identified
    after: Identified
    found: tuple[Found, ...]
    steps: tuple[Step, ...]


def key_of(effect: AbstractEffect) -> Key:
    """What tells two effects apart."""
    return effect.name, effect.joint, effect.channel, effect.inputs_named()


def _followed(
    now: "_Now", data: Dataset, before: Identified
) -> tuple[Gaussian, Bool[np.ndarray, " seq"], Bool[np.ndarray, " seq"], Dataset]:
    """Smoothed paths, the sequences that are followed whole and those used, and the data of the latter.

    A sequence that is lost tells most where it is being lost: it is used until a little later.
    """
    smoother = CubatureSmoother(before.bank.padded(now.model.log_q.shape[0]))
    posterior = e_step(now.model, data, smoother, key=before.state.key)
    whole = np.asarray(kept(posterior, data))
    if whole.all():
        return posterior.state, whole, whole, data
    dof = len(now.model.system.coordinates)
    kick = np.mean(np.asarray(posterior.kick), axis=2) / np.exp(0.5 * np.asarray(now.model.log_q))
    loud = ~(np.abs(kick[..., dof : 2 * dof]).max(axis=-1) < LOUD)
    first = np.where(loud.any(axis=1), loud.argmax(axis=1), data.t.shape[1])
    row = np.arange(data.t.shape[1])
    cut = data._replace(valid=data.valid & jnp.asarray(whole[:, None] | (row < first[:, None] + LATER)))
    posterior = e_step(now.model, cut, smoother, key=before.state.key)
    return posterior.state, whole, np.asarray(kept(posterior, cut)), cut


LOUD = 5.0
"""Standard deviations of a kick with which a track begins to be lost."""
LATER = 8
"""Rows after that which still count."""


class _Now(NamedTuple):
    """The model as it stands during the search."""

    model: StateSpaceModel
    m_step: ScoringMStep
    found: tuple[Found, ...]


def readings(data: Dataset) -> int:
    """Number of readings."""
    return int(np.sum(np.isfinite(np.asarray(data.y)) & np.asarray(data.valid)[..., None]))


def _price(count: int, data: Dataset) -> float:
    return 0.5 * count * math.log(max(readings(data), 2))


def _bar(data: Dataset, rules: Rules) -> float:
    return max(rules.margin, rules.matters * readings(data))


def _best_of_kind(
    candidates: Sequence[Candidate], verdicts: Sequence[Verdict], data: Dataset
) -> list[tuple[float, Candidate, Verdict]]:
    """The most promising member of every kind, best first."""
    best: dict[Key, tuple[float, Candidate, Verdict]] = {}
    for candidate, verdict in zip(candidates, verdicts, strict=True):
        if not seeded(candidate, verdict.coefficients).possible():
            continue
        net = verdict.gain - _price(verdict.rank, data)
        key = key_of(candidate.start)
        if key not in best or best[key][0] < net:
            best[key] = (net, candidate, verdict)
    return sorted(best.values(), key=lambda entry: -entry[0])


def rest_of(effect: AbstractEffect, model: StateSpaceModel) -> int | None:
    """Place of the named law whose rest an unnamed one is: a function of the same position at the same joint."""
    if effect.name != "unknown_function" or effect.joint is None:
        return None
    if effect.inputs_named() != (model.system.coordinates[effect.joint - 1],):
        return None
    return next((i for i, e in enumerate(model.effects) if e.place and e.joint == effect.joint), None)


def _told(effect: AbstractEffect, model: StateSpaceModel) -> bool:
    """Whether an unnamed law in the model is a function of the same position at the same joint."""
    if not effect.place or effect.joint is None:
        return False
    key = ("unknown_function", effect.joint, None, (model.system.coordinates[effect.joint - 1],))
    return key in map(key_of, model.effects)


def _shortlist(ranked, present: set[Key], model: StateSpaceModel, rules: Rules):
    """The few to be refitted: the best, and a law without a name only where it promises more than any with one."""
    fresh = [entry for entry in ranked if key_of(entry[1].start) not in present and entry[0] > rules.margin / 2]
    fresh = [entry for entry in fresh if not _told(entry[1].start, model)]
    named = [entry for entry in fresh if entry[1].start.name != "unknown_function"]
    top = named[0][0] if named else 0.0
    unnamed = [entry for entry in fresh if entry[1].start.name == "unknown_function" and entry[0] > top][:2]
    beside = [entry for entry in fresh if rest_of(entry[1].start, model) is not None]
    unnamed = (beside + [entry for entry in unnamed if entry not in beside])[:2]
    close = [entry for entry in named if entry[0] > rules.near * top]
    return [(c, v) for _, c, v in unnamed + close[: rules.shortlist - len(unnamed)]]


def _more_starts(entries, candidates: Sequence[Candidate], verdicts: Sequence[Verdict], rules: Rules):
    """The next best places to start from of laws that are not linear: the score test says less of them."""
    more = []
    for chosen, best in entries:
        if chosen.start.linear:
            continue
        own = [(c, v) for c, v in zip(candidates, verdicts, strict=True) if key_of(c.start) == key_of(chosen.start)]
        seen = {best.gain}
        for c, v in sorted(own, key=lambda pair: -pair[1].gain):
            if len(seen) < rules.starts and v.gain not in seen and v.gain > 0.3 * best.gain:
                seen.add(v.gain)
                more.append((c, v))
    return more


def _try(now: _Now, path: Gaussian, data: Dataset, used, candidate: Candidate, verdict: Verdict, rules: Rules) -> Trial:
    effect = seeded(candidate, verdict.coefficients)
    model, rule = augment(now.model, now.m_step.early(), effect, candidate)
    return refit(model, rule, extended(model, path, data), data, used, passes=rules.passes)


def significance(candidate: Candidate, model: StateSpaceModel, m_step: ScoringMStep, hessian, place: int = -1) -> float:
    """How many standard deviations the strengths of the effect at `place` are from none, jointly [Wald 1943].

    Half its square is the log-likelihood that would be lost without the effect, to second order.
    """
    here, prior = blocks(model, m_step)[place], m_step.prior
    none = np.asarray(flat(candidate.start))
    strong = np.any([np.asarray(flat(probe)) != none for probe in candidate.probes], axis=0)
    std, cov = np.asarray(prior.std)[here], np.linalg.inv(np.asarray(hessian))
    cut = cov.shape[0] - prior.size
    cov = (cov[cut:, cut:][here, here] * np.outer(std, std))[np.ix_(strong, strong)]
    away = (np.asarray(flat(model.effects[place])) - none)[strong]
    return float(np.sqrt(max(0.0, away @ np.linalg.pinv(cov, rcond=1e-12, hermitian=True) @ away)))


def _held_out(null: Trial, full: Trial, data: Dataset, used, passes: int = 3) -> float:
    """Gain on sequences after a fit to others, halves or quarters in turn; a sixth at either end is trimmed.

    A track that is lost in one of the two fits says nothing of the effect, and would say it loudest.  The noise stays
    that of the whole fit: a few sequences can be followed more closely than they deserve.
    """
    index = np.flatnonzero(used)
    gains = []
    folds = 2 if index.size >= 16 else min(4, index.size)
    for fold in range(folds):
        mask = used.copy()
        mask[index[fold::folds]] = False
        logliks = [
            refit(t.model, t.m_step, t.path, data, mask, passes=passes, noise=False).loglik[used & ~mask]
            for t in (null, full)
        ]
        gains.append(logliks[1] - logliks[0])
    return _trimmed(np.concatenate(gains))


def _chi2_tail(x: float, df: int) -> float:
    """P(chi^2_df > x)."""
    return float(jax.scipy.special.gammaincc(jnp.asarray(0.5 * df), jnp.asarray(0.5 * max(x, 0.0))))


def look(
    now: _Now, before: Identified, path: Gaussian, data: Dataset, used, rows: int, rules: Rules, say: Say
) -> tuple[Step, list[Refitted], Trial | None]:
    """One look at one horizon: everything screened, the best few refitted; those that hold, best first."""
    length = _longest(data)
    around = surroundings(before.rig, now.model, data, path)
    candidates = proposals(around)
    weights = now.m_step.weights(now.model)
    table = sheet(before.model, now.model, weights, candidates, path, data, rows)
    projected = project(table, np.asarray(used, float))
    verdicts = judge(projected, candidates)
    ranked = _best_of_kind(candidates, verdicts, data)
    present = {key_of(effect) for effect in now.model.effects}
    entries = _shortlist(ranked, present, now.model, rules)
    step = Step(length, tuple((key_of(c.start), net) for net, c, _ in ranked), (), None, len(candidates))
    if not entries:
        return step, [], None
    null = refit(now.model, now.m_step.early(), path, data, used, passes=rules.passes)
    entries += _more_starts(entries, candidates, verdicts, rules)
    tried: list[Refitted] = []
    for candidate, verdict in entries:
        trial = _try(now, path, data, used, candidate, verdict, rules)
        gain = float(np.sum((np.nan_to_num(trial.loglik, nan=-1e9) - null.loglik)[used]))
        count = verdict.rank if candidate.start.name == "unknown_function" else len(fields(candidate.start))
        shares = zip(candidates, unlike(projected, candidates, candidate), strict=True)
        lost = ((c, share * gain * (share > rules.same)) for c, share in shares)
        alike = tuple((key_of(c.start), nats) for c, nats in lost if _other(c, candidate))
        entry = Refitted(candidate, verdict, trial, gain, gain - _price(count, data), alike)
        same = next((i for i, e in enumerate(tried) if key_of(e.effect) == key_of(entry.effect)), None)
        if same is None:
            tried.append(entry)
        elif tried[same].net < entry.net:
            tried[same] = entry
        values = {n: float(f"{float(v):.4g}") for n, v in entry.effect.values().items()}
        say(f"  tried {_text(key_of(entry.effect))} {values}: expected {verdict.gain:.0f}, refit {gain:.0f} nat")
    tried.sort(key=lambda e: -e.net)
    step = step._replace(refitted=tuple((key_of(e.effect), e.net) for e in tried))
    sound = [e for e in tried if e.effect.possible() and e.net > _bar(data, rules) and _certain(e) > rules.certain]
    named = [e for e in sound if e.effect.name != "unknown_function"]
    if sound and named and sound[0] not in named:
        other = rest_of(sound[0].effect, now.model) is not None and named[0].effect.place
        if named[0].net > (0.9 if other else rules.named) * sound[0].net:
            sound = named
    return step, sound, null


def _certain(entry: Refitted) -> float:
    trial = entry.trial
    return significance(entry.candidate, trial.model, trial.m_step, trial.hessian)


def _other(candidate: Candidate, chosen: Candidate) -> bool:
    """A named effect of another kind."""
    return candidate.start.name != "unknown_function" and key_of(candidate.start) != key_of(chosen.start)


def _settle(
    now: _Now, before: Identified, data: Dataset, length: int, sound: list[Refitted], rules: Rules, say: Say
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
    ahead = lambda a, b: _trimmed(np.nan_to_num(a.top, nan=-1e3) - np.nan_to_num(b.top, nan=-1e3))  # noqa: E731
    winner, state = states[0]
    for rival, other in states[1:]:
        if ahead(other, state) > 0:
            winner, state = rival, other
    return winner, state, {key_of(rival.effect): ahead(state, other) for rival, other in states}


def _further(length: int, longest: int) -> int:
    """The horizon of a playoff."""
    return min(longest, SHORT if length < SHORT else round(2.5 * length))


def _trimmed(gain) -> float:
    """Sum of gains with a sixth at either end replaced by the mean of the others."""
    gain = np.sort(np.nan_to_num(gain, nan=-1e3))
    cut = gain.size // 6
    return float(np.mean(gain[cut : gain.size - cut]) * gain.size)


def _taken(now: _Now, entry: Refitted) -> _Now:
    """The search with a candidate in the model."""
    return _Now(entry.trial.model, now_rule(now.m_step, entry.trial.m_step), now.found)


def now_rule(old: ScoringMStep, new: ScoringMStep) -> ScoringMStep:
    """The new rule with the hold on process noise of the old one."""
    return eqx.tree_at(lambda r: r.tie, new, old.tie)


def _text(key: Key) -> str:
    name, joint, channel, inputs = key
    parts = [name, f"joint {joint}" if joint else "", channel or "", f"of {', '.join(inputs)}" if inputs else ""]
    return " ".join(part for part in parts if part)


def close(
    before: Identified,
    stages: dict[int, tuple[EMState, Bool[np.ndarray, " seq"]]],
    data: Dataset,
    *,
    rules: Rules = RULES,
    say: Say = lambda text: None,
) -> Closed:
    """Search for what `before` lacks; `stages` holds the state of its fit at the end of each horizon."""
    data = Dataset(*map(jnp.asarray, data))
    longest = _longest(data)
    now, steps = _Now(before.model, before.m_step, ()), []
    # steps in a reading come first: they spoil the noise that all else leans on
    now, state = _quantised(now, before, data, rules, say)
    last = longest if state else 0
    for length in [longest] if state else _lengths(stages, longest):
        if now.found and (state is None or last < length):
            state = _grow(now, data, before, last, length, say, state)
        own = stages[length][0].best if length < longest else before.model
        now = now._replace(model=state.best if state else own)
        part, last, known = _part(data, length), length, len(now.found)
        now, further = _search(now, before, part, length, data, steps, rules, say)
        if steps[-1].accepted or len(now.found) > known:
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
        if len(more.found) > len(now.found):
            now, state = more, trial or _grow(more, data, before, longest, longest, say)
            now, state = _needed(now, state, before, data, rules, say)
    if state is None:
        return Closed(before, before, (), tuple(steps))
    after = Identified(before.rig, state, now.m_step, before.bank.padded(state.best.log_q.shape[0]))
    return Closed(before, after, now.found, tuple(steps))


def _search(
    now: _Now, before: Identified, every: Dataset, length: int, data: Dataset, steps: list[Step], rules: Rules, say: Say
) -> tuple[_Now, EMState | None]:
    """Look at one horizon until nothing more is found; a fit to a longer one, where a playoff made it."""
    while len(now.found) < rules.most:
        path, whole, used, part = _followed(now, every, before)
        say(f"horizon {length * before.rig.dt:.2f} s: {whole.sum()} of {whole.size} sequences followed")
        step, sound, null = look(now, before, path, part, used, data.t.shape[1], rules, say)
        steps.append(step)
        if not sound or null is None:
            break
        winner, further, behind = _settle(now, before, data, length, sound, rules, say)
        held_out = _held_out(null, winner.trial, part, used)
        say(f"  best: {_text(key_of(winner.effect))}, {winner.net:.0f} nat net, {held_out:.0f} held out")
        if held_out < max(_bar(part, rules) / 2, rules.repeats * winner.net):
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
            say(f"  {_text(key_of(dropped))} was a part of it")
            further = None
        else:
            now = _taken(now, winner)
        now = now._replace(found=(*now.found, found))
        steps[-1] = step._replace(accepted=key_of(winner.effect))
        say(f"  added {_text(key_of(winner.effect))}")
        if further is not None:
            return now, further
    return now, None


def _plain(
    now: _Now, winner: Refitted, null: Trial, path: Gaussian, part: Dataset, used, rules: Rules
) -> tuple[_Now, AbstractEffect] | None:
    """The search with an unnamed law in place of a named one and its rest, where the named one says the lesser part."""
    place = rest_of(winner.effect, now.model)
    if place is None:
        return None
    model, rule = without(now.model, now.m_step, place)
    bare = refit(model, rule.early(), path, part, used, passes=rules.passes)
    whole, own = (_trimmed((trial.loglik - bare.loglik)[used]) for trial in (winner.trial, null))
    if own > rules.named * whole:
        return None
    model, rule = augment(bare.model, rule, winner.effect, winner.candidate)
    trial = refit(model, rule.early(), bare.path, part, used, passes=rules.passes)
    found = tuple(f for i, f in enumerate(now.found) if i != place)
    return _Now(trial.model, rule, found), now.model.effects[place]


def _needed(now: _Now, state: EMState | None, before: Identified, data: Dataset, rules: Rules, say: Say):
    """The search without the effects that later ones made needless."""
    while state is not None and now.found:
        model = cast(StateSpaceModel, state.best)
        losses = [_loss(f, model, now.m_step, state.hessian, i) for i, f in enumerate(now.found)]
        least = int(np.argmin(losses))
        if losses[least] > _bar(data, rules):
            break
        say(f"  {_text(key_of(now.found[least].candidate.start))} is needless now: {losses[least]:.0f} nat")
        model, rule = without(model, now.m_step, least)
        now = _Now(model, rule, tuple(f for i, f in enumerate(now.found) if i != least))
        state = _grow(now, data, before, _longest(data), _longest(data), say) if now.found else None
    return now, state


def _loss(found: Found, model: StateSpaceModel, m_step: ScoringMStep, hessian, place: int) -> float:
    """Log-likelihood that goes with an effect [nat]; none with one whose value makes no sense, all with steps seen."""
    effect = model.effects[place]
    if isinstance(effect, SensorQuantization):
        return math.inf
    return 0.5 * significance(found.candidate, model, m_step, hessian, place) ** 2 if effect.possible() else 0.0


def _longest(data: Dataset) -> int:
    return int(np.max(np.sum(np.asarray(data.valid), axis=1)))


def _quantised(now: _Now, before: Identified, data: Dataset, rules: Rules, say: Say):
    """Readings that come in steps larger than their noise: seen in the numbers themselves, modelled as noise."""
    rig, state = before.rig, None
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
        full, rule = augment(model, now.m_step, effect, candidate)
        if told:
            log_r = full.log_r.at[i].set(math.log(told**2 + step**2 / 12))
            full = eqx.tree_at(lambda m: m.log_r, full, log_r)
        now = _Now(full, rule, (*now.found, Found(candidate, float(gain), float(gain), 0.0, data.t.shape[1])))
        state = _grow(now, data, before, _longest(data), _longest(data), say)
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
    now: _Now, data: Dataset, before: Identified, first: int, length: int, say: Say, state: EMState | None = None
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
    stages: dict[int, tuple[EMState, Bool[np.ndarray, " seq"]]] = {}

    def watch(state: EMState, seen: int, used: Bool[np.ndarray, " seq"]) -> None:
        stages[seen] = (state, used)
        say(f"epoch {state.epoch}, horizon {seen * rig.dt:.2f} s: {state.loglik[-1]:.1f} nat per sequence")

    before = identify(rig, data, key=key, watch=watch)
    try:
        return close(before, stages, data, rules=rules, say=say)
    except FitError as lost:
        say(f"  with what was added no sequence can be followed to its end ({lost}); nothing is kept of it")
        return Closed(before, before, (), ())
