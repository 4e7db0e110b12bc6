"""Text tables of PLCs, drives and tools: other separators, decimal commas, lines above the header, several clocks."""

import codecs
import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise, takewhile
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from ..data.dataset import DataError
from ..data.formats import check_size, number, numbers, read_bytes, refuse, split, unreadable
from ..data.units import clock_of, is_episode, named_unit
from ..numerics.digits import counted
from .clock import in_a_row, nanoseconds, rising
from .recording import EXTRA, SECOND, UNTIMED, Recording, Topic, Track

MARKS = ((",", "."), (";", "."), (";", ","), ("\t", "."), ("\t", ","), ("", "."), ("", ","), (",", ","))
"""Marks of columns (none: blanks) and of decimals; of two that explain a file alike, the first counts."""
SHEETS = (".xlsx", ".xls", ".ods")
"""Ends of the names of workbooks."""
CODESYS = "[key]"
"""First word of a CODESYS trace."""
Cells = tuple[Sequence[int], Sequence[str]]
"""Lines in the file, counted from 1, and the fields of a column in them."""


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


class Block(NamedTuple):
    """Columns with one clock."""

    clock: str
    t: Int[np.ndarray, " row"] | None
    """ns; None: the table has no times."""
    columns: Mapping[str, Cells]
    decimal: str


def foreign(path: Path) -> bool:
    """True for a text table that is no plain CSV file: names in line 1, then rows, ',' and '.'."""
    text = _decoded(read_bytes(path, 2**18).rpartition(b"\n")[0])  # the layout shows in it
    found = layout(text.split("\n"))
    if found is None:
        return text.startswith(CODESYS)
    names = [name for name in found.names if name]
    plain = found.marks == MARKS[0] and found.first == 1 and len(set(names)) == len(names) and text[0] not in "#%"
    return not plain or any("," in name for name in names)


def topics(path: Path) -> tuple[Topic, ...]:
    """A topic for each clock; one alone has no name."""
    return tuple(
        Topic(name, "text table" + (", no times" if block.t is None else ""), None, tuple(block.columns))
        for name, block in _blocks(path).items()
    )


def read(path: Path, fields: Mapping[str, Sequence[str]]) -> Recording:
    """These columns; an empty field is NaN."""
    blocks, tracks = _blocks(path), {}
    for topic, names in fields.items():
        block = blocks[topic]
        values = {name: numbers(path, name, *block.columns[name], True, False, block.decimal) for name in names}
        t = SECOND * np.arange(len(values[names[0]])) if block.t is None else block.t
        for name in filter(is_episode, block.columns):
            t = in_a_row(t, numbers(path, name, *block.columns[name], False, False, block.decimal))
        if block.t is None:
            tracks[topic] = Track(t, values, UNTIMED, ())
        else:
            tracks[topic] = rising(path, f"column {block.clock!r}", t, block.clock).track(values.items())
    return Recording(path, tracks)


def layout(lines: Sequence[str]) -> Layout | None:
    """The layout that the first lines of a file show; None where no row of numbers stands under names."""
    lines = lines[:200][:-1] or lines  # headers have some dozens; the last one may be cut
    every = {marks: [[_kind(text, marks[1]) for text in _split(line, marks[0])] for line in lines] for marks in MARKS}
    marks = max(MARKS, key=lambda each: sum(sum(row) for row in every[each] if len(row) - row.count(0) > 1))
    kinds, widths = every[marks], Counter(map(len, every[marks]))
    full = max(reversed(kinds), key=lambda row: row.count(1) * (widths[len(row)] > 1))

    def alike(row: Sequence[int]) -> bool:
        """Texts where the fullest row has some, and elsewhere numbers."""
        return len(row) == len(full) and 1 in row and all(a >= 0 or b < 0 for a, b in zip(row, full, strict=True))

    first = next((k for k, row in enumerate(kinds) if alike(row)), 0)
    head = [_split(re.sub(r"^\s*[#%]\s*", "", line), marks[0]) for line in lines[:first]]
    row = _split(lines[first], marks[0])
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
    widths = {len(row), len(_trimmed(row))}
    above = (fields for fields in map(_trimmed, reversed(head)) if fields)
    block = [*takewhile(lambda fields: len(fields) in widths, above)]
    if not block:
        return None
    names = _with_units(block[-1], block[-2] if len(block) > 1 else ())
    time = clock_of(names)[0]
    return Layout(marks, len(head), names, tuple(i for i, name in enumerate(names) if name == time))


DIALECTS = (_twincat, _labview, _header)
"""Layouts, by the lines above the first row of numbers; for another one, add a function like these."""


def _blocks(path: Path) -> dict[str, Block]:
    """The columns by their clocks, those with the same times together."""
    check_size(path)
    lines = _sheet(path) if path.suffix.lower() in SHEETS else _decoded(read_bytes(path)).rstrip().split("\n")
    out: list[Block] = []
    for block in (_codesys if lines[0].startswith(CODESYS) else _table)(path, lines):
        same = [k for k, other in enumerate(out) if other.t is not None and np.array_equal(other.t, block.t)]  # pyright: ignore[reportArgumentType]
        if same:
            out[same[0]] = out[same[0]]._replace(columns={**out[same[0]].columns, **block.columns})
        elif block.columns:
            out.append(block)
    if not out:
        refuse(path, "the file", "holds no column of numbers under a name", "write a header, then rows of numbers")
    return {f"clock {k}" if len(out) > 1 else "": block for k, block in enumerate(out, 1)}


