"""Sequences: read from CSV and checked once, padded to one length, written whole or not at all."""

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, NoReturn

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Real

from .rig import Rig, nearest, replace_text

Array = jax.Array | np.ndarray  # host or device: a Dataset may hold either
TOLERANCE = 0.01  # of the declared dt, for every interval
IMPLAUSIBLE = 30.0  # rad/s, as the median speed of a joint


class DataError(ValueError):
    """A mistake in a log: the message names the file, the place, what was found and the mend."""


class DataWarning(UserWarning):
    """Something in a log that is possible but seldom meant."""


class Dataset(NamedTuple):
    """Sequences padded to one length; unequal length lives in `valid`, missing samples in NaN."""

    t: Float[Array, "*seq time"]  # s; repeats its last value in the padding
    u: Float[Array, "*seq time input"]  # N m; 0 in the padding
    y: Float[Array, "*seq time obs"]  # rad, rad/s; NaN = not measured, also in the padding
    valid: Bool[Array, "*seq time"]


@dataclass(frozen=True)
class Logs:
    """The sequences of one folder, one per file, and the names of their columns."""

    files: tuple[str, ...]  # without folder, in the order of the sequences
    data: Dataset
    columns: tuple[str, ...]  # inputs, then measured


def read_logs(folder: Path, rig: Rig) -> Logs:
    """All *.csv of `folder` by name, in the units and columns that `rig` declares (s, N m, rad, rad/s).

    Raises DataError at the first mistake; warns DataWarning of a constant signal or an implausible speed.
    """
    files = sorted(path for path in folder.glob("*.csv") if not path.name.startswith("."))
    if not files:
        found = "holds no *.csv" if folder.is_dir() else "is no folder"
        raise DataError(f"{folder}: {found}; put one CSV file per sequence there")
    sequences = [_read_sequence(path, rig) for path in files]
    return Logs(tuple(path.name for path in files), pad(sequences), (*rig.input_columns, *rig.measured))


def check_split(train: Logs, test: Logs) -> None:
    """Raise DataError where a test sequence is a training sequence too (same inputs and readings, clock aside)."""
    seen = dict(zip(_contents(train.data), train.files, strict=True))
    for content, file in zip(_contents(test.data), test.files, strict=True):
        if content in seen:
            raise DataError(f"test file {file}: the same content as train file {seen[content]}; remove one of the two")


def pad(sequences: Sequence[tuple[Array, Array, Array]]) -> Dataset:
    """Sequences (t [s], u [N m], y [rad, rad/s]) of any length as one Dataset.

    Raises DataError if the shapes of a sequence do not fit each other or the first sequence.
    """
    if not sequences:
        raise DataError("pad: no sequence; give at least one (t, u, y)")
    inputs, obs = (np.shape(x)[-1] for x in sequences[0][1:])
    for i, (t, u, y) in enumerate(sequences):
        wanted = (len(t),), (len(t), inputs), (len(t), obs)
        if (found := (np.shape(t), np.shape(u), np.shape(y))) != wanted or not len(t):
            raise DataError(f"pad: sequence {i}: shapes of t, u, y are {found}; they must be {wanted}, time above 0")
    lengths = [len(t) for t, _, _ in sequences]
    time = max(lengths)
    return Dataset(
        t=np.stack([np.pad(np.asarray(t, np.float64), (0, time - len(t)), mode="edge") for t, _, _ in sequences]),
        u=np.stack([_lengthen(u, time, 0.0) for _, u, _ in sequences]),
        y=np.stack([_lengthen(y, time, np.nan) for _, _, y in sequences]),
        valid=np.arange(time) < np.array(lengths)[:, None],
    )


def horizon(data: Dataset, samples: int) -> Dataset:
    """The first `samples` samples of every sequence; the rest stays as padding, so that shapes do not change."""
    seen = np.arange(data.t.shape[-1]) < samples
    return data._replace(valid=data.valid & np.broadcast_to(seen, data.valid.shape))


def fill_missing(y: Float[Array, "*batch obs"]) -> tuple[Float[jax.Array, "*batch obs"], Bool[jax.Array, "*batch obs"]]:
    """Readings with 0 in place of NaN, and the mask of what was measured."""
    observed = ~jnp.isnan(y)
    return jnp.where(observed, y, 0.0), observed


