"""Content of a recording, whatever file it came from: topics with numbers at times of their own."""

import functools
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ...machines.rig import toml_text
from ...machines.units import named_unit, si

EXTRA = 'pip install "nnap-em[logs]"'
SECOND = 1_000_000_000
"""ns."""
UNTIMED = "row number"
"""Clock of a table without times, 1 s a row."""
_ARRAYS = {
    "position": re.compile(r"(?:act(?:ual)?_?)?pos(?:ition)?", re.IGNORECASE),
    "velocity": re.compile(r"(?:act(?:ual)?_?)?(?:vel(?:o|ocity)?|speed)", re.IGNORECASE),
    "effort": re.compile(r"(?:act(?:ual)?_?)?(?:effort|torque|tau)", re.IGNORECASE),
}
"""Names of the quantities of a joint where they stand under its name: `Axis1.ActPos`."""


class Topic(NamedTuple):
    """One stream of messages, as a look at the file shows it."""

    name: str
    kind: str
    """Type and encoding, for people."""
    messages: int | None
    """Number of messages; None where the file does not have it."""
    fields: tuple[str, ...]
    """Paths of its numbers, such as `position[shoulder]` or `data[0]`, in the order of the message."""


class Track(NamedTuple):
    """Content of one topic."""

    t: Int[np.ndarray, " message"]
    """ns, rising; of the epoch where the file's clock is."""
    values: Mapping[str, Float[np.ndarray, " message"]]
    """Values by path; NaN where a message has no such number."""
    clock: str
    """Source of the times: `header stamp`, `log time`, or the name of a column."""
    notes: tuple[str, ...]
    """Irregularities of the times."""
    late: float = 0.0
    """Log times minus these times, the median [s]."""


class Recording(NamedTuple):
    """Content of one file."""

    path: Path
    tracks: Mapping[str, Track]
    """Tracks by topic."""
    notes: tuple[str, ...] = ()


class Address(NamedTuple):
    """Address of a column."""

    topic: str
    path: str
    scale: float | None = None
    """SI unit per unit of the log; None: by the unit in the path."""

    def __str__(self) -> str:
        return f"{self.topic}:{self.path}" if self.topic else self.path

    @property
    def toml(self) -> str:
        """The value of a line in [import.columns]."""
        text = toml_text(str(self))
        return text if self.scale in (1.0, None) else f"{{ from = {text}, scale = {self.scale:.9g} }}"


def address(text: str) -> tuple[str, str]:
    """Topic and path of `/joint_states:position[shoulder]`; a table of columns has one topic without name."""
    topic, _, path = text.rpartition(":")
    return topic, path


def last_word(path: str) -> str:
    """The end of a path of names: `q` of `/arm/q`, and of a quantity of a joint `position[joint0]`.

    That is what a table calls `/joint_states/joint0/position` or `Axis1.ActPos`.
    """
    words = [word for word in re.split(r"[.\\:/](?!s(?:\^?2|²)?$|[^\[(]*[\])])", path) if word]
    for array, pattern in _ARRAYS.items():
        if len(words) > 1 and pattern.fullmatch(words[-1]):
            return f"{array}[{words[-2]}]"
    return words[-1] if words else path


def places(topics: Iterable[Topic]) -> list[tuple[Address, str]]:
    """All numbers of a log, scaled by units that stand in brackets behind them, with the last words of their paths."""
    out = []
    for topic in topics:
        for field in topic.fields:
            name, unit = named_unit(field, brackets=True)
            size = si(unit)[1]
            out.append((Address(topic.name, field, None if size == 1 else size), last_word(name)))
    return out


@functools.cache
def steps(path: str) -> tuple[str | int, ...]:
    """The way to a number: names of fields, then indices and names in brackets as ints and as `[name`."""
    found = re.findall(r"([^.\[\]]+)|\[([^\]]*)\]", path)
    return tuple(name or (int(index) if index.isdigit() else f"[{index}") for name, index in found)


OTHER = "write it as ROS 2 CDR, JSON or protobuf, or name another topic"
