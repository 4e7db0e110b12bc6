"""The report as one page: a single HTML file without scripts that fetches nothing.

`document` is what the JSON file beside it holds.  Each command has a template; parts.html.j2 has what they share.
"""

import base64
import functools
import io
import itertools
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jinja2
from matplotlib.figure import Figure

from ..diagnosis.findings import growth
from ..diagnosis.statistics import FAILS
from ..effects import catalogue
from ..numerics.digits import finite, number
from ..storage.files import replace_own
from . import wording
from .tables import json_text
from .wording import ratio, reached

Section = Literal["found", "error", "residual", "details"]
"""Section of a page that a figure may stand in."""
MOST_PICTURES, PICTURE_BYTES = 5, 900_000
"""Pictures to choose from under one title, and bytes of all of them, at most; the first is always there."""
_NATS = ((100, "Beyond doubt"), (30, "Very sure"), (10, "Sure"), (3, "Likely"))
_TRUST = {
    "share_of_error": ((0.6, "Very sure"), (0.3, "Sure"), (0.15, "Likely")),
    "log_likelihood_gain": _NATS,
}
"""Thresholds of words: share of the error on recordings left out, log-likelihood [nat]; the first known
decides, because nats are worth little where noise is not that of the
model."""
_PLACES = re.compile(rb'(?<=\s)(?:d|x|y)="[^"]*"')
_DIGITS = re.compile(rb"(\.\d\d)\d+")


class Picture(NamedTuple):
    """A figure of the page."""

    title: str
    caption: str
    image: bytes
    """SVG."""
    place: Section = "residual"
    choice: str = ""
    """Name among the pictures of one title, of which the reader chooses one; empty: it stands alone."""
    width: float = 0.0
    """Width of the image [CSS px]; 0 where it is unknown."""

    @property
    def source(self) -> str:
        """The image as an address that holds it."""
        return f"data:image/svg+xml;base64,{base64.b64encode(self.image).decode('ascii')}"

    @property
    def style(self) -> str:
        """About its own size; wide ones scroll inside their box on a phone."""
        least = round(0.72 * self.width) if self.width > 560 else 0
        return f"min-width:{least}px;max-width:{round(1.1 * self.width)}px" if self.width else ""


def picture(place: Section, title: str, caption: str, figure: Figure, choice: str = "") -> Picture:
    """A drawn figure for the page; paths and marks to a hundredth of a point: four fifths of the size."""
    image = io.BytesIO()
    figure.savefig(image, format="svg")
    rounded = _PLACES.sub(lambda match: _DIGITS.sub(rb"\1", match[0]), image.getvalue())
    return Picture(title, caption, rounded, place, choice, 96 * figure.get_size_inches()[0])


def grouped(pictures: Sequence[Picture], place: str) -> list[list[Picture]]:
    """Pictures of a section in their order; those to choose from share a list."""
    section = [picture for picture in pictures if picture.place == place]
    return [list(group) for _, group in itertools.groupby(section, lambda p: p.title if p.choice else id(p))]


def write_report(
    out: Path, kind: str, document: Mapping[str, Any], text: str, named: Callable[[str], str] = str
) -> None:
    """Write KIND.json and the page `text` as KIND.html into the folder `out`, in the names of the user's file."""
    replace_own({out / f"{kind}.json": json_text(document, named), out / f"{kind}.html": named(text)})


def write_page(
    out: Path, document: Mapping[str, Any], pictures: Sequence[Picture], named: Callable[[str], str] = str
) -> None:
    """Write report.json and report.html."""
    write_report(out, "report", document, page(document, pictures), named)


def page(document: Mapping[str, Any], pictures: Sequence[Picture] = ()) -> str:
    """Page of a fit or a diagnosis, whose document has no key `effects` or has one."""
    error, effects = document.get("error") or {}, document.get("effects") or []
    parameters = document.get("parameters") or {}
    return rendered(
        "report.html.j2",
        document=document,
        fitted="effects" not in document,
        pictures=pictures,
        effects=effects,
        errors=[error.get("before") or error.get("fit") or {}, error.get("after") or {}],
        tiles=_error_tiles(document) + _test_tiles(document),
        horizons=reached(error),
        failed=_failures(document.get("tests")),
        doubted=_doubted(document),
        parameters=parameters if {"before", "after"} & set(parameters) else {"fitted": parameters},
    )


