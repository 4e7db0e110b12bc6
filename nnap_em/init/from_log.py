"""A first rig.toml from the header and the numbers of a log; what cannot be read stands as a commented line."""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..data.dataset import DataError
from ..data.formats import csv_table, header_hint, place, refuse
from ..data.noise import reading_noise
from ..data.rig import SystemSpec, dotted_key, toml_key, toml_text
from ..data.units import UNITS, named_unit, parameter_unit, si

_NAMES = {  # what people call a column, its number apart
    "time": re.compile(r"_*(time|t|timestamp|clock)()$"),
    "input": re.compile(r"(?:u|tau|torque|force|f|input|effort)_?(\d?)()$"),
    "dtheta": re.compile(r"(?:d_?theta|theta_?dot|dq|qd|qdot|omega|w|vel|velocity|speed)_?(\d?)()$"),
    "dtheta ": re.compile(r"(?:theta|q)_?(\d)_?dot()$"),
    "theta": re.compile(r"(?:theta|th|q|angle|phi|pos|position)_?(\d?)()$"),
    "dx": re.compile(r"(?:dx|x_?dot|v|vel|velocity|speed)()$"),
    "x": re.compile(r"(?:x|pos|position)()$"),
}
_PARAMETERS = {
    "m": "mass",
    "l": "length of the link",
    "lc": "distance of the centre of mass from the joint",
    "I": "inertia about the centre of mass",
    "g": "gravity",
    "Ir": "rotor inertia of the drives",
    "gr": "gear ratio of the drives",
}
SECONDS_ROW = 0.5
"""Interval of the rows [s] above which the clock may be in ms."""
DRAFT_HEAD = """\
format = 1
name = {name}

# SI units: s, kg, m, rad, N m.  Fill in the lines of the form  # key = ...  and take their first # away.
"""


class Draft(NamedTuple):
    """A rig.toml to fill in."""

    text: str
    notes: tuple[str, ...]
    """Changes that the log needs."""

    @property
    def missing(self) -> dict[str, list[str]]:
        """The keys that stand as comments, by their tables."""
        _, *parts = re.split(r"(?m)^\[([\w.]+)\]", self.text)
        keys = (re.findall(r"(?m)^# (\w+) = \.\.\.", lines) for lines in parts[1::2])
        return {table: names for table, names in zip(parts[::2], keys, strict=True) if names}


class _Column(NamedTuple):
    """Meaning of a name of the header."""

    name: str
    kind: str
    """`time`, `input`, the name of a state, or nothing."""
    number: int | None
    unit: str
    """Unit by the name where it is not SI."""


def draft(path: Path, system: str | None, specs: Mapping[str, SystemSpec]) -> Draft:
    """The rig.toml for a CSV log; `system` where its columns do not show it.

    Raises DataError where the log cannot be read or the system not be recognised.
    """
    table = numbers(path)
    if not any(meaning(name).kind for name in table):
        hint = header_hint(path) or "write a header with names such as time, u, theta1, dtheta1"
        refuse(path, "line 1", f"no column is recognised (found {', '.join(table)})", hint)
    return drafted(path, table, system, specs)


def drafted(
    path: Path, table: Mapping[str, Float[np.ndarray, " time"]], system: str | None, specs: Mapping[str, SystemSpec]
) -> Draft:
    """The rig.toml that columns of a log call for."""
    columns = from_one([meaning(name) for name in table])
    system = system or _system(path, columns, specs)
    spec = specs[system]
    inputs = {c.name: spec.driven if c.number is None else c.number for c in columns if c.kind == "input"}
    measured = [name for name in table if name in spec.states]
    name = toml_text(path.resolve().parent.name or "rig")
    lines = [
        *_model(system, spec),
        *driven({name: str(joint) for name, joint in inputs.items() if joint <= spec.joints}),
        *sampling(table, columns),
        *measurement(table, measured, spec),
    ]
    notes = (*_notes(columns, spec), *_clock_notes(path, table, columns))
    return Draft("\n".join([DRAFT_HEAD.format(name=name), *lines]) + "\n", notes)


