"""A folder of logs, read and checked once: what a fit sees of them, and what is masked."""

import math
import warnings
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..base.digits import counted
from ..errors import DataError, DataWarning
from ..machines.rig import Rig
from ..machines.units import is_episode, other_unit
from .dataset import Dataset, pad
from .formats import columns_of, header_hint, log_files, place, refuse, table_of, untimed
from .held import hold
from .held import repeats as held_rows
from .missing import interpolated
from .plausible import implausible, repeats
from .rough import FULL, Rough, rough

TOLERANCE = 0.01  # of the declared dt, for every interval
OTHER_UNIT = 100.0  # times the declared value of a column that scales a servo: V beside mV, and no gain changes so much
REPEAT, RANGE = "held", "range"
_Parts = tuple[np.ndarray, np.ndarray, np.ndarray]
_REASONS = {
    REPEAT: "equal to the one before, until the sensor takes its next",
    RANGE: "at the end of the declared range of the sensor",
    "spike": "far from what the readings before and after say",
    "stuck": "one value over again while the machine moves",
    "late start": "one value over again until the sensor starts",
    "saturated": "at the end of the sensor's range while the machine goes beyond",
}


class Masked(NamedTuple):
    """Readings of a log that a fit does not use."""

    file: str
    kind: str
    """`spike`, `stuck`, `late start`, `saturated`, `held`, `range`: readings; `gap`, `cut`: rows."""
    column: str | None
    row: int
    """The first one in the file, counted from 1 under the header."""
    time: float
    """Time of that row [s]."""
    amount: int
    """Readings, or rows."""


@dataclass(frozen=True)
class Logs:
    """The sequences of one folder, one per file, and the names of their columns."""

    files: tuple[str, ...]  # without folder, in the order of the sequences
    data: Dataset
    columns: tuple[str, ...]  # inputs, then measured
    masked: tuple[Masked, ...] = ()  # is NaN in `data`
    unmasked: Dataset | None = None

    @property
    def as_read(self) -> Dataset:
        """The readings of the files, those that are masked too."""
        return self.data if self.unmasked is None else self.unmasked

    def __str__(self) -> str:
        return f"Logs {self.files[0]} to {self.files[-1]}: {', '.join(self.columns)}; {self.data}"


def read_logs(folder: Path | str, rig: Rig, *, trust: bool = False, until: float = math.inf) -> Logs:
    """All logs of a folder by name, or one, in the units and columns that `rig` declares (s, N m, rad, rad/s).

    Spikes and readings of stuck, late or saturated sensors, values that repeat while the machine moves among them,
    become NaN.

    Args:
        folder: the CSV files, one a sequence.
        rig: what their columns mean.
        trust: mask nothing.
        until: readings later than that [s after the first row] are neither masked nor used: a prediction has no access
            to them.

    Returns:
        Names of the files, the Dataset (`.data`), and what was masked.

    Raises:
        DataError: at the first mistake, with file, row, column and what to do.

    Warns:
        DataWarning: of what is masked, and of what is seldom meant.

    Example:
        >>> nnap_em.read_logs(f"{folder}/train", rig).data.y.shape
        (4, 96, 1)
    """
    files = [Path(folder)] if Path(folder).is_file() else log_files(Path(folder))
    tables = [_read_table(path, rig) for path in files]
    tables = [_without(table, _at_ends(table, rig), rig) for table in tables]
    used = tables
    if not trust:
        early = [table.readings(rig, until) for table in tables]
        stands = {name: hold([readings[name] for readings in early]) for name in rig.measured}
        tables = [_without(table, _repeats(table, stands, rig), rig) for table in tables]
        early = [table.readings(rig, until) for table in tables]
        entries = [rough(readings, rig.dt) for readings in early]
        full = {
            (one.column, y)
            for readings, found in zip(early, entries, strict=True)
            for one in found if one.kind == FULL
            for y in readings[one.column][one.rows]
        }  # fmt: skip
        entries = [rough(readings, rig.dt, full) for readings in early] if full else entries
        used = [_without(table, found, rig) for table, found in zip(tables, entries, strict=True)]
    for table in used:
        _check_plausible(table, rig)
    data, masked = pad([table.parts(rig) for table in used]), tuple(m for table in used for m in table.masked)
    unmasked = pad([table.parts(rig) for table in tables]) if masked else None
    return Logs(tuple(path.name for path in files), data, (*rig.logged_inputs, *rig.measured), masked, unmasked)


