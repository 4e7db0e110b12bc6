"""Places of the numbers of a ROS 2 message in its bytes: CDR, little endian [OMG DDS-XTypes 1.3, 7.4: XCDR1]."""

import math
import re
import struct
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from .objects import NAMES

_PRIMITIVES = {
    "bool": "?", "byte": "u1", "char": "u1", "int8": "i1", "uint8": "u1", "int16": "<i2", "uint16": "<u2",
    "int32": "<i4", "uint32": "<u4", "int64": "<i8", "uint64": "<u8", "float32": "<f4", "float64": "<f8",
}  # fmt: skip
Field = tuple[str, str | None, str]
"""Type, brackets and name."""
Types = Mapping[str, list[Field]]
"""The fields of every message."""
_HEAD = 4
"""Bytes of the encapsulation, from whose end alignment counts."""


class UnknownLayout(ValueError):
    """A message or a definition that is not laid out here."""


class Run(NamedTuple):
    """Numbers of one type in a row."""

    offset: int
    kind: np.dtype
    length: int
    """-1: one number that is no list."""
    names: tuple[str, ...]
    """Names of the entries, where names are beside them."""


class Layout(NamedTuple):
    """Layout of the messages of one form: same lengths of all lists and texts, same names."""

    size: int
    fixed: Int[np.ndarray, " byte"]
    """Offsets of the bytes that make the form: those of every length, and of names."""
    form: UInt8[np.ndarray, " byte"]
    """Bytes of the form."""
    runs: Mapping[str, Run]

    def matches(
        self, data: UInt8[np.ndarray, " byte"], start: Int[np.ndarray, " message"], size: Int[np.ndarray, " message"]
    ) -> Bool[np.ndarray, " message"]:
        """Mask of the messages that have this form."""
        same = size == self.size
        rows = start[same] if not same.all() else start
        same[same] = (data[rows[:, None] + self.fixed] == self.form).all(axis=1)
        return same

    def read(
        self, data: UInt8[np.ndarray, " byte"], start: Int[np.ndarray, " message"], path: str
    ) -> Float[np.ndarray, " message"]:
        """The number at a path in messages of this form; NaN where they have none."""
        base, _, index = path.removesuffix("]").rpartition("[") if path.endswith("]") else (path, "", "")
        run = self.runs.get(base)
        place = None if run is None else _place(run, index if path.endswith("]") else None)
        if run is None or place is None or not start.size:
            return np.full(start.size, math.nan)
        offset, width = run.offset + place * run.kind.itemsize, run.kind.itemsize
        every = np.ndarray((data.size - width + 1,), run.kind, data, strides=(1,))  # one at each byte
        return every[start + offset].astype(np.float64)


def _place(run: Run, index: str | None) -> int | None:
    """Place of a number in a run."""
    if index is None:
        return 0 if run.length < 0 else None
    if index in run.names:
        return run.names.index(index)
    return int(index) if index.isdigit() and int(index) < run.length else None


def definitions(name: str, text: str) -> Types:
    """The messages of a concatenated definition; UnknownLayout where a line is of no known form."""
    time: list[Field] = [("int32", None, "sec"), ("uint32", None, "nanosec")]
    types: dict[str, list[Field]] = {"builtin_interfaces/Time": time, "builtin_interfaces/Duration": time}
    field = re.compile(r"([\w/]+)(?:<=\d+)?(\[(?:<=)?\d*\])?\s+(\w+)\s*(=)?")
    for part in re.split(r"(?m)^=+\s*$", f"MSG: {name}\n{text}"):
        head, *lines = [line for each in part.splitlines() if (line := each.split("#")[0].strip())] or [""]
        owner, fields = head.removeprefix("MSG:").strip().replace("/msg/", "/"), []
        for line in lines:
            match = field.match(line)
            if not match:
                raise UnknownLayout(line)
            if not match[4]:  # else a constant
                fields.append((_full(match[1], owner), match[2], match[3]))
        types[owner] = fields or [("uint8", None, "structure_needs_at_least_one_member")]
    return types


def _full(kind: str, owner: str) -> str:
    """The name of a type as other definitions call it."""
    if kind in _PRIMITIVES or kind in ("string", "wstring"):
        return kind
    short = {"time": "builtin_interfaces/Time", "duration": "builtin_interfaces/Duration", "Header": "std_msgs/Header"}
    kind = short.get(kind, kind).replace("/msg/", "/")
    return kind if "/" in kind else f"{owner.split('/')[0]}/{kind}"


class _Walk:
    """A way through one message, from front to back: where one field ends is where the next begins."""

    def __init__(self, types: Types, message: bytes):
        self.types, self.message, self.at = types, message, _HEAD
        self.fixed: list[range] = [range(_HEAD)]
        self.runs: dict[str, Run] = {}

    def record(self, kind: str, path: str) -> None:
        """All fields of a message."""
        if kind not in self.types:
            raise UnknownLayout(kind)
        arrays, names = [], ()
        for inner, brackets, field in self.types[kind]:
            full = f"{path}.{field}" if path else field
            if brackets is None:
                self.single(inner, full)
                continue
            count = int(brackets[1:-1]) if brackets[1:-1].isdigit() else self.length()
            if inner == "string":
                texts = [self.text(named=field in NAMES) for _ in range(count)]
                different = all(texts) and len(set(texts)) == len(texts)
                names = tuple(texts) if field in NAMES and different and not names else names
            elif inner in _PRIMITIVES:
                self.numbers(inner, full, count)
                arrays.append(full)
            else:
                for i in range(count):
                    self.single(inner, f"{full}[{i}]")
        for full in arrays:
            if self.runs[full].length == len(names):
                self.runs[full] = self.runs[full]._replace(names=names)

    def single(self, kind: str, path: str) -> None:
        """One field that is no list."""
        if kind == "string":
            self.text(named=False)
        elif kind in _PRIMITIVES:
            self.numbers(kind, path, -1)
        else:
            self.record(kind, path)

    def numbers(self, kind: str, path: str, count: int) -> None:
        """A run of numbers; -1: one, that is no list."""
        dtype = np.dtype(_PRIMITIVES[kind])
        if count:
            self.align(dtype.itemsize)
        self.runs[path] = Run(self.at, dtype, count, ())
        self.skip(dtype.itemsize * abs(count))

    def length(self) -> int:
        """The length of a list, which makes the form."""
        self.align(4)
        if self.at + 4 > len(self.message):
            raise UnknownLayout("cut short")
        (count,) = struct.unpack_from("<I", self.message, self.at)
        self.fixed.append(range(self.at, self.at + 4))
        self.at += 4
        return count

    def text(self, *, named: bool) -> str:
        """A text; its letters make the form where they name the entries of a list."""
        size, first = self.length(), self.at
        self.skip(size)
        if named:
            self.fixed.append(range(first, self.at))
        return self.message[first : self.at].rstrip(b"\0").decode(errors="replace")

    def align(self, width: int) -> None:
        self.at += -(self.at - _HEAD) % width

    def skip(self, size: int) -> None:
        self.at += size
        if self.at > len(self.message):
            raise UnknownLayout("cut short")


def layout(types: Types, name: str, message: bytes) -> Layout:
    """Places of the numbers of a message; UnknownLayout where it is no little-endian XCDR1 of these types."""
    if message[:2] != b"\x00\x01":
        raise UnknownLayout(f"encapsulation {message[:2].hex()}")
    walk = _Walk(types, message)
    walk.record(name, "")
    fixed = np.array([i for part in walk.fixed for i in part])
    return Layout(len(message), fixed, np.frombuffer(message, np.uint8)[fixed], walk.runs)