def _sheet(path: Path) -> list[str]:
    """The rows of the first sheet of a workbook, fields separated by tabulators, dates as ISO 8601."""
    try:
        import python_calamine
    except ImportError:
        raise DataError(f"{path}: workbooks cannot be read without python-calamine; {EXTRA}") from None
    try:
        rows = python_calamine.CalamineWorkbook.from_path(path).get_sheet_by_index(0).to_python(skip_empty_area=False)
    except PermissionError as error:
        raise unreadable(path, error) from None
    except Exception as error:  # whatever the parser raises on bytes that are no workbook
        raise DataError(f"{path}: no workbook, or damaged ({error}); save the sheet as CSV UTF-8") from None
    text = lambda cell: cell.isoformat() if hasattr(cell, "isoformat") else " ".join(str(cell).split())  # noqa: E731
    return ["\t".join(map(text, row)) for row in rows] or [""]


def _table(path: Path, lines: Sequence[str]) -> Iterator[Block]:
    """The columns of a table, in one block for each column of times."""
    found = layout([*lines, ""])
    if found is None:
        return
    width, rows = len(found.names), []
    for at, line in enumerate(lines[found.first :], found.first + 1):
        fields = _trimmed(_split(line, found.marks[0]))
        if fields == ["EOF"]:
            break
        if len(fields) > width:
            problem = f"found {counted(len(fields), 'field')} under {counted(width, 'name')}"
            refuse(path, f"line {at}", problem, "name every column; mark columns and decimals differently")
        rows += [(at, fields + [""] * (width - len(fields)))] if fields else []
    twice = Counter[str]()
    names = list(found.names)
    for i, name in enumerate(names):
        twice[name] += 1
        names[i] += f" ({twice[name] - 1})" * bool(name and twice[name] > 1)
    for k, (start, end) in enumerate(pairwise((0, *found.clocks[1:], width))):
        clock = found.clocks[k : k + 1]
        inside = [i for i in range(start, end) if names[i] and i not in found.clocks]
        full = [row for row in rows if not clock or any(row[1][i] for i in (*clock, *inside))]  # fewer of a slower one
        column = {i: ([at for at, _ in full], [fields[i] for _, fields in full]) for i in (*clock, *inside)}
        columns = {names[i]: column[i] for i in inside}
        if clock:
            name = found.names[clock[0]]
            day = columns.get(clock_of(found.names)[1] or "")
            t = _nanoseconds(path, name, column[clock[0]], found.unit, found.marks[1], day)
            yield Block(name, t, columns, found.marks[1])
        else:
            t = None if math.isnan(found.dt) else np.round(found.dt * SECOND * np.arange(len(rows))).astype(np.int64)
            yield Block("Delta_X", t, columns, found.marks[1])


def _codesys(path: Path, lines: Sequence[str]) -> Iterator[Block]:
    """CODESYS trace: for each variable `0.Variable; name`, then rows `; time; value`; bit 5 of `Flags`: us, else ms."""
    name, unit = "", "ms"
    parts: dict[str, tuple[list[int], list[str], list[str]]] = {}
    for at, line in enumerate(lines, 1):
        key, *rest = _split(line, ";")
        if not key and len(rest) == 2:
            numbered, t, y = parts.setdefault(name, ([], [], []))
            numbered.append(at)
            t.append(rest[0])
            y.append(rest[1])
        elif key.endswith("Variable"):
            name = " ".join(rest)
        elif key == "Flags" and rest and rest[0].isdecimal() and int(rest[0]) & 32:
            unit = "us"
    for name, (numbered, t, y) in parts.items():
        yield Block("time", _nanoseconds(path, "time", (numbered, t), unit, "."), {name: (numbered, y)}, ".")


def _with_units(names: Sequence[str], units: Sequence[str]) -> tuple[str, ...]:
    """Names with the units that stand under them, where these are known."""
    known = [unit.strip("[]() ") for unit in units] + [""] * len(names)
    return tuple(
        f"{name} [{unit}]" if name and named_unit(f"{name} [{unit}]")[1] else name
        for name, unit in zip(names, known, strict=False)
    )


def _nanoseconds(
    path: Path, name: str, cells: Cells, unit: str, decimal: str, day: Cells | None = None
) -> Int[np.ndarray, " row"]:
    """The times, with the dates beside them; ticks in whole numbers, of which floating point holds 16 digits."""
    t = numbers(path, name, *cells, False, True, decimal)
    ticks_1970 = 116_444_736_000_000_000
    if unit == "ticks":
        whole = [int(text) if text.isdecimal() else int(x) for text, x in zip(cells[1], t, strict=True)]
        return np.array([100 * (ticks - ticks_1970) for ticks in whole])
    days = (lambda: numbers(path, "date", *day, False, True, decimal)) if day else None
    return nanoseconds(path, f"column {name!r}", t, unit or named_unit(name)[1], days)


def _split(line: str, mark: str) -> list[str]:
    """The fields of a line, truth values of a PLC as numbers."""
    truths = {"TRUE": "1", "FALSE": "0"}
    return [truths.get(text.upper(), text) for text in split(line, mark)]


def _kind(text: str, decimal: str) -> int:
    """1 for a number, 0 for an empty field, -1 for a text."""
    value = number(text, decimal)
    return -1 if math.isinf(value) else int(not math.isnan(value))


def _trimmed(fields: Sequence[str]) -> list[str]:
    """The fields up to the last one that is not empty."""
    return list(fields[: max((k for k, text in enumerate(fields, 1) if text), default=0)])


def _decoded(data: bytes) -> str:
    """Text in UTF-8, UTF-16 with its mark, or else as Windows writes it in western Europe."""
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        text = data.decode("utf-16", errors="replace")
    else:
        try:
            text = data.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = data.decode("cp1252", errors="replace")
    return text.replace("\r\n", "\n").replace("\r", "\n")
