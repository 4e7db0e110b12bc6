"""Numbers that decide whether an effect enters a model or leaves it, and the decisions.

The search measures; this file decides.  A share is the part of a squared error that a candidate removes [0 to 1].
Elsewhere: READINGS (`em/readings.py`), the bars of `statistics.py`, `interventions.py` and `shapes.py`; and counts of
parts, placebos, laws and passes, each where it counts.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

from ..numerics.digits import share_of

CHANCE = 2.0
"""Multiple of the chance level that a share must reach: two placebos are exceeded by chance once in three rounds."""
NAMED = 0.6
"""Prior odds of a free function to a named law, for every signal of the function, and of any law to the remainder of an
accepted one: shares are multiplied by them, and bars divided."""
AGREE = 0.75
"""Share of the parts left out on which the error must fall."""
HARM = 2 / 3
"""Multiple of the floor by which the error may rise on one part: 10 % of a multi-step error."""
PROBE = (0.3, 3.0)
"""Smallest and largest multiple of its probe at which a law that is not linear is still the law that was probed."""
FAR = 3.0
"""Largest distance of a linear law from none, in root mean square of the standard deviations of its prior."""
SURVIVES = 0.05
"""Smallest share of a law's columns that friction and parameters cannot give: on a slide under control that lacks a
force 2 % of a false scale of its sensor, and 10 to 95 % of all other laws."""
CERTAIN, DETERMINED = 5.0, 2.0
"""Wald statistics [standard deviations] from which on an effect differs from none, 12.5 nat of log-likelihood, and its
amplitude alone: amplitude and phase may cancel in a fit, so that neither is known."""
EQUIVALENT = 0.9
"""Share of the best from which on a law explains the same: a simpler law is then preferred to one that contains it,
refits decide between others, and between laws of different causes the question stays open."""
EQUIVALENT_NATS = 5.0
"""Log-likelihood [nat] within which two laws are indistinguishable: 1 in 150."""
FORESEEN = 1 / 3
"""Multiple of what a refit must remove by which the error must fall along the step of the screen, or none is made."""
KEEP = 0.6
"""Multiple of the floor that a refit must remove, and that must be lost without an effect for the effect to stay."""
PAIR = 0.5
"""Prior odds of a pair of laws of equations to a single one: 120 pairs of the best sixteen laws are tried."""
SUSPECT, SUSPECT_SHARE = 0.5, 0.08
"""Multiple of the floor from which on a law is listed as a suspect, on two real rigs as recorded the best of 600
candidates removed 0.02 and 0.07 of the multi-step error; share from which on a law of equations is."""
HELD = 0.2
"""Standard deviation of declared numbers in a search over the declared one: else they bend to what is missing."""
FOLLOWED = 0.5
"""Share of the sequences that the first round follows: over the whole length, or as many rows as so many keep."""
REPEATS = 0.2
"""Mean square difference of two recordings, over their mean square, below which they are one motion: real repetitions
differ by up to 0.13, others by 0.25 and more."""
RISEN = 0.01
"""Chance of errors as large as those of new recordings, by their ranks, below which something changed since a fit."""
COARSE, FINEST = 0.1, 0.25
"""Variance of rounding to the steps of a reading, over that of its noise, from which on steps are an effect; smallest
share of an estimated variance that is noise beside the rounding in it."""
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


def sensible(multiple: float, far: float, survived: float, *, linear: bool) -> bool:
    """True for a law that a fit may reach and that the nuisance cannot stand for. `multiple` is the fitted multiple of
    its probe, `far` the distance of a linear law from none in standard deviations of its prior, `survived` the share of
    its columns that friction and parameters cannot give.
    """
    return (linear or PROBE[0] < multiple < PROBE[1]) and far < FAR and survived >= SURVIVES


def agreed(folds: Sequence[float], floor: float, *, responds: bool = False) -> bool:
    """True where the error falls on most parts and rises on none by much. A free function of an input `responds` to any
    disturbance under feedback, and has to remove the floor on every part.
    """
    if responds:
        return min(folds) >= floor
    return sum(fold > 0 for fold in folds) >= AGREE * len(folds) and min(folds) > -HARM * floor


def odds(complexity: int) -> float:
    """Prior odds of a law: remainders of accepted laws (-1), named laws (0), free functions by their signals."""
    return NAMED ** (1 + complexity)


def required(bar: float, complexity: int) -> float:
    """Share that a law must reach: the bar, higher by the odds for a free function."""
    return bar / NAMED ** max(complexity, 0)


def even(values: Sequence[float]) -> list[int]:
    """Places of those that explain as much as the best."""
    return [i for i, value in enumerate(values) if value >= EQUIVALENT * max(values)]


def lead(own: float, its: float) -> float:
    """Lead of a law in the place of another: beyond 1 clearly better, below -1 clearly worse, else the same."""
    return (its - own) / max((1 - EQUIVALENT) * max(own, its), 1e-12)


def simplest(values: Sequence[float], complexities: Sequence[int], ties: Sequence[float]) -> int:
    """The one order of laws: place of the simplest of those that explain as much as the best, then by `ties`."""
    return min(even(values), key=lambda i: (complexities[i], -ties[i]))


IMPOSSIBLE = "has a value without physical meaning after its refit"
UNCERTAIN = "is {:.1f} standard deviations from none after its refit"
UNDETERMINED = "has an amplitude of {:.1f} standard deviations after its refit"
SMALL = "removes {} after its refit"
BEFORE = "explains the recordings of the fit as well, of which it removes {}: it is missing there, and no change"
"""Reasons against a refitted effect, as clauses whose subject it is."""


def veto(
    *, possible: bool, certainty: float, amplitude: float, removed: float, floor: float, complexity: int,
    before: float = -math.inf,
) -> str | None:  # fmt: skip
    """Reason against an effect after its refit, None where there is none. `certainty` is the Wald statistic of its
    strengths, `amplitude` that of its reported amplitude (infinite without one), `removed` the share of the squared
    error that goes with it, `floor` the smallest share that counts, `complexity` that of the law, `before` the share
    that it removes from the recordings of an earlier fit: a law that counts there as well is missing, and no change.
    """
    least = required(floor, complexity)
    if not possible:
        return IMPOSSIBLE
    if not certainty > CERTAIN:
        return UNCERTAIN.format(certainty)
    if not amplitude > DETERMINED:
        return UNDETERMINED.format(amplitude)
    if not needed(removed, least):
        return SMALL.format(share_of(removed, "the squared error", 1))
    return BEFORE.format(share_of(before, "the squared error", 1)) if needed(before, least) else None


def needed(share: float, floor: float) -> bool:
    """True for a share between two fits, with an effect and without it, that is enough for the effect."""
    return share >= KEEP * floor


def foreseen(share: float, floor: float, complexity: int, *, hidden: bool) -> bool:
    """True where the step of the screen removes a share of the squared error that makes a refit worth its time. A
    motion that is `hidden` was inferred without the law, and need not follow it.
    """
    return hidden or needed(share, FORESEEN * required(floor, complexity))


def suspected(share: float, floor: float, chance: float) -> bool:
    """True for a share below the bar that is worth a line on the page."""
    return share >= max(SUSPECT * floor, CHANCE * chance)
