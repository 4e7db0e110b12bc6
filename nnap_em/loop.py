"""Closing the loop: find what a fitted model lacks, add it, fit again, and look once more.

The horizon grows as in EM: a strong effect loses the hidden joint within seconds, so it is looked for where every
track still holds; a weak one needs the whole length.  At every horizon the score test proposes, short refits of the
few best compete, and the winner must also predict sequences that it was not fitted to.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from .augment import augment, extended, proposals, seeded, surroundings
from .data import Dataset, horizon
from .effects import AbstractEffect, Candidate, fields
from .em import EMState, Schedule, fit, start_state
from .gaussian import Gaussian
from .identify import Identified, identify
from .model import StateSpaceModel
from .mstep import ScoringMStep, kept
from .refit import Trial, refit
from .rig import Rig
from .screen import Verdict, judge, project, sheet
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
    passes: int = 5
    """Passes of a refit."""
    margin: float = 12.0
    """Log-likelihood [nat] that must be left of a gain after paying half of log(readings) for every parameter."""
    certain: float = 5.0
    """Standard deviations from zero that the strength must be."""
    most: int = 4
    """Effects at most."""
    named: float = 0.6
    """Share of the gain of an unnamed law that a named one must reach to be preferred."""
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
    rivals: tuple[tuple[Key, float], ...]
    """Refitted alternatives and how much less they gained [nat]."""


class Step(NamedTuple):
    """What was seen at one look, for the report."""

    horizon: int
    screened: tuple[tuple[Key, float], ...]
    """Best of every kind with its net expected gain [nat]."""
    refitted: tuple[tuple[Key, float], ...]
    accepted: Key | None


class Closed(NamedTuple):
    """The outcome."""

    before: Identified
    after: Identified
    found: tuple[Found, ...]
    steps: tuple[Step, ...]


def key_of(effect: AbstractEffect) -> Key:
    """What tells two effects apart."""
    return effect.name, effect.joint, effect.channel, effect.inputs_named()


@eqx.filter_jit
def _smoothed(model, data: Dataset, smoother) -> tuple[Gaussian, Float[Array, " seq"], Bool[Array, " seq"]]:
    posterior = jax.vmap(lambda seq: smoother(model, seq))(data)
    return posterior.state, posterior.loglik, kept(posterior, data)


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


def _best_of_kind(
    candidates: Sequence[Candidate], verdicts: Sequence[Verdict], data: Dataset
) -> list[tuple[float, Candidate, Verdict]]:
    """The most promising member of every kind, best first."""
    best: dict[Key, tuple[float, Candidate, Verdict]] = {}
    for candidate, verdict in zip(candidates, verdicts, strict=True):
        net = verdict.gain - _price(verdict.rank, data)
        key = key_of(candidate.start)
        if key not in best or best[key][0] < net:
            best[key] = (net, candidate, verdict)
    return sorted(best.values(), key=lambda entry: -entry[0])


def _shortlist(ranked, present: set[Key], rules: Rules):
    """The few to be refitted: the best, and a law without a name only where it promises more than any with one."""
    fresh = [entry for entry in ranked if key_of(entry[1].start) not in present and entry[0] > rules.margin / 2]
    named = [entry for entry in fresh if entry[1].start.name != "unknown_function"]
    top = named[0][0] if named else 0.0
    unnamed = [entry for entry in fresh if entry[1].start.name == "unknown_function" and entry[0] > top][:2]
    close = [entry for entry in named if entry[0] > rules.near * top]
    return [(c, v) for _, c, v in unnamed + close[: rules.shortlist - len(unnamed)]]


def _try(now: _Now, path: Gaussian, data: Dataset, used, candidate: Candidate, verdict: Verdict, rules: Rules) -> Trial:
    effect = seeded(candidate, verdict.coefficients)
    model, rule = augment(now.model, now.m_step.early(), effect, candidate)
    return refit(model, rule, extended(model, path, data), data, used, passes=rules.passes)


def _significance(candidate: Candidate, trial: Trial) -> float:
    """How many standard deviations the last effect's strengths are from none, jointly."""
    effect = trial.model.effects[-1]
    flat = lambda e: np.concatenate([np.ravel(getattr(e, name)) for name in fields(e)])  # noqa: E731
    none = flat(candidate.start)
    strong = np.any([flat(probe) != none for probe in candidate.probes], axis=0)
    std = np.asarray(trial.m_step.prior.std)[-none.size :]
    cov = np.linalg.inv(np.asarray(trial.hessian))[-none.size :, -none.size :] * np.outer(std, std)
    away = (flat(effect) - none)[strong]
    return float(np.sqrt(away @ np.linalg.solve(cov[np.ix_(strong, strong)], away)))


def _held_out(null: Trial, full: Trial, data: Dataset, used, passes: int = 3) -> float:
    """Gain on each half of the sequences after a fit to the other; a sixth at either end is trimmed.

    A track that is lost in one of the two fits says nothing of the effect, and would say it loudest.
    """
    index = np.flatnonzero(used)
    gains = []
    for half in (index[::2], index[1::2]):
        mask = np.zeros_like(used)
        mask[half] = True
        logliks = [
            refit(t.model, t.m_step, t.path, data, mask, passes=passes).loglik[used & ~mask] for t in (null, full)
        ]
        gains.append(logliks[1] - logliks[0])
    gain = np.sort(np.nan_to_num(np.concatenate(gains), nan=-1e3))
    cut = gain.size // 6
    return float(np.mean(gain[cut : gain.size - cut]) * gain.size)


def _chi2_tail(x: float, df: int) -> float:
    """P(chi^2_df > x)."""
    return float(jax.scipy.special.gammaincc(jnp.asarray(0.5 * df), jnp.asarray(0.5 * max(x, 0.0))))


