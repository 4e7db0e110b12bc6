"""One log file as named columns of numbers: CSV in and out, Parquet and MAT in; every mistake refused with a hint."""

import codecs
import csv
import dataclasses
import difflib
import functools
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import cached_property
from pathlib import Path
from typing import NamedTuple, NoReturn

import numpy as np
import scipy.io
from jaxtyping import Float, Real

from ..base.digits import counted
from ..base.files import replace_text
from ..errors import DataError
from ..machines.rig import nearest
from ..machines.units import is_time
from .dataset import Array
from .dates import dated, moments
from .mat_structs import mat_columns

PLAIN = (",", ".")
"""Marks of columns and of decimals in the CSV files of a data set."""
_GROUPS = {
    decimal: re.compile(
        rf"[+-]?\d{{1,3}}([{other}](?=[\d{other}]*[{decimal}])|[ '’\u00a0\u202f])\d{{3}}(\1\d{{3}})*([{decimal}]\d*)?"
    )
    for decimal, other in (".,", ",.")
}
"""Numbers in groups of thousands by the mark of decimals."""
Table = Float[np.ndarray, "time column"]


def has_logs(folder: Path) -> bool:
    """True where there is a log in the folder."""
    return bool(_logs(folder))


def log_files(folder: Path) -> list[Path]:
    """The logs of a folder by name; DataError where there is none."""
    files = _logs(folder)
    if not files:
        every = sorted(path for path in folder.glob("*") if not path.name.startswith("."))
        problem = "holds no *.csv (nor *.parquet, *.mat)" if folder.is_dir() else "is no folder"
        others = f"; found there: {', '.join(path.name for path in every[:3])}" if every else ""
        raise DataError(f"{folder}: {problem}{others}; put one CSV file per sequence there")
    return files


def table_of(path: Path) -> "TextTable | ArrayTable":
    """The content of a log by the end of its name; DataError where it is of no kind that is read."""
    kind = path.suffix.lower()
    if kind not in _KINDS:
        raise DataError(f"{path}: no log (*.csv, *.parquet or *.mat); `nnap-em import` converts those of other kinds")
    return csv_table(path) if kind == ".csv" else ArrayTable(path, _KINDS[kind](path))


def columns_of(
    table: "TextTable | ArrayTable", required: Sequence[str], gaps: Sequence[str] = (), *, dates: bool = False
) -> Table:
    """The columns `required`, then `gaps`, in file units; NaN where one of `gaps` is missing.

    `dates`: texts of `required` may be dates.  Raises DataError that names the row and the column.
    """
    path = table.path
    _check_names(path, table.names, required, gaps)
    columns = {name: table.column(name, dates=dates) for name in required}
    columns |= {name: table.column(name, gaps=True) for name in gaps}
    count = np.size(next(iter(columns.values())))
    if count < 2:
        _too_few(path, "the file", count)
    for name, values in columns.items():
        if values.shape != (count,):
            shape = " x ".join(map(str, values.shape)) or 1
            refuse(path, f"column {name!r}", f"is {shape}, the first has {count} rows", "give all columns one length")
    return np.stack([*columns.values()], -1)


def place(path: Path, column: str, row: int | None = None) -> str:
    """Name of a column, or of a field of it, in messages: by the line of a CSV file, or by the row of another."""
    if row is None:
        return f"column {column!r}"
    return f"{f'line {row + 2}' if path.suffix.lower() == '.csv' else f'row {row + 1}'}, column {column!r}"


def refuse(path: Path, where: str, problem: str, hint: str) -> NoReturn:
    """Raise the DataError."""
    raise DataError(f"{path}: {where}: {problem}; {hint}")


def write_csv(path: Path, columns: Mapping[str, Sequence[float] | Real[Array, " time"]]) -> None:
    """Write columns of one length, 12 digits (a late clock: all), NaN as an empty field; the file is whole or absent.

    Raises DataError if the lengths differ or a value is infinite.
    """
    table = {name: np.asarray(values, np.float64) for name, values in columns.items()}
    if len({values.shape for values in table.values()}) != 1 or np.isinf([*table.values()]).any():
        shapes = {name: values.shape for name, values in table.items()}
        raise DataError(f"{path}: columns {shapes}; write finite columns (NaN = missing) of one length")
    # 12 digits, or all where a clock runs on from so long ago that samples would fall together
    late = {name for name, values in table.items() if name == "time" and np.max(np.abs(values), initial=0.0) > 1e4}
    line = ",".join(["%r" if name in late else "%.12g" for name in table])
    body = "\n".join([line % row for row in zip(*(values.tolist() for values in table.values()), strict=True)])
    replace_text(path, f"{header(table)}\n{body.replace('nan', '')}\n")


