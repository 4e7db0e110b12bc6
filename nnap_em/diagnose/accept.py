"""What is believed: the only place where numbers decide whether an effect is in the model.

The search measures and asks, a rule answers.  Another rule is one more class.
"""

from abc import abstractmethod
from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import equinox as eqx

from ..effects import Candidate
from .evidence import Evidence, Question, Screen, Screened, Worth, price
from .screen import score_test
from .shares import chance_test, members, parts, share_test

SHORT = 150
"""Rows to which short horizons are cut, so that they share their programs."""


class Verdict(NamedTuple):
    """What a rule says."""

    believed: bool
    reason: str
    """One clause, for the log of the search."""


class AbstractRule(eqx.Module):
    """When an effect is worth a refit, when it is believed, and when it stays."""

    certain: float = eqx.field(static=True, default=5.0)
    """Standard deviations from none that the strengths must be: 12 nat by another road."""
    near: float = eqx.field(static=True, default=0.6)
    """Share of the best from which on another is nearly as good: a named law is preferred to a free one, a rival is
    followed further, a law stands beside its rest.  A quick refit, or one fold, errs by less than the rest."""

    promises: ClassVar[str] = "expected gain in log-likelihood [nat]"
    """What `promise` and `worth` are, as a figure labels them."""
    multistep: ClassVar[bool] = False
    """Whether refits are finished on multi-step errors, as what is believed is judged by them."""

    @abstractmethod
    def horizons(self, fitted: Sequence[int], longest: int) -> list[int]:
        """Rows at which to look, of those at which the model was fitted."""

    @abstractmethod
    def screen(self, question: Question, candidates: Sequence[Candidate]) -> Screen:
        """All candidates before any refit, by what this rule believes in."""

    @abstractmethod
    def promise(self, screened: Screened, readings: int) -> float:
        """What a candidate promises; the larger the better."""

    @abstractmethod
    def worth_a_refit(self, promise: float, readings: int) -> bool:
        """Whether that is enough to look closer."""

    def disputed(self, screened: Screened) -> bool:
        """Whether recordings disagree about a candidate that would be worth a refit were it not for some of them."""
        return False

    def chance(self, question: Question, candidates: Sequence[Candidate]) -> float | None:
        """Largest promise of any candidate whose meaning is taken away; None where this rule measures no such level."""
        return None

    def suspected(self, promise: float, chance: float = 0.0) -> bool:
        """True for a candidate that is listed as a suspect where it is not accepted."""
        return False

    @abstractmethod
    def worth(self, evidence: Evidence) -> float:
        """What an effect is worth after its refit; the larger the better."""

    @abstractmethod
    def sound(self, evidence: Evidence) -> Verdict:
        """Whether a refitted effect may compete."""

    @abstractmethod
    def believes(self, evidence: Evidence) -> Verdict:
        """Whether the winner is believed."""

    @abstractmethod
    def even(self, winner: Evidence, rival: Evidence) -> bool:
        """Whether the data cannot tell the winner from a rival."""

    @abstractmethod
    def keeps(self, worth: Worth) -> Verdict:
        """Whether an effect, or all of them together, stay."""

    def beyond(self) -> "AbstractRule | None":
        """The rule that looks where nothing is sound by this one."""
        return None


class LikelihoodRule(AbstractRule):
    """One-step likelihood, on the data and on sequences left out: right where innovations are what the model says."""

    margin: float = eqx.field(static=True, default=12.0)
    """Log-likelihood [nat] that must be left of a gain after its price: 400 candidates gain 6 by chance."""
    matters: float = eqx.field(static=True, default=0.002)
    """The same for every reading: many readings make certain of what nobody would notice."""
    repeats: float = eqx.field(static=True, default=0.3)
    """Share of the gain that must be seen on sequences left out: halves fit half as well."""

    level: float = eqx.field(static=True, default=5.0)
    """Log-likelihood [nat] within which a rival is as likely: 1 in 150."""

    def bar(self, readings: int) -> float:
        """Log-likelihood that an effect must be worth [nat]."""
        return max(self.margin, self.matters * readings)

    def horizons(self, fitted: Sequence[int], longest: int) -> list[int]:
        """The first two, one in the middle, the whole: a strong effect loses tracks early, a weak one needs all."""
        short = [h for h in sorted(fitted) if h < longest]
        chosen = [h for h in short if h <= SHORT][:2] + [h for h in short if longest / 3 < h < 0.7 * longest][:1]
        return list(dict.fromkeys([*chosen, longest]))

    def screen(self, question: Question, candidates: Sequence[Candidate]) -> Screen:
        """By the score test."""
        return score_test(question, candidates)

    def promise(self, screened: Screened, readings: int) -> float:
        """Expected gain beyond its price [nat]."""
        return screened.gain - price(screened.directions, readings)

    def worth_a_refit(self, promise: float, readings: int) -> bool:
        """Whether that is half of the bar."""
        return promise > 0.5 * self.bar(readings)  # the score test says too little of what is not linear

    def worth(self, evidence: Evidence) -> float:
        """Gain beyond its price [nat]."""
        return evidence.gain - price(evidence.directions, evidence.readings)

    def sound(self, evidence: Evidence) -> Verdict:
        """Whether it is worth more than the bar, and far from none."""
        net = self.worth(evidence)
        if net <= self.bar(evidence.readings):
            return Verdict(False, f"gains {net:.0f} nat net only")
        certain = evidence.certainty > self.certain
        return Verdict(certain, f"is {evidence.certainty:.1f} standard deviations from none")

    def believes(self, evidence: Evidence) -> Verdict:
        """Whether enough of its worth is there on sequences left out."""
        needed = max(0.5 * self.bar(evidence.readings), self.repeats * self.worth(evidence))
        return Verdict(evidence.held_out >= needed, f"gains {evidence.held_out:.0f} nat on sequences left out")

    def even(self, winner: Evidence, rival: Evidence) -> bool:
        """Within some nats."""
        return winner.gain - rival.gain < self.level

    def keeps(self, worth: Worth) -> Verdict:
        """Whether less would lose more than the bar."""
        return Verdict(worth.gain > self.bar(worth.readings), f"gains {worth.gain:.0f} nat")


