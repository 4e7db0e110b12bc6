"""HDF5 files: a group with a time axis is a topic, its data sets are the fields."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ...errors import DataError
from ...machines.units import UNITS, is_time, named_unit
from ..dates import dated
from ..formats import refuse, unreadable
from .clock import nanoseconds, rising
from .objects import LISTED_ENTRIES
from .recording import EXTRA, Recording, Topic, Track


def topics(path: Path) -> tuple[Topic, ...]:
    """Every group that holds numbers, with a time axis of its own or of a group above."""
    with _opened(path) as file:
        every = [_topic(group) for group in _groups(file)]
        return tuple(topic for topic in every if topic.fields)


def read(path: Path, fields: Mapping[str, Sequence[str]]) -> Recording:
    """The numbers at these paths of these groups."""
    with _opened(path) as file:
        return Recording(path, {topic: _track(path, file[topic], paths) for topic, paths in fields.items()})


def _topic(group: Any) -> Topic:
    """A group as a topic."""
    axis, fields, rows = _axis(group), [], None
    for name, data in _numeric(group):
        if axis is None or (data != axis and data.shape[0] == axis.shape[0]):
            names = [name] if data.ndim == 1 else [f"{name}[{i}]" for i in range(data.shape[1])]
            unit = f" [{_unit(data)}]"
            known = named_unit(f"{name}{unit}")[1] and not named_unit(name)[1]
            fields += [f"{each}{unit}" if known else each for each in names]
            rows = data.shape[0]
    return Topic(group.name, f"group, time in {axis.name!r}" if axis else "no time axis", rows, tuple(fields))


def _track(path: Path, group: Any, paths: Sequence[str]) -> Track:
    axis = _axis(group)
    if axis is None:
        names = ", ".join(group) or "nothing"
        hint = "name the data set of its times `time` [s], or give it an attribute axis = 'time'"
        refuse(path, f"group {group.name!r}", f"has no time axis (holds {names})", hint)
    where, name, t = f"data set {axis.name!r}", axis.name.rpartition("/")[2], axis[:]
    unit = _unit(axis).lower().partition(" since ")[0].strip()
    unit = unit if unit in UNITS else named_unit(name)[1]
    t = nanoseconds(path, where, dated(t) if t.dtype.kind in "OS" else t, unit)
    return rising(path, where, t, {each: _column(group, each) for each in paths}, name)


def _column(group: Any, field: str) -> Float[np.ndarray, " row"]:
    """One column, of one number a row or of a row of numbers."""
    field = field if field in group else named_unit(field, brackets=True)[0]
    name, _, index = (field, "", "") if field in group else field.removesuffix("]").rpartition("[")
    data = group[name]
    return np.asarray(data[:] if data.ndim == 1 else data[:, int(index)], np.float64)


def _axis(group: Any) -> Any | None:
    """The times of a group: a data set marked or named so; else that of a group above it, of as many rows."""
    inside = [(name, data) for name, data in _numeric(group, "iufOS") if data.ndim == 1]
    marks = ("axis", "kind", "role", "standard_name")  # attributes that mark a data set as the time
    marked = [data for _, data in inside if "time" in (_text(data.attrs.get(mark, "")).lower() for mark in marks)]
    # the stamp of a sensor may be of another clock than the times of other groups
    named = sorted(filter(lambda pair: is_time(pair[0]), inside), key=lambda pair: "stamp" in pair[0].lower())
    if marked or named:
        return marked[0] if marked else named[0][1]
    above = None if group.name == "/" else _axis(group.parent)
    return above if above and any(data.shape[0] == above.shape[0] for _, data in _numeric(group)) else None


def _numeric(group: Any, kinds: str = "iuf") -> Iterator[tuple[str, Any]]:
    """Data sets of one number or one row of numbers per time; dates are texts."""
    for name, data in group.items():
        wide = not hasattr(data, "shape") or data.ndim not in (1, 2) or data.shape[1:] > (LISTED_ENTRIES,)
        if not wide and data.dtype.kind in kinds and data.shape[0] > 1:
            yield name, data


def _groups(group: Any) -> Iterator[Any]:
    yield group
    for item in group.values():
        if hasattr(item, "items"):
            yield from _groups(item)


def _unit(data: Any) -> str:
    """The unit that an attribute of a data set names."""
    return _text(data.attrs.get("units", data.attrs.get("unit", "")))


def _text(value: Any) -> str:
    return value.decode(errors="replace") if isinstance(value, bytes) else str(value)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    try:
        import h5py
    except ImportError:
        raise DataError(f"{path}: HDF5 files cannot be read without h5py; {EXTRA}") from None
    hint = "use another copy, or write it again"
    try:
        file = h5py.File(path, "r")
    except OSError as error:
        if error.errno:
            raise unreadable(path, error) from None
        raise DataError(f"{path}: no HDF5 file, or damaged or cut short; {hint}") from None
    with file:
        try:
            yield file
        except (OSError, RuntimeError) as error:
            raise DataError(f"{path}: the file is damaged ({' '.join(str(error).split())}); {hint}") from None