def header(names: Iterable[str]) -> str:
    """Line 1 of a CSV file; names with a comma or quotation marks stand in these."""
    quoted = ('"' + name.replace('"', '""') + '"' if set(name) & set(',"') else name for name in names)
    return ",".join(quoted)


def header_hint(path: Path) -> str | None:
    """The hint where line 1 of a CSV file is no header of columns separated by ','; None where it may be one."""
    if path.suffix.lower() != ".csv":
        return None
    lines = text_lines(path)
    first, last = lines[0], lines[-1]
    if all(map(_is_number, first.split(","))):
        return "line 1 holds numbers: write a header"
    above = "remove the lines above the header" if first.count(",") < last.count(",") else None
    return _separator_hint(first, last) or above


def untimed(names: Sequence[str]) -> str | None:
    """The hint where a column may be meant as the times; None where a table has no such column at all."""
    like = [name for name in names if is_time(name) or difflib.get_close_matches("time", [name.casefold()])]
    return f"name it 'time' [s], if {like[0]!r} is that" if like else None


def split(line: str, separator: str = ",") -> list[str]:
    """The fields of a line, which may stand in quotes; without separator they are separated by blanks."""
    if not separator:
        return line.split()
    fields = line.split(separator)
    if '"' in line:
        with suppress(csv.Error):  # a field of 128 kB
            fields = next(csv.reader([line], delimiter=separator, skipinitialspace=True))
    return [field.strip() for field in fields]


def text_lines(path: Path) -> list[str]:
    """The lines of a text in UTF-8, UTF-16 with its mark, or else as Windows writes it in western Europe.

    Those that are blank at the end are left out; DataError where none is left.
    """
    wide = read_bytes(path, 2) in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
    try:
        text = path.read_text("utf-16", "replace") if wide else path.read_text("utf-8-sig")
    except UnicodeDecodeError:
        text = path.read_text("cp1252", "replace")
    lines = text.rstrip().split("\n")
    if lines == [""]:
        refuse(path, "line 1", "the file is empty", "write a header and one row per sample, or remove the file")
    return lines


@dataclasses.dataclass(frozen=True)
class TextTable:
    """Rows of text under names, whose fields are split when they are read."""

    path: Path
    names: Sequence[str]
    lines: Sequence[str]
    at: Sequence[int]
    """Lines of the file in which the rows stand, from 1."""
    marks: tuple[str, str] = PLAIN
    """Marks of columns and of decimals."""

    @cached_property
    def values(self) -> Table:
        """Numbers of all fields: NaN where one is empty, infinite where it is a text."""
        (mark, decimal), shape = self.marks, (len(self.lines), len(self.names))
        read = functools.partial(np.loadtxt, self.lines, delimiter=mark or None, comments=None, ndmin=2)
        with suppress(ValueError):  # at full speed, where all of them are finite numbers
            table = read()
            if decimal == "." and table.shape == shape and np.isfinite(table).all():
                return table
        try:
            table = read(converters=lambda text: number(text, decimal), quotechar='"')
        except ValueError:  # rows of different lengths
            table = np.zeros((0, 0))
        if table.shape == shape and self.at[0] == 2 and np.isinf(table[0]).all():
            hint = header_hint(self.path) or "remove the row of units"
            refuse(self.path, "line 2", f"holds no number, found {self.lines[0]!r}", hint)
        if table.shape == shape:
            return table
        counts = [len(split(line, mark)) for line in self.lines]
        k = next((k for k, count in enumerate(counts) if count != shape[1]), 0)
        hint = "separate columns by ',', write decimals with '.', give every column a field; line 1 is the header"
        problem = f"found {counted(counts[k], 'field')} under {counted(shape[1], 'name')}"
        return refuse(self.path, f"line {self.at[k]}", problem, _separator_hint(*2 * [self.lines[k]]) or hint)

    def texts(self, name: str) -> list[str]:
        """The fields of one column."""
        i = self.names.index(name)
        return [split(line, self.marks[0])[i] for line in self.lines]

    def column(self, name: str, *, gaps: bool = False, dates: bool = False) -> np.ndarray:
        """One column as finite numbers, or NaN where `gaps` allow that; as seconds where it has dates."""
        values = self.values[:, self.names.index(name)]
        dates = dates and bool(np.isinf(values[:1]).any())
        values = moments(self.texts(name)) if dates else values
        if (k := _wrong(values, gaps)) is not None:
            where, text = f"line {self.at[k]}, column {name!r}", repr(self.texts(name)[k])
            if dates:
                refuse(self.path, where, f"found {text}", "write seconds, or dates such as 2026-11-03T23:59:40.010")
            _no_number(self.path, where, text, bool(np.isnan(values[k])), gaps)
        return values

    def part(self, rows: np.ndarray) -> "TextTable":
        """Some of its rows."""
        lines, at = ([each[k] for k in rows.tolist()] for each in (self.lines, self.at))
        return dataclasses.replace(self, lines=lines, at=at)