def rendered(template: str, **content: Any) -> str:
    """A template of this folder, filled in."""
    return _environment().get_template(template).render(**content)


@functools.cache
def _environment() -> jinja2.Environment:
    """Templates that escape all text, with the words of a report as filters."""
    loader = jinja2.PackageLoader("nnap_em", "report")
    environment = jinja2.Environment(
        loader=loader, autoescape=True, undefined=jinja2.ChainableUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters["grouped"] = grouped
    names = ("number", "with_std", "quantity", "p_value", "label", "sentence", "share")
    environment.filters |= {name: getattr(wording, name) for name in names} | {"trust": _trust, "highest": _highest}
    environment.tests |= {"finite": finite, "failed": _fails}
    environment.globals |= {"most": MOST_PICTURES, "catalogue": catalogue, "level": FAILS, "at": _at, "ratio": ratio}
    return environment


# --- what is worked out of the document


def _error_tiles(document: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Title, number and remark of the errors about 1 s ahead, of the two columns that change most by the effects."""
    error, units = document.get("error") or {}, document.get("units") or {}
    horizons, after = reached(error), error.get("after") or {}
    grows, tiles = growth(error) if document.get("effects") else {}, []
    columns = (error.get("before") or error.get("fit") or {}).items()
    for column, values in sorted(columns, key=lambda entry: -abs(grows.get(entry[0], 0.0)))[:2]:
        if not horizons:
            break
        place = min(range(len(horizons)), key=lambda i: abs(horizons[i] - 1.0))
        first, last, unit = _at(values, place), _at(after.get(column), place), units.get(column) or ""
        title = f"error of {column}, {horizons[place]:.3g} s ahead"
        if document.get("effects"):
            times = ratio(first, last)
            change = f"{number(first, 2)} → {number(last, 2)} {unit}"
            tiles.append((title, change, f"{times} smaller" if times.endswith("×") else times))
        else:
            tiles.append((title, f"{number(first, 2)} {unit}", "on test sequences"))
    return tiles


def _test_tiles(document: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    failed = _failures(document.get("tests"))
    if failed is None:
        return []
    text = str(failed.before) if failed.after is None else f"{failed.before} → {failed.after}"
    return [("failed tests of one-step errors", text, f"of {failed.total}; a right model fails none")]


def _at(values: Any, place: int) -> Any:
    return values[place] if values and place < len(values) else None


class _Failed(NamedTuple):
    """Numbers of tests that failed before and after (None: there is no after), and of those that failed by little."""

    total: int
    before: int
    after: int | None
    slight_before: int
    slight_after: int


def _failures(tests: Any) -> _Failed | None:
    if not (tests and tests.get("before")):
        return None
    sides = [[t for t in tests.get(side) or [] if _fails(t)] for side in ("before", "after")]
    slight = [sum(bool(t.get("slight")) for t in side) for side in sides]
    first, last = (len(side) - little for side, little in zip(sides, slight, strict=True))
    return _Failed(len(tests["before"]), first, last if tests.get("after") else None, *slight)


def _fails(test: Mapping[str, Any]) -> bool:
    p = test.get("p_value")
    return finite(p) and p < FAILS  # type: ignore[operator]


def _doubted(document: Mapping[str, Any]) -> bool:
    """True where the test error 1 s ahead does not fall with the accepted effects, in the geometric mean of columns."""
    grows = growth(document.get("error") or {}) if document.get("effects") else {}
    return bool(grows) and sum(grows.values()) >= 0


def _trust(evidence: Mapping[str, Any] | None, doubted: bool) -> str:
    """Certainty of the finding in words; empty where it is unknown."""
    rows = ((name, scale, (evidence or {}).get(name)) for name, scale in _TRUST.items())
    decisive = next(((scale, value) for _, scale, value in rows if finite(value)), None)
    if decisive is None:
        return ""
    if doubted:
        return "Doubtful: the test sequences are predicted no better with it"
    return next((word for least, word in decisive[0] if decisive[1] >= least), "A hint only")


def _highest(entries: Sequence[Mapping[str, Any]] | None) -> list[Mapping[str, Any]]:
    """The eight entries of highest score, highest first."""
    return sorted(entries or [], key=lambda entry: -(entry.get("gain") or 0.0))[:8]
