"""A first rig.toml from the topics of an MCAP or HDF5 log, with the table of addresses of all columns."""

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..data.dataset import DataError
from ..data.rig import SystemSpec, toml_text
from ..recordings.files import reader
from ..recordings.recording import Address, Topic
from .from_log import Draft, drafted, meaning

ROWS = 100_000
"""Rows of the log from which its interval and noise are estimated."""
COMMAND = re.compile(r"cmd|command|torque|effort|tau|motor", re.IGNORECASE)


def draft_recorded(path: Path, system: str | None, specs: Mapping[str, SystemSpec]) -> Draft:
    """The rig.toml for a log of topics; `system` where its names do not show it.

    Raises DataError where the log cannot be read, or nothing in it looks like a machine.
    """
    topics = reader(path).topics(path)
    columns = found_columns(topics)
    if not columns:
        names = ", ".join(topic.name for topic in topics) or "none"
        hint = "write rig.toml by hand, with [import.columns]"
        raise DataError(f"{path}: no topic looks like joints or torques (topics: {names}); {hint}")
    draft = drafted(path, columns_table(path, columns), system, specs)
    lines = [f"# not used: {each}" for each in others(topics, columns)]
    lines += [f"{toml_text(name)} = {toml_text(str(at))}" for name, at in columns.items() if f'"{name}"' in draft.text]
    head = "\n[import.columns]    # where each column is in the log\n"
    return draft._replace(text=draft.text + head + "\n".join(lines) + "\n")


def found_columns(topics: Sequence[Topic]) -> dict[str, Address]:
    """Columns, as the built-in machines call them, and where they are."""
    out: dict[str, Address] = {}
    for topic in topics:
        joints = joints_of(topic)
        names = {joint: f"theta{i}" for i, joint in enumerate(joints, 1)}
        for column, at in (*joint_columns(topic, names).items(), *_called(topic)):
            out.setdefault(column, at)
    torques = {f"tau{i}": at for i, at in enumerate(commands(topics), 1)}
    efforts = {f"tau{i}": at for i, at in enumerate(_efforts(topics), 1)}
    return out | ({} if any(meaning(name).kind == "input" for name in out) else torques or efforts)


def joints_of(topic: Topic) -> list[str]:
    """The joints that a topic names, in its order."""
    return [match[1] for field in topic.fields if (match := re.fullmatch(r"position\[(.+)\]", field))]


def joint_columns(topic: Topic, coordinates: Mapping[str, str]) -> dict[str, Address]:
    """Angles and rates of joints, called as a machine calls them; `coordinates` are by the joints' names in the log."""
    fields = [(name, f"position[{joint}]") for joint, name in coordinates.items()]
    fields += [(f"d{name}", f"velocity[{joint}]") for joint, name in coordinates.items()]
    return {column: Address(topic.name, field) for column, field in fields if field in topic.fields}


def commands(topics: Sequence[Topic]) -> list[Address]:
    """Entries of an array on a topic whose name is that of torques."""
    return [Address(t.name, field) for t in topics if COMMAND.search(t.name) for field in t.fields
            if re.fullmatch(r"data(\[\d+\])?", field)]  # fmt: skip


def _efforts(topics: Sequence[Topic]) -> list[Address]:
    return [Address(t.name, field) for t in topics for field in t.fields if field.startswith("effort[")]


def _called(topic: Topic) -> Iterator[tuple[str, Address]]:
    """Fields whose names mean a state or an input; rows of a wide data set count from 0."""
    for field in topic.fields:
        word = re.sub(r"\[(\d+)\]$", lambda m: str(int(m[1]) + 1), field.rpartition(".")[2])
        column = meaning(word)
        if column.kind and column.kind != "time" and "[" not in word and "stamp" not in field:
            yield (word if column.kind == "input" else column.kind), Address(topic.name, field)


def others(topics: Sequence[Topic], columns: Mapping[str, Address]) -> list[str]:
    """Topics of numbers that no column is from."""
    used = {at.topic for at in columns.values()}
    return [f"{t.name} ({', '.join(t.fields[:3])}{', ...' * (len(t.fields) > 3)})" for t in topics if t.fields and
            t.name not in used][:10]  # fmt: skip


def columns_table(path: Path, columns: Mapping[str, Address]) -> dict[str, Float[np.ndarray, " time"]]:
    """The columns on the rows of the fastest topic, for a look at interval and noise."""
    fields: dict[str, list[str]] = {}
    for at in columns.values():
        fields.setdefault(at.topic, []).append(at.path)
    tracks = reader(path).read(path, {topic: tuple(dict.fromkeys(paths)) for topic, paths in fields.items()}).tracks
    origin = max(int(track.t[0]) for track in tracks.values())
    dt = min(float(f"{np.median(np.diff(track.t)) * 1e-9:.3g}") for track in tracks.values() if track.t.size > 1)
    end = min(int(track.t[-1]) for track in tracks.values())
    at = dt * np.arange(min(max(int((end - origin) * 1e-9 / dt), 0), ROWS))
    if at.size < 2:
        raise DataError(f"{path}: its topics have no time in common; name others in [import.columns] by hand")
    table = {"time": at}
    for name, place in columns.items():
        track = tracks[place.topic]
        y = track.values[place.path]
        finite = np.isfinite(y)
        table[name] = np.interp(at, (track.t[finite] - origin) * 1e-9, y[finite]) if finite.any() else 0 * at
    return table