def sequences_of(data: Dataset | Logs, rig: Rig) -> Dataset:
    """The sequences of logs, or of arrays, which must be those of `rig`.

    Raises DataError where they have other columns, another interval, or a row without an input.
    """
    data = data.data if isinstance(data, Logs) else data
    for name, array, columns in (("u", data.u, rig.logged_inputs), ("y", data.y, rig.measured)):
        if np.shape(array)[-1] != len(columns):
            given, wanted = counted(np.shape(array)[-1], "column"), ", ".join(columns) or "none"
            raise DataError(f"{name} has {given}; give those of the rig in its order: {wanted}")
    valid, t, u = (np.asarray(a) for a in (data.valid, data.t, data.u))
    steps = np.where(valid[:, 1:] & valid[:, :-1], np.diff(t, axis=1) / rig.dt, 1.0)
    uneven = np.abs(steps - np.maximum(np.round(steps), 1)) > TOLERANCE
    if uneven.any() or np.median(steps) > 1 + TOLERANCE:
        i, k = np.argwhere(uneven if uneven.any() else steps > 1 + TOLERANCE)[0]
        problem = f"sequence {i}, row {k + 1}: t goes from {t[i, k]:.6g} to {t[i, k + 1]:.6g} {rig.time_unit}"
        raise DataError(
            f"{problem}, the rig has dt = {rig.dt:g} {rig.time_unit}; resample to uniform rows, or correct dt"
        )
    if (dark := valid & ~np.isfinite(u).all(axis=-1)).any():
        i, k = np.argwhere(dark)[0]
        raise DataError(f"sequence {i}, row {k}: u is no number; give it in every row (NaN in y is a missing reading)")
    return data


def logs_of_arrays(data: Dataset | Logs, rig: Rig) -> Logs:
    """Arrays as logs, whose files are called by their place.

    Raises DataError where they are not of `rig`.
    """
    if isinstance(data, Logs):
        return data
    data = sequences_of(data, rig)
    return Logs(tuple(f"sequence {i}" for i in range(len(data.t))), data, (*rig.logged_inputs, *rig.measured))


def check_split(train: Logs, test: Logs | None = None) -> None:
    """Raise DataError where a sequence is there twice, or where a test sequence has rows of a training sequence.

    Warns DataWarning where other sequences overlap.  Clocks do not count.
    """
    parts = {
        f"{part} file {file}": np.hstack(columns)
        for part, logs in (("train", train), ("test", test))
        if logs is not None
        for file, (_, *columns) in zip(logs.files, _unpadded(logs.as_read), strict=True)
    }
    for name, row, other, source_row, copy in repeats(parts):
        if copy:
            raise DataError(f"{name}: the same content as {other}; remove one of the two")
        problem = f"{name}: row {row + 1} and those after it are also in {other}, from row {source_row + 1}"
        if name.startswith("test") and other.startswith("train"):
            raise DataError(f"{problem}; remove one of the two: test sequences are new to the fit")
        warnings.warn(f"{problem}; cut sequences without overlap", DataWarning, 2)


def together(parts: Mapping[str, Logs]) -> Logs:
    """Logs of one rig from some folders as one; files of all but the first carry the names of their folders."""
    first, *others = parts.items()
    if not others:
        return first[1]
    named = [("", first[1]), *((f"{name}/", logs) for name, logs in others)]
    files = tuple(start + file for start, logs in named for file in logs.files)
    masked = tuple(m._replace(file=start + m.file) for start, logs in named for m in logs.masked)
    every = [logs for _, logs in named]
    unmasked = pad([s for logs in every for s in _unpadded(logs.as_read)]) if masked else None
    return Logs(files, pad([s for logs in every for s in _unpadded(logs.data)]), first[1].columns, masked, unmasked)


def _unpadded(data: Dataset) -> Iterator[_Parts]:
    """Time, inputs and readings of every sequence, without padding."""
    t, u, y, valid = map(np.asarray, data)
    return ((a[rows], b[rows], c[rows]) for a, b, c, rows in zip(t, u, y, valid, strict=True))


