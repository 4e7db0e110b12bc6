"""What a search leaves behind: every look at it, and the models before and after."""

from typing import NamedTuple

from ..em.identify import Identified
from .hypothesis import Found
from .keys import Key


class Disputed(NamedTuple):
    """A law on which recordings disagree."""

    key: Key
    share: float
    """Of the squared error that it would remove."""
    against: tuple[int, ...]
    """Sequences that it would harm."""
    harm: float
    """Share by which the error of the worst part of them would rise."""


class Suspect(NamedTuple):
    """A law that removes more of the error than chance, and was not accepted."""

    key: Key
    share: float
    """Of the squared multi-step error, before any refit."""
    chance: float
    """Largest share of any candidate whose columns are shifted in time."""


class Step(NamedTuple):
    """What was seen at one look, for the report."""

    horizon: int
    screened: tuple[tuple[Key, float], ...]
    """Best of every kind with its promise: nat, or a share."""
    refitted: tuple[tuple[Key, float], ...]
    accepted: Key | None
    tried: int
    """Candidates screened."""
    measure: str = "expected gain in log-likelihood [nat]"
    """What the numbers are."""
    disputed: tuple[Disputed, ...] = ()
    """Best first."""
    rivals: tuple[Key, ...] = ()
    """Laws of other causes that explain the same, so that none of them was added."""
    suspects: tuple[Suspect, ...] = ()
    """Best first; empty where a law was accepted."""


class Intervention(NamedTuple):
    """A push on one joint that no law explains."""

    sequence: int
    joint: int
    """Counted from 1."""
    first: int
    """First row."""
    last: int
    """Last row."""
    from_s: float
    to_s: float
    """On the clock of the log [s]."""
    size: float
    """Largest mean over a bell [N m, or N]."""
    std: float
    """How large such means are where nothing touches."""
    unit: str


class Closed(NamedTuple):
    """The outcome."""

    before: Identified
    after: Identified
    found: tuple[Found, ...]
    steps: tuple[Step, ...]
    interventions: tuple[Intervention, ...] = ()
    """Touches from outside, which no fit saw."""
    pieces: tuple[int, ...] = ()
    """Of which recording every sequence of the fits is a piece; empty: each is one."""
