"""Logs as machines write them, made by the writers of their formats."""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
from mcap.writer import CompressionType, Writer
from mcap_ros2._dynamic import serialize_dynamic

from nnap_em.logs.importing.columns import read_plan
from nnap_em.logs.importing.resample import Resampled, resample
from nnap_em.machines.rig import read_rig
from nnap_em.machines.systems import specs

NS = 1_000_000_000
EPOCH = 1_700_000_000 * NS
"""Where the clocks of these logs begin [ns]."""
T = 0.004 * np.arange(2000)
Q = np.stack([np.sin(T), np.cos(2 * T)], axis=1)
V = np.stack([np.cos(T), -2 * np.sin(2 * T)], axis=1)
"""Times, angles and rates of a robot of two joints, hip and knee."""
TOPICS = """
[import.columns]
theta1 = "/js:position[joint]"
dtheta1 = "/js:velocity[joint]"
u = "/cmd:data[0]"
"""
"""Columns of a pendulum in a topic of joint states and one of commands."""
JOINT_STATE = """\
std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
ARRAY = """\
MultiArrayLayout layout
float64[] data
================================================================================
MSG: std_msgs/MultiArrayLayout
MultiArrayDimension[] dim
uint32 data_offset
================================================================================
MSG: std_msgs/MultiArrayDimension
string label
uint32 size
uint32 stride
"""


def ns(t) -> np.ndarray:
    """Seconds as the stamps of these logs."""
    return EPOCH + np.round(np.asarray(t) * NS).astype(np.int64)


def joint_states(names: Sequence[str], position=None, velocity=None, effort=None, stamps=None, frame: str = "base"):
    """Messages of a JointState topic; arrays [message, joint]."""

    def row(values, k):
        return [] if values is None else np.atleast_1d(values[k]).tolist()

    first = next(values for values in (position, velocity, effort) if values is not None)
    for k in range(len(first)):
        stamp = 0 if stamps is None else int(stamps[k])
        header = SimpleNamespace(stamp=SimpleNamespace(sec=stamp // NS, nanosec=stamp % NS), frame_id=frame)
        yield SimpleNamespace(header=header, name=list(names), position=row(position, k), velocity=row(velocity, k),
                              effort=row(effort, k))  # fmt: skip


def arrays(values):
    """Messages of a Float64MultiArray topic."""
    layout = SimpleNamespace(dim=[], data_offset=0)
    return (SimpleNamespace(layout=layout, data=np.atleast_1d(row).tolist()) for row in values)


def ros2(kind: str, text: str) -> tuple[str, str, bytes, str, Callable[[Any], bytes]]:
    """Type, encoding of the schema, schema, encoding of the messages, and their encoder."""
    return kind, "ros2msg", text.encode(), "cdr", serialize_dynamic(kind, text)[kind]


def plain_json() -> tuple[str, str, bytes, str, Callable[[Any], bytes]]:
    return "log", "jsonschema", b"{}", "json", lambda message: json.dumps(message).encode()


JOINTS = ("sensor_msgs/msg/JointState", JOINT_STATE)
MULTI = ("std_msgs/msg/Float64MultiArray", ARRAY)


def write_mcap(
    path: Path, topics: Mapping[str, tuple], compression=CompressionType.ZSTD, chunk_size: int = 10_000, **options
) -> Path:
    """Topics of (schema, log times [ns], messages), in the order of their times."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:
        writer = Writer(file, compression=compression, chunk_size=chunk_size, **options)
        writer.start()
        every = []
        for topic, (schema, times, messages) in topics.items():
            name, form, text, encoding, encode = schema
            number = writer.register_channel(topic, encoding, writer.register_schema(name, form, text))
            every += [(int(t), number, encode(m)) for t, m in zip(times, messages, strict=True)]
        for t, number, data in sorted(every, key=lambda entry: entry[0]):
            writer.add_message(number, t, data, t)
        writer.finish()
    return path


def imported(log: Path, rig_file: Path, shifts: Mapping[str, float] | None = None) -> Resampled:
    """A log on the grid of a rig."""
    rig = read_rig(rig_file, specs)
    return resample(log, rig, read_plan(rig_file, (*rig.logged_inputs, *rig.measured)), shifts or {})


def write_hdf5(path: Path, groups: Mapping[str, Mapping[str, Any]]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        for name, columns in groups.items():
            group = file.require_group(name)
            for column, values in columns.items():
                group[column] = values
    return path


def robot_log(path: Path, command: str | None, joints: Sequence[str] = ("hip", "knee")) -> Path:
    """A robot's log with its joints in this order, each other name an axis that moves as the hip."""
    rng, turn = np.random.default_rng(0), [int(joint == "knee") for joint in joints]
    noisy = Q[:, turn] + 1e-3 * rng.normal(size=(len(T), len(turn)))
    topics = {"/joint_states": (ros2(*JOINTS), ns(T), joint_states(joints, noisy, V[:, turn], 7 * Q[:, turn], ns(T)))}
    topics |= {command: (ros2(*MULTI), ns(T), arrays(np.stack([T, -T], 1)))} if command else {}
    return write_mcap(path, topics)
