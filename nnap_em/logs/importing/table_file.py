"""Tables: CSV and other texts, workbooks, Parquet and MAT files; a topic for each clock, whose fields are columns."""

import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from ...errors import DataError
from ...machines.units import UNITS, clock_of, is_episode, named_unit
from ..formats import (
    ArrayTable,
    TextTable,
    columns_of,
    csv_table,
    header_hint,
    refuse,
    split,
    table_of,
    text_lines,
    unreadable,
    untimed,
)
from .clock import in_a_row, nanoseconds, rising
from .recording import EXTRA, SECOND, UNTIMED, Recording, Topic, Track
from .text_file import CODESYS, layout, plain

SHEETS = (".xlsx", ".xls", ".ods")
"""Ends of the names of workbooks."""
_TICKS_1970 = 116_444_736_000_000_000
"""1970 in ticks of 100 ns since 1601."""


class Block(NamedTuple):
    """Columns with one clock."""

    table: TextTable | ArrayTable
    columns: tuple[str, ...]
    clock: str | None
    day: str | None = None
    """Column of the dates beside the times."""
    unit: str = ""
    """Unit of the times; empty: by their name or size."""
    dt: float = math.nan
    """Interval of the rows [s], of a table without times that states it."""

    def times(self) -> Int[np.ndarray, " row"]:
        """The times [ns], with the dates beside them; ticks in whole numbers, of which a float holds 16 digits."""
        table, clock = self.table, self.clock or ""
        t = columns_of(table, (clock,), dates=True)[:, 0]
        if self.unit == "ticks" and isinstance(table, TextTable):
            every = zip(table.texts(clock), t, strict=True)
            return np.array([100 * (int(text if text.isdecimal() else x) - _TICKS_1970) for text, x in every])
        unit = clock.lower() if clock.lower() in UNITS else named_unit(clock)[1]
        days = (lambda: columns_of(table, (self.day or "",), dates=True)[:, 0]) if self.day else None
        return nanoseconds(table.path, f"column {clock!r}", t, self.unit or unit, days)

    def track(self, names: Sequence[str]) -> Track:
        """Some of the columns at their times."""
        episode = [name for name in self.columns if is_episode(name)][:1]
        read = columns_of(self.table, episode, names)
        values = dict(zip(names, read[:, len(episode) :].T, strict=True))
        step = SECOND * (1.0 if math.isnan(self.dt) else self.dt)
        t = self.times() if self.clock else np.round(step * np.arange(len(read))).astype(np.int64)
        t = in_a_row(t, read[:, 0]) if episode else t
        if not self.clock and math.isnan(self.dt):
            return Track(t, values, UNTIMED, ())
        name = re.sub(r" \(\d+\)$", "", self.clock or "Delta_X")  # several clocks that are called alike
        return rising(self.table.path, f"column {self.clock!r}", t, values, name)


def topics(path: Path) -> tuple[Topic, ...]:
    """A topic for each clock; one alone has no name."""
    return tuple(
        Topic(name, f"table, time in column {block.clock!r}" if block.clock else "table without times", None,
              block.columns)
        for name, block in _blocks(path).items()
    )  # fmt: skip


def read(path: Path, fields: Mapping[str, Sequence[str]]) -> Recording:
    """These columns; an empty field is NaN."""
    blocks = _blocks(path)
    return Recording(path, {topic: blocks[topic].track(names) for topic, names in fields.items()})


def _blocks(path: Path) -> dict[str, Block]:
    """The columns by their clocks."""
    if path.suffix.lower() in (".parquet", ".mat"):
        return {"": _whole(table_of(path))}
    lines = _sheet(path) if path.suffix.lower() in SHEETS else text_lines(path)
    blocks = [*(_codesys if lines[0].startswith(CODESYS) else _parts)(path, lines)]
    if not blocks:
        hint = header_hint(path) or "write a header, then rows of numbers"
        refuse(path, "the file", "holds no column of numbers under a name", hint)
    return {f"clock {k}" if len(blocks) > 1 else "": block for k, block in enumerate(blocks, 1)}


