"""One log file as named columns of numbers: CSV in and out, Parquet and MAT in; every mistake refused with a hint."""

import csv
import difflib
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from itertools import pairwise
from pathlib import Path
from typing import Any, NoReturn, TextIO

import numpy as np
import scipy.io
from jaxtyping import Float, Real

from ..numerics.digits import counted
from ..storage.files import replace_text
from .dataset import Array, DataError
from .dates import dated, moments
from .mat_structs import mat_columns
from .rig import nearest
from .units import clock_of, is_time

LARGEST_FILE = 256 * 2**20  # bytes of the file of one sequence: some million rows
TEXT_BYTES = 2**20  # bytes of text that are split at once, which take some 40 times as much memory
Table = Float[np.ndarray, "time column"]


def has_logs(folder: Path) -> bool:
    """True where there is a log in the folder."""
    return bool(_logs(folder))


def log_files(folder: Path) -> list[Path]:
    """The logs of a folder by name; DataError where there is none, or two for one sequence."""
    files = _logs(folder)
    if not files:
        every = sorted(path for path in folder.glob("*") if not path.name.startswith("."))
        problem = "holds no *.csv (nor *.parquet, *.mat)" if folder.is_dir() else "is no folder"
        others = f"; found there: {', '.join(path.name for path in every[:3])}" if every else ""
        raise DataError(f"{folder}: {problem}{others}; put one CSV file per sequence there")
    for one, two in pairwise(sorted(files, key=lambda path: (path.stem, path.name))):
        if one.stem == two.stem:
            raise DataError(f"{two}: there is a {one.name} beside it, maybe of the same sequence; remove or rename one")
    return files


def read_table(path: Path, required: Sequence[str], gaps: Sequence[str] = ()) -> Table:
    """The columns `required`, then `gaps`, of a log in the format that its name ends in; NaN = missing (`gaps` only).

    Raises DataError that names the row and the column.
    """
    check_size(path)
    return _of(path, _readers)(path, required, gaps)


def read_log(path: Path, required: Sequence[str], gaps: Sequence[str]) -> Table:
    """The same of a log of any size, whose times may be dates [s since 1970]."""
    return _of(path, _readers)(path, required, gaps, True)


def column_names(path: Path) -> list[str]:
    """The names of the columns of a log, in the order of the file."""
    return _of(path, _namers)(path)


def _of(path: Path, functions: Mapping[str, Callable[..., Any]]) -> Callable[..., Any]:
    """The function for the kind of a file; DataError where there is none."""
    if path.suffix.lower() not in functions:
        raise DataError(f"{path}: no log (*.csv, *.parquet or *.mat); `nnap-em import` converts those of other kinds")
    return functions[path.suffix.lower()]


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
    first, last = _ends(path)
    if all(map(_is_number, first.split(","))):
        return "line 1 holds numbers: write a header"
    above = "remove the lines above the header" if first.count(",") < last.count(",") else None
    return _separator_hint(path) or above


def dated_csv(path: Path) -> bool:
    """True for a CSV file whose times are dates or times of day."""
    lines = read_bytes(path, 2**18).decode("utf-8-sig", errors="replace").splitlines()
    names, row = split(lines[0]), split("".join(lines[1:2]))
    clock = clock_of(names)[0]
    return clock is not None and len(row) == len(names) and not _is_number(row[names.index(clock)])


def untimed(path: Path, names: Sequence[str]) -> str | None:
    """The hint where a column may be meant as the times; None where a table has no such column at all."""
    like = [name for name in names if is_time(name) or difflib.get_close_matches("time", [name.casefold()])]
    return header_hint(path) or (f"name it 'time' [s], if {like[0]!r} is that" if like else None)


def split(line: str, separator: str = ",") -> list[str]:
    """The fields of a line, which may stand in quotes; without separator they are separated by blanks."""
    if not separator:
        return line.split()
    fields = line.split(separator)
    if '"' in line:
        with suppress(csv.Error):  # a field of 128 kB
            fields = next(csv.reader([line], delimiter=separator, skipinitialspace=True))
    return [field.strip() for field in fields]


def csv_fields(path: Path) -> tuple[list[str], list[list[str]]]:
    """The names in the header of a CSV file, and the fields of every row under it."""
    names = split(_first_line(path))
    return names, [row for first, lines in _blocks(path) for row in _fields(path, names, first, lines)]


