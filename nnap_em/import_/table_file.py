"""CSV, Parquet and MAT files: one topic without a name, whose fields are the columns."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from ..data.formats import column_names, read_log, refuse, untimed
from ..data.units import clock_of, is_episode, named_unit
from .clock import in_a_row, nanoseconds, rising
from .recording import SECOND, UNTIMED, Recording, Topic, Track


def topics(path: Path) -> tuple[Topic, ...]:
    """The columns, save those of the time."""
    names = column_names(path)
    clock = _clock(path, names)
    kind = f"table, time in column {clock[0]!r}" if clock else "table without times"
    return (Topic("", kind, None, tuple(name for name in names if name not in clock)),)


def read(path: Path, fields: Mapping[str, Sequence[str]]) -> Recording:
    """These columns; an empty field is NaN."""
    names = column_names(path)
    clock, episode = _clock(path, names), [name for name in names if is_episode(name)][:1]
    table = read_log(path, (*clock[:1], *episode), fields[""])
    first = len(clock[:1]) + len(episode)
    values = dict(zip(fields[""], table[:, first:].T, strict=True))
    t = SECOND * np.arange(len(table))
    if clock:
        days = (lambda: read_log(path, clock[1:], ())[:, 0]) if clock[1:] else None
        t = nanoseconds(path, f"column {clock[0]!r}", table[:, 0], named_unit(clock[0])[1], days)
    t = in_a_row(t, table[:, first - 1]) if episode else t
    if not clock:
        return Recording(path, {"": Track(t, values, UNTIMED, ())})
    return Recording(path, {"": rising(path, f"column {clock[0]!r}", t, clock[0]).track(values.items())})


def _clock(path: Path, names: Sequence[str]) -> tuple[str, ...]:
    """The column that is the time, and that of its dates; nothing where no name is like one."""
    column, day = clock_of(names)
    if column is None and (hint := untimed(path, names)):
        refuse(path, "the file", f"has no column of times (found {', '.join(names[:6])})", hint)
    return tuple(filter(None, (column, day)))