def _whole(table: TextTable | ArrayTable) -> Block:
    """All columns of a table with one clock, or none."""
    clock, day = clock_of(table.names)
    if clock is None:
        _refuse_clock(table, header_hint(table.path) or untimed(table.names))
    return Block(table, tuple(name for name in table.names if name not in (clock, day, "")), clock, day)


def _refuse_clock(table: TextTable | ArrayTable, hint: str | None) -> None:
    """Refuse a table whose times may have a name that is not known; one without times has no hint."""
    if hint:
        refuse(table.path, "the file", f"has no column of times (found {', '.join(table.names[:6])})", hint)


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


def _parts(path: Path, lines: Sequence[str]) -> Iterator[Block]:
    """The columns of a text table, in one block for each column of times; those with the same times together."""
    found = layout(lines)
    if found is None and path.suffix.lower() != ".csv":
        return
    if found is None or plain(lines, found):
        yield _whole(csv_table(path, lines))
        return
    rows, names = lines[found.first :], _different(found.names)
    end = next((k for k, line in enumerate(rows) if line.strip("\t ,;") == "EOF"), len(rows))
    lines = _padded(rows[:end], found.marks[0], len(names))
    table = TextTable(path, names, lines, range(found.first + 1, found.first + 1 + end), found.marks)
    if not found.clocks:
        filled = np.flatnonzero(~np.isnan(table.values).all(axis=1))
        columns = tuple(filter(None, names))
        _refuse_clock(table, untimed(columns) if math.isnan(found.dt) else None)
        yield Block(table.part(filled), columns, None, dt=found.dt)
        return
    day = clock_of(found.names)[1]
    parts: dict[bytes, list[int]] = {}
    for clock, (start, stop) in zip(found.clocks, pairwise((0, *found.clocks[1:], len(names))), strict=True):
        inside = [i for i in range(start, stop) if names[i] and i not in found.clocks and names[i] != day]
        if inside:
            parts.setdefault(table.values[:, clock].tobytes(), [clock]).extend(inside)
    for clock, *inside in parts.values():
        filled = np.flatnonzero((~np.isnan(table.values[:, [clock, *inside]])).any(axis=1))
        yield Block(table.part(filled), tuple(names[i] for i in inside), names[clock], day, found.unit)


def _padded(lines: Sequence[str], mark: str, width: int) -> list[str]:
    """Lines with empty fields up to this number, as the last ones may be absent."""
    short = (line.rstrip().rstrip(mark) if mark else line for line in lines)
    return [
        line + (mark or " nan") * (width - 1 - line.count(mark) if mark else width - len(line.split()))
        for line in short
    ]


def _different(names: Sequence[str]) -> tuple[str, ...]:
    """Names with a number behind those that stood there before."""
    twice, out = Counter[str](), []
    for name in names:
        twice[name] += 1
        out.append(f"{name} ({twice[name] - 1})" if name and twice[name] > 1 else name)
    return tuple(out)


def _codesys(path: Path, lines: Sequence[str]) -> Iterator[Block]:
    """CODESYS trace: for each variable `0.Variable; name`, then rows `; time; value`; bit 5 of `Flags`: us, else ms."""
    name, unit = "", "ms"
    parts: dict[str, tuple[int, list[str]]] = {}
    for at, line in enumerate(lines, 1):
        key, *rest = split(line, ";")
        if not key and len(rest) == 2:
            parts.setdefault(name, (at, []))[1].append(";".join(rest))
        elif key.endswith("Variable"):
            name = " ".join(rest)
        elif key == "Flags" and rest and rest[0].isdecimal() and int(rest[0]) & 32:
            unit = "us"
    for name, (first, rows) in parts.items():
        table = TextTable(path, ("time", name), rows, range(first, first + len(rows)), (";", "."))
        yield Block(table, (name,), "time", unit=unit)
