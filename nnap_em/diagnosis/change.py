"""The outcome of a search that began from a fit, in words: what changed since, or that nothing did."""

from collections.abc import Mapping, Sequence
from typing import Any

from ..numerics.digits import number
from .findings import Finding, suspected, undecided, verdict
from .keys import listed, words
from .outcome import Diagnosis
from .verdict import RISEN


def changes(diagnosis: Diagnosis, accepted: Sequence[Finding], error: Mapping[str, Any] | None = None) -> str:
    """The outcome in one sentence, where nothing is named with the test of whether errors have risen."""
    if not diagnosis.complete:
        first = changes(diagnosis._replace(complete=True), accepted, error)
        return f"{first} {diagnosis.unfinished}: more may have changed."
    if accepted:
        return verdict(accepted, error, opening="Changed since the fit:")
    test, rivals = diagnosis.risen, listed([*map(words, undecided(diagnosis))])
    tied = f" {rivals[0].upper()}{rivals[1:]} explain the same; none is added." if rivals else ""
    also = tied or "".join(f" Suspected: {suspect.description}." for suspect in suspected(diagnosis)[:1])
    none = "Nothing is certain to have changed since the fit"
    if test is None:
        return f"{none}, whose own recordings are not at hand.{also}"
    size = f"errors are {number(test.ratio, 2)} times those on its recordings left out (p = {number(test.p_value, 2)})"
    if test.p_value < RISEN:
        return f"Something changed since the fit, and no law and no number is certain to explain it: {size}.{also}"
    if test.least >= RISEN:
        return f"{none}, and so few recordings cannot show it by errors: {size}.{also}"
    return f"{none if tied else 'Nothing changed since the fit that these recordings could show'}: {size}.{tied}"
