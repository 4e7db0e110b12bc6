"""The records of an MCAP file by their places: chunks with their indices, and messages in what they hold.

The format: mcap.dev/spec.  Messages of a chunk are found by its indices, which NumPy reads; where there is none, record
by record.
"""

import io
import os
import struct
from collections.abc import Callable, Container, Iterator, Mapping
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from jaxtyping import Int, UInt8

from .recording import EXTRA

MAGIC = b"\x89MCAP0\r\n"
SCHEMA, CHANNEL, MESSAGE, CHUNK, INDEX = 3, 4, 5, 6, 7


class Batch(NamedTuple):
    """Messages of one channel in one piece of the file."""

    channel: int
    data: UInt8[np.ndarray, " byte"]
    t: Int[np.ndarray, " message"]
    """Log time [ns]."""
    start: Int[np.ndarray, " message"]
    """Offset in `data` of each message."""
    size: Int[np.ndarray, " message"]
    """Bytes."""


class Broken(ValueError):
    """A piece of the file that is damaged or cannot be unpacked, with the reason."""


class Walked(NamedTuple):
    """Records of a piece of the file."""

    schemas: dict[int, Any]
    channels: dict[int, Any]
    messages: Mapping[int, Int[np.ndarray, "message two"]]
    """Log time [ns] and offset of the records of each channel."""


