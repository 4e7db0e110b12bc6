"""A first rig.toml from any log: columns by their names, interval and noise by their numbers; the rest as comments."""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ...errors import DataError
from ...machines.rig import SystemSpec
from ...machines.table import toml_key, toml_text
from ...machines.units import named_unit, parameter_unit, si
from ..formats import header_hint
from ..importing.files import read, reader
from ..importing.recording import UNTIMED, Address, Topic, last_word, places
from ..importing.signals import Signal, interpolated
from ..noise import reading_noise

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
COMMAND = re.compile(r"cmd|command|torque|effort|tau|motor", re.IGNORECASE)
SLOW = 0.5
"""Interval of the rows [s] above which the clock may be in ms."""
HEAD = """\
format = 1
name = {name}

# SI units: s, kg, m, rad, N m.  Fill in the lines of the form  # key = ...  and take their first # away.
"""


class Draft(NamedTuple):
    """A rig.toml to fill in."""

    text: str

    @property
    def missing(self) -> dict[str, list[str]]:
        """The keys that stand as comments, by their tables."""
        _, *parts = re.split(r"(?m)^\[([\w.]+)\]", self.text)
        keys = (re.findall(r"(?m)^# (\w+) = \.\.\.", lines) for lines in parts[1::2])
        return {table: names for table, names in zip(parts[::2], keys, strict=True) if names}

    @property
    def mapped(self) -> bool:
        """True where columns have other names or units in the log."""
        return "[import.columns]" in self.text


class Meaning(NamedTuple):
    """Meaning of the name of a column."""

    kind: str  # `time`, `input`, the name of a state, or nothing
    number: int | None
    unit: str  # Unit by the name where it is not SI


def draft(path: Path, system: str | None, specs: Mapping[str, SystemSpec]) -> Draft:
    """The rig.toml for a log of a built-in machine; `system` where its names do not show it."""
    topics = reader(path).topics(path)
    states, inputs = found_columns(topics)
    if not states and not inputs:
        fields = [str(at) for at, _ in places(topics)] or ["topic:field"]
        hint = f"write rig.toml by hand, with [import.columns] such as theta1 = {toml_text(fields[0])}"
        hint = (path.suffix.lower() == ".csv" and header_hint(path)) or hint
        raise DataError(f"{path}: nothing looks like joints or torques (found {', '.join(fields[:12])}); {hint}")
    system = system or _system(path, states, inputs, specs)
    spec = specs[system]
    driven = {name: (at, spec.driven if joint is None else joint) for name, (at, joint) in inputs.items()}
    driven = {name: (at, str(joint)) for name, (at, joint) in driven.items() if joint <= spec.joints}
    states = {name: states[name] for name in spec.states if name in states}
    name = path.resolve().parent.name or "rig"
    return drafted(path, topics, name, _model(system, spec), states, driven, spec.states)


def drafted(
    path: Path,
    topics: Sequence[Topic],
    name: str,
    model: Iterable[str],
    readings: Mapping[str, Address],
    inputs: Mapping[str, tuple[Address, str]],
    states: Sequence[str],
    unit: Callable[[str], str] = parameter_unit,
    drives: Iterable[str] | None = None,
) -> Draft:
    """The rig.toml of a machine with these columns; an input has its joint, as TOML writes it."""
    columns = {**readings, **{column: at for column, (at, _) in inputs.items()}}
    table = columns_table(path, columns)
    lines = [
        *model,
        *(driven({column: joint for column, (_, joint) in inputs.items()}) if drives is None else drives),
        *sampling(table),
        *_measurement(table, list(readings), states, unit),
        *addresses(topics, columns),
    ]
    return Draft("\n".join([HEAD.format(name=toml_text(name)), *lines]) + "\n")


# --- names


def meaning(name: str) -> Meaning:
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
            return Meaning(state, number, unit if si(unit)[0] and si(unit)[1] != 1.0 else "")
    return Meaning("", None, "")


