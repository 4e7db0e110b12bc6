"""Diagnosis: find the effects that a fitted model lacks, add them, fit again, remove those no longer needed."""

import dataclasses
import math
import time
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, PRNGKeyArray
from scipy import stats

from ..data.dataset import Dataset, stepped
from ..data.logs import Logs, sequences_of
from ..data.rig import Rig
from ..em.loop import EMState, FitError, e_step
from ..em.mstep import ScoringMStep, not_diverged
from ..em.readings import white_readings
from ..fit.identify import Identified, begin, finished, identify
from ..fit.known import forgotten, known, unheld
from ..model.state_space import StateSpaceModel
from ..numerics.programs import release_programs
from ..smoother.gaussian import CubatureSmoother, GaussianSmoother
from ..smoother.start import StartBank
from ..storage.deadline import TimeUp, until
from ..storage.log import Log, silent
from .backward import backward
from .context import SHORT, SearchContext, Stages, extend, quantised, smooth
from .equations import search_equations
from .hypothesis import Evidence, Hypothesis, covariances, declared
from .interventions import Intervention, interventions
from .keys import Key, key_of, remainder_of, replaced, words
from .losses import MultiStep
from .outcome import Diagnosis, Step, Suspect
from .rounds import screening_round
from .smoothed import along, risen_since
from .trial import Trial, certainty
from .verdict import DETERMINED, FOLLOWED, HELD, UNCERTAIN, even

FAILURES = (ArithmeticError, ValueError, RuntimeError)
"""Numerical failures: those of NumPy and SciPy are ValueErrors, those of JAX and `FitError` RuntimeErrors."""
MOST_LAWS = 4
"""Laws that a search adds at most."""


def _forward(context: SearchContext, hypothesis: Hypothesis, length: int, steps: list[Step]) -> Hypothesis:
    """The hypothesis with the law that a screening round over `length` rows accepts; unchanged, if it accepts none."""
    release_programs()
    fit, followed = smooth(context, hypothesis, length)
    reach = f"{length * context.before.rig.dt:.2f} s"
    context.log(f"{context.loss.measure}, horizon {reach}: {followed.sum()} of {followed.size} sequences followed")
    effects = zip(hypothesis.model.effects, hypothesis.evidence, strict=True)
    added = sum(not effect.read_off and evidence is not None for effect, evidence in effects)
    if not fit.used.any() or added >= MOST_LAWS:
        return hypothesis
    outcome = screening_round(fit, context)
    steps.append(outcome.step)
    if not outcome.complete:
        raise TimeUp
    if (case := outcome.accepted) is None:
        return hypothesis
    screened, share = case.screened, case.screened.share
    parts = sum(part > 0 for part in share.folds), len(share.folds)
    found = {"share": share.left_out, "chance": screened.chance, "parts": parts, "removed": case.removed}
    return joined(hypothesis, case, Evidence(equivalent=outcome.equivalent, candidate=case.candidate, **found), context)


def joined(hypothesis: Hypothesis, case: Trial, evidence: Evidence, context: SearchContext) -> Hypothesis:
    """The hypothesis with a refitted law; a named law gives way to a remainder unless it explains most of both."""
    context.log(f"  added {words(key_of(case.effect))}")
    remainder, form = remainder_of(case.effect, hypothesis.model), replaced(case.effect, hypothesis.model)
    place = remainder if form is None else form
    law = None if place is None else hypothesis.evidence[place]
    both = None if law is None else 1 - (1 - law.removed) * (1 - case.removed)
    stays = law is None or (form is None and 0 in even([law.removed, cast(float, both)]))
    if not stays:  # over the model without the older law
        evidence = evidence._replace(removed=cast(float, both))
    following = case.after._replace(evidence=(*case.after.evidence[:-1], evidence))
    if stays or form is not None:  # its place is taken already
        return following
    context.log(f"  {words(key_of(hypothesis.model.effects[cast(int, remainder)]))} is a part of it, and is removed")
    return following.without(cast(int, remainder))


def _names(hypothesis: Hypothesis) -> frozenset[tuple[tuple[Key, Any], int]]:
    """The laws and their forms, and how often each is there."""
    return frozenset(Counter((key_of(e), jax.tree.structure(e)) for e in hypothesis.model.effects).items())


