"""Variables of a MAT file as columns: vectors, and the structs that Simulink and dSPACE write."""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import DataError


def mat_columns(path: Path, variables: Mapping[str, np.ndarray]) -> Iterator[tuple[str, Any]]:
    """The vectors, those of a struct that stands alone, and those of structs that recorders write.

    Raises DataError with the MATLAB line that saves an object as a struct.
    """
    only = next(iter(variables.values())) if len(variables) == 1 else None
    if only is not None and only.shape == () and only.dtype.names and _struct(only) is None:
        variables = {name: np.asarray(only[name].item()) for name in only.dtype.names}
    for name, value in variables.items():
        if "s2" in (value.dtype.names or ()):  # as scipy gives what it does not read
            called, _, kind = (text.decode() for text in list(value[0])[:3])
            hint = _OBJECTS.get(kind, _OBJECTS["timeseries"]).format(called)
            raise DataError(f"{path}: variable {called!r}: an object ({kind}), which only MATLAB reads; {hint}")
        form = _struct(value)
        yield from [(name, value)] if form is None else form(name, value)


def _control_desk(name: str, record: Any) -> Iterator[tuple[str, Any]]:
    """dSPACE ControlDesk: X(i).Data are times, Y(k).Data the signal Y(k).Name, on the times X(Y(k).XIndex)."""
    axes = np.atleast_1d(record["X"].item())
    for signal in np.atleast_1d(record["Y"].item()):
        axis = axes[int(signal["XIndex"]) - 1 if "XIndex" in signal.dtype.names else 0]
        yield from (("time", axis["Data"]), (str(signal["Name"]), signal["Data"]))


def _structure_with_time(name: str, record: Any) -> Iterator[tuple[str, Any]]:
    """Simulink's structure with time: signals(k).values, called as their labels or else as the variable."""
    signals = np.atleast_1d(record["signals"].item())
    labels = {str(each["label"]) for each in signals if "label" in each.dtype.names and np.size(each["label"])}
    if np.size(record["time"].item()):
        yield "time", record["time"].item()
    for k, signal in enumerate(signals, 1):
        other = name if len(signals) == 1 else f"{name}({k})"
        yield str(signal["label"]) if len(labels) == len(signals) else other, signal["values"]


_STRUCTS = {("X", "Y"): _control_desk, ("time", "signals"): _structure_with_time}
"""Structs of recorders, by fields that they have; for another one, add a function that gives its columns."""
_OBJECTS = {
    "timeseries": "in MATLAB: s.time = {0}.Time; s.{0} = {0}.Data; save('log.mat', '-struct', 's', '-v7')",
    "timetable": "in MATLAB: s = table2struct(timetable2table({0}), 'ToScalar', true); s.time = seconds({0}.Time); "
    "save('log.mat', '-struct', 's', '-v7')",
    "Simulink.SimulationData.Dataset": "in MATLAB: s.time = {0}{{1}}.Values.Time; for k = 1:{0}.numElements, "
    "s.({0}{{k}}.Name) = {0}{{k}}.Values.Data; end, save('log.mat', '-struct', 's', '-v7')",
}
"""Lines that write a MATLAB object as a struct, by its class."""


def _struct(value: np.ndarray) -> Callable[[str, Any], Iterator[tuple[str, Any]]] | None:
    known = value.shape == ()
    return next((form for keys, form in _STRUCTS.items() if known and set(keys) <= set(value.dtype.names or ())), None)