def write_csv(path: Path, columns: Mapping[str, Sequence[float] | Real[Array, " time"]]) -> None:
    """Write columns of one length, 12 significant digits, NaN as an empty field; the file appears whole or not at all.

    Raises DataError if the lengths differ or a value is infinite.
    """
    table = {name: np.asarray(values, np.float64) for name, values in columns.items()}
    if len({values.shape for values in table.values()}) != 1 or np.isinf([*table.values()]).any():
        shapes = {name: values.shape for name, values in table.items()}
        raise DataError(f"{path}: columns {shapes}; write finite columns (NaN = missing) of one length")
    line = ",".join(["%.12g"] * len(table))
    body = "\n".join([line % row for row in zip(*(values.tolist() for values in table.values()), strict=True)])
    replace_text(path, f"{','.join(table)}\n{body.replace('nan', '')}\n")


def read_csv(path: Path, required: Sequence[str], gaps: Sequence[str] = ()) -> Float[np.ndarray, "time column"]:
    """The columns `required`, then `gaps`, of a CSV file with a header, in file units; NaN = empty field (`gaps` only).

    Raises DataError that names the line and the column.
    """
    header, *lines = _text(path).rstrip().split("\n")
    names = [name.strip().strip('"').strip() for name in header.split(",")]
    _check_header(path, header, names, (*required, *gaps))
    if len(lines) < 2:
        _refuse(path, f"line {len(lines) + 1}", f"found {len(lines)} rows", "write a header and 2 rows or more")
    rows = [line.split(",") for line in lines]
    for number, row in enumerate(rows, 2):
        if len(row) != len(names):
            mend = "separate columns by ',', write decimals with '.', and give every column a field"
            _refuse(path, f"line {number}", f"found {len(row)} fields under {len(names)} names", mend)
    columns = list(zip(*rows, strict=True))
    return np.stack([_numbers(path, name, columns[names.index(name)], name in gaps) for name in (*required, *gaps)], -1)


