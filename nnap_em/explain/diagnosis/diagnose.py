"""Diagnosis: find the effects that a fitted model lacks, add them, fit again, remove those no longer needed."""

import dataclasses
import functools
import math
import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, PRNGKeyArray

from ...base.log import Log, silent
from ...errors import FitError
from ...estimate.em.loop import EMState, e_step
from ...estimate.em.mstep import ScoringMStep, not_diverged
from ...estimate.em.readings import white_readings
from ...estimate.identify import Identified, begin, finished, identify
from ...estimate.known import forgotten, known, unheld
from ...estimate.smoother.gaussian import CubatureSmoother, GaussianSmoother
from ...estimate.smoother.start import StartBank
from ...logs.dataset import Dataset, stepped
from ...logs.read import Logs, sequences_of
from ...machines.rig import Rig
from ...model.state_space import StateSpaceModel
from .backward import lost
from .context import SearchContext, Stages, extend, lengths_of, quantised
from .equations import by_simulation
from .hypothesis import declared
from .interventions import Intervention, interventions
from .outcome import Diagnosis
from .rounds import screening_round
from .search import FAILURES, Method, Progress, search
from .smoothed import along, risen_since
from .verdict import HELD


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

    External disturbances are reported, too, where every coordinate is measured.

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
    held, hold = held_in(rig, first)

    def watch(state: EMState, rows: int, used: Bool[np.ndarray, " seq"]) -> None:
        stages[rows] = state, used
        reach = f"{rows * rig.dt:.2f} {rig.time_unit}"
        log(f"epoch {state.epoch}, horizon {reach}: {state.loglik[-1]:.1f} nat per sequence")

    def ended(fitted: Identified) -> Identified:
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
        return search(by_simulation(before, data, log), Progress(declared(before)), before, log, end)
    change = start is not None
    origin = None if start is None or own is None else along(start, own, unbranched(start.bank))
    risen = None if origin is None else risen_since(origin, along(before, data, before.smoother))
    context = SearchContext(before, stages, data, log, origin, change, white_readings(data, first), risen)
    begun = Progress(declared(before))
    try:  # steps of readings as noise: they spoil the noise that all else leans on
        begun = begun if change else Progress(*quantised(context, begun.hypothesis))
    except FAILURES as error:
        log(f"  with steps of readings as noise the fit fails ({error})")
    of = functools.partial
    steps = of(screening_round, context), of(extend, context), of(lost, context)
    diagnosis = search(Method(lengths_of(context), *steps, ended, len(data.t)), begun, before, log, end)
    before = ended(before)
    after = diagnosis.after if any(diagnosis.evidence) else before
    diagnosis = diagnosis._replace(before=before, after=after, change=change, risen=risen)
    return branching(diagnosis._replace(interventions=_pushed(after, data, log)))


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


def held_in(rig: Rig, model: StateSpaceModel) -> tuple[Rig, float]:
    """The rig with declared numbers nearly held, and their standard deviation over the declared one."""
    if rig.equations or model.hides:  # a law would stand for what they leave of a motion that is hidden
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