def search(context: SearchContext, *, release: Callable[[Identified, Dataset], Identified]) -> Diagnosis:
    """Search for what the declared model lacks, by multi-step errors; `release` ends the fit of the outcome."""
    before, steps = context.before, cast(list[Step], [])
    begun = declared(before), None
    try:  # steps of readings as noise: they spoil the noise that all else leans on
        begun = begun if context.change else quantised(context, begun[0])
    except FAILURES as error:
        context.log(f"  with steps of readings as noise the fit fails ({error})")
    hypothesis, state, stopped = _search(context, *begun, lengths_of(context), steps)
    outcome = before if state is None else before._replace(state=state, m_step=hypothesis.m_step)
    try:
        hypothesis, outcome, steps = _determined(context, hypothesis, state, steps, release)
    except FAILURES as error:
        stopped = stopped or _told(context, error)
    found = cast(tuple[Evidence, ...], hypothesis.evidence)
    done = {"complete": stopped is None, "failure": stopped or ""}
    return Diagnosis(before, outcome or before, found, tuple(steps), **done)


def _determined(
    context: SearchContext,
    hypothesis: Hypothesis,
    state: EMState | None,
    steps: list[Step],
    release: Callable[[Identified, Dataset], Identified],
) -> tuple[Hypothesis, Identified | None, list[Step]]:
    """The outcome without laws that are not determined as they are stated, the least sure first: those are suspects."""
    while state is not None and any(hypothesis.evidence):
        outcome = release(context.before._replace(state=state, m_step=hypothesis.m_step), context.data)
        model, found = outcome.model, hypothesis.evidence
        spreads = covariances(model, outcome.m_step, outcome.state.hessian)
        tested = [one.candidate if one else None for one in found]
        every = zip(tested, model.effects, spreads, strict=True)
        sure = [certainty(one, effect, cov) if one else math.inf for one, effect, cov in every]
        least = doubtful(sure, math.inf if context.white else len(context.data.t))
        if least is None:
            return hypothesis, outcome, steps
        law, evidence = key_of(model.effects[least]), cast(Evidence, found[least])
        context.log(f"  {words(law)} is removed: it {UNCERTAIN.format(sure[least])}")
        steps = [step._replace(accepted=None) if step.accepted == law else step for step in steps]
        suspects = Suspect(law, evidence.share, evidence.chance), *steps[-1].suspects
        steps[-1] = steps[-1]._replace(suspects=suspects)
        hypothesis = backward(context, hypothesis.refitted(cast(StateSpaceModel, state.best)).without(least))
        state = extend(context, hypothesis, context.longest) if hypothesis.evidence else None
    return hypothesis, None, steps


def doubtful(sure: Sequence[float], recordings: int | float) -> int | None:
    """Place of the law of the least Wald statistic, where that of its stated values shows no law. The search counts
    rows by their likelihood, which is surer than recordings agree; of few, the standard deviation is hardly known, and
    chance is that of Student's t [Cameron & Miller 2015, J. Human Resources 50(2), for clusters].
    """
    least = int(np.argmin(sure))
    chance = stats.t.isf(stats.norm.sf(DETERMINED), max(recordings - 1, 1))
    return None if sure[least] > chance else least


def lengths_of(context: SearchContext) -> list[int]:
    """Rows of the first rounds: all, or if most sequences diverge before, as many as most keep. Where a joint is hidden
    and readings are white, the two shortest horizons of the fit, and one in the middle: over the whole length a fit
    takes a strong effect for process noise. On a simulated arm a spring explains 0.38 of the multi-step error over 0.6
    s, less than 0.09 over 5 s. On real arms short horizons named six of 13 laws wrong.
    """
    longest = context.longest
    if context.white and context.before.model.hides:
        short = [length for length in sorted(context.stages) if length < longest]
        middle = [length for length in short if longest / 3 < length < 0.7 * longest]
        return list(dict.fromkeys([length for length in short if length <= SHORT][:2] + middle[:1]))
    followed = {length: np.mean(used) for length, (_, used) in context.stages.items()}
    most = [length for length, share in followed.items() if share >= FOLLOWED]
    return [max(most, default=min(followed, default=longest))]


def _told(context: SearchContext, error: Exception) -> str:
    """The first line of a failure, after a line of progress on it."""
    text = (str(error).strip().splitlines() or [type(error).__name__])[0]
    context.log(f"the search is stopped by a numerical failure ({text}); what was found before is kept")
    return text