def read_csv(path: Path, required: Sequence[str], gaps: Sequence[str] = (), dates: bool = False) -> Table:
    """The columns `required`, then `gaps`, of a CSV file with a header, in file units; NaN = empty field (`gaps` only).

    `dates`: texts of `required` may be dates of ISO 8601.  Raises DataError that names the line and the column.
    """
    names = split(_first_line(path))
    _check_names(path, names, required, gaps)
    places = {name: names.index(name) for name in (*required, *gaps)}

    def table(first: int, lines: Sequence[str]) -> Table:
        if (plain := _plain(lines, len(names))) is not None:
            return plain[:, [*places.values()]]
        columns = [*zip(*_fields(path, names, first, lines), strict=True)]
        numbered = range(first + 2, first + 2 + len(lines))
        return np.stack([numbers(path, name, numbered, columns[i], name in gaps, dates and name in required)
                         for name, i in places.items()], -1)  # fmt: skip

    return np.concatenate([table(first, lines) for first, lines in _blocks(path)])


def read_parquet(path: Path, required: Sequence[str], gaps: Sequence[str] = (), dates: bool = False) -> Table:
    """The same of a Parquet file, where null and NaN are missing samples."""
    names = _parquet_columns(path)
    _check_names(path, list(names), required, gaps)
    with _damaged(path, "Parquet"):
        table = _parquet_file(path).read(columns=list(dict.fromkeys(names[name][0] for name in (*required, *gaps))))
        columns = {name: _entry(table[names[name][0]], names[name][1]) for name in (*required, *gaps)}
    return _stack(path, columns, gaps, dates)


def read_mat(path: Path, required: Sequence[str], gaps: Sequence[str] = (), dates: bool = False) -> Table:
    """The same of a MAT file (version 7 or older): one vector per column, or one struct of them; NaN is missing."""
    columns = _mat_columns(path)
    _check_names(path, list(columns), required, gaps)
    return _stack(path, {name: np.asarray(columns[name]) for name in (*required, *gaps)}, gaps, dates)


_readers: dict[str, Callable[..., Table]] = {".csv": read_csv, ".parquet": read_parquet, ".mat": read_mat}


def _mat_columns(path: Path) -> dict[str, Any]:
    """The columns of a MAT file: its vectors, those of a struct alone, and those of structs that recorders write."""
    with _damaged(path, "MAT"):
        try:
            content = scipy.io.loadmat(path, squeeze_me=True, struct_as_record=True)
        except NotImplementedError:
            refuse(path, "the file", "a MAT file of version 7.3", "save it with save(..., '-v7')")
    variables = {name: np.asarray(value) for name, value in content.items() if not name.startswith("__")}
    out: dict[str, Any] = {}
    for name, column in mat_columns(path, variables):
        if name in out and not np.array_equal(out[name], column):
            hint = "save signals of one sample time, with different names, to a file"
            refuse(path, f"column {name!r}", "stands there twice with different numbers", hint)
        out |= _entries(name, np.asarray(column))
    return out


def _entries(name: str, column: np.ndarray) -> dict[str, np.ndarray]:
    """A vector; the columns of a matrix, `yout[0]` and so on, which is longer than wide."""
    if column.ndim != 2 or column.dtype.kind not in "iuf":
        return {name: column}
    columns = column.T if column.shape[0] > column.shape[1] else column
    return {f"{name}[{i}]": each for i, each in enumerate(columns)}


def _parquet_file(path: Path) -> Any:
    try:
        from pyarrow import parquet
    except ImportError:
        hint = "pip install 'nnap-em[formats]', or write the log as CSV"
        raise DataError(f"{path}: cannot be read without pyarrow; {hint}") from None
    with _damaged(path, "Parquet"):
        return parquet.ParquetFile(path)


def _parquet_columns(path: Path) -> dict[str, tuple[str, int | None]]:
    """The columns by their names; where a row holds a list, one for each entry of the first."""
    file, out = _parquet_file(path), {}
    _enough(path, file.metadata.num_rows)
    with _damaged(path, "Parquet"):
        for field in file.schema_arrow:
            if "list" not in str(field.type):
                out[field.name] = (field.name, None)
                continue
            first = next(file.iter_batches(1, columns=[field.name]))[0][0].as_py() or ()
            out |= {f"{field.name}[{i}]": (field.name, i) for i in range(len(first))}
    return out


def _entry(column: Any, index: int | None) -> np.ndarray:
    """One column, or one entry of the list in each of its rows."""
    if index is None:
        return column.to_numpy()
    from pyarrow import compute

    return compute.call_function("list_element", [column, index]).to_numpy()


