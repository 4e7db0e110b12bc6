"""Messages of an MCAP channel as numbers: one class an encoding."""

import json
import math
from collections.abc import Callable, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int, UInt8

from .objects import flatten, pick
from .ros2 import Layout, UnknownLayout, definitions, layout

Bytes = UInt8[np.ndarray, " byte"]


@runtime_checkable
class Codec(Protocol):
    """Reader of messages of one schema."""

    def fields(self, message: bytes) -> dict[str, float]:
        """All numbers of a message by their paths."""
        ...

    def read(
        self, data: Bytes, start: Int[np.ndarray, " message"], size: Int[np.ndarray, " message"], paths: Sequence[str]
    ) -> Float[np.ndarray, "message path"]:
        """Numbers of many messages that lie in `data`; NaN where one has none."""
        ...


class Unreadable(ValueError):
    """An encoding that cannot be read, with its name."""


class Decoded:
    """Messages decoded one by one into objects."""

    def __init__(self, decode: Callable[[bytes], Any]):
        self.decode = decode

    def fields(self, message: bytes) -> dict[str, float]:
        """All numbers of a message by their paths."""
        return flatten(self.decode(message))

    def read(
        self, data: Bytes, start: Int[np.ndarray, " message"], size: Int[np.ndarray, " message"], paths: Sequence[str]
    ) -> Float[np.ndarray, "message path"]:
        """Numbers of many messages; NaN where one has none."""
        out = np.full((start.size, len(paths)), math.nan)
        for row, (first, length) in enumerate(zip(start.tolist(), size.tolist(), strict=True)):
            message = self.decode(data[first : first + length].tobytes())
            out[row] = [pick(message, path) for path in paths]
        return out


class Ros2:
    """CDR messages, many at once: where the numbers of one lie is where those of all of its form lie.

    Every form is compared with the decoder of `mcap_ros2` on its first message; where the two differ, or a message
    cannot be laid out, that decoder reads, which takes a hundred times as long.
    """

    def __init__(self, name: str, text: str, generic: Callable[[bytes], Any]):
        self.slow = Decoded(generic)
        self.known: list[Layout] = []
        self.name = name.replace("/msg/", "/")
        try:
            self.types = definitions(name, text)
        except UnknownLayout:
            self.types = {}

    def fields(self, message: bytes) -> dict[str, float]:
        """All numbers of a message by their paths."""
        return self.slow.fields(message)

    def read(
        self, data: Bytes, start: Int[np.ndarray, " message"], size: Int[np.ndarray, " message"], paths: Sequence[str]
    ) -> Float[np.ndarray, "message path"]:
        """Numbers of many messages; NaN where one has none."""
        out, todo = np.full((start.size, len(paths)), math.nan), np.arange(start.size)
        for form in self.known:
            todo = self._fill(out, todo, form, data, start, size, paths)
        while todo.size:
            k = todo[0]
            form = self._form(data[start[k] : start[k] + size[k]].tobytes(), paths)
            if form is None:
                out[todo] = self.slow.read(data, start[todo], size[todo], paths)
                break
            self.known.append(form)
            todo = self._fill(out, todo, form, data, start, size, paths)
        return out

    @staticmethod
    def _fill(out, todo, form: Layout, data, start, size, paths) -> Int[np.ndarray, " rest"]:
        """Read what has this form; the others come back."""
        same = form.matches(data, start[todo], size[todo])
        rows = todo[same] if not same.all() else todo
        for i, path in enumerate(paths):
            out[rows, i] = form.read(data, start[rows], path)
        return todo[~same]

    def _form(self, message: bytes, paths: Sequence[str]) -> Layout | None:
        """Places of the numbers of this message; None where they are unknown, or forms are too many."""
        if len(self.known) >= MESSAGE_FORMS or not self.types:
            return None
        try:
            form = layout(self.types, self.name, message)
        except UnknownLayout:
            return None
        data, first = np.frombuffer(message, np.uint8), np.zeros(1, int)
        values = np.array([form.read(data, first, path)[0] for path in paths])
        decoded = self.slow.read(data, first, np.array([len(message)]), paths)[0]
        return form if np.array_equal(values, decoded, equal_nan=True) else None


MESSAGE_FORMS = 64
"""Forms of the messages of a channel that are laid out: of frames, joints and lengths of lists there are few."""


def codec(encoding: str, channel: Any, schema: Any) -> Codec:
    """Codec of a channel of this message encoding; Unreadable where there is none."""
    if encoding not in _codecs:
        raise Unreadable(f"encoding {encoding!r} is not read")
    return _codecs[encoding](channel, schema)


def _ros2(channel: Any, schema: Any) -> Codec:
    from mcap_ros2.decoder import DecoderFactory

    if schema is None or schema.encoding != "ros2msg":
        raise Unreadable(f"schema encoding {schema.encoding if schema else 'none'!r} of CDR messages is not read")
    try:
        decode = DecoderFactory().decoder_for("cdr", schema)
    except Exception as error:
        raise Unreadable(f"its schema cannot be parsed ({error})") from None
    assert decode is not None
    return Ros2(schema.name, schema.data.decode(), decode)


def _protobuf(channel: Any, schema: Any) -> Codec:
    from mcap_protobuf.decoder import DecoderFactory

    try:
        decode = DecoderFactory().decoder_for("protobuf", schema)
    except Exception as error:
        raise Unreadable(f"its schema cannot be parsed ({error})") from None
    if decode is None:
        raise Unreadable("protobuf without a protobuf schema is not read")
    return Decoded(decode)


_codecs: dict[str, Callable[[Any, Any], Codec]] = {
    "cdr": _ros2,
    "json": lambda channel, schema: Decoded(json.loads),
    "protobuf": _protobuf,
}
