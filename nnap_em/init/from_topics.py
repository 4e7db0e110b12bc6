"""A first rig.toml from the topics of an MCAP or HDF5 log, with the table of addresses of all columns."""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..data.dataset import DataError
from ..data.rig import SystemSpec, toml_text
from ..data.units import named_unit, si
from ..import_.files import read, reader
from ..import_.recording import UNTIMED, Address, Topic, last_word, places
from ..import_.segments import reach
from ..import_.signals import Signal, interpolated
from .from_log import Draft, drafted, meaning

COMMAND = re.compile(r"cmd|command|torque|effort|tau|motor", re.IGNORECASE)


def draft_recorded(path: Path, system: str | None, specs: Mapping[str, SystemSpec]) -> Draft:
    """The rig.toml for a log of topics; `system` where its names do not show it.

    Raises DataError where the log cannot be read, or nothing in it looks like a machine.
    """
    topics = reader(path).topics(path)
    columns = found_columns(topics)
    if not columns:
        every = [str(at) for at, _ in places(topics)]
        names = ", ".join(topic.name for topic in topics if topic.name) or ", ".join(every[:12]) or "none"
        hint = f"write rig.toml by hand, with [import.columns] such as theta1 = {toml_text((*every, 'topic:field')[0])}"
        raise DataError(f"{path}: no topic looks like joints or torques (topics: {names}); {hint}")
    draft = drafted(path, columns_table(path, columns), system, specs)
    used = {name: at for name, at in columns.items() if f'"{name}"' in draft.text}
    return draft._replace(text="\n".join([draft.text.rstrip(), *addresses(topics, used)]) + "\n")


def found_columns(topics: Sequence[Topic]) -> dict[str, Address]:
    """Columns, as the built-in machines call them, and where they are."""
    out: dict[str, Address] = {}
    for topic in topics:
        there = {word: at for at, word in reversed(places([topic]))}
        joints = [match[1] for _, word in places([topic]) if (match := re.fullmatch(r"position\[(.+)\]", word))]
        for d, array in (("", "position"), ("d", "velocity")):
            words = {f"{d}theta{i}": f"{array}[{joint}]" for i, joint in enumerate(joints, 1)}
            out |= {column: there[word] for column, word in words.items() if word in there and column not in out}
        for column, at in _called(topic):
            out.setdefault(column, at)
    efforts = [at for at, word in places(topics) if word.startswith("effort[")]
    torques = {f"tau{i}": at for i, at in enumerate(commands(topics) or efforts, 1)}
    return out | ({} if any(meaning(name).kind == "input" for name in out) else torques)


def commands(topics: Sequence[Topic]) -> list[Address]:
    """Entries of an array on a topic whose name is that of torques."""
    return [at for at, word in places(topics) if re.fullmatch(r"data(\[\d+\])?", word) and COMMAND.search(str(at))]


def _called(topic: Topic) -> Iterator[tuple[str, Address]]:
    """Fields whose names mean a state or an input; rows of a wide data set count from 0."""
    quantity = re.compile(r"(position|velocity|effort)\[")
    for field in topic.fields:
        word = re.sub(r"\[(\d+)\]$", lambda m: str(int(m[1]) + 1), last_word(field))
        column = meaning(word)
        if column.kind and column.kind != "time" and not quantity.match(word) and "stamp" not in field:
            name = re.sub(r"\W+", "_", named_unit(word)[0]) if column.kind == "input" else column.kind
            yield name, Address(topic.name, field, si(column.unit)[1] if column.unit else None)


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


def columns_table(path: Path, columns: Mapping[str, Address]) -> dict[str, Float[np.ndarray, " time"]]:
    """The columns on the rows of the fastest topic, for a look at interval and noise; NaN where no reading is near."""
    tracks = read(path, columns.values()).tracks
    origin = max(int(track.t[0]) for track in tracks.values())
    steps = [np.median(np.diff(track.t)) * 1e-9 for track in tracks.values() if track.t.size > 1]
    if not steps:
        raise DataError(f"{path}: its topics have one message each; give a log of a motion")
    dt = float(f"{min(steps):.3g}")
    end = min(int(track.t[-1]) for track in tracks.values())
    most = 100_000  # rows of the log from which its interval and noise are estimated
    at = dt * np.arange(min(max(int((end - origin) * 1e-9 / dt), 0), most))
    if at.size < 2:
        raise DataError(f"{path}: its topics have no time in common; name others in [import.columns] by hand")
    timed = all(track.clock != UNTIMED for track in tracks.values())
    table = {"time": at} if timed else {}
    for name, place in columns.items():
        track = tracks[place.topic]
        y = track.values[place.path]
        t, y = (track.t - origin)[np.isfinite(y)] * 1e-9, y[np.isfinite(y)]
        signal = Signal(place.topic, t, (place.scale or 1.0) * y)
        table[name] = interpolated(signal, at, dt, reach(signal, dt)) if y.size > 1 else np.full(at.size, math.nan)
    return table
