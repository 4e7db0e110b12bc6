"""How long does an import take, and how much memory: an hour of 1 kHz with 12 topics, packed in chunks.

The log is made here, byte by byte as a recorder lays it out, and import runs in a process of its own.  Numbers
are noise about slow sines, so that they pack no better than measured ones.
"""

import argparse
import platform
import resource
import struct
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, DataEnd, Footer, Header, Schema, Statistics
from mcap_ros2._dynamic import serialize_dynamic

from nnap_em.import_.ros2 import definitions, layout

EPOCH = 1_700_000_000 * 10**9
BAR = "\n" + "=" * 80 + "\n"
HEADER = f"{BAR}MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
ARRAY = f"""MultiArrayLayout layout\nfloat64[] data{BAR}MSG: std_msgs/MultiArrayLayout
MultiArrayDimension[] dim\nuint32 data_offset{BAR}MSG: std_msgs/MultiArrayDimension
string label\nuint32 size\nuint32 stride
"""
JOINTS = f"std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort{HEADER}"
WRENCH = f"std_msgs/Header header\nfloat64[6] wrench{HEADER}"
POSE = f"std_msgs/Header header\nfloat64[7] pose{HEADER}"
IMU = f"std_msgs/Header header\nfloat64[37] values{HEADER}"
RIG = """format = 1
name = "arm"
[model]
type = "acrobot"
m1 = 0.2
m2 = 0.2
l1 = 0.2
l2 = 0.2
lc1 = 0.1
lc2 = 0.1
I1 = 0.001
I2 = 0.001
g = 9.81
friction = "unknown"
[input]
columns = ["tau1", "tau2"]
joints = [1, 2]
[sampling]
dt = 0.001
input_hold = "zero-order"
clock = "sequence"
[measurement]
columns = ["theta1", "theta2", "dtheta1", "dtheta2"]
[import.columns]
tau1 = "/command:data[0]"
tau2 = "/command:data[1]"
theta1 = "/joint_states:position[joint_1]"
theta2 = "/joint_states:position[joint_2]"
dtheta1 = "/joint_states:velocity[joint_1]"
dtheta2 = "/joint_states:velocity[joint_2]"
"""


class Kind(NamedTuple):
    """A topic: its type, definition, and one message."""

    topic: str
    name: str
    text: str
    message: Any


def kinds() -> list[Kind]:
    """Twelve topics of an arm with seven joints."""
    header = SimpleNamespace(stamp=SimpleNamespace(sec=0, nanosec=0), frame_id="base")
    seven = [0.0] * 7
    joints = SimpleNamespace(
        header=header, name=[f"joint_{i}" for i in range(1, 8)], position=seven, velocity=seven, effort=seven
    )
    command = SimpleNamespace(layout=SimpleNamespace(dim=[], data_offset=0), data=seven)
    return [
        Kind("/joint_states", "sensor_msgs/msg/JointState", JOINTS, joints),
        Kind("/command", "std_msgs/msg/Float64MultiArray", ARRAY, command),
        Kind("/imu", "bench/msg/Imu", IMU, SimpleNamespace(header=header, values=[0.0] * 37)),
        Kind("/wrench", "bench/msg/Wrench", WRENCH, SimpleNamespace(header=header, wrench=[0.0] * 6)),
        Kind("/pose", "bench/msg/Pose", POSE, SimpleNamespace(header=header, pose=seven)),
        *(Kind(f"/drive_{i}/temperature", "std_msgs/msg/Float64", "float64 data\n", SimpleNamespace(data=0.0))
          for i in range(1, 8)),
    ]  # fmt: skip