class Frames:
    """The data section of an open file, piece by piece."""

    def __init__(self, file: BinaryIO):
        self.file, self.end = file, os.fstat(file.fileno()).st_size
        self.schemas: dict[int, Any] = {}
        self.channels: dict[int, Any] = {}
        self.whole = True
        """False once the file ended inside a record, or without its summary."""
        self.chunks = 0
        self.unread = 0
        """Bytes after the last whole record."""

    def batches(self, channels: Callable[[], Container[int]]) -> Iterator[Batch]:
        """Messages of wanted channels, piece by piece.

        `channels` is called before each piece, because channels appear on the way.
        """
        self.file.seek(len(MAGIC))
        chunk, index, loose = None, {}, bytearray()
        for code, position, size in self._records():
            if chunk is not None and code != INDEX:
                yield from self._chunk(chunk, index, channels)
                chunk, index = None, {}
            if loose and (code not in (SCHEMA, CHANNEL, MESSAGE) or len(loose) > 2**22):
                yield from self._piece(np.frombuffer(bytes(loose), np.uint8), {}, channels)
                loose = bytearray()
            if code == CHUNK:
                chunk = (position, size)
                self.chunks += 1
            elif code == INDEX:
                record = self.file.read(size)
                channel, length = struct.unpack_from("<HI", record)
                index[channel] = np.frombuffer(record, "<i8", length // 8, 6).reshape(-1, 2)
            elif code in (SCHEMA, CHANNEL, MESSAGE):
                loose += struct.pack("<BQ", code, size) + self.file.read(size)
        if chunk is not None:
            yield from self._chunk(chunk, {}, channels)  # its indices may be cut short
        if loose:
            yield from self._piece(np.frombuffer(bytes(loose), np.uint8), {}, channels)

    def _records(self) -> Iterator[tuple[int, int, int]]:
        """Code, offset of the content and size of each record, up to the summary."""
        while True:
            position = self.file.tell()
            head = self.file.read(9)
            if len(head) == 9:
                code, size = struct.unpack("<BQ", head)
                if position + 9 + size <= self.end:
                    if code in (2, 15):  # footer, end of the data
                        return
                    yield code, position + 9, size
                    self.file.seek(position + 9 + size)
                    continue
            self.whole, self.unread = False, self.end - position
            return

    def _chunk(self, chunk: tuple[int, int], index: Mapping[int, np.ndarray], channels) -> Iterator[Batch]:
        known = index and index.keys() <= self.channels.keys()
        if known and not any(channel in channels() for channel in index):
            return
        self.file.seek(chunk[0])
        yield from self._piece(unpack(self.file.read(chunk[1])), index if known else {}, channels)

    def _piece(self, data: UInt8[np.ndarray, " byte"], index: Mapping[int, np.ndarray], channels) -> Iterator[Batch]:
        batches = [_batch(channel, data, entries) for channel, entries in index.items() if channel in channels()]
        if not index or None in batches:
            walked = walk(data)
            self.schemas |= walked.schemas
            self.channels |= walked.channels
            batches = [
                _batch(channel, data, rows) for channel, rows in walked.messages.items() if channel in channels()
            ]
        yield from (batch for batch in batches if batch is not None and batch.t.size)


def unpack(record: bytes) -> UInt8[np.ndarray, " byte"]:
    """Content of a chunk record, unpacked; Broken where it is damaged, or of an unknown compression."""
    from mcap.data_stream import ReadDataStream
    from mcap.exceptions import UnsupportedCompressionError
    from mcap.records import Chunk
    from mcap.stream_reader import CRCValidationError, get_chunk_data_stream

    chunk = Chunk.read(ReadDataStream(io.BytesIO(record)))
    if chunk.compression not in ("", "lz4", "zstd"):
        raise Broken(f"compression {chunk.compression!r} of its chunks is not read; write it with lz4, zstd or none")
    try:
        data, size = get_chunk_data_stream(chunk, validate_crc=True)
    except UnsupportedCompressionError:
        raise Broken(f"its chunks are packed by {chunk.compression}, whose library is not there; {EXTRA}") from None
    except CRCValidationError:
        raise Broken("the checksum of a chunk does not hold") from None
    except Exception as error:
        raise Broken(f"a chunk cannot be unpacked ({error})") from None
    return np.frombuffer(data.read(size), np.uint8)


def walk(data: UInt8[np.ndarray, " byte"]) -> Walked:
    """Record by record; what ends in the middle of one ends before it."""
    from mcap.data_stream import ReadDataStream
    from mcap.records import Channel, Schema

    walked, text, at = Walked({}, {}, {}), data.tobytes(), 0
    rows: dict[int, list[tuple[int, int]]] = {}
    while at + 9 <= len(text):
        code, size = struct.unpack_from("<BQ", text, at)
        if at + 9 + size > len(text):
            break
        if code == MESSAGE:
            channel, _, t = struct.unpack_from("<HIQ", text, at + 9)
            rows.setdefault(channel, []).append((t, at))
        elif code == SCHEMA:
            schema = Schema.read(ReadDataStream(io.BytesIO(text[at + 9 : at + 9 + size])))
            walked.schemas[schema.id] = schema
        elif code == CHANNEL:
            channel = Channel.read(ReadDataStream(io.BytesIO(text[at + 9 : at + 9 + size])))
            walked.channels[channel.id] = channel
        at += 9 + size
    return walked._replace(messages={channel: np.array(each, np.int64) for channel, each in rows.items()})


def _batch(channel: int, data: UInt8[np.ndarray, " byte"], rows: Int[np.ndarray, "message two"]) -> Batch | None:
    """The messages at these places; None where there are none at one of them."""
    t, at = rows[:, 0], rows[:, 1]
    if not at.size:
        return Batch(channel, data, t, at, at)
    if at.min() < 0 or at.max() + 31 > data.size or (data[at] != MESSAGE).any():
        return None
    size = _numbers(data, "<i8", at + 1) - 22
    if (_numbers(data, "<u2", at + 9) != channel).any() or size.min() < 0 or (at + 31 + size).max() > data.size:
        return None
    return Batch(channel, data, t, at + 31, size)


def _numbers(data: UInt8[np.ndarray, " byte"], kind: str, at: Int[np.ndarray, " message"]) -> np.ndarray:
    """Numbers at any bytes."""
    return np.ndarray((data.size - np.dtype(kind).itemsize + 1,), kind, data, strides=(1,))[at]
