"""The search: rounds that add one law each, those that are not needed removed, and the test of what is stated."""

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple, cast

import numpy as np

from ...base.deadline import TimeUp, until
from ...base.digits import share_of
from ...base.log import Log
from ...base.programs import release_programs
from ...estimate.em.loop import EMState
from ...estimate.identify import Identified
from ...model.state_space import StateSpaceModel
from .hypothesis import Evidence, Hypothesis, covariances
from .keys import key_of, words
from .outcome import Diagnosis, Step, Suspect
from .trial import certainty
from .verdict import KEEP, MULTI_STEP, doubtful, needed

FAILURES = (ArithmeticError, ValueError, RuntimeError)
"""Numerical failures: those of NumPy and SciPy are ValueErrors, those of JAX and `FitError` RuntimeErrors."""
MOST_LAWS = 4
"""Laws that a search adds at most."""


class Round(NamedTuple):
    """Outcome of a round."""

    step: Step
    proposed: Hypothesis | None = None
    """The hypothesis with the law that was accepted; None where none was."""
    complete: bool = True
    """False where the time was up before all was refitted."""


class Progress(NamedTuple):
    """A hypothesis and its fit over the whole length; None where that is the fit from which the search began."""

    hypothesis: Hypothesis
    state: EMState | None = None


class Method(NamedTuple):
    """Functions of a search that depend on the kind of its errors: along smoothed paths, or in free simulations."""

    lengths: list[int]
    """Rows over which rounds look for a first law in turn; further ones are looked for over the last."""
    round: Callable[[Hypothesis, int], Round]
    """One round over so many rows."""
    grown: Callable[[Hypothesis, int], EMState]
    """Fit over the whole length of a law that was found over so many rows."""
    lost: Callable[[Hypothesis], list[float]]
    """Share of the squared error that is lost without each law."""
    ended: Callable[[Identified], Identified]
    """The end of the fit of the outcome, with the uncertainty that is reported."""
    parts: int
    """Recordings, or parts of them, whose errors are independent of each other."""


def search(method: Method, begun: Progress, before: Identified, log: Log, end: float = math.inf) -> Diagnosis:
    """Forward selection until no round accepts a law, backward elimination, and the test of what is stated; a failure
    or the time `end` [s, of time.monotonic] leaves what was accepted before.
    """
    steps: list[Step] = []
    case, after, stopped = begun, None, None
    try:
        with until(end):
            for case in _forward(method, begun, steps, log):  # noqa: B007
                pass
            case = _reduced(method, case, log)
    except TimeUp:
        log("the time is up: the search is not finished")
        stopped = ""
    except FAILURES as error:
        stopped = _told(log, error)
    try:
        case, after = _determined(method, case, before, steps, log)
    except FAILURES as error:
        stopped = stopped or _told(log, error)
    if after is None:
        after = before if case.state is None else before._replace(state=case.state, m_step=case.hypothesis.m_step)
    found = cast(tuple[Evidence, ...], case.hypothesis.evidence)
    return Diagnosis(before, after, found, tuple(steps), complete=stopped is None, failure=stopped or "")


def _forward(method: Method, case: Progress, steps: list[Step], log: Log) -> Iterator[Progress]:
    """The case, and after each round that accepts a law the case with it."""
    ahead = method.lengths if case.state is None else method.lengths[-1:]
    while ahead and sum(step.accepted is not None for step in steps) < MOST_LAWS:
        length, *ahead = ahead
        release_programs()
        outcome = method.round(case.hypothesis, length)
        steps.append(outcome.step)
        if outcome.proposed is not None:
            try:
                case = _grown(method, outcome.proposed, length)
            except FAILURES as error:
                log(f"  with the new law the fit fails ({error}); it is removed")
                steps[-1] = steps[-1]._replace(accepted=None)
                return
            yield case
            ahead = method.lengths[-1:]
        if not outcome.complete:
            raise TimeUp


def _grown(method: Method, hypothesis: Hypothesis, length: int) -> Progress:
    """A hypothesis fitted over the whole length, however long that takes; as it is without laws."""
    if not hypothesis.evidence:
        return Progress(hypothesis)
    with until(math.inf):
        state = method.grown(hypothesis, length)
    return Progress(hypothesis.refitted(cast(StateSpaceModel, state.best)), state)


def _reduced(method: Method, case: Progress, log: Log) -> Progress:
    """The case without the laws with which too little of the error goes, the least needed first."""
    hypothesis = case.hypothesis
    while hypothesis.evidence:
        lost = method.lost(hypothesis)
        least = int(np.argmin(lost))
        if needed(lost[least], MULTI_STEP):
            break
        reason = f"without it {share_of(lost[least], 'the squared error', 1)} is lost, {KEEP * MULTI_STEP:.1%} counts"
        log(f"  {words(key_of(hypothesis.model.effects[least]))} is removed: {reason}")
        hypothesis = hypothesis.without(least)
    return case if hypothesis is case.hypothesis else _grown(method, hypothesis, method.lengths[-1])


def _determined(
    method: Method, case: Progress, before: Identified, steps: list[Step], log: Log
) -> tuple[Progress, Identified | None]:
    """The case without laws that are not determined as they are stated, the least sure first, which are suspects; and
    the end of its fit.
    """
    while case.state is not None and any(case.hypothesis.evidence):
        outcome = method.ended(before._replace(state=case.state, m_step=case.hypothesis.m_step))
        model, found = outcome.model, case.hypothesis.evidence
        spreads = covariances(model, outcome.m_step, outcome.state.hessian)
        tested = [one.candidate if one else None for one in found]
        every = zip(tested, model.effects, spreads, strict=True)
        sure = [certainty(one, effect, cov) if one else math.inf for one, effect, cov in every]
        least = doubtful(sure, method.parts)
        if least is None:
            return case, outcome
        law, evidence = key_of(model.effects[least]), cast(Evidence, found[least])
        log(f"  {words(law)} is removed: it is {sure[least]:.1f} standard deviations from none")
        steps[:] = [step._replace(accepted=None) if step.accepted == law else step for step in steps]
        suspects = Suspect(law, evidence.share, evidence.chance), *steps[-1].suspects
        steps[-1] = steps[-1]._replace(suspects=suspects)
        case = _reduced(method, Progress(case.hypothesis.without(least)), log)
        case = case if case.state else _grown(method, case.hypothesis, method.lengths[-1])
    return case, None


def _told(log: Log, error: Exception) -> str:
    """The first line of a failure, after a line of progress on it."""
    text = (str(error).strip().splitlines() or [type(error).__name__])[0]
    log(f"the search is stopped by a numerical failure ({text}); what was found before is kept")
    return text
