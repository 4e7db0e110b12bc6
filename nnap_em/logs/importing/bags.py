"""Recordings of robots: MCAP files, and bags of ROS 1 and 2; their messages are decoded one by one."""

import functools
import json
import struct
from array import array
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ...errors import DataError
from ..formats import refuse, unreadable
from .clock import Messages, choose
from .objects import flatten, pick
from .recording import EXTRA, OTHER, Recording, Topic

SAMPLES = 20
"""Messages of a channel that are looked at for its fields: not every message needs to have them all."""


Decode = Callable[[bytes], Any]


class Channel(NamedTuple):
    """Messages of one type on one topic."""

    topic: str
    kind: str
    """Type and encoding, for people."""
    decode: Decode | str
    """Message of its bytes, which raises anything for damaged ones; a text: the reason why it is not read."""


class _Log:
    """An open file: its channels, which may appear on the way, and the numbers, times and bytes of its messages."""

    def __init__(self) -> None:
        self.channels: dict[int, Channel] = {}
        self.counts: dict[int, int] = {}
        """Messages of each channel, where the file has them."""
        self.notes: tuple[str, ...] = ()
        self.messages: Iterator[tuple[int, int, bytes]] = iter(())

    def decoded(self, number: int, data: bytes) -> Any:
        """A message; ValueError with the reason where it cannot be read."""
        _, _, decode = self.channels[number]
        if isinstance(decode, str):
            raise ValueError(decode)
        try:
            return decode(data)
        except Exception as error:  # what the decoders raise on damaged bytes is open-ended
            text = " ".join(str(error).split()) or type(error).__name__
            raise ValueError(f"a message does not fit its schema ({text})") from None


def topics(path: Path) -> tuple[Topic, ...]:
    """Topics of the file; it is read until the first messages of each channel were seen."""
    samples: dict[int, list[bytes]] = defaultdict(list)
    with _opened(path) as log:
        for number, _, data in log.messages:
            if len(samples[number]) < SAMPLES:
                samples[number].append(data)
                counts = log.counts or {i: SAMPLES for i in log.channels} | {-1: 1}  # not known: to the end
                if all(len(samples[i]) >= min(n, SAMPLES) for i, n in counts.items()):
                    break
        by_name: dict[str, Topic] = {}
        for number, (name, kind, _) in sorted(log.channels.items()):
            fields: list[str] = []
            try:
                fields = [field for data in samples[number] for field in flatten(log.decoded(number, data))]
            except ValueError as error:
                kind = f"{kind}: {error}"
            before = by_name.get(name, Topic(name, kind, 0, ()))
            total = before.messages + log.counts.get(number, 0) if log.counts and before.messages is not None else None
            by_name[name] = Topic(name, kind, total, tuple(dict.fromkeys([*before.fields, *fields])))
    return tuple(by_name.values())


def read(path: Path, fields: Mapping[str, Sequence[str]]) -> Recording:
    """The numbers at these paths of these topics, in the order of their times."""
    times: dict[str, array[int]] = {}
    columns: dict[str, dict[str, array[float]]] = {}
    stamps: dict[str, tuple[str, ...]] = {}
    with _opened(path) as log:
        for number, t, data in log.messages:
            topic = log.channels[number].topic
            if topic not in fields:
                continue
            try:
                message = log.decoded(number, data)
            except ValueError as error:
                refuse(path, f"topic {topic!r}", str(error), OTHER)
            if topic not in times:
                stamps[topic] = _stamp(flatten(message))
                times[topic] = array("q")
                columns[topic] = {at: array("d") for at in (*fields[topic], *stamps[topic])}
            times[topic].append(t)
            for at, values in columns[topic].items():
                values.append(pick(message, at))
        messages = {}
        for topic in fields:
            if topic not in times:
                refuse(path, f"topic {topic!r}", "has no messages", "name another topic, or take the log out")
            values = {at: np.array(y) for at, y in columns[topic].items()}
            stamp = _nanoseconds(*(values[at] for at in stamps[topic]))
            messages[topic] = Messages(np.array(times[topic]), stamp, {at: values[at] for at in fields[topic]})
        return Recording(path, choose(path, messages), log.notes)


def _stamp(fields: Mapping[str, float]) -> tuple[str, ...]:
    """The fields that hold the time at which a message was measured: seconds, and nanoseconds of a second."""
    stamps = [
        (f"{place}.{seconds}", f"{place}.{nanoseconds}")
        for place in ("header.stamp", "stamp", "timestamp", "header.timestamp")
        for seconds, nanoseconds in (("sec", "nanosec"), ("sec", "nsec"), ("secs", "nsecs"), ("seconds", "nanos"))
    ]
    return next((pair for pair in stamps if all(name in fields for name in pair)), ())


