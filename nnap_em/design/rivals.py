"""Laws that the logs could not tell apart, each fitted in the other's place, so that an experiment can be asked to."""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from ..data.dataset import Dataset
from ..diagnose.accept import LikelihoodRule
from ..diagnose.evidence import Question
from ..diagnose.grow import Loop, asked
from ..diagnose.hypothesis import Hypothesis
from ..diagnose.keys import key_of, words
from ..diagnose.look import EFFORT, Say
from ..diagnose.propose import extended, proposals, seeded, surroundings
from ..diagnose.refit import Trial, refit
from ..diagnose.screen import score_test
from ..effects import AbstractEffect
from ..em.identify import Identified
from .limits import DesignError

STARTS = 3
"""Places from which a law is fitted."""
PASSES = 10
"""Passes of a fit from one of them, more than in a search: rivals are compared closely."""


class Law(NamedTuple):
    """An effect as a report or a user names it."""

    name: str
    joint: int | None = None
    """None: any."""
    channel: str | None = None

    def __str__(self) -> str:
        place = f" at joint {self.joint}" if self.joint else f" on {self.channel}" if self.channel else ""
        return self.name.replace("_", " ") + place

    def means(self, effect: AbstractEffect) -> bool:
        """Whether it is this one."""
        here = self.joint in (None, effect.joint) and self.channel in (None, effect.channel)
        return here and self.name in (effect.name, effect.key())


class Rivals(NamedTuple):
    """Two models of the same logs."""

    names: tuple[str, str]
    one: Identified
    other: Identified


def open_pairs(report: Mapping[str, Any]) -> list[tuple[Law | None, Law]]:
    """What a diagnosis could not tell: a law of its model, or None where nothing was added, and a rival of it."""
    law = lambda told: Law(told["name"], told.get("joint"), told.get("channel"))  # noqa: E731
    out: list[tuple[Law | None, Law]] = [(None, law(told)) for told in report.get("cannot_tell", [])]
    for effect in report.get("effects", []):
        out += [(law(effect), law(other)) for other in effect.get("equivalent", [])]
    return out


def rivals(
    fitted: Identified, data: Dataset, wanted: Sequence[tuple[Law | None, Law]], say: Say = lambda text: None
) -> list[Rivals]:
    """Models to be told apart: `fitted` beside itself with another law in the place of one of its own, and, where
    there is none (None), all that may come on top beside each other and beside `fitted` as it is, if there is but one.

    Raises DesignError where the machine cannot have such a law, or the fit does not hold the one.
    """
    out, beside = [], []
    for own, other in wanted:
        say(f"fitting {other} in place of {own or 'nothing'}")
        model = instead(fitted, Dataset(*map(jnp.asarray, data)), own, other, say)
        if own is None:
            beside.append((str(other), model))
        else:
            out.append(Rivals((str(own), str(other)), fitted, model))
    pairs = itertools.combinations(beside if len(beside) > 1 else [("nothing", fitted), *beside], 2)
    return out + [Rivals((a, b), one, other) for (a, one), (b, other) in pairs if beside]


def instead(fitted: Identified, data: Dataset, own: Law | None, other: Law, say: Say = lambda text: None) -> Identified:
    """The fit with one law in the place of another (None: on top), from quick refits.

    Raises DesignError where the fit does not hold the one, or the machine cannot have the other.
    """
    effects = fitted.model.effects
    now = Hypothesis(fitted.model, fitted.m_step, (None,) * len(effects))
    if own is not None:
        place = next((i for i, effect in enumerate(effects) if own.means(effect)), None)
        if place is None:
            held = ", ".join(words(key_of(effect)) for effect in effects)
            raise DesignError(f"the fit holds no {own}; it holds {held or 'no effect'}")
        now = now.without(place)
    loop = Loop(fitted, {}, data, LikelihoodRule(), EFFORT, say)
    question, _ = asked(loop, now, loop.longest)
    trials = _trials(fitted, question._replace(bare=now.having(())), other)
    best = max(trials, key=lambda trial: float(np.nansum(np.where(question.used, trial.loglik, 0.0))))
    state = fitted.state._replace(model=best.model, best=best.model, hessian=best.hessian, top=best.loglik)
    return fitted._replace(state=state, m_step=best.m_step)


def _trials(fitted: Identified, question: Question, law: Law) -> Iterator[Trial]:
    """Fits of a law from its most promising starts."""
    around = surroundings(fitted.rig, question.model, question.data, question.path, question.rows)
    every = proposals(around, question.model.effects)
    same = [candidate for candidate in every if law.means(candidate.start)]
    if not same:
        known = sorted({words(key_of(candidate.start)) for candidate in every})
        raise DesignError(f"this machine cannot have {law}; possible here: {', '.join(known)}")
    for entry in sorted(score_test(question, same).screened, key=lambda s: -s.gain)[:STARTS]:
        full = question.now.plus(seeded(entry.candidate, entry.coefficients), entry.candidate)
        path = extended(full.model, question.path, question.data)
        yield refit(full.model, full.m_step.early(), path, question.data, question.used, passes=PASSES)
