"""CSV, Parquet and MAT files: one topic without a name, whose fields are the columns."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from ..data.formats import column_names, read_log, refuse, untimed
from ..data.units import is_time, named_unit
from .clock import nanoseconds, rising
from .recording import SECOND, UNTIMED, Recording, Topic, Track


def topics(path: Path) -> tuple[Topic, ...]:
    """The columns, save that of the time."""
    names = column_names(path)
    clock = _clock(path, names)
    kind = "table without times" if clock is None else f"table, time in column {clock!r}"
    return (Topic("", kind, None, tuple(name for name in names if name != clock)),)


def read(path: Path, fields: Mapping[str, Sequence[str]]) -> Recording:
    """These columns; an empty field is NaN."""
    names = column_names(path)
    counter = re.compile(r"episode(_index|_id)?", re.IGNORECASE)  # of the sequences of a file, each with its own clock
    name, episode = _clock(path, names), [each for each in names if counter.fullmatch(each)][:1]
    table = read_log(path, (*((name,) if name else ()), *episode), fields[""])
    values = dict(zip(fields[""], table[:, table.shape[1] - len(fields[""]) :].T, strict=True))
    if name is None:
        return Recording(path, {"": Track(SECOND * np.arange(len(table)), values, UNTIMED, ())})
    where = f"column {name!r}"
    t = nanoseconds(path, where, table[:, 0], named_unit(name)[1])
    clock = rising(path, where, _in_a_row(t, table[:, 1]) if episode else t, name)
    return Recording(path, {"": clock.track(values.items())})


def _in_a_row(t: Int[np.ndarray, " row"], episode: Float[np.ndarray, " row"]) -> Int[np.ndarray, " row"]:
    """The times of episodes whose clocks restart, one after the other, with a silence between that is a gap."""
    steps = np.diff(t)
    new = np.diff(episode) != 0
    usual = np.mean(steps[~new]) if not new.all() else SECOND  # of single precision, the mean is exact
    # Intervals between two episodes: more than the 5 of a gap, and few enough for rows of the grid to stay in step
    return t[0] + np.append(0, np.cumsum(np.where(new, round(100 * usual), steps)))


def _clock(path: Path, names: Sequence[str]) -> str | None:
    """The column that is the time; None where no name is like one."""
    column = next((name for name in names if is_time(name)), None)
    if column is None and (hint := untimed(path, names)):
        refuse(path, "the file", f"has no column of times (found {', '.join(names[:6])})", hint)
    return column