def write(path: Path, seconds: int, packing: str) -> int:
    """The log; returns its bytes before packing."""
    every, rng, whole = kinds(), np.random.default_rng(0), 0
    template, places, starts, stamps = bytearray(), [], [], []
    for number, kind in enumerate(every, 1):
        data = serialize_dynamic(kind.name, kind.text)[kind.name](kind.message)
        starts.append(len(template))
        template += struct.pack("<BQHIQQ", Opcode.MESSAGE, 22 + len(data), number, 0, 0, 0)
        form = layout(definitions(kind.name, kind.text), kind.name.replace("/msg/", "/"), data)
        for name, run in form.runs.items():
            if run.kind == np.float64:
                places += [len(template) + run.offset + 8 * i for i in range(abs(run.length))]
            if name == "header.stamp.sec":
                stamps.append(len(template) + run.offset)
        template += data
    row, index = np.frombuffer(bytes(template), np.uint8), []
    with path.open("wb") as file:
        file.write(b"\x89MCAP0\r\n")
        record(file, Header("ros2", "benchmark"))
        about = [Schema(i, k.text.encode(), "ros2msg", k.name) for i, k in enumerate(every, 1)]
        channels = [Channel(i, k.topic, "cdr", {}, i) for i, k in enumerate(every, 1)]
        head = b"".join(map(packed, (*about, *channels)))
        for second in range(seconds):
            t = EPOCH + second * 10**9 + np.arange(1000, dtype=np.int64) * 10**6 + rng.integers(0, 10**5, 1000)
            rows = np.tile(row, (1000, 1))
            slow = np.sin(second + 0.001 * np.arange(1000)[:, None] + np.arange(len(places)))
            numbers = rng.standard_normal(slow.shape) * 0.01 + slow
            for i, place in enumerate(places):
                rows[:, place : place + 8] = numbers[:, i : i + 1].copy().view(np.uint8)
            for start in starts:
                rows[:, start + 15 : start + 31] = np.stack([t, t], 1).view(np.uint8)
            for place in stamps:
                rows[:, place : place + 8] = np.stack([t // 10**9, t % 10**9], 1).astype("<u4").view(np.uint8)
            first = head if second == 0 else b""
            index.append(chunk(file, first, rows, starts, t, packing))
            whole += rows.size
        record(file, DataEnd(0))
        summary = file.tell()
        for entry in (*about, *channels):
            record(file, entry)
        counts = {i: 1000 * seconds for i in range(1, len(every) + 1)}
        statistics = Statistics(
            attachment_count=0,
            channel_count=len(every),
            channel_message_counts=counts,
            chunk_count=seconds,
            message_count=1000 * len(every) * seconds,
            message_end_time=EPOCH + seconds * 10**9,
            message_start_time=EPOCH,
            metadata_count=0,
            schema_count=len(every),
        )
        record(file, statistics)
        for entry in index:
            record(file, entry)
        record(file, Footer(summary_start=summary, summary_offset_start=0, summary_crc=0))
        file.write(b"\x89MCAP0\r\n")
    return whole


def chunk(file, first: bytes, rows: np.ndarray, starts: list[int], t: np.ndarray, packing: str) -> ChunkIndex:
    """Write a second of all topics, and where its messages are."""
    import zlib

    import lz4.frame
    import zstandard

    data = first + rows.tobytes()
    crc = zlib.crc32(data)
    done = zstandard.ZstdCompressor(1).compress(data) if packing == "zstd" else lz4.frame.compress(data)
    begin, low, high = file.tell(), int(t[0]), int(t[-1])
    record(file, Chunk(packing, done, high, low, crc, len(data)))
    length, offsets = file.tell() - begin, {}
    for number, start in enumerate(starts, 1):
        offsets[number] = file.tell()
        entries = np.stack([t, len(first) + start + rows.shape[1] * np.arange(len(t))], 1).astype("<i8").tobytes()
        file.write(struct.pack("<BQHI", Opcode.MESSAGE_INDEX, 6 + len(entries), number, len(entries)) + entries)
    return ChunkIndex(length, begin, packing, len(done), high, file.tell() - begin - length, offsets, low, len(data))


def packed(entry: Any) -> bytes:
    builder = RecordBuilder()
    entry.write(builder)
    return builder.end()


def record(file, entry: Any) -> None:
    file.write(packed(entry))


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--seconds", type=int, default=3600)
    arguments.add_argument("--packing", choices=("zstd", "lz4"), default="zstd")
    arguments.add_argument("--folder", type=Path, help="keeps the log there, and takes one that is there")
    args = arguments.parse_args()
    with tempfile.TemporaryDirectory() as spare:
        folder = args.folder or Path(spare)
        log = folder / f"{args.seconds}_{args.packing}.mcap"
        if not log.exists():
            began = time.perf_counter()
            whole = write(log, args.seconds, args.packing)
            print(f"made {log.name} in {time.perf_counter() - began:.0f} s: {whole / 2**30:.1f} GB before packing")
        (Path(spare) / "rig.toml").write_text(RIG)
        command = [sys.executable, "-m", "nnap_em.commands.cli", "import", str(log), "--out", f"{spare}/out"]
        before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        subprocess.run([*command, "--rig", f"{spare}/rig.toml"], check=True)
        size = log.stat().st_size
        wall, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
        rows = sum(path.read_bytes().count(b"\n") - 1 for path in Path(spare).glob("out/t*/*.csv"))
    print(f"{time.strftime('%Y-%m-%d')}, {platform.machine()}, {platform.node()}, Python {platform.python_version()}")
    messages = f"{12 * args.seconds / 1000:.1f} million messages"
    used = f"{wall:.1f} s | {after.ru_utime - before.ru_utime:.1f} s of a core | {after.ru_maxrss / 2**20:.2f} GB"
    print(f"| {args.packing} | {size / 2**30:.1f} GB | {messages} | {rows} rows | {used} |")


if __name__ == "__main__":
    main()
