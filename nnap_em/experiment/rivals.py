"""Laws that the logs could not discriminate, each fitted in the other's place, for an experiment that can."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from ..data.dataset import Dataset
from ..diagnosis.keys import key_of, words
from ..diagnosis.rivals import proposals_for, with_rival
from ..effects import AbstractEffect
from ..fit.identify import Identified
from ..storage.log import Log, silent
from .limits import DesignError


class Law(NamedTuple):
    """An effect as a report or a user names it."""

    name: str
    joint: int | None = None
    """None: any."""
    channel: str | None = None

    def __str__(self) -> str:
        place = f" at joint {self.joint}" if self.joint else f" on {self.channel}" if self.channel else ""
        return self.name.replace("_", " ") + place

    @property
    def typed(self) -> str:
        """NAME, NAME:JOINT or NAME:CHANNEL, as --rival reads it."""
        place = self.joint or self.channel
        return f"{self.name}:{place}" if place else self.name

    def means(self, effect: AbstractEffect) -> bool:
        """True for this law."""
        matches = self.joint in (None, effect.joint) and self.channel in (None, effect.channel)
        return matches and self.name in (effect.name, effect.key())


class Rivals(NamedTuple):
    """Two models of the same logs."""

    names: tuple[str, str]
    one: Identified
    other: Identified


def open_pairs(report: Mapping[str, Any]) -> list[tuple[Law | None, Law]]:
    """Pairs that a diagnosis left open: a law of its model, or None where nothing was added, and a rival."""
    law = lambda entry: Law(entry["name"], entry.get("joint"), entry.get("channel"))  # noqa: E731
    out: list[tuple[Law | None, Law]] = [(None, law(entry)) for entry in report.get("undecided", [])]
    for effect in report.get("effects", []):
        out += [(law(effect), law(other)) for other in effect.get("equivalent", [])]
    return out


def rivals(
    fitted: Identified, data: Dataset, laws: Sequence[tuple[Law | None, Law]], log: Log = silent
) -> list[Rivals]:
    """Models to be discriminated: `fitted` beside itself with another law in the place of one of its own, and, where
    there is none (None), all that may come on top beside each other and beside `fitted` as it is, if there is but one.

    Raises DesignError where the machine cannot have such a law, or the fit does not hold the one.
    """
    out, beside = [], []
    for law, other in laws:
        log(f"fitting {other} in place of {law or 'nothing'}")
        model = _instead(fitted, data, law, other)
        if law is None:
            beside.append((str(other), model))
        else:
            out.append(Rivals((str(law), str(other)), fitted, model))
    pairs = itertools.combinations(beside if len(beside) > 1 else [("nothing", fitted), *beside], 2)
    return out + [Rivals((a, b), one, other) for (a, one), (b, other) in pairs if beside]


def _instead(fitted: Identified, data: Dataset, law: Law | None, other: Law) -> Identified:
    """The fit with one law in the place of another."""
    effects = fitted.model.effects
    place = next((i for i, effect in enumerate(effects) if law is not None and law.means(effect)), None)
    if law is not None and place is None:
        held = ", ".join(words(key_of(effect)) for effect in effects)
        raise DesignError(f"the fit holds no {law}; it holds {held or 'no effect'}")
    refit = with_rival(fitted, data, place, other.means)
    if refit is None:
        known = sorted({Law(effect.name, effect.joint, effect.channel).typed for effect in proposals_for(fitted, data)})
        raise DesignError(f"this machine cannot have {other}; possible here: {', '.join(known)}")
    return refit