def meanings(topics: Sequence[Topic]) -> list[tuple[Address, str, Meaning]]:
    """Fields of known meaning with their last words; joints count from 1, where a row or names count from 0, too."""
    every = []
    for topic in topics:
        for field in topic.fields:
            word = re.sub(r"\[(\d+)\]$", lambda place: str(int(place[1]) + 1), last_word(field))
            of = meaning(word)
            named = of.kind not in ("", "time") and "stamp" not in field
            if named and not re.match(r"(position|velocity|effort)\[", word):
                every.append((Address(topic.name, field, si(of.unit)[1] if of.unit else None), word, of))
    shift = {of.kind == "input" for _, _, of in every if of.number == 0}

    def from_one(of: Meaning) -> Meaning:
        if of.number is None or (of.kind == "input") not in shift:
            return of
        return of._replace(number=of.number + 1, kind=re.sub(r"\d$", str(of.number + 1), of.kind))

    return [(at, word, from_one(of)) for at, word, of in every]


def found_columns(topics: Sequence[Topic]) -> tuple[dict[str, Address], dict[str, tuple[Address, int | None]]]:
    """States as the built-in machines call them, and inputs with the number of their joint where they have one."""
    states: dict[str, Address] = {}
    for topic in topics:
        there = {word: at for at, word in reversed(places([topic]))}
        joints = [match[1] for _, word in places([topic]) if (match := re.fullmatch(r"position\[(.+)\]", word))]
        for d, array in (("", "position"), ("d", "velocity")):
            words = {f"{d}theta{i}": f"{array}[{joint}]" for i, joint in enumerate(joints, 1)}
            states |= {name: there[word] for name, word in words.items() if word in there and name not in states}
    named = sorted(meanings(topics), key=lambda one: one[1] != one[2].kind)  # a state under its own name comes first
    for at, _, of in named:
        if of.kind != "input":
            states.setdefault(of.kind, at)
    inputs = {re.sub(r"\W+", "_", named_unit(word)[0]): (at, of.number) for at, word, of in named if of.kind == "input"}
    efforts = [at for at, word in places(topics) if word.startswith("effort[")]
    return states, inputs or {f"tau{i}": (at, i) for i, at in enumerate(commands(topics) or efforts, 1)}


def commands(topics: Sequence[Topic]) -> list[Address]:
    """Entries of an array on a topic whose name is that of torques."""
    return [at for at, word in places(topics) if re.fullmatch(r"data(\[\d+\])?", word) and COMMAND.search(str(at))]


def _system(path: Path, states: Iterable[str], inputs: Mapping[str, tuple], specs: Mapping[str, SystemSpec]) -> str:
    kinds = {*states}
    slides, angles = kinds & {"x", "dx"}, any("theta" in kind for kind in kinds)
    if slides and not angles:
        return "slide"
    if kinds & {"theta2", "dtheta2"} and not slides:
        return "pendubot" if [joint for _, joint in inputs.values()] == [1] else "acrobot"
    reason = "theta1 may be of a pendulum, or of an arm with a hidden joint"
    reason = reason if angles and not slides else "its columns are those of no machine here"
    raise DataError(f"{path}: {reason}; give --system {', '.join(sorted(specs))}")


# --- numbers


def columns_table(path: Path, columns: Mapping[str, Address]) -> dict[str, Float[np.ndarray, " time"]]:
    """The columns on the rows of the fastest topic, for a look at interval and noise; NaN where no reading is near."""
    tracks = read(path, columns.values()).tracks
    origin = max(int(track.t[0]) for track in tracks.values())
    read_at = [tracks[at.topic].t[np.isfinite(tracks[at.topic].values[at.path])] for at in columns.values()]
    steps = [common_step(t) for t in read_at if t.size > 1]
    if not steps:
        raise DataError(f"{path}: its topics have one message each; give a log of a motion")
    rows = [common_step(track.t) for track in tracks.values() if track.t.size > 1]
    # Columns that are read in turns share the step of the rows, those a little later than others do not
    step, error = min(step for step in (*steps, *rows) if step[0] > 0.4 * min(steps)[0])
    dt = float(f"{step:.3g}")
    dt = dt if abs(dt - step) < max(1e-4 * step, error) or "" not in tracks else float(f"{step:.6g}")
    end = min(int(track.t[-1]) for track in tracks.values())
    most = 100_000  # rows of the log from which its interval and noise are estimated
    at = dt * np.arange(min(max(round((end - origin) * 1e-9 / dt), 0), most))
    if at.size < 2:
        raise DataError(f"{path}: its topics have no time in common; name others in [import.columns] by hand")
    table = {}
    if all(track.clock != UNTIMED for track in tracks.values()):
        since = 1e-9 * origin if "" in tracks and origin < 1e17 else 0.0  # of a table, but for times since 1970
        table["time"] = since + at
    for name, place in columns.items():
        track = tracks[place.topic]
        y = track.values[place.path]
        t, y = (track.t - origin)[np.isfinite(y)] * 1e-9, y[np.isfinite(y)]
        signal = Signal(place.topic, t, (place.scale or 1.0) * y)
        table[name] = interpolated(signal, at, dt) if y.size > 1 else np.full(at.size, np.nan)
    return table