def _read_sequence(path: Path, rig: Rig) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One file, checked against the rig: t, u, y."""
    table = read_csv(path, ("time", *rig.input_columns), rig.measured)
    first = 1 + len(rig.input_columns)
    t, u, y = table[:, 0], table[:, 1:first], table[:, first:]
    _check_time(path, t, rig)
    readings = dict(zip(rig.measured, y.T, strict=True))
    for name, values in readings.items():
        _check_reading(path, name, values)
    for name, values in readings.items():
        if name.startswith("theta"):
            _check_angle(path, name, values, readings.get(f"d{name}"), rig.dt)
    return t, u, y


def _text(path: Path) -> str:
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror}); check the path and the rights") from None
    except UnicodeDecodeError as error:
        line = error.object[: error.start].count(b"\n") + 1
        raise DataError(f"{path}: line {line}: not UTF-8; save the file as plain UTF-8 text") from None
    if not text.strip():
        _refuse(path, "line 1", "the file is empty", "write a header and one row per sample, or remove the file")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def _check_header(path: Path, header: str, names: list[str], wanted: Sequence[str]) -> None:
    spare = [name for name in names if name not in wanted]
    for name in wanted:
        if name not in names:
            other = next((mark for mark in (";", "\t") if mark in header), None)
            mend = f"separate columns by ',' (not {other!r}), decimals by '.'" if other else nearest(name, spare)
            _refuse(path, f"line 1, column {name!r}", "missing", mend)
        if names.count(name) > 1:
            _refuse(path, f"line 1, column {name!r}", f"stands there {names.count(name)} times", "keep one of them")


def _numbers(path: Path, name: str, texts: Sequence[str], gaps: bool) -> Float[np.ndarray, " time"]:
    """The numbers of one column at full speed; where that fails, field by field to find the mistake."""
    try:
        values = np.array([float(text) if text else math.nan for text in texts])
        if np.isfinite(values).all() if not gaps else not np.isinf(values).any():
            return values
    except ValueError:
        pass
    return np.array([_number(path, name, number, text.strip(), gaps) for number, text in enumerate(texts, 2)])


def _number(path: Path, name: str, line: int, text: str, gaps: bool) -> float:
    try:
        value = float(text or "nan")
    except ValueError:
        value = math.inf
    missing = math.isnan(value)
    if math.isinf(value) or (missing and not gaps):
        mend = "write a number such as -0.125" + (", or leave the field empty: a missing sample" if gaps else "")
        hint = "; time and inputs are never empty" if missing else ""
        _refuse(path, f"line {line}, column {name!r}", f"found {text!r}", mend + hint)
    return value


def _check_time(path: Path, t: Float[np.ndarray, " time"], rig: Rig) -> None:
    """Refuse a clock that is not uniform, not the declared one, or does not start where it should."""
    steps = np.diff(t) / rig.dt
    typical = np.median(steps)
    if abs(typical - 1) > TOLERANCE and abs(steps.mean() - 1) > TOLERANCE:
        thousand = 0.99 < typical / 1000 < 1.01 or 0.99 < typical * 1000 < 1.01
        mend = "one of the two is in ms: write s" if thousand else "correct [sampling] dt of rig.toml, or resample"
        _refuse(path, "column 'time'", f"rows are {typical * rig.dt:.6g} s apart, rig.toml says {rig.dt:g} s", mend)
    wrong = np.flatnonzero(np.abs(steps - 1) > TOLERANCE)
    if wrong.size:
        k = wrong[0]
        kind = "time does not run on" if steps[k] <= 0 else "a gap" if steps[k] > 1.5 else "jitter"
        found = f"{kind}: {t[k]:.9g} s, then {t[k + 1]:.9g} s ({wrong.size} places in all)"
        mend = "resample to uniform rows; a missing sample is an empty field in a uniformly spaced row"
        _refuse(path, f"line {k + 3}, column 'time'", found, f"{mend} (dt = {rig.dt:g} s)")
    if rig.clock == "sequence" and abs(t[0]) > TOLERANCE * rig.dt:
        mend = 'subtract it, or declare [sampling] clock = "session" in rig.toml'
        _refuse(path, "line 2, column 'time'", f"starts at {t[0]:.9g} s, not at 0", mend)


def _check_reading(path: Path, name: str, values: Float[np.ndarray, " time"]) -> None:
    """Refuse a measured column without a sample; warn of one that never changes."""
    observed = values[np.isfinite(values)]
    if not observed.size:
        _refuse(path, f"column {name!r}", "no sample at all", "take the file out, or the column out of [measurement]")
    if observed.size > 1 and np.ptp(observed) == 0:
        warnings.warn(f"{path}: column {name!r}: constant at {observed[0]:g}; is the sensor alive?", DataWarning, 2)


def _check_angle(path: Path, name: str, theta: np.ndarray, rate: np.ndarray | None, dt: float) -> None:
    """Refuse degrees in an angle or in its rate, and a wrapped angle; warn of a speed that no arm has."""
    span = min(max(round(0.1 / dt), 1), theta.size - 1)  # long enough to see past the noise of single readings
    turned = _advance(theta, span)
    if rate is not None:
        expected = _advance(np.cumsum(_bridge(rate)) * dt, span)
        common = math.sqrt((turned @ turned) * (expected @ expected))
        ratio = math.sqrt(turned @ turned) / max(math.sqrt(expected @ expected), 1e-300)
        for factor, wrong in ((math.degrees(1), name), (math.radians(1), f"d{name}")):
            if turned @ expected > 0.7 * common and 0.7 < ratio / factor < 1.4:
                found = f"the rate of {name!r} is {ratio:.3g} times column 'd{name}'"
                _refuse(path, f"column {wrong!r}", found, "it looks like degrees: write rad and rad/s")
    rows = np.flatnonzero(np.isfinite(theta))
    step = np.diff(theta[rows])
    for turn, unit in ((2 * math.pi, ""), (360.0, " and convert degrees to rad")):
        jumps = (np.abs(np.abs(step) - turn) < 0.15 * turn) & (np.diff(rows) <= 2)
        if jumps.any() and np.median(np.abs(step)) < 0.1 * turn:
            k, row = step[jumps][0], rows[1:][jumps][0]
            mend = f"angles are continuous [rad]: unwrap the column (numpy.unwrap){unit}"
            _refuse(path, f"line {row + 2}, column {name!r}", f"jumps by {k:.4g} to {theta[row]:.6g}", mend)
    if (speed := float(np.median(np.abs(turned))) / (span * dt)) > IMPLAUSIBLE:
        warnings.warn(
            f"{path}: column {name!r}: turns at {speed:.0f} rad/s; is it in degrees? write rad", DataWarning, 2
        )


def _advance(values: Float[np.ndarray, " time"], span: int) -> Float[np.ndarray, " span"]:
    values = _bridge(values)
    return values[span:] - values[:-span]


def _bridge(values: Float[np.ndarray, " time"]) -> Float[np.ndarray, " time"]:
    """Missing samples by straight lines between their neighbours."""
    k = np.flatnonzero(np.isfinite(values))
    return np.interp(np.arange(values.size), k, values[k])


def _lengthen(values: Array, time: int, filler: float) -> np.ndarray:
    return np.pad(np.asarray(values, np.float64), ((0, time - len(values)), (0, 0)), constant_values=filler)


def _contents(data: Dataset) -> list[bytes]:
    """What each sequence holds, its clock aside."""
    u, y, valid = (np.asarray(x) for x in data[1:])
    return [u[i][valid[i]].tobytes() + y[i][valid[i]].tobytes() for i in range(len(valid))]


def _refuse(path: Path, place: str, found: str, mend: str) -> NoReturn:
    raise DataError(f"{path}: {place}: {found}; {mend}")