def csv_table(path: Path, lines: Sequence[str] = ()) -> TextTable:
    """A CSV file, or its lines: names in line 1, then rows."""
    first, *rows = lines or text_lines(path)
    if len(rows) < 2:
        _too_few(path, f"line {len(rows) + 1}", len(rows))
    return TextTable(path, split(first), rows, range(2, len(rows) + 2))


class ArrayTable(NamedTuple):
    """Columns of a file that stores numbers as such."""

    path: Path
    columns: Mapping[str, np.ndarray]

    @property
    def names(self) -> Sequence[str]:
        """The names of the columns."""
        return list(self.columns)

    def column(self, name: str, *, gaps: bool = False, dates: bool = False) -> np.ndarray:
        """One column as finite numbers, or NaN where `gaps` allow that; as seconds where it has dates."""
        values = self.columns[name]
        if dates and values.dtype.kind in "MmOSU":
            values = dated(values)
        if values.dtype.kind not in "iuf":
            hint = "store it as 64-bit floating point"
            refuse(self.path, f"column {name!r}", f"holds {values.dtype}, no numbers", hint)
        values = values.astype(np.float64)
        if (k := _wrong(values, gaps)) is not None:
            value = values.ravel()[k]
            _no_number(self.path, place(self.path, name, k), f"{value:g}", bool(np.isnan(value)), gaps)
        return values


def _mat(path: Path) -> dict[str, np.ndarray]:
    """The columns of a MAT file: its vectors, those of a struct alone, and those of structs that recorders write."""
    with _damaged(path):
        try:
            content = scipy.io.loadmat(path, squeeze_me=True, struct_as_record=True)
        except NotImplementedError:
            refuse(path, "the file", "a MAT file of version 7.3", "save it with save(..., '-v7')")
    variables = {name: np.asarray(value) for name, value in content.items() if not name.startswith("__")}
    out: dict[str, np.ndarray] = {}
    for name, column in mat_columns(path, variables):
        if name in out and not np.array_equal(out[name], column):
            hint = "save signals of one sample time, with different names, to a file"
            refuse(path, f"column {name!r}", "stands there twice with different numbers", hint)
        column = np.asarray(column)
        if column.ndim == 2 and column.dtype.kind in "iuf":  # a matrix, longer than wide: yout[0] and so on
            columns = column.T if column.shape[0] > column.shape[1] else column
            out |= {f"{name}[{i}]": each for i, each in enumerate(columns)}
        else:
            out[name] = column
    return out


def _parquet(path: Path) -> dict[str, np.ndarray]:
    """The columns of a Parquet file; where a row holds a list, one for each entry."""
    try:
        from pyarrow import parquet
    except ImportError:
        hint = "pip install 'nnap-em[formats]', or write the log as CSV"
        raise DataError(f"{path}: cannot be read without pyarrow; {hint}") from None
    out: dict[str, np.ndarray] = {}
    with _damaged(path):
        table = parquet.read_table(path)
        if (rows := table.num_rows) < 2:
            _too_few(path, "the file", rows)
        for name, column in zip(table.column_names, table.columns, strict=True):
            if "list" in str(column.type):
                entries = column.combine_chunks().flatten().to_numpy(zero_copy_only=False)
                if entries.size % rows == 0:
                    out |= {f"{name}[{i}]": entry for i, entry in enumerate(entries.reshape(rows, -1).T)}
            else:
                out[name] = column.to_numpy()
    return out