class _Table(NamedTuple):
    """One file, its clock checked; rows that it lost are back, with interpolated inputs."""

    path: Path
    table: Float[np.ndarray, "time column"]
    """Time, inputs, readings."""
    rows: Int[np.ndarray, " row"]
    """Rows of the uniform grid in which those of the file stand."""
    masked: list[Masked]

    @property
    def line(self) -> Int[np.ndarray, " time"]:
        """Row of the file of each row of the table."""
        return np.searchsorted(self.rows, np.arange(len(self.table)))

    def parts(self, rig: Rig) -> _Parts:
        """Time, inputs, readings."""
        return self.table[:, 0], self.table[:, 1 : -len(rig.measured)], self.table[:, -len(rig.measured) :]

    def readings(self, rig: Rig, until: float = math.inf) -> dict[str, Float[np.ndarray, " time"]]:
        """The columns of readings up to some seconds after the first row."""
        early = self.table[:, 0] - self.table[0, 0] <= until + TOLERANCE * rig.dt
        return dict(zip(rig.measured, self.parts(rig)[2][early].T, strict=True))


def _at_ends(table: _Table, rig: Rig) -> Iterator[Rough]:
    """Readings at the declared ends of the sensors, whose tangent there would be 0."""
    for name, (low, high) in rig.ranges.items():
        y = table.readings(rig)[name]
        yield Rough(RANGE, name, np.flatnonzero((y <= low) | (y >= high)))


def _repeats(table: _Table, stands: Mapping[str, float], rig: Rig) -> Iterator[Rough]:
    """Readings that stand there once more, of sensors that take each in so many rows."""
    for name, rows in stands.items():
        if rows > 1:
            yield Rough(REPEAT, name, held_rows(table.readings(rig)[name], rows))


def _without(source: _Table, entries: Iterable[Rough], rig: Rig) -> _Table:
    """A file without these readings, with a warning for each column."""
    table, masked = source.table.copy(), list(source.masked)
    for kind, column, rows in entries:
        if rows.size:
            line, t = int(source.line[rows[0]]), float(table[rows[0], 0])
            table[rows, rig.measured.index(column) - len(rig.measured)] = np.nan
            first = f"the first at {t:.6g} {rig.time_unit}"
            problem = f"{counted(rows.size, 'reading')} {_REASONS[kind]} ({kind}), {first}; not used"
            hint = "" if kind == RANGE else "; to use them: --trust-readings, or read_logs(..., trust=True)"
            warnings.warn(f"{source.path}: {place(source.path, column, line)}: {problem}{hint}", DataWarning, 2)
            masked.append(Masked(source.path.name, kind, column, line + 1, t, rows.size))
    return source._replace(table=table, masked=masked)


def _read_table(path: Path, rig: Rig) -> _Table:
    content = table_of(path)
    clock = ("time",) if "time" in content.names or header_hint(path) or untimed(content.names) else ()
    table = columns_of(content, (*clock, *rig.logged_inputs), rig.measured)
    for name in filter(is_episode, content.names):
        if changes := np.flatnonzero(np.diff(columns_of(content, (name,))[:, 0])).tolist():
            hint = "`nnap-em import` it: each becomes a sequence"
            refuse(path, place(path, name, changes[0] + 1), "another episode begins", hint)
    if not clock:
        problem = f"no column of times: rows are taken as dt = {rig.dt:g} {rig.time_unit} apart"
        warnings.warn(f"{path}: {problem}; log the time [{rig.time_unit}], so that lost rows show", DataWarning, 2)
        table = np.column_stack([rig.dt * np.arange(len(table)), table])
    _check_scales(path, table, rig)
    return _whole(path, table, _rows(path, table[:, 0], rig), rig)


def _check_scales(path: Path, table: Float[np.ndarray, "row column"], rig: Rig) -> None:
    """Refuse columns that numbers of servos are proportional to where they are negative or in another unit."""
    for name, scale in rig.input_scales.items():
        for column, declared in scale.items():
            values = table[:, 1 + rig.logged_inputs.index(column)]
            if values[k := int(np.argmin(values))] < 0:
                hint = f"{name} is proportional to it: write 0 or more, or take it out of `at`"
                refuse(path, place(path, column, k), f"found {values[k]:g}", hint)
            ratio = float(np.max(values)) / declared
            if ratio > OTHER_UNIT or 0 < ratio < 1 / OTHER_UNIT:
                problem = f"at most {np.max(values):g}, where rig.toml declares {name} at {declared:g}"
                refuse(path, place(path, column), problem, "write both in one unit")