_namers: dict[str, Callable[[Path], list[str]]] = {
    ".csv": lambda path: split(_first_line(path)),
    ".parquet": lambda path: list(_parquet_columns(path)),
    ".mat": lambda path: list(_mat_columns(path)),
}


def _logs(folder: Path) -> list[Path]:
    return sorted(p for p in folder.glob("*") if p.suffix.lower() in _readers and not p.name.startswith("."))


@contextmanager
def _damaged(path: Path, form: str) -> Iterator[None]:
    """Whatever a parser raises on bytes that are none of its format, as a DataError."""
    try:
        yield
    except DataError:
        raise
    except Exception as error:
        if isinstance(error, OSError) and error.errno:
            raise unreadable(path, error) from None
        hint = "use another copy, or write it as CSV"
        raise DataError(f"{path}: no {form} file, or damaged or cut short; {hint}") from None


def check_size(path: Path) -> None:
    """Raise DataError where a file cannot be read, or is too large to be one sequence."""
    try:
        size = path.stat().st_size
    except OSError as error:
        raise unreadable(path, error) from None
    if size > LARGEST_FILE:
        hint = f"cut it into sequences of some seconds, at most {LARGEST_FILE // 2**20} MB a file"
        raise DataError(f"{path}: {size / 2**20:.0f} MB are too much for one sequence; {hint}")


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


@contextmanager
def _opened(path: Path) -> Iterator[TextIO]:
    """A file as text; whatever is wrong with it as a DataError."""
    try:
        with path.open(encoding="utf-8-sig") as file:
            yield file
    except OSError as error:
        raise unreadable(path, error) from None
    except UnicodeDecodeError:
        line = read_bytes(path).decode(errors="replace").partition("\ufffd")[0].count("\n") + 1
        refuse(path, f"line {line}", "not UTF-8", "save the file as plain UTF-8 text")


def _first_line(path: Path) -> str:
    with _opened(path) as file:
        line = file.readline()
        if not line.strip() and not any(map(str.strip, file)):
            refuse(path, "line 1", "the file is empty", "write a header and one row per sample, or remove the file")
    return line.rstrip("\n")


def _ends(path: Path) -> tuple[str, str]:
    """The first and the last line of a text file."""
    with path.open("rb") as file:
        file.seek(max(path.stat().st_size - TEXT_BYTES, 0))
        return _first_line(path), file.read().decode(errors="replace").strip().splitlines()[-1]


def _separator_hint(path: Path) -> str | None:
    first, last = _ends(path)
    other = next((mark for mark in (";", "\t") if mark in first and mark in last), None)
    return f"separate columns by ',' (not {other!r}), decimals by '.'" if other else None


def number(text: str, decimal: str = ".") -> float:
    """A number; NaN for an empty field, infinite for another text."""
    if decimal == ",":
        text = text.replace(".", "?").replace(",", ".")
    try:
        return float(text.replace("_", "?") or "nan")  # Python takes 1_0 for 10
    except ValueError:
        return math.inf


def _is_number(field: str) -> bool:
    """True for a number and for an empty field."""
    return not math.isinf(number(field.strip()))


def _blocks(path: Path) -> Iterator[tuple[int, list[str]]]:
    """The lines under the header in blocks, each with the number of its first, from 0; without blank ones at the end.

    Two rows at least, or a DataError.
    """
    count, lines = 0, []
    with _opened(path) as file:
        file.readline()
        while block := file.readlines(TEXT_BYTES):
            lines += block
            blank = next((k for k, line in enumerate(reversed(lines)) if line.strip()), len(lines))
            lines, rest = lines[: len(lines) - blank], lines[len(lines) - blank :]
            if lines:
                yield count, lines
            count, lines = count + len(lines), rest
    if count < 2:
        refuse(path, f"line {count + 1}", f"found {counted(count, 'row')}", "write a header and 2 rows or more")


def _plain(lines: Sequence[str], columns: int) -> Table | None:
    """All fields of the lines at full speed; None where one is no finite number, or they are not so many in each."""
    with suppress(ValueError):
        table = np.loadtxt(lines, delimiter=",", comments=None, ndmin=2)
        return table if table.shape == (len(lines), columns) and np.isfinite(table).all() else None