def numbers(path: Path) -> dict[str, Float[np.ndarray, " time"]]:
    """The columns of a CSV file that hold numbers; NaN where a field is empty."""
    if path.suffix.lower() != ".csv":
        raise DataError(f"{path}: its name does not end in .csv; give a CSV file")
    table, columns = csv_table(path), {}
    for name, values in zip(table.names, table.values.T, strict=True):
        columns[name] = values
        if np.isinf(columns[name]).any():
            del columns[name]
            if meaning(name).kind == "time":
                refuse(path, place(path, name), "holds texts", "write seconds, or `nnap-em import` it")
    return columns


def meaning(name: str) -> _Column:
    """Meaning of a column by its name."""
    word, unit = re.sub(r"^(lr|f|r)(?=[A-Z][a-z])", "", name.strip()).lower(), ""  # fAngle of a PLC: a REAL
    if not any(pattern.match(word) for pattern in _NAMES.values()):
        word, unit = named_unit(word)
    either = ("pos", "position", "vel", "velocity", "speed")  # of a joint with a number, of a slide without
    for kind, pattern in _NAMES.items():
        if match := pattern.match(word):
            number = int(match[1]) if match[1].isdigit() else None
            if "theta" in kind and number is None and word in either:
                continue
            state = f"{kind.strip()}{1 if number is None else number}" if "theta" in kind else kind
            return _Column(name, state, number, unit if si(unit)[0] and si(unit)[1] != 1.0 else "")
    return _Column(name, "", None, "")


def from_one(columns: Sequence[_Column]) -> list[_Column]:
    """The joints of states, and those of inputs, counted from 1 where names count them from 0."""
    shift = {c.kind == "input" for c in columns if c.number == 0}

    def one(c: _Column) -> _Column:
        if c.number is None or (c.kind == "input") not in shift:
            return c
        return c._replace(number=c.number + 1, kind=re.sub(r"\d$", str(c.number + 1), c.kind))

    return [one(column) for column in columns]


def _system(path: Path, columns: Sequence[_Column], specs: Mapping[str, SystemSpec]) -> str:
    """The system that the names call for."""
    kinds = {column.kind for column in columns}
    angles = any("theta" in kind for kind in kinds)
    if kinds & {"x", "dx"} and not angles:
        return "slide"
    if kinds & {"theta2", "dtheta2"} and not kinds & {"x", "dx"}:
        return "pendubot" if [c.number for c in columns if c.kind == "input"] == [1] else "acrobot"
    if kinds & {"x", "dx"}:
        reason = "a coordinate x and an angle are of no machine that is known by its columns"
    elif angles:
        reason = "theta1 may be of a pendulum or of an arm with a hidden joint"
    else:
        reason = "no column is named as a state"
    raise DataError(f"{path}: line 1: {reason}; give --system {', '.join(sorted(specs))}")


def _model(system: str, spec: SystemSpec) -> Iterator[str]:
    yield from ("[model]", f"type = {toml_text(system)}")
    yield "# A number is trusted; { mean = 0.2, std = 0.02 } is estimated, with that belief."
    for name in spec.parameters:
        what = _what(name)
        yield f"g = 9.81    # {what}" if name == "g" else f"# {name} = ...    # {what}"
    for name, value in spec.optional.items():
        yield f"# {name} = {value:g}    # {_what(name)}; may be left out"
    yield 'friction = "unknown"    # learned in every joint; or "none"'


def _what(name: str) -> str:
    """The unit of a parameter, and what it is where its name is a usual one."""
    return ": ".join(filter(None, (parameter_unit(name), _PARAMETERS.get(name.rstrip("0123456789")))))


def driven(inputs: Mapping[str, str], joints: bool = True) -> Iterator[str]:
    """Columns of inputs, and the joint that each drives as TOML has it; as comments where there are none."""
    mark, both = "" if inputs else "# ", (map(toml_text, inputs), inputs.values())
    names, places = (f"[{', '.join(each)}]" if inputs else "..." for each in both)
    yield from ("", "[input]", f'{mark}columns = {names}    # N m, or N on a slide; such as ["u"]')
    if joints:
        yield f"{mark}joints = {places}    # the joint that each drives, by name or counted from 1; such as [1]"


