"""Processor time of a message of MCAP in our reader and others, and the messages that each reads of a cut file.

The log is that of `import_logs.py`, twelve topics at 1 kHz.  Each reader gives six numbers of the messages of two
topics, or the first number of the messages of all; the best processor time of five [us a message].  Besides the extra
`logs`: pip install mcap-ros2-support-fast rosbags
"""

import argparse
import functools
import importlib
import platform
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from import_logs import kinds, write

from nnap_em.import_ import mcap_file

Topics = Mapping[str, Sequence[str]]
JOINTS = ("position[joint_1]", "position[joint_2]", "velocity[joint_1]", "velocity[joint_2]")
TWO = {"/joint_states": JOINTS, "/command": ("data[0]", "data[1]")}
FIRST = {"/joint_states": "position[joint_1]", "/imu": "values[0]", "/wrench": "wrench[0]", "/pose": "pose[0]"}
ALL = {kind.topic: (FIRST.get(kind.topic, "data[0]" if kind.topic == "/command" else "data"),) for kind in kinds()}


def own(path: Path, topics: Topics) -> int:
    """Numbers read by `nnap-em import`."""
    tracks = mcap_file.read(path, topics).tracks.values()
    return sum(values.size for track in tracks for values in track.values.values())


def by_mcap(path: Path, topics: Topics, decoder: str) -> int:
    """Numbers read by the library `mcap` and a decoder of ROS 2."""
    factory = importlib.import_module(f"{decoder}.decoder").DecoderFactory()
    with path.open("rb") as file:
        reader = importlib.import_module("mcap.reader").make_reader(file, decoder_factories=[factory])
        every = reader.iter_decoded_messages(topics=list(topics), log_time_order=False)
        return numbers(((channel.topic, message) for _, channel, _, message in every), topics)


def by_rosbags(path: Path, topics: Topics) -> int:
    """Numbers read by `rosbags`."""
    with importlib.import_module("rosbags.highlevel").AnyReader([path]) as reader:
        wanted = [each for each in reader.connections if each.topic in topics]
        every = ((each.topic, reader.deserialize(data, each.msgtype)) for each, _, data in reader.messages(wanted))
        return numbers(every, topics)


def numbers(messages: Iterable[tuple[str, Any]], topics: Topics) -> int:
    """Amount of numbers at these paths of decoded messages."""
    out, parts = [], {topic: [_part(path) for path in paths] for topic, paths in topics.items()}
    for topic, message in messages:
        for field, index in parts[topic]:
            values = getattr(message, field)
            out.append(values if index == "" else values[message.name.index(index) if index[0] == "j" else int(index)])
    return len(out)


def _part(path: str) -> tuple[str, str]:
    field, _, index = path.removesuffix("]").partition("[")
    return field, index


READERS: dict[str, Callable[[Path, Topics], int]] = {
    "own": own,
    "mcap and mcap-ros2-support": functools.partial(by_mcap, decoder="mcap_ros2"),
    "mcap and mcap-ros2-support-fast": functools.partial(by_mcap, decoder="mcap_ros2_support_fast"),
    "rosbags": by_rosbags,
}


def seconds(read: Callable[[Path, Topics], int], path: Path, topics: Topics, messages: int) -> float:
    """Best processor time of five [s]; refused where numbers are absent."""
    times = []
    for _ in range(5):
        began = time.process_time()
        assert read(path, topics) == messages * sum(map(len, topics.values()))
        times.append(time.process_time() - began)
    return min(times)


def left(read: Callable[[Path, Topics], int], path: Path) -> str:
    """Messages that are read of a file, or the error."""
    try:
        return str(read(path, {"/command": ("data[0]",)}))
    except Exception as error:
        return type(error).__name__


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--seconds", type=int, default=20)
    args = arguments.parse_args()
    print(f"{time.strftime('%Y-%m-%d')}, {platform.machine()}, Python {platform.python_version()}")
    with tempfile.TemporaryDirectory() as folder:
        path, cut = Path(folder) / "whole.mcap", Path(folder) / "cut.mcap"
        write(path, args.seconds, "zstd")
        cut.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
        count = 1000 * args.seconds
        print(f"| reader | two of twelve topics | all | messages read of {count // 2} in half a file |")
        for name, read in READERS.items():
            two, every = (1e6 * seconds(read, path, t, count) / (count * len(t)) for t in (TWO, ALL))
            print(f"| {name} | {two:.2f} | {every:.2f} | {left(read, cut)} |", flush=True)


if __name__ == "__main__":
    main()