class ErrorRule(AbstractRule):
    """Errors of the model run alone, whatever its likelihood."""

    multistep: ClassVar[bool] = True
    level: float = eqx.field(static=True, default=0.9)
    """Share of the winner's worth from which on a rival explains the same as well: folds differ by more."""

    def horizons(self, fitted: Sequence[int], longest: int) -> list[int]:
        """The whole: over a second a fifth of the error goes by chance."""
        return [longest]

    def even(self, winner: Evidence, rival: Evidence) -> bool:
        """Nearly the same share."""
        return self.worth(rival) > self.level * self.worth(winner)

    def falls(self, error: float, bar: float, where: str) -> Verdict:
        """Whether an error has fallen by a share."""
        gone = 1.0 - error
        return Verdict(gone >= bar, f"removes {gone:.0%} of the {where}")


class ShareRule(ErrorRule):
    """Multi-step prediction, on all recordings and on those left out: right where innovations are not what the model
    says, because what a machine lacks adds up over many steps and what spoils its readings does not.
    """

    promises: ClassVar[str] = "share of the squared multi-step error"
    least: float = eqx.field(static=True, default=0.15)
    """Share of the squared error that must go, inside and on what is left out: chance removes up to a tenth."""
    agree: float = eqx.field(static=True, default=0.75)
    """Share of the parts left out on which the error must fall."""
    harm: float = eqx.field(static=True, default=0.1)
    """Share by which it may rise on any."""
    matters: float = eqx.field(static=True, default=0.1)
    """Share of the declared model's error that a later law must remove as well: what chance can of the whole."""
    hint: float = eqx.field(static=True, default=0.075)
    """Share of the squared error from which on a law is a suspect, half of `least`: on two real rigs as recorded the
    best of 600 candidates removed .02 and .07."""
    above: float = eqx.field(static=True, default=2.0)
    """Multiple of the chance level that a suspect must reach: chance alone beats two placebos once in three."""

    def screen(self, question: Question, candidates: Sequence[Candidate]) -> Screen:
        """By shares of the multi-step error."""
        return share_test(question, candidates)

    def promise(self, screened: Screened, readings: int) -> float:
        """The smaller share; none where the recordings disagree, for a multiple of a law that is not linear, or where
        the law removes next to nothing of what there was at first.
        """
        share = screened.share
        assert share is not None
        fits = self._same(screened) and self._agreed(screened) and share.least * share.left >= self.matters
        return share.least if fits else 0.0

    def disputed(self, screened: Screened) -> bool:
        """Whether it would remove enough, but not of all."""
        share = screened.share
        assert share is not None
        enough = share.least >= self.least and share.least * share.left >= self.matters
        return enough and self._same(screened) and not self._agreed(screened)

    def chance(self, question: Question, candidates: Sequence[Candidate]) -> float:
        """Largest share of any candidate whose columns are shifted in time [0 to 1]."""
        screens = chance_test(question, candidates)
        return max(self.promise(each, question.readings) for screen in screens for each in screen.screened)

    def suspected(self, promise: float, chance: float = 0.0) -> bool:
        """True for a share that is neither small nor within what chance can."""
        return promise >= max(self.hint, self.above * chance)

    @staticmethod
    def _same(screened: Screened) -> bool:
        """Whether it is nearly its probe, where it is not linear."""
        return screened.candidate.start.linear or 0.3 < float(screened.coefficients[0]) < 3.0

    def _agreed(self, screened: Screened) -> bool:
        """Whether the error falls on most parts and rises on none; a free function of an input, which answers any
        disturbance under feedback, has to remove the least share of every one.
        """
        assert screened.share is not None
        folds = screened.share.folds
        if screened.candidate.start.answers():
            return min(folds) >= self.least
        return sum(f > 0 for f in folds) >= self.agree * len(folds) and min(folds) > -self.harm

    def worth_a_refit(self, promise: float, readings: int) -> bool:
        """Whether that is the least share."""
        return promise >= self.least

    def worth(self, evidence: Evidence) -> float:
        """What the refit removes, as far as it was seen on what was left out of a fit."""
        share = evidence.screened.share
        assert share is not None
        return (1.0 - evidence.error) * min(1.0, share.left_out / max(share.inside, 1e-9))

    def sound(self, evidence: Evidence) -> Verdict:
        """Whether it is far from none and the error falls.

        One-step likelihood has no say: in a quick refit the noise has not settled, and the true law can lose nats. What
        has no name, many numbers that fit many things a little, must be worth the whole of the least share.
        """
        if evidence.certainty <= self.certain:
            return Verdict(False, f"is {evidence.certainty:.1f} standard deviations from none only")
        worth, verdict = self.worth(evidence), self._falls(evidence.error)
        if verdict.believed and not evidence.screened.candidate.start.named and worth < self.least:
            return Verdict(False, f"{verdict.reason}, {worth:.0%} as far as recordings left out say so: has no name")
        return verdict

    def believes(self, evidence: Evidence) -> Verdict:
        """Whether the error falls on what was left out of the refit, too.

        A fit to half of chaotic recordings may say nothing of the others. A named law, which is few numbers, is then
        believed by the whole of the least share on motions that these were not fitted to.
        """
        verdict = self._falls(evidence.unseen, " of motions left out")
        if verdict.believed or not evidence.screened.candidate.start.named:
            return verdict
        gone = 1.0 - evidence.foretold
        return Verdict(gone >= self.least, f"{verdict.reason}, {gone:.0%} where its own numbers alone are left out")

    def keeps(self, worth: Worth) -> Verdict:
        """Whether the error falls, or most of that at once."""
        verdict = self._falls(worth.error)
        at_once = verdict if verdict.believed else self.beyond().keeps(worth)
        return at_once if at_once.believed else verdict

    def beyond(self) -> AbstractRule:
        """Errors at once."""
        return SoonRule()

    def _falls(self, error: float, where: str = "") -> Verdict:
        """Of the refitted model, which is not linear and has to say it all, most of the share."""
        return self.falls(error, self.near * self.least, f"open-loop error{where}")


