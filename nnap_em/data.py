"""Sequences: logs read and checked once, padded to one length."""

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from .formats import Array, DataError, DataWarning, log_files, place, read_table, refuse
from .plausible import doubts, repeats
from .rig import Rig

TOLERANCE = 0.01  # of the declared dt, for every interval


class Dataset(NamedTuple):
    """Sequences padded to one length; unequal length lives in `valid`, missing samples in NaN."""

    t: Float[Array, "*seq time"]  # s; repeats its last value in the padding
    u: Float[Array, "*seq time input"]  # N m; 0 in the padding
    y: Float[Array, "*seq time obs"]  # rad, rad/s; NaN = not measured, also in the padding
    valid: Bool[Array, "*seq time"]

    def __str__(self) -> str:
        y, valid = np.asarray(self.y), np.asarray(self.valid)
        count, gone = valid[..., 0].size, np.isnan(y[valid]).mean() if y[valid].size else 0.0
        t = np.asarray(self.t)
        longest, inputs = float(np.max(t[..., -1] - t[..., 0])), np.shape(self.u)[-1]
        said = f"{count} sequence{'s' * (count != 1)}, {valid.sum()} rows, the longest {longest:.3g} s"
        return f"Dataset: {said}; {inputs} inputs, {y.shape[-1]} readings, {100 * gone:.2g} % missing"


@dataclass(frozen=True)
class Logs:
    """The sequences of one folder, one per file, and the names of their columns."""

    files: tuple[str, ...]  # without folder, in the order of the sequences
    data: Dataset
    columns: tuple[str, ...]  # inputs, then measured

    def __str__(self) -> str:
        return f"Logs {self.files[0]} to {self.files[-1]}: {', '.join(self.columns)}; {self.data}"


def read_logs(folder: Path | str, rig: Rig) -> Logs:
    """All logs of `folder` by name, in the units and columns that `rig` declares (s, N m, rad, rad/s).

    Raises DataError at the first mistake; warns DataWarning of what is possible but seldom meant.
    """
    files = log_files(Path(folder))
    sequences = [_read_sequence(path, rig) for path in files]
    return Logs(tuple(path.name for path in files), pad(sequences), (*rig.input_columns, *rig.measured))


def check_split(train: Logs, test: Logs | None = None) -> None:
    """Raise DataError where a sequence is there twice, or where a test sequence has rows of a training sequence.

    Warns DataWarning where other sequences overlap.  Clocks do not count.
    """
    parts = {f"train file {file}": rows for file, rows in _contents(train)}
    parts |= {f"test file {file}": rows for file, rows in (_contents(test) if test else ())}
    for name, row, other, there, whole in repeats(parts):
        leaks = name.startswith("test") and other.startswith("train")
        if whole:
            raise DataError(f"{name}: the same content as {other}; remove one of the two")
        found = f"{name}: row {row + 1} and those after it are also in {other}, from row {there + 1}"
        if leaks:
            raise DataError(f"{found}; remove one of the two: test sequences are new to the fit")
        warnings.warn(f"{found}; cut sequences without overlap", DataWarning, 2)


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


def _read_sequence(path: Path, rig: Rig) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One file, checked against the rig: t, u, y."""
    table = read_table(path, ("time", *rig.input_columns), rig.measured)
    first = 1 + len(rig.input_columns)
    t, u, y = table[:, 0], table[:, 1:first], table[:, first:]
    _check_time(path, t, rig)
    inputs, readings = dict(zip(rig.input_columns, u.T, strict=True)), dict(zip(rig.measured, y.T, strict=True))
    for doubt in doubts(inputs, readings, rig.dt):
        where = place(path, doubt.column, doubt.row)
        if doubt.ruins:
            refuse(path, where, doubt.found, doubt.mend)
        warnings.warn(f"{path}: {where}: {doubt.found}; {doubt.mend}", DataWarning, 2)
    return t, u, y


def _check_time(path: Path, t: Float[np.ndarray, " time"], rig: Rig) -> None:
    """Refuse a clock that is not uniform, not the declared one, or does not start where it should."""
    steps = np.diff(t) / rig.dt
    typical = np.median(steps)
    if abs(typical - 1) > TOLERANCE and abs(steps.mean() - 1) > TOLERANCE:
        thousand = 0.99 < typical / 1000 < 1.01 or 0.99 < typical * 1000 < 1.01
        mend = "one of the two is in ms: write s" if thousand else "correct [sampling] dt of rig.toml, or resample"
        refuse(path, "column 'time'", f"rows are {typical * rig.dt:.6g} s apart, rig.toml says {rig.dt:g} s", mend)
    wrong = np.flatnonzero(np.abs(steps - 1) > TOLERANCE)
    if wrong.size:
        k = wrong[0]
        kind = "time does not run on" if steps[k] <= 0 else "a gap" if steps[k] > 1.5 else "jitter"
        found = f"{kind}: {t[k]:.9g} s, then {t[k + 1]:.9g} s ({wrong.size} places in all)"
        mend = "resample to uniform rows; a missing sample is an empty field in a uniformly spaced row"
        refuse(path, place(path, "time", int(k) + 1), found, f"{mend} (dt = {rig.dt:g} s)")
    if rig.clock == "sequence" and abs(t[0]) > TOLERANCE * rig.dt:
        mend = 'subtract it, or declare [sampling] clock = "session" in rig.toml'
        refuse(path, place(path, "time", 0), f"starts at {t[0]:.9g} s, not at 0", mend)


def _lengthen(values: Array, time: int, filler: float) -> np.ndarray:
    return np.pad(np.asarray(values, np.float64), ((0, time - len(values)), (0, 0)), constant_values=filler)


def _contents(logs: Logs) -> Iterator[tuple[str, Float[np.ndarray, "time column"]]]:
    """Inputs and readings of each file."""
    u, y, valid = (np.asarray(x) for x in logs.data[1:])
    for i, file in enumerate(logs.files):
        yield file, np.hstack([u[i][valid[i]], y[i][valid[i]]])