def _check_plausible(table: _Table, rig: Rig) -> None:
    """Refuse readings that would ruin a fit, and warn of others that are seldom meant."""
    for finding in implausible(table.readings(rig), rig.dt, rig.unit, rig.pairs()):
        where = place(table.path, finding.column, None if finding.row is None else int(table.line[finding.row]))
        if finding.ruins:
            refuse(table.path, where, finding.problem, finding.hint)
        warnings.warn(f"{table.path}: {where}: {finding.problem}; {finding.hint}", DataWarning, 2)


def _rows(path: Path, t: Float[np.ndarray, " time"], rig: Rig) -> Int[np.ndarray, " time"]:
    """Place of the rows of a file in a uniform grid; refuses a clock that is not uniform but for a few gaps."""
    steps, unit = np.diff(t) / rig.dt, rig.time_unit
    typical = np.median(steps)
    if abs(typical - 1) > TOLERANCE and abs(steps.mean() - 1) > TOLERANCE:
        hint = other_unit(float(typical), "correct [sampling] dt of rig.toml, or resample with `nnap-em import`")
        apart = f"rows are {typical * rig.dt:.6g} {unit} apart, rig.toml says {rig.dt:g} {unit}"
        refuse(path, "column 'time'", apart, hint)
    intervals = np.maximum(np.round(steps), 1)
    wrong = np.abs(steps - intervals) > TOLERANCE
    missing = int(np.sum(intervals[~wrong] - 1))
    if not wrong.any() and missing > 0.25 * (t.size + missing):  # share of the rows of a file that may be lost in gaps
        wrong = intervals > 1
    if wrong.any():
        k, count = np.flatnonzero(wrong)[0], wrong.sum()
        kind = "time does not run on" if steps[k] <= 0 else "a gap" if steps[k] > 1.5 else "jitter"
        problem = f"{kind}: {t[k]:.9g} {unit}, then {t[k + 1]:.9g} {unit} ({counted(count, 'place')} in all)"
        hint = "resample to uniform rows with `nnap-em import`; a missing sample is an empty field of a row"
        refuse(path, place(path, "time", int(k) + 1), problem, f"{hint} (dt = {rig.dt:g} {unit})")
    if rig.clock == "sequence" and abs(t[0]) > TOLERANCE * rig.dt:
        hint = 'subtract it, or declare [sampling] clock = "session" in rig.toml'
        refuse(path, place(path, "time", 0), f"starts at {t[0]:.9g} {unit}, not at 0", hint)
    return np.append(0, np.cumsum(intervals)).astype(int)


def _whole(path: Path, table: Float[np.ndarray, "row column"], rows: Int[np.ndarray, " row"], rig: Rig) -> _Table:
    """The rows that the file lost, without readings; cut at the first gap where inputs cannot be interpolated."""
    size = int(rows[-1]) + 1
    if size == len(rows):
        return _Table(path, table, rows, [])
    missing, dark = ~np.isin(np.arange(size), rows), np.zeros(size, bool)
    full = np.full((size, table.shape[1]), np.nan)
    full[rows] = table
    full[:, 0] = np.interp(np.arange(size), rows, table[:, 0])
    for column in range(1, 1 + len(rig.logged_inputs)):
        full[:, column], error = interpolated(full[:, column], missing)
        dark |= error > 0.1  # of the impulse of one row: allowed error of inputs interpolated over a gap
    end = int(np.argmax(dark)) if dark.any() else size
    used, masked = rows[rows < end], []
    for first, count, kind, hint in (
        (int(missing.argmax()), int(missing[:end].sum()), "gap", "inputs there are interpolated from the rows around"),
        (end, len(rows) - len(used), "cut", "inputs before these rows cannot be interpolated: `nnap-em import`"),
    ):
        if count:
            k = int(np.searchsorted(rows, first))  # the row of the file after the gap
            masked.append(Masked(path.name, kind, None, k + 1, float(full[first, 0]), count))
            problem = f"a gap: {table[k - 1, 0]:.9g} {rig.time_unit}, then {table[k, 0]:.9g} {rig.time_unit}"
            problem += f" ({counted(count, 'row')} {'missing' if kind == 'gap' else 'after it'} in all)"
            warnings.warn(f"{path}: {place(path, 'time', k)}: {problem}; {hint}", DataWarning, 2)
    return _Table(path, full[:end], used, masked)
