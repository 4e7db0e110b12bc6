"""One look at one horizon: everything screened by the score test, the best few refitted and judged."""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import numpy as np

from .augment import augment, blocks, extended, proposals, seeded, surroundings, without
from .data import Dataset
from .effects import AbstractEffect, Candidate, fields, flat
from .gaussian import Gaussian
from .identify import Identified
from .model import StateSpaceModel
from .mstep import ScoringMStep
from .refit import Trial, refit
from .screen import Verdict, judge, screen, unlike

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
    says: float = 0.8
    """Share of a force that a named law must say to stay when its rest is found."""
    rivals: float = 0.6
    """Share of the winner's gain from which on another one is followed further too."""
    same: float = 0.01
    """Share of an effect's information, where it was found, that an equivalent one may leave unexplained."""
    loud: float = 5.0
    """Standard deviations of a kick with which a track begins to be lost."""
    later: tuple[int, ...] = (8, 3, 1)
    """Rows after that which still count; the fewer where the many are too much."""
    even: float = 5.0
    """Alternatives whose refit is within this many nats of the winner cannot be told from it."""


RULES = Rules()


def key_of(effect: AbstractEffect) -> Key:
    """What tells two effects apart."""
    return effect.name, effect.joint, effect.channel, effect.inputs_named()


def words(key: Key) -> str:
    """An effect as a reader would call it."""
    name, joint, channel, inputs = key
    text = name.replace("_", " ")
    if inputs:
        text += f" of {' and '.join(inputs)}"
    return text + (f" at joint {joint}" if joint else "") + (f" on {channel}" if channel else "")


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


class Search(NamedTuple):
    """The model as it stands during the search."""

    model: StateSpaceModel
    m_step: ScoringMStep
    found: tuple[Found, ...]


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


class Step(NamedTuple):
    """What was seen at one look, for the report."""

    horizon: int
    screened: tuple[tuple[Key, float], ...]
    """Best of every kind with its net expected gain [nat]."""
    refitted: tuple[tuple[Key, float], ...]
    accepted: Key | None
    tried: int
    """Candidates screened."""


def readings(data: Dataset) -> int:
    """Number of readings."""
    return int(np.sum(np.isfinite(np.asarray(data.y)) & np.asarray(data.valid)[..., None]))


def _price(count: int, data: Dataset) -> float:
    return 0.5 * count * math.log(max(readings(data), 2))


def bar(data: Dataset, rules: Rules) -> float:
    """Log-likelihood that an effect must be worth on these data [nat]."""
    return max(rules.margin, rules.matters * readings(data))


def rest_of(effect: AbstractEffect, model: StateSpaceModel) -> int | None:
    """Place of the named law whose rest an unnamed one is: a function of the same position at the same joint."""
    if effect.named or effect.joint is None:
        return None
    if effect.inputs_named() != (model.system.coordinates[effect.joint - 1],):
        return None
    return next((i for i, e in enumerate(model.effects) if e.place and e.joint == effect.joint), None)


def replaced(effect: AbstractEffect, model: StateSpaceModel) -> int | None:
    """Place of the law whose place `effect` takes: of the same key in another form, as one that repeats each turn."""
    alike = (i for i, e in enumerate(model.effects) if key_of(e) == key_of(effect))
    return next((i for i in alike if jax.tree.structure(model.effects[i]) != jax.tree.structure(effect)), None)


def _told(effect: AbstractEffect, model: StateSpaceModel) -> bool:
    """Whether an unnamed law in the model is a function of the same position at the same joint."""
    if not effect.place or effect.joint is None:
        return False
    own = (model.system.coordinates[effect.joint - 1],)
    return any(e.joint == effect.joint and e.inputs_named() == own for e in model.effects)


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


def _shortlist(ranked, present: set[Key], model: StateSpaceModel, needed: float, rules: Rules):
    """The few to be refitted: the best, and a law without a name only where it promises more than any with one."""
    other = [entry for entry in ranked if replaced(entry[1].start, model) is not None and entry[0] > needed]
    fresh = other + [entry for entry in ranked if key_of(entry[1].start) not in present and entry[0] > needed]
    fresh = [entry for entry in fresh if not _told(entry[1].start, model)]
    named = [entry for entry in fresh if entry[1].start.named]
    top = named[0][0] if named else 0.0
    unnamed = [entry for entry in fresh if not entry[1].start.named and entry[0] > top][:2]
    beside = other + [entry for entry in fresh if rest_of(entry[1].start, model) is not None and entry not in other]
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