def sampling(table: Mapping[str, np.ndarray], columns: Sequence[_Column]) -> Iterator[str]:
    """The interval of the rows, where they have one, and the clock."""
    yield from ("", "[sampling]")
    time = next((column for column in columns if column.kind == "time"), None)
    t = table[time.name] * UNITS.get(time.unit, 1.0) if time else np.zeros(2)
    steps = np.diff(t)
    dt = float(f"{np.median(steps):.6g}")
    if dt > 0 and np.max(np.abs(steps - dt)) <= 0.01 * dt:
        yield f"dt = {dt!r}    # s" + ("; is the clock in ms?" if dt > SECONDS_ROW else "")
    else:
        between = f"{np.min(steps):.3g} to {np.max(steps):.3g} s" if time else "no time"
        yield f"# dt = ...    # s; the rows of this log are {between} apart: resample it to uniform rows"
    yield 'input_hold = "zero-order"    # of commands; "first-order" of a measured torque, current or force'
    clock = "sequence" if abs(t[0]) <= 0.01 * max(dt, 0.0) else "session"
    yield f'clock = "{clock}"    # "sequence": time starts at 0 in each file; "session": it runs on over all files'


def measurement(
    table: Mapping[str, np.ndarray],
    measured: Sequence[str],
    spec: SystemSpec,
    unit: Callable[[str], str] = parameter_unit,
) -> Iterator[str]:
    """Tables of readings, their noise, and the state in the first row."""
    yield from ("", "[measurement]")
    names = f"[{', '.join(map(toml_text, measured))}]"
    states = ", ".join(map(toml_text, spec.states))
    yield f"columns = {names}    # of {states}" if measured else f"# columns = ...    # such as [{states}]"
    yield from ("", "[measurement.noise_std]    # read off the high frequencies; what is left out is estimated")
    for name in measured:
        noise = reading_noise(table[name][None])
        sure = 0 < noise < 0.3 * np.nanstd(table[name])
        yield f"{'' if sure else '# '}{dotted_key(name)} = {noise:.2g}    # {unit(name)}"
    yield from ("", "[start]    # the state in the first row, where it is known but not measured")
    for name in spec.states:
        if name not in measured:
            yield f"# {toml_key(name)} = {{ mean = 0.0, std = 0.5 }}    # {unit(name)}; may be left out"


def _notes(columns: Sequence[_Column], spec: SystemSpec) -> Iterator[str]:
    """Columns to rename or convert in the log."""
    names = {column.name for column in columns}
    for column in columns:
        if column.number and column.name.strip().endswith(str(column.number - 1)):
            yield f"column {column.name!r}: counted from 0, so taken for joint {column.number}"
    for column in columns:
        state = column.kind in (*spec.states, "time")
        if not state and column.kind != "input":
            continue
        if state and column.kind != column.name and column.kind in names:
            continue
        hints = [f"name it {column.kind!r}"] if state and column.kind != column.name else []
        hints += [f"convert it from {column.unit} to {si(column.unit)[0]}"] if column.unit else []
        if hints:
            yield f"column {column.name!r}: {' and '.join(hints)}"


def _clock_notes(path: Path, table: Mapping[str, np.ndarray], columns: Sequence[_Column]) -> Iterator[str]:
    """Absence, standstill or wrong unit of the time."""
    time = next((column for column in columns if column.kind == "time"), None)
    if time is None:
        yield "no column 'time': add one [s], or write [sampling] dt"
        return
    steps = np.diff(table[time.name])
    if (stands := np.flatnonzero(steps <= 0)).size:
        yield f"{place(path, time.name, int(stands[0]) + 1)}: time does not run on: remove or correct the row"
    if not time.unit and (dt := np.median(steps)) > SECONDS_ROW:
        yield f"column {time.name!r}: rows are {dt:.6g} s apart: is the clock in ms? write s"
