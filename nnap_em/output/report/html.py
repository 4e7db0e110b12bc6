"""One page for every report: sections of text, tables and figures, in one HTML file that runs and fetches nothing.

A part of a section is a text (a paragraph), a list of texts (bullets), a `Table`, a `Picture` or a `Section` in it.
"""

import base64
import functools
import io
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jinja2
from matplotlib.figure import Figure

from ...base.digits import number
from ...base.files import replace_own
from .tables import json_text


class Table(NamedTuple):
    """Texts in rows; the first of each names it."""

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    kind: Literal["", "left"] = ""
    """Alignment of the other columns: numbers to the right, words to the left."""


class Picture(NamedTuple):
    """A figure of the page."""

    title: str
    caption: str
    image: bytes
    """SVG."""
    place: Literal["found", "error", "residual"] = "residual"
    """Section of the page."""
    width: float = 0.0
    """Width of the image [CSS px]; 0 where it is unknown."""

    @property
    def source(self) -> str:
        """The image as an address that holds it."""
        return f"data:image/svg+xml;base64,{base64.b64encode(self.image).decode('ascii')}"


class Section(NamedTuple):
    """Parts under a title."""

    title: str
    parts: Sequence["Part"]
    folded: bool = False
    """True where a click opens it."""


Part = str | Sequence[str] | Table | Picture | Section


def picture(place: Literal["found", "error", "residual"], title: str, caption: str, figure: Figure) -> Picture:
    """A drawn figure for the page."""
    image = io.BytesIO()
    figure.savefig(image, format="svg")
    return Picture(title, caption, image.getvalue(), place, 96 * figure.get_size_inches()[0])


def section(title: str, *parts: Part | None, folded: bool = False) -> Section | None:
    """The parts that there are, under a title; None where there is none."""
    kept = [part for part in parts if part and not (isinstance(part, Table) and not part.rows)]
    return Section(title, kept, folded) if kept else None


def rendered(
    title: str, document: Mapping[str, Any], sections: Sequence[Section | None], details: Sequence[Section | None] = ()
) -> str:
    """The page of a document that JSON holds beside it: its verdict, sections, folded details, and what made it."""
    made = dict(document.get("versions") or {})
    made |= {f"model {name}": file for name, file in (document.get("models") or {}).items()}
    made |= {name: document[name] for name in ("model", "seed", "seconds") if name in document}
    rows = [[name, number(value) if isinstance(value, float) else str(value)] for name, value in made.items()]
    versions = section("Versions, files and time", Table([], rows), folded=True)
    rig, system = document.get("rig") or "", document.get("system")
    return _template().render(
        title=f"{title} {rig}" + (f" ({system})" if system and system != rig else ""),
        verdict=document.get("verdict") or "",
        sections=[each for each in (*sections, section("Details", *details, versions)) if each],
    )


@functools.cache
def _template() -> jinja2.Template:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("nnap_em", "output/report"), autoescape=True, trim_blocks=True, lstrip_blocks=True
    )
    return environment.get_template("page.html.j2")


def write_report(
    out: Path, kind: str, document: Mapping[str, Any], text: str, named: Callable[[str], str] = str
) -> None:
    """Write KIND.json and the page `text` as KIND.html into the folder `out`, in the names of the user's file."""
    replace_own({out / f"{kind}.json": json_text(document, named), out / f"{kind}.html": named(text)})
