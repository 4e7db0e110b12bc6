"""Numbers that decide whether an effect enters a model or leaves it, and the decisions.

The search measures; this file decides.  A share is the part of a squared error that a candidate removes [0 to 1].
Elsewhere: READINGS (`estimate/em/readings.py`), the bars of `statistics.py`, `interventions.py` and `shapes.py`; and
counts of parts, placebos, laws and passes, each where it counts.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import stats

from ...base.digits import share_of

CHANCE = 2.0
"""Multiple of the chance level that a share must reach: two placebos are exceeded by chance once in three rounds."""
NAMED = 0.6
"""Prior odds of a free function to a named law, for every signal of the function, of a pair of laws of equations to a
single one, and of any law to the remainder of an accepted one: shares are multiplied by them, and bars divided."""
AGREE = 0.75
"""Share of the parts left out on which the error must fall."""
SURVIVES = 0.05
"""Smallest share of a law's columns that friction and parameters cannot give: on a slide under control that lacks a
force 2 % of a false scale of its sensor, and 10 to 95 % of all other laws."""
DETERMINED = 2.0
"""Wald statistic [standard deviations] of a normal law whose chance is that at which a law differs from none, and at
which errors have risen since a fit: one in 44."""
RISEN = float(stats.norm.sf(DETERMINED))
"""The same chance, of errors as large as those of new recordings, by their ranks."""
EQUIVALENT = 0.9
"""Share of the best from which on a law explains the same: a simpler law is then preferred to one that contains it,
refits decide between others, and between laws of different causes the question stays open."""
EXCEEDS = 1.4
"""Log of the error without a law over that with it, after a refit over that of the screen, below which six of ten
accepted laws on real arms lie. No law is accepted before all that may remove more are refitted: below 1.29 a saturation
stands for a loss of torque on a real arm, above 1.53 a free function for Coulomb friction that grew."""
WORSE = 2.0
"""Multiple of the squared error of a reading at some age from which on laws of equations harm it: heat from one real
heater to the other makes it 1.3 times as large beside what else lacks, a wrong law on a ship 20 and 56 times."""
EQUIVALENT_NATS = 5.0
"""Log-likelihood [nat] within which two laws of equations are indistinguishable: 1 in 150."""
KEEP = 0.6
"""Multiple of the floor that a refit must remove, and that must be lost without an effect for the effect to stay."""
SUSPECT = 0.5
"""Multiple of the floor from which on a law is listed as a suspect, on two real rigs as recorded the best of 600
candidates removed 0.02 and 0.07 of the multi-step error."""
HELD = 0.2
"""Standard deviation of declared numbers in a search over the declared one: else they bend to what is missing."""
FOLLOWED = 0.5
"""Share of the sequences that the first round follows: over the whole length, or as many rows as so many keep."""
REPEATS = 0.2
"""Mean square difference of two recordings, over their mean square, below which they are one motion: real repetitions
differ by up to 0.13, others by 0.25 and more."""
COARSE = 0.1
"""Variance of rounding to the steps of a reading, over that of its noise, from which on steps are an effect."""
MULTI_STEP = 0.15
"""Smallest share that counts, whatever chance can do: aliases of what their models lack remove up to 0.14 on three real
rigs as recorded, and below it an effect that is not in the catalogue looks like some law that is."""


class Share(NamedTuple):
    """Part of the squared error that a candidate removes."""

    inside: float
    """Share of the whole squared error, adjusted for the number of directions [Wherry 1931]."""
    left_out: float
    """Smaller of the shares on motions and on moments that its strengths were not fitted to."""
    folds: tuple[float, ...]
    """Share on each part of motions; where the error rises, relative to an average part, if that holds more."""

    @property
    def least(self) -> float:
        """The smaller share."""
        return min(self.inside, self.left_out)


def agreed(folds: Sequence[float], floor: float = 0.0, *, responds: bool = False) -> bool:
    """True where the error falls on most parts. A free function of an input `responds` to any disturbance under
    feedback, and has to remove the floor on every part.
    """
    return min(folds) >= floor if responds else sum(fold > 0 for fold in folds) >= AGREE * len(folds)


def odds(complexity: int) -> float:
    """Prior odds of a law: remainders of accepted laws (-1), named laws (0), free functions by their signals."""
    return NAMED ** (1 + complexity)


def least_share(removed: Sequence[float]) -> float:
    """Smallest share that counts of the error that accepted laws leave, which have `removed` these of what was there.
    Of the first error a second law can be no large part where one explains most, of what is left any alias may be one
    where little is: the geometric mean of both shares must reach the floor.
    """
    return MULTI_STEP / math.sqrt(math.prod(1 - share for share in removed))


def required(bar: float, complexity: int) -> float:
    """Share that a law must reach: the bar, higher by the odds for a free function."""
    return bar / NAMED ** max(complexity, 0)


def even(values: Sequence[float]) -> list[int]:
    """Places of those that explain as much as the best."""
    return [i for i, value in enumerate(values) if value >= EQUIVALENT * max(values)]


def simplest(values: Sequence[float], complexities: Sequence[int], ties: Sequence[float]) -> int:
    """The one order of laws: place of the simplest of those that explain as much as the best, then by `ties`."""
    return min(even(values), key=lambda i: (complexities[i], -ties[i]))


def needed(share: float, floor: float) -> bool:
    """True for a share between two fits, with an effect and without it, that is enough for the effect."""
    return share >= KEEP * floor


def veto(possible: bool, removed: float, floor: float, before: float = -math.inf) -> str | None:
    """Reason against a refitted effect, as a clause whose subject it is; None where there is none. `removed` is the
    share of the squared error that goes with it, `floor` what its law must reach, `before` the share that it removes
    from the recordings of an earlier fit: a law that counts there as well is missing, and no change.
    """
    if not possible:
        return "has a value without physical meaning after its refit"
    if not needed(removed, floor):
        return f"removes {share_of(removed, 'the squared error', 1)} after its refit"
    text = f"explains the recordings of the fit as well, of which it removes {share_of(before, 'the squared error', 1)}"
    return f"{text}: it is missing there, and no change" if needed(before, floor) else None


def suspected(share: float, floor: float, chance: float = 0.0) -> bool:
    """True for a share below the bar that is worth a line on the page."""
    return share >= max(SUSPECT * floor, CHANCE * chance)


def doubtful(sure: Sequence[float], recordings: int) -> int | None:
    """Place of the law of the least Wald statistic, where that shows no law. Of few recordings the standard deviation
    is hardly known, and chance is that of Student's t [Cameron & Miller 2015, J. Human Resources 50(2), for clusters].
    """
    least = int(np.argmin(sure))
    chance = stats.t.isf(stats.norm.sf(DETERMINED), max(recordings - 1, 1))
    return None if sure[least] > chance else least