def look(
    now: _Now, before: Identified, path: Gaussian, data: Dataset, used, rules: Rules, say: Say
) -> tuple[_Now, Step, Trial | None]:
    """One look at one horizon: at most one effect more."""
    length = int(np.max(np.sum(np.asarray(data.valid), axis=1)))
    around = surroundings(before.rig, now.model, data, path)
    candidates = proposals(around)
    weights = now.m_step.weights(now.model)
    table = sheet(before.model, now.model, weights, candidates, path, data)
    verdicts = judge(project(table, np.asarray(used, float)), candidates)
    ranked = _best_of_kind(candidates, verdicts, data)
    present = {key_of(effect) for effect in now.model.effects}
    entries = _shortlist(ranked, present, rules)
    screened = tuple((key_of(c.start), net) for net, c, _ in ranked)
    if not entries:
        return now, Step(length, screened, (), None), None
    null = refit(now.model, now.m_step.early(), path, data, used, passes=rules.passes)
    tried = []
    for candidate, verdict in entries:
        trial = _try(now, path, data, used, candidate, verdict, rules)
        gain = float(np.sum((np.nan_to_num(trial.loglik, nan=-1e9) - null.loglik)[used]))
        count = verdict.rank if candidate.start.name == "unknown_function" else len(fields(candidate.start))
        entry = Refitted(candidate, verdict, trial, gain, gain - _price(count, data))
        tried.append(entry)
        values = {n: float(f"{float(v):.4g}") for n, v in entry.effect.values().items()}
        say(f"  tried {_text(key_of(entry.effect))} {values}: expected {verdict.gain:.0f}, refit {gain:.0f} nat")
    outcome = tuple((key_of(e.effect), e.net) for e in sorted(tried, key=lambda e: -e.net))
    sound = [
        e
        for e in tried
        if e.effect.possible() and e.net > rules.margin and _significance(e.candidate, e.trial) > rules.certain
    ]
    if not sound:
        return now, Step(length, screened, outcome, None), None
    winner = max(sound, key=lambda e: e.net)
    named = [e for e in sound if e.effect.name != "unknown_function"]
    if winner.effect.name == "unknown_function" and named:
        best = max(named, key=lambda e: e.net)
        winner = best if best.net > rules.named * winner.net else winner
    held_out = _held_out(null, winner.trial, data, used)
    say(f"  best: {_text(key_of(winner.effect))}, {winner.net:.0f} nat net, {held_out:.0f} on sequences not fitted to")
    if held_out < rules.margin / 2:
        return now, Step(length, screened, outcome, None), None
    p_value = min(1.0, _chi2_tail(2 * winner.gain, len(fields(winner.candidate.start))) * len(candidates))
    rivals = tuple((key_of(e.effect), winner.gain - e.gain) for e in tried if e is not winner)
    found = Found(winner.candidate, winner.gain, held_out, p_value, length, rivals)
    model, rule = winner.trial.model, now_rule(now.m_step, winner.trial.m_step)
    return _Now(model, rule, (*now.found, found)), Step(length, screened, outcome, key_of(winner.effect)), winner.trial


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
    longest = int(np.max(np.sum(np.asarray(data.valid), axis=1)))
    lengths = sorted({h for h in stages if h >= 90} | {longest})
    lengths = [lengths[0], *([h for h in lengths[1:-1]][1:2]), lengths[-1]] if len(lengths) > 1 else lengths
    now = _Now(before.model, before.m_step, ())
    steps: list[Step] = []
    state: EMState | None = None
    last = 0
    for length in dict.fromkeys(lengths):
        if now.found and length < longest:
            continue  # EM grows to the whole length by itself
        if not now.found:
            own = stages[length][0].best if length in stages else before.model
            now = now._replace(model=own if length < longest else before.model)
        else:
            state = _grow(now, data, before, last, length, say)
            now = now._replace(model=state.best)
        part = horizon(data, length)
        if length <= 128:
            part = jax.tree.map(lambda a, n=length: a[:, :n], part)
        while len(now.found) < rules.most:
            path, _, used = _smoothed(now.model, part, CubatureSmoother(before.bank.padded(now.model.log_q.shape[0])))
            used = np.asarray(used)
            say(f"horizon {length * before.rig.dt:.2f} s: {used.sum()} of {used.size} sequences followed")
            now, step, trial = look(now, before, path, part, used, rules, say)
            steps.append(step)
            if trial is None:
                break
            say(f"  added {_text(step.accepted)}")  # type: ignore[arg-type]
            state = None
            last = length
        last = length
    if not now.found:
        return Closed(before, before, (), tuple(steps))
    if state is None:
        state = _grow(now, data, before, longest, longest, say)
    after = Identified(before.rig, state, now.m_step, before.bank.padded(now.model.log_q.shape[0]))
    return Closed(before, after, now.found, tuple(steps))


def _grow(now: _Now, data: Dataset, before: Identified, first: int, length: int, say: Say) -> EMState:
    """EM of the model as it stands, from the horizon where it was found to a longer one."""
    schedule = Schedule(first=min(first, length), growth=1.6, hold=1)
    part = horizon(data, length)
    state = start_state(now.model, now.m_step, key=before.state.key)._replace(epoch=1)
    growing = math.ceil(math.log(length / schedule.first) / math.log(1.6)) if length > schedule.first else 0
    smoother = CubatureSmoother(before.bank.padded(now.model.log_q.shape[0]))
    state = fit(state, part, smoother, now.m_step, epochs=growing + 7, schedule=schedule)
    say(
        f"  fitted over {length * before.rig.dt:.2f} s in {state.epoch - 1} epochs: {state.loglik[-1]:.1f} nat per sequence"
    )
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
    return close(before, stages, data, rules=rules, say=say)