_KINDS: dict[str, Callable[[Path], Mapping[str, np.ndarray]]] = {
    ".csv": lambda path: {},
    ".parquet": _parquet,
    ".mat": _mat,
}


def _logs(folder: Path) -> list[Path]:
    return sorted(p for p in folder.glob("*") if p.suffix.lower() in _KINDS and not p.name.startswith("."))


@contextmanager
def _damaged(path: Path) -> Iterator[None]:
    """Whatever a parser raises on bytes that are none of its format, as a DataError."""
    try:
        yield
    except DataError:
        raise
    except Exception as error:
        if isinstance(error, OSError) and error.errno:
            raise unreadable(path, error) from None
        form = {".mat": "MAT", ".parquet": "Parquet"}[path.suffix.lower()]
        hint = "use another copy, or write it as CSV"
        raise DataError(f"{path}: no {form} file, or damaged or cut short; {hint}") from None


def unreadable(path: Path, error: OSError) -> DataError:
    """The error of a file that the system does not give."""
    return DataError(f"{path}: cannot be read ({error.strerror}); check the path and the rights")


def read_bytes(path: Path, most: int = -1) -> bytes:
    """The first bytes of a file, or all."""
    try:
        with path.open("rb") as file:
            return file.read(most)
    except OSError as error:
        raise unreadable(path, error) from None


def number(text: str, decimal: str = ".") -> float:
    """A number, or a truth value of a PLC; NaN for an empty field, infinite for another text.

    Thousands may be grouped, by the other mark where decimals follow: 1,016 alone may be 1.016 as well.
    """
    text = text.strip()
    if group := _GROUPS[decimal].fullmatch(text):
        text = text.replace(group[1], "")
    if decimal == ",":
        text = text.replace(".", "?").replace(",", ".")
    try:
        return float(text or "nan") if "_" not in text else math.inf  # Python takes 1_0 for 10
    except ValueError:
        return {"TRUE": 1.0, "FALSE": 0.0}.get(text.upper(), math.inf)


def trimmed(row: Sequence[str]) -> list[str]:
    """The fields up to the last one that is not empty."""
    return list(row[: max((k for k, text in enumerate(row, 1) if text), default=0)])


def _is_number(field: str) -> bool:
    """True for a number and for an empty field."""
    return not math.isinf(number(field))


def _separator_hint(first: str, last: str) -> str | None:
    other = next((mark for mark in (";", "\t") if mark in first and mark in last), None)
    return f"separate columns by ',' (not {other!r}), decimals by '.'" if other else None


def _check_names(path: Path, names: Sequence[str], required: Sequence[str], gaps: Sequence[str]) -> None:
    """Refuse columns that are not there, or more than once."""
    line = "line 1, " if path.suffix.lower() == ".csv" else ""
    spare = [name for name in names if name not in (*required, *gaps)]
    for name in (*required, *gaps):
        if name not in names:
            reads = "or `nnap-em import` it: it reads other names, separators and clocks"
            other = reads if name == "time" else "or correct the columns of rig.toml"
            hint = header_hint(path) or (nearest(name, spare) if spare else "log it")
            refuse(path, f"{line}column {name!r}", "missing", f"{hint}; {other}")
        if names.count(name) > 1:
            refuse(path, f"{line}column {name!r}", f"stands there {names.count(name)} times", "keep one of them")


def _wrong(values: np.ndarray, gaps: bool) -> int | None:
    """Place of the first value that is no number; NaN is a missing one where `gaps` allow it."""
    wrong = np.flatnonzero(np.isinf(values) | (np.isnan(values) & (not gaps)))
    return int(wrong[0]) if wrong.size else None


def _no_number(path: Path, where: str, text: str, missing: bool, gaps: bool) -> NoReturn:
    hint = "write a number such as -0.125" + (", or leave the field empty: a missing sample" if gaps else "")
    refuse(path, where, f"found {text}", hint + ("; time and inputs are never empty" * missing))


def _too_few(path: Path, where: str, rows: int) -> NoReturn:
    hint = "write 2 rows or more" if where == "the file" else "write a header and 2 rows or more"
    refuse(path, where, f"found {counted(rows, 'row')}", hint)