class SoonRule(ErrorRule):
    """Errors at once, of named laws that one-step likelihood shouts for: right where a machine forgets.

    A law that makes a fast machine unstable, as detents do, cannot be seen in errors half a second ahead: small
    differences have grown by e^10 there, with the law as without it. Nor do these errors show which law is missing.
    """

    promises: ClassVar[str] = "expected gain in log-likelihood a reading [nat]"
    loud: float = eqx.field(static=True, default=0.05)
    """Expected gain a reading [nat]: errors that are halved in one reading of four give .09."""
    least: float = eqx.field(static=True, default=0.5)
    """Share of the squared errors a tenth of a second ahead that must go: what is false removed a quarter at most."""

    def screen(self, question: Question, candidates: Sequence[Candidate]) -> Screen:
        """By the score test; what is left out is as by shares."""
        part = parts(question.model, question.path, question.data, question.used, question.recording)
        return score_test(question, candidates)._replace(members=members(part, question.used))

    def promise(self, screened: Screened, readings: int) -> float:
        """Expected gain a reading beyond its price [nat]; none for a law without a name."""
        if not screened.candidate.start.named:
            return 0.0
        return (screened.gain - price(screened.directions, readings)) / readings

    def worth_a_refit(self, promise: float, readings: int) -> bool:
        """Whether it shouts."""
        return promise > self.loud

    def worth(self, evidence: Evidence) -> float:
        """What the refit removes at once."""
        return 1.0 - evidence.soon

    def sound(self, evidence: Evidence) -> Verdict:
        """Whether it is far from none and most of the error goes at once."""
        if evidence.certainty <= self.certain:
            return Verdict(False, f"is {evidence.certainty:.1f} standard deviations from none only")
        return self._falls(evidence.soon, self.least)

    def believes(self, evidence: Evidence) -> Verdict:
        """Whether it goes on what was left out of the refit, too: most of the share, as halves fit less well."""
        return self._falls(evidence.soon_unseen, self.near * self.least, " of motions left out")

    def keeps(self, worth: Worth) -> Verdict:
        """Whether most of the error goes at once."""
        return self._falls(worth.soon, self.least)

    def _falls(self, error: float, bar: float, where: str = "") -> Verdict:
        return self.falls(error, bar, f"error at once{where}")