def _try(
    now: Search, path: Gaussian, data: Dataset, used, candidate: Candidate, verdict: Verdict, rules: Rules
) -> Trial:
    effect, model, rule = seeded(candidate, verdict.coefficients), now.model, now.m_step.early()
    place = replaced(effect, model)
    if place is not None:
        model, rule = without(model, rule, place)
    model, rule = augment(model, rule, effect, candidate)
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


def _certain(entry: Refitted) -> float:
    trial = entry.trial
    return significance(entry.candidate, trial.model, trial.m_step, trial.hessian)


def _other(candidate: Candidate, chosen: Candidate) -> bool:
    """A named effect of another kind."""
    return candidate.start.named and key_of(candidate.start) != key_of(chosen.start)


def look(
    now: Search, before: Identified, path: Gaussian, data: Dataset, used, rows: int, rules: Rules, say: Say
) -> tuple[Step, list[Refitted], Trial | None]:
    """One look at one horizon: everything screened, the best few refitted; those that hold, best first."""
    length = int(np.max(np.sum(np.asarray(data.valid), axis=1)))
    around = surroundings(before.rig, now.model, data, path, rows)
    candidates = proposals(around)
    weights = now.m_step.weights(now.model)
    projected = screen(before.model, now.model, weights, candidates, path, data, used, rows)
    verdicts = judge(projected, candidates)
    ranked = _best_of_kind(candidates, verdicts, data)
    present = {key_of(effect) for effect in now.model.effects}
    entries = _shortlist(ranked, present, now.model, 0.5 * bar(data, rules), rules)
    step = Step(length, tuple((key_of(c.start), net) for net, c, _ in ranked), (), None, len(candidates))
    if not entries:
        return step, [], None
    null = refit(now.model, now.m_step.early(), path, data, used, passes=rules.passes)
    if data.t.shape[1] < rows:  # over a long horizon a start that is far off loses every track
        entries += _more_starts(entries, candidates, verdicts, rules)
    tried: list[Refitted] = []
    for candidate, verdict in entries:
        trial = _try(now, path, data, used, candidate, verdict, rules)
        gain = float(np.sum((np.nan_to_num(trial.loglik, nan=-1e9) - null.loglik)[used]))
        count = len(fields(candidate.start)) if candidate.start.named else verdict.rank
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
        say(f"  tried {words(key_of(entry.effect))} {values}: expected {verdict.gain:.0f}, refit {gain:.0f} nat")
    tried.sort(key=lambda e: -e.net)
    step = step._replace(refitted=tuple((key_of(e.effect), e.net) for e in tried))
    sound = [e for e in tried if e.effect.possible() and e.net > bar(data, rules) and _certain(e) > rules.certain]
    named = [e for e in sound if e.effect.named]
    if sound and named and sound[0] not in named:
        other = rest_of(sound[0].effect, now.model) is not None and named[0].effect.place
        if named[0].net > (0.9 if other else rules.named) * sound[0].net:
            sound = named
    return step, sound, null


def trimmed(gain) -> float:
    """Sum of gains with a sixth at either end replaced by the mean of the others."""
    gain = np.sort(np.nan_to_num(gain, nan=-1e3))
    cut = gain.size // 6
    return float(np.mean(gain[cut : gain.size - cut]) * gain.size)


def held_out_gain(null: Trial, full: Trial, data: Dataset, used, passes: int = 3) -> float:
    """Gain on sequences after a fit to others, halves or quarters in turn; a sixth at either end is trimmed.

    A track that is lost in one of the two fits says nothing of the effect, and would say it loudest.  The noise stays
    that of the whole fit: a few sequences can be followed more closely than they deserve.  From one sequence nothing
    can be held out, and the gain is 0.
    """
    index = np.flatnonzero(used)
    if index.size < 2:
        return 0.0
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
    return trimmed(np.concatenate(gains))