def common_step(t: Int[np.ndarray, " row"]) -> tuple[float, float]:
    """Interval [s] of which the steps of times [ns] are multiples, but for jitter, and three standard errors of it.

    Without such an interval, the median.
    """
    steps, scatter = 1e-9 * np.diff(t), 0.15  # mean distance from multiples, a quarter where there are none [intervals]
    usual = float(np.quantile(steps, 0.5, method="nearest"))
    steps = steps[steps < 10 * usual]  # no pause
    for part in range(1, 9):
        count = np.round(steps * part / usual)
        step = float(steps.sum() / count.sum())
        if np.mean(np.abs(steps / step - count)) < scatter:
            return step, 3 * float(np.std(steps - count * step)) / float(count.sum())
    return usual, 0.0


# --- lines


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


def sampling(table: Mapping[str, np.ndarray], slow: float = SLOW) -> Iterator[str]:
    """The interval of the rows, where they have times, and the clock, which above `slow` [s] is in doubt."""
    yield from ("", "[sampling]")
    t = table.get("time", np.zeros(2))
    dt = float(f"{t[1] - t[0]:.6g}")
    doubt = "; is the clock in ms?" if dt > slow else ""
    yield f"dt = {dt!r}    # s{doubt}" if dt else "# dt = ...    # s; the rows of this log have no times"
    yield 'input_hold = "zero-order"    # of commands; "first-order" of a measured torque, current or force'
    clock = "sequence" if abs(t[0]) <= 0.01 * dt else "session"
    yield f'clock = "{clock}"    # "sequence": time starts at 0 in each file; "session": it runs on over all files'


def _measurement(
    table: Mapping[str, np.ndarray], measured: Sequence[str], states: Sequence[str], unit: Callable[[str], str]
) -> Iterator[str]:
    known = ", ".join(map(toml_text, states))
    names = f"[{', '.join(map(toml_text, measured))}]"
    yield from ("", "[measurement]")
    yield f"columns = {names}    # of {known}" if measured else f"# columns = ...    # such as [{known}]"
    yield from ("", "[measurement.noise_std]    # read off the high frequencies; what is left out is estimated")
    for name in measured:
        noise = reading_noise(table[name][None])
        sure = 0 < noise < 0.3 * np.nanstd(table[name])
        yield f"{'' if sure else '# '}{toml_key(name)} = {noise:.2g}    # {unit(name)}"
    yield from ("", "[start]    # the state in the first row, where it is known but not measured")
    for name in states:
        if name not in measured:
            yield f"# {toml_key(name)} = {{ mean = 0.0, std = 0.5 }}    # {unit(name)}; may be left out"


def addresses(topics: Sequence[Topic], columns: Mapping[str, Address]) -> Iterator[str]:
    """Addresses of columns that have another name in the log, after what is not used: topics, or columns of tables."""
    lines = [f"{toml_text(name)} = {at.toml}" for name, at in columns.items() if at != Address("", name)]
    if lines:
        used, there = {at.topic for at in columns.values()}, {(at.topic, at.path) for at in columns.values()}
        tables = [str(at) for at, _ in places(topics) if at.topic[:1] != "/" and (at.topic, at.path) not in there]
        named = [t for t in topics if t.name[:1] == "/" and t.fields and t.name not in used]
        others = [f"{t.name} ({', '.join(t.fields[:3])}{', ...' * (len(t.fields) > 3)})" for t in named] + tables
        yield from ("", "[import.columns]    # where each column is in the log: nnap-em import reads it there")
        yield from (f"# not used: {each}" for each in others[:10])
        yield from lines