def _nanoseconds(*stamp: Float[np.ndarray, " message"]) -> Int[np.ndarray, " message"] | None:
    """Stamps of seconds and nanoseconds, where every message has one."""
    if not stamp or not np.isfinite(stamp).all():
        return None
    return stamp[0].astype(np.int64) * 1_000_000_000 + stamp[1].astype(np.int64)


@contextmanager
def _opened(path: Path) -> Iterator[_Log]:
    """The file; mistakes as a DataError."""
    try:
        import mcap.exceptions
        import rosbags.highlevel  # noqa: F401
    except ImportError:
        raise DataError(f"{path}: recordings cannot be read without mcap and rosbags; {EXTRA}") from None
    opened = _mcap if path.suffix.lower() == ".mcap" else _bag
    try:
        with opened(path) as log:
            yield log
    except DataError:
        raise
    except OSError as error:
        raise unreadable(path, error) from None
    except mcap.exceptions.InvalidMagic:
        refuse(path, "the file", "no MCAP file", "give a file that an MCAP recorder wrote")
    except Exception as error:  # what the parsers raise on damaged bytes is open-ended
        problem = " ".join(str(error).split()) or type(error).__name__
        raise DataError(f"{path}: the file is damaged ({problem}); use another copy, or repair it") from None


@contextmanager
def _mcap(path: Path) -> Iterator[_Log]:
    """An MCAP file, whose head is read where its end is missing [mcap.dev/spec]."""
    from mcap.exceptions import EndOfFile
    from mcap.reader import NonSeekingReader, SeekingReader

    with path.open("rb") as file:
        log = _Log()
        try:
            summary = SeekingReader(file).get_summary()
        except Exception:  # damaged, or cut short
            summary = None
        file.seek(0)

        def add(schema: Any, channel: Any) -> None:
            kind = f"{schema.name if schema else 'no schema'}, {channel.message_encoding}"
            decode = _decoder(channel.message_encoding, schema)
            log.channels[channel.id] = Channel(channel.topic, kind, decode)

        def messages() -> Iterator[tuple[int, int, bytes]]:
            count = 0
            try:
                for schema, channel, message in NonSeekingReader(file, True).iter_messages(log_time_order=False):
                    if channel.id not in log.channels:
                        add(schema, channel)
                    count += 1
                    yield channel.id, message.log_time, message.data
            except (EndOfFile, struct.error):
                if file.read(1):
                    raise
                log.notes = (f"the file is cut short: what is whole was read, {count} messages",)

        if summary is not None:
            log.counts = dict(summary.statistics.channel_message_counts) if summary.statistics else {}
            for channel in summary.channels.values():
                if channel.schema_id in (0, *summary.schemas):
                    add(summary.schemas.get(channel.schema_id), channel)
        log.messages = messages()
        yield log


@contextmanager
def _bag(path: Path) -> Iterator[_Log]:
    """A bag of ROS 1, or a database of ROS 2, whose older ones do not hold their definitions."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as bag:
        log = _Log()
        for connection in bag.connections:
            kind = connection.msgtype
            known = kind in bag.typestore.fielddefs
            lacking = "its type is not in the file, nor one of ROS"
            decode = functools.partial(bag.deserialize, typ=kind) if known else lacking
            log.channels[connection.id] = Channel(connection.topic, kind, decode)
            log.counts[connection.id] = connection.msgcount
        log.messages = ((connection.id, t, data) for connection, t, data in bag.messages())
        yield log


def _decoder(encoding: str, schema: Any) -> Decode | str:
    """Decoder of the messages of an MCAP file, or the reason why there is none."""
    form = schema.encoding if schema else "none"
    try:
        if encoding == "json":
            return json.loads
        if encoding == "cdr" and form == "ros2msg":
            return _cdr(schema)
        if encoding == "protobuf":
            from mcap_protobuf.decoder import DecoderFactory

            if decode := DecoderFactory().decoder_for("protobuf", schema):
                return decode
    except ImportError as error:
        return f"it cannot be read without {error.name}; {EXTRA}"
    except Exception as error:
        return f"its schema cannot be parsed ({error})"
    return f"messages in {encoding!r} with a schema in {form!r} are not read"


def _cdr(schema: Any) -> Decode:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    package, _, kind = schema.name.partition("/")
    name = schema.name if kind.startswith("msg/") else f"{package}/msg/{kind}"  # some writers leave the middle out
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(schema.data.decode(), name))
    return lambda data: store.deserialize_cdr(data, name)
