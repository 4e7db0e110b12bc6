"""MCAP files: topics and their numbers, in the memory of the requested ones."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..data.dataset import DataError
from ..data.formats import unreadable
from .clock import choose
from .codecs import Codec, Unreadable, codec
from .mcap_records import MAGIC, Batch, Broken, Frames
from .recording import EXTRA, OTHER, Recording, Topic, Track, refuse

SAMPLES = 20
"""Messages of a channel that are looked at for its fields: not every message needs to have them all."""


class _Open(NamedTuple):
    """A file that is being read."""

    path: Path
    frames: Frames
    counts: Mapping[int, int] | None
    """Messages of each channel, where the file has them."""


def topics(path: Path) -> tuple[Topic, ...]:
    """Topics of the file; whole chunks are read only for the first messages of each channel."""
    with _opened(path) as log:
        samples = _samples(log)
        by_name: dict[str, Topic] = {}
        for number, channel in sorted(log.frames.channels.items()):
            count = None if log.counts is None else log.counts.get(number, 0)
            schema = log.frames.schemas.get(channel.schema_id)
            kind = f"{schema.name if schema else 'no schema'}, {channel.message_encoding}"
            try:
                reader = codec(channel.message_encoding, channel, schema)
                fields = [name for message in samples.get(number, ()) for name in reader.fields(message)]
            except Unreadable as unread:
                kind, fields = f"{kind}: {unread}", []
            except Exception as error:
                kind, fields = f"{kind}: its messages do not fit their schema ({type(error).__name__})", []
            before = by_name.get(channel.topic, Topic(channel.topic, kind, 0, ()))
            total = None if count is None or before.messages is None else before.messages + count
            by_name[channel.topic] = Topic(channel.topic, kind, total, tuple(dict.fromkeys([*before.fields, *fields])))
        return tuple(by_name.values())


def read(path: Path, fields: Mapping[str, Sequence[str]]) -> Recording:
    """The numbers at these paths of these topics, in the order of their times."""
    with _opened(path) as log:
        parts: dict[str, list[_Part]] = {topic: [] for topic in fields}
        codecs: dict[int, Codec] = {}
        stamps: dict[int, tuple[str, ...]] = {}

        def channels() -> set[int]:
            return {number for number, channel in log.frames.channels.items() if channel.topic in fields}

        for batch in log.frames.batches(channels):
            number, topic = batch.channel, log.frames.channels[batch.channel].topic
            if number not in codecs:
                codecs[number] = _codec(log, number)
            values, stamp = _decoded(log, batch, codecs[number], fields[topic], stamps)
            parts[topic].append(_Part(batch.t, stamp, values))
        notes = _cut(log)
    tracks = {}
    for topic, pieces in parts.items():
        if not pieces:
            refuse(path, f"topic {topic!r}", "has no messages", "name another topic, or take the log out")
        tracks[topic] = _track(path, topic, fields[topic], pieces)
    return Recording(path, tracks, notes)


def _decoded(
    log: _Open, batch: Batch, reader: Codec, paths: Sequence[str], stamps: dict[int, tuple[str, ...]]
) -> tuple[Float[np.ndarray, "path message"], Int[np.ndarray, " message"] | None]:
    """Numbers and stamps of a batch; DataError where a message is none of its schema."""
    try:
        if batch.channel not in stamps:
            stamps[batch.channel] = _stamp(reader, batch)
        fields = stamps[batch.channel]
        values = reader.read(batch.data, batch.start, batch.size, (*paths, *fields))
    except Exception as error:  # what the decoders raise on damaged bytes is open-ended
        problem = f"a message does not fit its schema ({' '.join(str(error).split()) or type(error).__name__})"
        hint = "the recorder wrote another type than it said: record again, or name another topic"
        refuse(log.path, f"topic {log.frames.channels[batch.channel].topic!r}", problem, hint)
    stamp = _nanoseconds(values[:, len(paths) :]) if fields else None
    return np.ascontiguousarray(values[:, : len(paths)].T), stamp


class _Part(NamedTuple):
    """Messages of one topic in one piece of the file."""

    t: Int[np.ndarray, " message"]
    stamp: Int[np.ndarray, " message"] | None
    values: Float[np.ndarray, "path message"]


def _track(path: Path, topic: str, paths: Sequence[str], parts: list[_Part]) -> Track:
    """The pieces of one topic as one, which are let go."""
    log = np.concatenate([part.t for part in parts])
    stamps = [part.stamp for part in parts if part.stamp is not None]
    columns = np.concatenate([part.values for part in parts], axis=1)
    parts.clear()
    clock = choose(path, topic, log, np.concatenate(stamps) if sum(map(len, stamps)) == log.size else None)
    return clock.track(zip(paths, columns, strict=True))


def _nanoseconds(values: Float[np.ndarray, "message two"]) -> Int[np.ndarray, " message"] | None:
    """Stamps of seconds and nanoseconds, where every message has one."""
    if not np.isfinite(values).all():
        return None
    return values[:, 0].astype(np.int64) * 1_000_000_000 + values[:, 1].astype(np.int64)


@contextmanager
def _opened(path: Path) -> Iterator[_Open]:
    """The file with the content of its summary; mistakes as a DataError."""
    try:
        import mcap.exceptions
        import mcap.reader
    except ImportError:
        raise DataError(f"{path}: MCAP files cannot be read without mcap; {EXTRA}") from None
    try:
        file = path.open("rb")
    except OSError as error:
        raise unreadable(path, error) from None
    with file:
        if file.read(len(MAGIC)) != MAGIC:
            refuse(path, "the file", "no MCAP file", "give a file that an MCAP recorder wrote")
        try:
            file.seek(0)
            summary = mcap.reader.SeekingReader(file).get_summary()
        except Exception:  # what the parser raises on damaged bytes is open-ended
            summary = None
        frames = Frames(file)
        counts = None
        if summary is not None:
            frames.schemas |= summary.schemas
            frames.channels |= summary.channels
            counts = dict(summary.statistics.channel_message_counts) if summary.statistics else None
        try:
            yield _Open(path, frames, counts)
        except Broken as broken:
            hint = "" if ";" in str(broken) else "; use another copy, or `mcap recover` it"
            raise DataError(f"{path}: {broken}{hint}") from None


def _samples(log: _Open) -> dict[int, list[bytes]]:
    """The first messages of each channel; of a file with counts, those in its first chunk."""
    samples: dict[int, list[bytes]] = {}

    def lacking() -> set[int]:
        if log.counts is None:
            return {number for number in log.frames.channels if len(samples.get(number, ())) < SAMPLES}
        return {number for number, count in log.counts.items() if count and number not in samples}

    for batch in log.frames.batches(lacking):
        rows = zip(batch.start[:SAMPLES].tolist(), batch.size[:SAMPLES].tolist(), strict=True)
        samples.setdefault(batch.channel, []).extend(batch.data[at : at + size].tobytes() for at, size in rows)
        if log.counts is not None and not lacking():
            break
    return samples


def _codec(log: _Open, number: int) -> Codec:
    channel = log.frames.channels[number]
    try:
        return codec(channel.message_encoding, channel, log.frames.schemas.get(channel.schema_id))
    except Unreadable as unread:
        refuse(log.path, f"topic {channel.topic!r}", str(unread), OTHER)


def _stamp(reader: Codec, batch: Batch) -> tuple[str, ...]:
    """The fields that hold the header stamp, if there are such."""
    fields = reader.fields(batch.data[batch.start[0] : batch.start[0] + batch.size[0]].tobytes())
    # Fields of a message that are the time at which it was measured: seconds, and nanoseconds of a second
    stamps = [
        (f"{place}.{seconds}", f"{place}.{nanoseconds}")
        for place in ("header.stamp", "stamp", "timestamp", "header.timestamp")
        for seconds, nanoseconds in (("sec", "nanosec"), ("sec", "nsec"), ("secs", "nsecs"), ("seconds", "nanos"))
    ]
    return next((pair for pair in stamps if all(name in fields for name in pair)), ())


def _cut(log: _Open) -> tuple[str, ...]:
    """Messages about a file that ends too early."""
    if log.frames.whole:
        return ()
    reason = (
        f"its last {log.frames.unread} bytes are no whole record" if log.frames.unread else "its summary is missing"
    )
    return (f"the file is cut short ({reason}): what is whole was read, {log.frames.chunks} chunks",)
