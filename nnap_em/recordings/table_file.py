"""CSV, Parquet and MAT files: one topic without a name, whose fields are the columns."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from ..data.formats import column_names, header_hint, read_log
from ..data.units import TIME
from .clock import nanoseconds, rising
from .recording import Recording, Topic, Track, refuse


def topics(path: Path) -> tuple[Topic, ...]:
    """The columns, save that of the time."""
    names = column_names(path)
    clock = _clock(path, names)
    return (Topic("", f"table, time in column {clock!r}", None, tuple(name for name in names if name != clock)),)


def read(path: Path, fields: Mapping[str, Sequence[str]]) -> Recording:
    """These columns; an empty field is NaN."""
    name = _clock(path, column_names(path))
    table = read_log(path, name, fields[""])
    match = TIME.match(name)
    t = nanoseconds(path, f"column {name!r}", table[:, 0], (match and match[1]) or "")
    clock = rising(path, f"column {name!r}", t, name)
    values = {column: clock.take(table[:, i]) for i, column in enumerate(fields[""], 1)}
    return Recording(path, {"": Track(clock.t, values, clock.name, clock.notes)})


def _clock(path: Path, names: Sequence[str]) -> str:
    """The column that is the time."""
    column = next((name for name in names if TIME.match(name)), None)
    if column is None:
        hint = header_hint(path) or "name it 'time' [s]"
        refuse(path, "the file", f"has no column of times (found {', '.join(names[:6])})", hint)
    return column
