"""Results of a search: its rounds, and the models before and after."""

from typing import NamedTuple

from ...estimate.em.recorded import Risen
from ...estimate.identify import Identified
from .hypothesis import Evidence
from .interventions import Intervention
from .keys import Key, key_of, listed, words


class Suspect(NamedTuple):
    """A law that removes more of the error than chance, and was not accepted."""

    key: Key
    share: float
    chance: float
    """Shares of the squared multi-step error before any refit [0 to 1], and of the best placebo, NaN without one."""


class Step(NamedTuple):
    """Results of one screening round, for the report."""

    horizon: int
    screened: tuple[tuple[Key, float], ...]
    """Best of every kind with the share of the squared error that it removes."""
    refitted: tuple[tuple[Key, float], ...]
    accepted: Key | None
    measure: str = "share of the squared error"
    rivals: tuple[Key, ...] = ()
    """Laws of other causes that explain the same, so that none of them was added."""
    suspects: tuple[Suspect, ...] = ()
    """Best first; empty where a law was accepted."""
    untried: int = 0
    """Candidates over their bar that were not tried before the time was up or the shortlist was full."""


class Diagnosis(NamedTuple):
    """Outcome of a search: the fits before and after, the effects found, and the rounds that led to them."""

    before: Identified
    after: Identified
    evidence: tuple[Evidence, ...]
    steps: tuple[Step, ...]
    interventions: tuple[Intervention, ...] = ()
    """External disturbances by the last model."""
    complete: bool = True
    """False where the search was stopped before its end: more may be missing."""
    failure: str = ""
    """Numerical failure that stopped it; empty where the time was up."""
    change: bool = False
    """True where the question was what changed since a fit, whose laws are in both models."""
    risen: Risen | None = None
    """Test of whether errors have risen since that fit; None where its recordings are not at hand."""

    def __str__(self) -> str:
        found = [words(key_of(effect)) for effect in self.after.model.effects[len(self.before.model.effects) :]]
        open_ = [words(key) for step in self.last for key in step.rivals]
        text = f"Diagnosis of {self.before.rig.name!r}: {listed(found) or 'nothing was found'}"
        text += f"; the logs do not discriminate {listed(open_)}" if open_ else ""
        return text + ("" if self.complete else "; the search is not complete")

    @property
    def unfinished(self) -> str:
        """The reason for which the search was stopped, as the beginning of a sentence; empty where it was not."""
        if self.complete:
            return ""
        failed = f"The search was stopped by a numerical failure ({self.failure})"
        return failed if self.failure else "The search was not finished in the time given"

    @property
    def last(self) -> tuple[Step, ...]:
        """The last round, if there was one."""
        return self.steps[-1:]
