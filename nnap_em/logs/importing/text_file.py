"""Layouts of text tables of PLCs, drives and tools: other separators, decimal commas, lines above the header."""

import math
import re
from collections import Counter
from collections.abc import Sequence
from itertools import takewhile
from pathlib import Path
from typing import NamedTuple

from ...machines.units import clock_of, named_unit
from ..formats import PLAIN, number, split, text_lines, trimmed

MARKS = (PLAIN, (";", "."), (";", ","), ("\t", "."), ("\t", ","), ("", "."), ("", ","), (",", ","))
"""Marks of columns (none: blanks) and of decimals; of two that explain a file alike, the first counts."""
CODESYS = "[key]"
"""First word of a CODESYS trace."""


class Layout(NamedTuple):
    """Places of the numbers of a table."""

    marks: tuple[str, str]
    first: int
    """Lines above the first row of numbers."""
    names: tuple[str, ...]
    clocks: tuple[int, ...]
    """Columns of times; each counts for the columns up to the next one."""
    unit: str = ""
    """Unit of the times; empty: by their name or size."""
    dt: float = math.nan
    """Interval of the rows [s], of a table without times that states it."""


def plain_csv(path: Path) -> bool:
    """True for a CSV file whose numbers can be read as those of a data set are: it has no dates either."""
    if path.suffix.lower() != ".csv" or not path.is_file():
        return False
    lines = text_lines(path)
    found, names, row = layout(lines), split(lines[0]), split("".join(lines[1:2]))
    clock = clock_of(names)[0]
    dated = clock is not None and len(row) == len(names) and _kind(row[names.index(clock)], ".") < 0
    # What is wrong with a file of no layout is said by those who read a data set
    return not dated and (plain(lines, found) if found else not lines[0].startswith(CODESYS))


def plain(lines: Sequence[str], found: Layout) -> bool:
    """True for names in line 1, then rows, with ',' and '.'."""
    names = [name for name in found.names if name]
    odd = len(set(names)) < len(names) or any("," in name for name in names) or lines[0].startswith(("#", "%"))
    return found.marks == PLAIN and found.first == 1 and not odd


def layout(lines: Sequence[str]) -> Layout | None:
    """The layout that the first lines of a file show; None where no row of numbers stands under names."""
    lines = lines[:200]  # headers have some dozens
    every = {marks: [[_kind(text, marks[1]) for text in split(line, marks[0])] for line in lines] for marks in MARKS}
    score = lambda row: row.count(1) - row.count(-1) / 2 if len(row) - row.count(0) > 1 else 0  # noqa: E731
    marks = max(MARKS, key=lambda each: sum(map(score, every[each])))
    kinds, widths = every[marks], Counter(map(len, every[marks]))
    full = max(reversed(kinds), key=lambda row: row.count(1) * (widths[len(row)] > 1))

    def alike(row: Sequence[int]) -> bool:
        """Texts where the fullest row has some, and elsewhere numbers."""
        return len(row) == len(full) and 1 in row and all(a >= 0 or b < 0 for a, b in zip(row, full, strict=True))

    first = next((k for k, row in enumerate(kinds) if alike(row)), 0)
    head = [split(re.sub(r"^\s*[#%]\s*", "", line), marks[0]) for line in lines[:first]]
    row = split(lines[first], marks[0])
    return next((found for dialect in DIALECTS if (found := dialect(head, row, marks))), None)


def _twincat(head: Sequence[list[str]], row: list[str], marks: tuple[str, str]) -> Layout | None:
    """TwinCAT Scope: rows `Name`, `SymbolName`, `Unit`, ..., whose key stands again over every column of times."""
    rows = {fields[0]: fields for fields in head if fields}
    names = rows.get("Name", [])
    clocks = tuple(i for i, x in enumerate(row[: len(names)]) if names[i] == "Name" and _kind(x, marks[1]) == 1)
    if len(names) < 2 or not clocks:
        return None
    units = [re.sub(r"\s*\(.*", "", unit) for unit in rows.get("Unit", ())]
    ticks = 1e16  # times from here on are 100 ns ticks since 1601, as Windows counts them; in 2026, 1.3e17
    unit = "ticks" if number(row[0], marks[1]) > ticks else "ms"
    return Layout(marks, len(head), _with_units(names, units), clocks, unit)


def _labview(head: Sequence[list[str]], row: list[str], marks: tuple[str, str]) -> Layout | None:
    """LabVIEW measurement file: tags, then `X_Value` over every column of times, which may be left empty."""
    rows = {fields[0]: fields for fields in head if fields}
    if "X_Value" not in rows or "Delta_X" not in rows:
        return None
    names = _with_units(["" if name == "Comment" else name for name in head[-1]], rows.get("Y_Unit_Label", ()))
    clocks = tuple(i for i, name in enumerate(names) if name == "X_Value")
    if row[0]:
        return Layout(marks, len(head), names, clocks, "s")
    dt = number(next((text for text in rows["Delta_X"] if _kind(text, marks[1]) == 1), ""), marks[1])
    return Layout(marks, len(head), tuple("" if name == "X_Value" else name for name in names), (), dt=dt)


def _header(head: Sequence[list[str]], row: list[str], marks: tuple[str, str]) -> Layout | None:
    """A header, maybe with a row of units under it, below lines of any kind."""
    widths = {len(row), len(trimmed(row))}
    above = (fields for fields in map(trimmed, reversed(head)) if fields)
    block = [*takewhile(lambda fields: len(fields) in widths, above)]
    if not block:
        return None
    names = _with_units(block[-1], block[-2] if len(block) > 1 else ())
    time = clock_of(names)[0]
    return Layout(marks, len(head), names, tuple(i for i, name in enumerate(names) if name == time))


DIALECTS = (_twincat, _labview, _header)
"""Layouts, by the lines above the first row of numbers; for another one, add a function like these."""


def _with_units(names: Sequence[str], units: Sequence[str]) -> tuple[str, ...]:
    """Names with the units that stand under them, where these are known."""
    known = [unit.strip("[]() ") for unit in units] + [""] * len(names)
    return tuple(
        f"{name} [{unit}]" if name and named_unit(f"{name} [{unit}]")[1] else name
        for name, unit in zip(names, known, strict=False)
    )


def _kind(text: str, decimal: str) -> int:
    """1 for a number, 0 for an empty field, -1 for a text."""
    value = number(text, decimal)
    return -1 if math.isinf(value) else int(not math.isnan(value))
