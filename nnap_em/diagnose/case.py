"""A candidate after its refit: what was measured of it, and what a rule may still ask to be measured."""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Bool

from ..data.dataset import Dataset
from ..effects import AbstractEffect, Candidate, fields, flat
from ..em.multistep import JUDGED, SOON, errors, finish, forks, ratio, weighed
from ..numerics.gaussian import Gaussian
from .evidence import Evidence, Question, Screened, lazy
from .hypothesis import Hypothesis, blocks
from .refit import Trial, refit

Fit = Callable[[Hypothesis, Gaussian, Question], Trial]
"""Some passes from a path, on the sequences of a question."""


def refitted(now: Hypothesis, path: Gaussian, question: Question, *, passes: int, multistep: bool) -> Trial:
    """Some passes from a path; with `multistep`, the errors of many steps are fitted before and after."""

    def finished(model, m_step, path):
        return finish(model, m_step, path, question.data, question.used) if multistep else model

    model = finished(now.model, now.m_step, path)
    trial = refit(model, now.m_step.early(), path, question.data, question.used, passes=passes)
    return trial._replace(model=finished(trial.model, trial.m_step, trial.path))


def open_loop_error(null: Trial | Question, full: Trial | Question, data: Dataset, used, horizons=JUDGED) -> float:
    """Squared open-loop error of one model over that of another, each along its own smoothed paths."""
    before, after = (errors(one.model, one.m_step.prior, one.path, data, horizons) for one in (null, full))
    return ratio(before, after, used)


def left_out_error(
    null: Trial,
    full: Trial,
    own: slice,
    question: Question,
    parts: Sequence[tuple[Bool[np.ndarray, " seq"], Bool[np.ndarray, " seq"]]],
) -> float:
    """Squared open-loop error of `full` over that of `null` on what is left out, the mean over the `parts`.

    The numbers at `own` among its parameters are those of a Gauss-Newton step on the others; all else stays as it was
    fitted to all: nuisance that is fitted to a half of chaotic recordings runs away on the other.
    """
    weights = full.m_step.weights(full.model)
    now = forks(full.model, weights, full.path, question.data)
    weight, z = weighed(now, question.used), np.asarray(weights.prior.read(full.model))[own]
    columns = now.columns[..., weights.nodes.size + own.start : weights.nodes.size + own.stop].astype(float)
    jac, error = np.where(weight[..., None] > 0, columns, 0.0), np.where(weight > 0, now.error, 0.0)
    before, out = errors(null.model, null.m_step.prior, null.path, question.data), []
    for left, rest in parts:
        by, pull = (jac[rest] * weight[rest][..., None]).reshape(-1, z.size), error[rest].ravel()
        moved = np.linalg.solve(by.T @ jac[rest].reshape(-1, z.size) + np.eye(z.size), by.T @ pull - z)
        out.append(ratio(before, now.error - columns @ moved, left))
    return float(np.mean(out))


class Case(Evidence):
    """A candidate, refitted from `path`, beside `null`: the model without it after as many passes."""

    def __init__(
        self,
        screened: Screened,
        begun: Hypothesis,
        path: Gaussian,
        null: Trial,
        question: Question,
        fit: Fit,
        halves: Sequence[Bool[np.ndarray, " seq"]] = (),
    ):
        self.screened, self.null, self.question = screened, null, question
        self._refit = lambda question: (fit(question.now, question.path, question), fit(begun, path, question))
        self._halves = halves
        self.trial = fit(begun, path, question)
        self.after = begun.refitted(self.trial.model)
        """The model with it."""
        self.readings = question.readings
        self.gain = float(np.sum((np.nan_to_num(self.trial.loglik, nan=-1e9) - null.loglik)[question.used]))
        named = screened.candidate.start.named
        self.directions = len(fields(screened.candidate.start)) if named else screened.directions

    @property
    def effect(self) -> AbstractEffect:
        """The effect with its fitted parameters."""
        return self.trial.model.effects[-1]

    @lazy
    def certainty(self) -> float:
        """Standard deviations from none."""
        return significance(self.screened.candidate, self.after, self.trial.hessian)

    @lazy
    def held_out(self) -> float:
        """Gain on sequences left out [nat]."""
        return held_out_gain(self.null, self.trial, self.question.data, self.question.used)

    @lazy
    def error(self) -> float:
        """Squared open-loop error over that without it."""
        return open_loop_error(self.null, self.trial, self.question.data, self.question.used)

    @lazy
    def soon(self) -> float:
        """The same over the first tenth of a second."""
        return open_loop_error(self.null, self.trial, self.question.data, self.question.used, SOON)

    @lazy
    def unseen(self) -> float:
        """The error on either half of the motions after fits to the other, their mean."""
        return self._on_refits(JUDGED) if self._parts() else self.error

    @lazy
    def soon_unseen(self) -> float:
        """The same over the first tenth of a second."""
        return self._on_refits(SOON) if self._parts() else self.soon

    @lazy
    def _refits(self) -> list[tuple[Bool[np.ndarray, " seq"], tuple[Trial, Trial]]]:
        """Without and with the effect, fitted to the other half."""
        return [(out, self._refit(self.question._replace(used=rest))) for out, rest in self._parts()]

    def _on_refits(self, horizons: tuple[float, ...]) -> float:
        data = self.question.data
        told = [open_loop_error(null, full, data, out, horizons) for out, (null, full) in self._refits]
        return float(np.mean(told))

    @lazy
    def foretold(self) -> float:
        """The same on either half of the motions, where only the numbers of the effect are fitted to the other."""
        own = blocks(self.trial.model, self.trial.m_step)[-1]
        parts = self._parts()
        return left_out_error(self.null, self.trial, own, self.question, parts) if parts else self.error

    def _parts(self) -> list[tuple[Bool[np.ndarray, " seq"], Bool[np.ndarray, " seq"]]]:
        """Sequences left out, and those that are left; none where the motions have no two halves."""
        parts = [(self.question.used & half, self.question.used & ~half) for half in self._halves]
        return parts if all(part.any() for pair in parts for part in pair) else []


def significance(candidate: Candidate, now: Hypothesis, hessian, place: int = -1) -> float:
    """How many standard deviations the strengths of the effect at `place` are from none, jointly [Wald 1943].

    Half its square is the log-likelihood that would be lost without the effect, to second order.
    """
    model, prior = now.model, now.m_step.prior
    here = blocks(model, now.m_step)[place]
    none = np.asarray(flat(candidate.start))
    strong = np.any([np.asarray(flat(probe)) != none for probe in candidate.probes], axis=0)
    std, cov = np.asarray(prior.std)[here], np.linalg.inv(np.asarray(hessian))
    cut = cov.shape[0] - prior.size
    cov = (cov[cut:, cut:][here, here] * np.outer(std, std))[np.ix_(strong, strong)]
    away = (np.asarray(flat(model.effects[place])) - none)[strong]
    return float(np.sqrt(max(0.0, away @ np.linalg.pinv(cov, rcond=1e-12, hermitian=True) @ away)))


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
