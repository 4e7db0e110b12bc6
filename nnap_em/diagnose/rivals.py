"""A law in the place of another, over the whole length: which of the two the logs speak for."""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np

from ..data.dataset import Dataset
from ..effects import AbstractEffect
from ..em.identify import Identified
from .accept import LikelihoodRule
from .evidence import Question
from .grow import Loop, asked
from .hypothesis import Hypothesis
from .keys import Key, key_of
from .look import EFFORT
from .outcome import Closed
from .propose import extended, proposals, seeded, surroundings
from .refit import Trial, refit
from .screen import score_test

STARTS = 3
"""Places from which a law is fitted."""
PASSES = 10
"""Passes of a fit from one of them, more than in a search: rivals are compared closely."""
EVEN = 5.0
"""Log-likelihood [nat] within which two laws cannot be told apart."""


def possible(fitted: Identified, data: Dataset) -> list[AbstractEffect]:
    """The laws that the machine of a fit may have."""
    question = _question(fitted, data, None)
    around = surroundings(fitted.rig, question.model, question.data, question.path, question.rows)
    return [candidate.start for candidate in proposals(around, question.model.effects)]


def instead(
    fitted: Identified, data: Dataset, place: int | None, means: Callable[[AbstractEffect], bool]
) -> Identified | None:
    """The fit with such a law in the place of its effect number `place` (None: on top), from quick refits.

    None where the machine cannot have one.
    """
    question = _question(fitted, data, place)
    around = surroundings(fitted.rig, question.model, question.data, question.path, question.rows)
    same = [one for one in proposals(around, question.model.effects) if means(one.start)]
    trials = []
    for entry in sorted(score_test(question, same).screened, key=lambda s: -s.gain)[:STARTS] if same else ():
        full = question.now.plus(seeded(entry.candidate, entry.coefficients), entry.candidate)
        path = extended(full.model, question.path, question.data)
        trials.append(refit(full.model, full.m_step.early(), path, question.data, question.used, passes=PASSES))
    return _with(fitted, max(trials, key=_total)) if trials else None


def again(fitted: Identified, data: Dataset) -> Identified:
    """The fit after as many quick passes as its rivals get."""
    question = _question(fitted, data, None)
    rule = question.m_step.early()
    return _with(fitted, refit(question.model, rule, question.path, question.data, question.used, passes=PASSES))


def apart(closed: Closed, data: Dataset) -> Closed:
    """`closed`, its effects without equivalents that the whole length of the logs tells from them.

    A playoff on the way ends where the search does, and what it leaves even more rows may tell.
    """
    after, found = closed.after, list(closed.found)
    if not any(one.equivalent for one in found):
        return closed
    own = float(np.nansum(np.asarray(again(after, data).state.top)))
    for place, one in enumerate(found):
        even = [key for key in one.equivalent if not _behind(after, data, place, key, own)]
        found[place] = one._replace(equivalent=tuple(even))
    return closed._replace(found=tuple(found))


def _behind(fitted: Identified, data: Dataset, place: int, key: Key, own: float) -> bool:
    """Whether a rival is clearly less likely."""
    other = instead(fitted, data, place, lambda effect: key_of(effect) == key)
    return other is not None and own - float(np.nansum(np.asarray(other.state.top))) > EVEN


def _question(fitted: Identified, data: Dataset, place: int | None) -> Question:
    """What a fit lacks without one of its effects, over the whole length."""
    data = Dataset(*map(jnp.asarray, data))
    now = Hypothesis(fitted.model, fitted.m_step, (None,) * len(fitted.model.effects))
    now = now if place is None else now.without(place)
    loop = Loop(fitted, {}, data, LikelihoodRule(), EFFORT, lambda text: None)
    return asked(loop, now, loop.longest)[0]._replace(bare=now.having(()))


def _total(trial: Trial) -> float:
    return float(np.nansum(trial.loglik))


def _with(fitted: Identified, trial: Trial) -> Identified:
    """The fit with the numbers of a trial."""
    state = fitted.state._replace(model=trial.model, best=trial.model, hessian=trial.hessian, top=trial.loglik)
    return fitted._replace(state=state, m_step=trial.m_step)
