"""What is measured about a candidate, and what it is asked of: numbers only, no decision."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..data.dataset import Dataset
from ..effects import Candidate
from ..em.mstep import ScoringMStep
from ..model.state_space import StateSpaceModel
from ..numerics.gaussian import Gaussian
from .hypothesis import Hypothesis


def lazy(measure: Callable[[Any], Any]) -> Any:
    """A property that is measured when it is asked for, and once."""
    name = f"_{measure.__name__}"

    def value(self) -> Any:
        if name not in self.__dict__:
            self.__dict__[name] = measure(self)
        return self.__dict__[name]

    return property(value, doc=measure.__doc__)


class Question(NamedTuple):
    """What does a fitted model lack, along its smoothed paths?"""

    bare: Hypothesis
    """The declared model."""
    now: Hypothesis
    """The same with what was found so far."""
    path: Gaussian
    data: Dataset
    used: Bool[np.ndarray, " seq"]
    """Sequences that are followed."""
    rows: int
    """Of the whole recording, of which `data` may be a part."""
    pieces: tuple[int, ...] = ()
    """Of which recording every sequence is a piece; empty: each is one."""
    left: float = 1.0
    """Squared open-loop error of the model over that of the declared one."""

    @property
    def model(self) -> StateSpaceModel:
        """That of which is asked."""
        return self.now.model

    @property
    def m_step(self) -> ScoringMStep:
        """The rule that fits it."""
        return self.now.m_step

    @property
    def readings(self) -> int:
        """Number of readings."""
        return readings(self.data)

    @property
    def recording(self) -> Int[np.ndarray, " seq"]:
        """Number of the recording of every sequence."""
        return np.asarray(self.pieces) if self.pieces else np.arange(len(self.data.t))


class Share(NamedTuple):
    """What a candidate removes of the squared multi-step error."""

    inside: float
    """Of all of it, adjusted for the number of directions [Wherry 1931]."""
    left_out: float
    """Of that on recordings which its strengths were not fitted to."""
    folds: tuple[float, ...]
    """Of that on each part of them; where it rises, of that on an average part, if that is more."""
    left: float = 1.0
    """Squared error of the model that is asked of, over that of the declared one."""

    @property
    def least(self) -> float:
        """The smaller share."""
        return min(self.inside, self.left_out)


class Screened(NamedTuple):
    """A candidate before any refit."""

    candidate: Candidate
    coefficients: Float[np.ndarray, " probe"]
    """Multiples of its probes."""
    directions: int
    """That the data see."""
    gain: float
    """Expected gain of the log-likelihood [nat]; NaN where the screen is no score test."""
    share: Share | None
    """None where the screen does not look at it."""


class Projected(NamedTuple):
    """Score and information of the candidate columns once the nuisance has taken what it can."""

    score: Float[np.ndarray, " column"]
    information: Float[np.ndarray, "column column"]


class Screen(NamedTuple):
    """All candidates, before any refit."""

    screened: tuple[Screened, ...]
    projected: Projected
    members: Bool[np.ndarray, "fold seq"] = np.zeros((1, 0), bool)
    """Sequences that each part left out holds, or pieces of."""

    @property
    def halves(self) -> tuple[Bool[np.ndarray, " seq"], ...]:
        """The sequences in two halves that share no part; empty where one part runs through all of them."""
        first = self.members.argmax(axis=0)
        order = np.unique(first[self.members.any(axis=0)])
        halves = tuple(np.isin(first, order[i::2]) & self.members.any(axis=0) for i in range(2))
        return halves if len(order) > 1 else ()


class Worth:
    """What a model has over one that it contains; what costs time is `lazy`."""

    readings: int
    gain: float
    """Log-likelihood [nat]."""
    error: float
    """Squared open-loop error of the one over that of the other."""
    soon: float
    """The same over the first tenth of a second."""


class Evidence(Worth):
    """What may be asked about an effect after its refit, beside the model without it after as many passes."""

    screened: Screened
    directions: int
    """Numbers that are estimated of it."""
    certainty: float
    """Standard deviations of its strengths from none, jointly."""
    held_out: float
    """Gain on sequences that had no part in the fit [nat]."""
    unseen: float
    """Squared open-loop error over that without it, on motions that had no part in either fit; on the only one, if
    there are no others."""
    foretold: float
    """The same on motions that had no part in the fit of its own numbers alone."""
    soon_unseen: float
    """`unseen` over the first tenth of a second."""


def readings(data: Dataset) -> int:
    """Number of readings."""
    return int(np.sum(np.isfinite(np.asarray(data.y)) & np.asarray(data.valid)[..., None]))


def price(directions: int, readings: int) -> float:
    """Half of log(readings) for every direction [nat; Schwarz 1978]."""
    return 0.5 * directions * math.log(max(readings, 2))