def _search(
    context: SearchContext, hypothesis: Hypothesis, state: EMState | None, lengths: list[int], steps: list[Step]
) -> tuple[Hypothesis, EMState | None, str | None]:
    """Forward selection and backward elimination, until neither changes anything or the time is up: the hypothesis, its
    fit over the whole length, and the numerical failure that stopped it, empty where the time was up. The rounds use
    `lengths` rows in turn, then, and after the first law at once, all. A law that was accepted in time is fitted over
    the whole length, however long that takes.
    """
    searched: set[frozenset] = set()
    longest = context.longest
    ahead = [longest] if state else [*(length for length in lengths if length < longest), longest]
    while True:
        length = ahead.pop(0)
        best = state.best if state else context.stages[length][0].best if length < longest else context.before.model
        hypothesis = hypothesis.refitted(cast(StateSpaceModel, best))
        try:
            with until(context.until):
                proposed = _forward(context, hypothesis, length, steps)
                if proposed.evidence is hypothesis.evidence and ahead:
                    continue
                searched.add(_names(hypothesis))
                if _names(proposed) in searched:  # nothing new, or one law in the place of another and back
                    steps[-1:] = [step._replace(accepted=None) for step in steps[-1:]]
                    proposed = backward(context, hypothesis)
                    if _names(proposed) == _names(hypothesis):
                        return hypothesis._replace(evidence=proposed.evidence), state, None
        except TimeUp:
            context.log("the time is up: the search is not finished")
            return hypothesis, state, ""
        except FAILURES as error:
            return hypothesis, state, _told(context, error)
        try:
            hypothesis, state = proposed, extend(context, proposed, length) if proposed.evidence else None
        except FAILURES as error:
            context.log(f"  with the new law the fit fails ({error}); it is removed")
            steps[-1] = steps[-1]._replace(accepted=None)
            return hypothesis, state, None
        if _names(hypothesis) in searched:
            return hypothesis, state, None
        ahead = [longest]


def diagnose(
    rig: Rig,
    data: Dataset | Logs,
    *,
    key: PRNGKeyArray,
    log: Log = silent,
    seconds: float = math.inf,
    start: Identified | None = None,
    own: Dataset | None = None,
) -> Diagnosis:
    """Fit the declared unknowns of a rig, find what it lacks, add that, and fit again.

    Where readings do not carry white noise, as on real machines, external disturbances are reported, too.

    Args:
        rig: what is declared.
        data: sequences; two at least, better five.
        key: random key of the start.
        log: receives a line of progress at a time.
        seconds: time after which no new round or refit begins [s]; the outcome is then what was accepted until that,
            not `complete`. The first fit, and that of an accepted law over the whole length, are always done.
        start: an earlier fit of the machine; the question is then what changed since. Its posterior is the prior of
            `data`, and nothing is fitted before the search.
        own: recordings of that fit; a law that they show as well is no change.

    Returns:
        The models before and after, the evidence, and the course of the search; `findings` has it in sentences.

    Raises:
        DataError: arrays are not of the rig: other columns, another interval, a row without an input; or `start` is of
            another machine.
        FitError: no sequence can be followed.

    Example:
        >>> diagnosis = nnap_em.diagnose(rig, train, key=key, seconds=1.0)
        >>> diagnosis.after.rig == rig
        True
    """
    end = time.monotonic() + seconds
    data = Dataset(*map(jax.device_put, stepped(sequences_of(data, rig))))
    stages: Stages = {}

    first = begin(rig, data, key=key).model
    white = white_readings(data, first)
    held, hold = held_in(rig, first, white)

    def watch(state: EMState, rows: int, used: Bool[np.ndarray, " seq"]) -> None:
        stages[rows] = state, used
        log(f"epoch {state.epoch}, horizon {rows * rig.dt:.2f} s: {state.loglik[-1]:.1f} nat per sequence")

    def ended(fitted: Identified, data: Dataset) -> Identified:
        """The end of a fit, whose numbers and posterior were held more tightly in the search than they are stated."""
        if start is not None:
            return forgotten(_under(unheld(fitted.m_step, fitted.model, hold), fitted, data))
        if hold == 1.0:
            return finished(fitted, data)
        return _under(released(fitted.m_step), fitted._replace(rig=rig), data)

    if len(data.t) < 2 and not rig.equations:
        log("one sequence: only pieces of it can be left out, so that little is accepted; record at least two")
    if start is None:
        before = identify(held, data, key=key, smoother=unbranched, watch=watch)
    else:
        before, used = _put(start, rig, data, hold, key)
        stages[int(np.max(np.sum(np.asarray(data.valid), axis=1)))] = before.state, used
    if rig.equations:
        return search_equations(before, data, log, end)
    change = start is not None
    origin = None if start is None or own is None else along(start, own, unbranched(start.bank))
    risen = None if origin is None else risen_since(origin, along(before, data, before.smoother))
    context = SearchContext(before, stages, data, MultiStep(), log, end, origin, change, white, risen)
    diagnosis = search(context, release=ended)._replace(risen=risen)
    if change or not white:
        before = ended(before, data)
        after = diagnosis.after if any(diagnosis.evidence) else before
        diagnosis = diagnosis._replace(before=before, after=after, change=change)
    if not white:
        diagnosis = diagnosis._replace(interventions=_pushed(diagnosis.after, data, log))
    return branching(diagnosis)