def _fields(path: Path, names: Sequence[str], first: int, lines: Sequence[str]) -> list[list[str]]:
    """The fields of lines, as many as there are names; the first line is row `first`."""
    rows = [split(line) for line in lines]
    for line, row in enumerate(rows, first + 2):
        if len(row) != len(names):
            hint = "separate columns by ',', write decimals with '.', give every column a field; line 1 is the header"
            problem = f"found {counted(len(row), 'field')} under {counted(len(names), 'name')}"
            refuse(path, f"line {line}", problem, _separator_hint(path) or hint)
    if first == 0 and not any(map(_is_number, rows[0])):
        problem = f"holds no number, found {','.join(rows[0])!r}"
        refuse(path, "line 2", problem, header_hint(path) or "remove the row of units")
    return rows


def _check_names(path: Path, names: Sequence[str], required: Sequence[str], gaps: Sequence[str]) -> None:
    """Refuse columns that are not there, or more than once."""
    line = "line 1, " if path.suffix.lower() == ".csv" else ""
    every = (*required, *gaps)
    spare = [name for name in names if name not in every]
    for name in every:
        if name not in names:
            hint = header_hint(path)
            alone = "no other column is free for it: log it, or correct the columns of rig.toml"
            other = "or correct [input] columns in rig.toml" if name in required else ""
            other = "or `nnap-em import` it: it reads other names, separators and clocks" if name == "time" else other
            mend = hint or (nearest(name, spare) if spare else alone)
            refuse(path, f"{line}column {name!r}", "missing", f"{mend}; {other}" if other and (spare or hint) else mend)
        if names.count(name) > 1:
            refuse(path, f"{line}column {name!r}", f"stands there {names.count(name)} times", "keep one of them")


def numbers(
    path: Path, name: str, lines: Sequence[int], texts: Sequence[str], gaps: bool, dates: bool, decimal: str = "."
) -> Float[np.ndarray, " time"]:
    """The numbers of one column, or its dates, at full speed; where that fails, field by field to find the mistake."""
    with suppress(ValueError):
        values = np.array([float(text) if text else math.nan for text in texts])
        plain = np.isfinite(values).all() if not gaps else not np.isinf(values).any()
        if plain and decimal == "." and "_" not in "".join(texts):
            return values
    dates = dates and math.isinf(number(texts[0], decimal))
    values = moments(texts) if dates else np.array([number(text, decimal) for text in texts])
    wrong = np.flatnonzero(np.isinf(values) | (np.isnan(values) & (not gaps)))
    if wrong.size:
        where, text = f"line {lines[int(wrong[0])]}, column {name!r}", repr(texts[int(wrong[0])])
        if dates:
            refuse(path, where, f"found {text}", "write seconds, or dates such as 2026-11-03T23:59:40.010")
        _no_number(path, where, text, math.isnan(values[wrong[0]]), gaps)
    return values


def _no_number(path: Path, where: str, text: str, missing: bool, gaps: bool) -> NoReturn:
    hint = "write a number such as -0.125" + (", or leave the field empty: a missing sample" if gaps else "")
    refuse(path, where, f"found {text}", hint + ("; time and inputs are never empty" * missing))


def _enough(path: Path, rows: int) -> None:
    """Refuse a table without motion."""
    if rows < 2:
        refuse(path, "the file", f"found {counted(rows, 'row')}", "write 2 rows or more")


def _stack(path: Path, columns: Mapping[str, Any], gaps: Sequence[str], dates: bool) -> Table:
    """Columns of numbers side by side, checked as those of a CSV file are."""
    rows = np.size(next(iter(columns.values())))
    _enough(path, rows)
    out = []
    for name, values in columns.items():
        if dates and name not in gaps and values.dtype.kind in "MmOSU":
            values = dated(values)
        if values.dtype.kind not in "iuf":
            refuse(path, f"column {name!r}", f"holds {values.dtype}, no numbers", "store it as 64-bit floating point")
        if values.shape != (rows,):
            shape = " x ".join(map(str, values.shape))
            refuse(
                path, f"column {name!r}", f"is {shape or 1}, the first has {rows} rows", "give all columns one length"
            )
        values = values.astype(np.float64)
        wrong = np.flatnonzero(np.isinf(values) | (np.isnan(values) & (name not in gaps)))
        if wrong.size:
            value = values[wrong[0]]
            where = place(path, name, int(wrong[0]))
            _no_number(path, where, f"{value:g}", bool(np.isnan(value)), name in gaps)
        out.append(values)
    return np.stack(out, -1)