def _pushed(fitted: Identified, data: Dataset, log: Log) -> tuple[Intervention, ...]:
    """External disturbances; none where they cannot be computed."""
    try:
        return interventions(fitted, data)
    except FAILURES as error:
        log(f"external disturbances are not known: a numerical failure ({error})")
        return ()


def _put(
    start: Identified, rig: Rig, data: Dataset, hold: float, key: PRNGKeyArray
) -> tuple[Identified, Bool[np.ndarray, " seq"]]:
    """A fit on other recordings, its posterior their prior, and the sequences that it follows."""
    before = known(start, rig, data, key=key, smoother=unbranched, hold=hold)
    posterior = e_step(before.model, data, before.smoother, key=before.state.key)
    used = np.asarray(not_diverged(posterior, data))
    if not used.any():
        raise FitError("the fit follows none of the recordings; look at units and columns with nnap-em check")
    top = np.where(used, np.asarray(posterior.loglik), np.nan)
    return before._replace(state=before.state._replace(top=top)), used


def _under(rule: ScoringMStep, fitted: Identified, data: Dataset) -> Identified:
    """The end of a fit under another rule: numbers move by it where that predicts what is left out."""
    posterior = e_step(fitted.model, data, fitted.smoother.tolerant(), key=fitted.state.key)
    _, info = rule(fitted.model, posterior, data)
    return finished(fitted._replace(m_step=rule, state=fitted.state._replace(hessian=info.hessian)), data)


def held_in(rig: Rig, model: StateSpaceModel, white: bool) -> tuple[Rig, float]:
    """The rig with declared numbers nearly held, and their standard deviation over the declared one."""
    # Readings that are white do not bend them; a law would stand for what they leave of a motion that is hidden
    if white or rig.equations or model.hides:
        return rig, 1.0
    narrow = {name: dataclasses.replace(number, std=HELD * number.std) for name, number in rig.parameters.items()}
    return dataclasses.replace(rig, parameters=narrow), HELD


def released(rule: ScoringMStep) -> ScoringMStep:
    """The rule of a fit whose numbers were held, with their declared standard deviations."""
    own = np.arange(rule.prior.size) < len(rule.prior.declared)
    std = jnp.where(own, rule.prior.std / HELD, rule.prior.std)
    return eqx.tree_at(lambda r: (r.prior.std, r.least), rule, (std, HELD * rule.least))


def unbranched(bank: StartBank) -> GaussianSmoother:
    """Smoother of the search: one Gaussian. The likelier branch of a hidden angle is that of the model, and a model
    that lacks an effect chooses wrongly: on a real double pendulum with a planted bump its fit became likelier so, and
    the bump was no longer seen.
    """
    return CubatureSmoother(bank, branching=False)


def branching(diagnosis: Diagnosis) -> Diagnosis:
    """The outcome with the smoother of `identify`, by which states are smoothed and predicted."""
    both = diagnosis.before, diagnosis.after
    before, after = (fit._replace(smoother=CubatureSmoother(fit.bank)) for fit in both)
    return diagnosis._replace(before=before, after=before if both[0] is both[1] else after)
