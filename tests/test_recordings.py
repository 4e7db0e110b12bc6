"""Files of recorders: every encoding and layout gives the numbers that were written; what is broken is refused."""

import struct
import sys
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.writer import CompressionType, IndexType
from recorders import EPOCH, JOINTS, MULTI, NS, arrays, joint_states, ns, plain_json, ros2, write_hdf5, write_mcap
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_typestore

from nnap_em.errors import DataError
from nnap_em.logs.importing.files import reader

T = 0.01 * np.arange(300)
Q = np.stack([np.sin(T), np.cos(2 * T)], axis=1)
U = np.cos(3 * T)


def _read(path, **wanted):
    """Tracks by topic without its slash."""
    return reader(path).read(path, {f"/{topic}": paths for topic, paths in wanted.items()}).tracks


def _log(path, **options):
    joints = joint_states(("shoulder", "elbow"), Q, 2 * Q, stamps=ns(T - 0.003))
    topics = {
        "/js": (ros2(*JOINTS), ns(T), joints),
        "/cmd": (ros2(*MULTI), ns(T + 0.001), arrays(U)),
        "/rest": (ros2("std_msgs/msg/Float64", "float64 data\n"), ns(T), (SimpleNamespace(data=1.0) for _ in T)),
    }
    return write_mcap(path, topics, **options)


WHOLE = ("repeat_channels", "repeat_schemas", "use_statistics", "use_summary_offsets")
LAYOUTS = {
    "zstd": {},
    "no index, no summary": dict.fromkeys(WHOLE, False) | {"index_types": IndexType.NONE},
    "channels once": {"repeat_channels": False},
}


@pytest.mark.parametrize("options", LAYOUTS.values(), ids=LAYOUTS)
def test_every_layout_of_a_file_gives_what_was_written(tmp_path, options):
    path = _log(tmp_path / "a.mcap", **options)
    topics = {topic.name: topic for topic in reader(path).topics(path)}
    joints = [f"{word}[{joint}]" for word in ("position", "velocity") for joint in ("shoulder", "elbow")]
    assert topics["/js"].fields[2:] == tuple(joints)
    assert topics["/cmd"].fields == ("layout.data_offset", "data[0]")
    assert topics["/js"].messages in (300, None)
    tracks = _read(path, js=("position[elbow]", "velocity[shoulder]"), cmd=("data[0]",))
    np.testing.assert_array_equal(tracks["/js"].values["position[elbow]"], Q[:, 1])
    np.testing.assert_array_equal(tracks["/js"].values["velocity[shoulder]"], 2 * Q[:, 0])
    np.testing.assert_array_equal(tracks["/cmd"].values["data[0]"], U)
    np.testing.assert_array_equal(tracks["/js"].t, ns(T - 0.003))
    np.testing.assert_array_equal(tracks["/cmd"].t, ns(T + 0.001))
    assert (tracks["/js"].clock, tracks["/cmd"].clock) == ("header stamp", "log time")


def test_messages_of_many_forms_on_one_topic_are_read_by_the_names_in_each(tmp_path):
    """Frames of other lengths, joints in another order, a joint that is missing, and a list that is empty."""
    two = ("a", "b")  # names of joints in messages of a frame
    forms = [("base", two), ("a longer frame", two), ("base", ("b", "a")), ("", ("a",)), ("x", ("c", "a"))]
    rng = np.random.default_rng(0)
    messages = []
    for k in rng.integers(len(forms), size=200):
        frame, names = forms[k]
        y = rng.normal(size=(1, len(names)))
        messages += joint_states(names, y, None if k == 1 else 2 * y, frame=frame)
    path = write_mcap(tmp_path / "a.mcap", {"/js": (ros2(*JOINTS), ns(0.01 * np.arange(200)), messages)})
    values = _read(path, js=("position[a]", "velocity[b]", "position[1]", "header.stamp.sec"))["/js"].values
    at = lambda row, i: row[i] if i is not None and i < len(row) else np.nan  # noqa: E731
    place = lambda m, name: m.name.index(name) if name in m.name else None  # noqa: E731
    np.testing.assert_array_equal(values["position[a]"], [at(m.position, place(m, "a")) for m in messages])
    np.testing.assert_array_equal(values["velocity[b]"], [at(m.velocity, place(m, "b")) for m in messages])
    np.testing.assert_array_equal(values["position[1]"], [at(m.position, 1) for m in messages])
    assert np.isnan(values["velocity[b]"]).any() and np.isfinite(values["position[a]"]).all()
    assert not values["header.stamp.sec"].any()


def _ros_bag(path, version):
    """Joint states with a stamp, in the bag that the library of bags writes."""
    store = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_HUMBLE)
    kind = "sensor_msgs/msg/JointState"
    time, header, joints = (store.types[name] for name in ("builtin_interfaces/msg/Time", "std_msgs/msg/Header", kind))
    order = {"seq": 0} if version == 1 else {}
    with rosbag1.Writer(path) if version == 1 else rosbag2.Writer(path, version=8) as bag:
        connection = bag.add_connection("/js", kind, typestore=store)
        encode = store.serialize_ros1 if version == 1 else store.serialize_cdr
        for t, q in zip(ns(T), Q, strict=True):
            stamp = time(sec=int(t - 3_000_000) // NS, nanosec=int(t - 3_000_000) % NS)
            none = np.zeros(0)
            message = joints(header(stamp=stamp, frame_id="base", **order), ["shoulder", "elbow"], q, none, none)
            bag.write(connection, int(t), encode(message, kind))
    return path if version == 1 else next(path.glob("*.db3"))


@pytest.mark.parametrize("version, name", [(1, "a.bag"), (2, "run")])
def test_bags_of_ros_1_and_2_are_read(tmp_path, version, name):
    path = _ros_bag(tmp_path / name, version)
    (topic,) = reader(path).topics(path)
    assert (topic.name, topic.messages) == ("/js", 300) and "position[elbow]" in topic.fields
    track = _read(path, js=("position[elbow]",))["/js"]
    np.testing.assert_array_equal(track.values["position[elbow]"], Q[:, 1])
    np.testing.assert_array_equal(track.t, ns(T) - 3_000_000)
    assert track.clock == "header stamp"


def _protobuf():
    """A message with a number, a list and a stamp."""
    file = descriptor_pb2.FileDescriptorProto(name="m.proto", package="robot", syntax="proto3")
    stamp = file.message_type.add(name="Stamp")
    for i, (name, kind) in enumerate((("seconds", 3), ("nanos", 5)), 1):
        stamp.field.add(name=name, number=i, type=kind, label=1)
    state = file.message_type.add(name="State")
    state.field.add(name="timestamp", number=1, type=11, label=1, type_name=".robot.Stamp")
    state.field.add(name="q", number=2, type=1, label=3)
    state.field.add(name="u", number=3, type=2, label=1)
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    made = message_factory.GetMessageClass(pool.FindMessageTypeByName("robot.State"))
    text = descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString()
    return made, ("robot.State", "protobuf", text, "protobuf", lambda message: message.SerializeToString())


def test_protobuf_and_json(tmp_path):
    made, schema = _protobuf()
    stamps = ns(T - 0.002)
    states = [made(timestamp={"seconds": int(s) // NS, "nanos": int(s) % NS}, q=q.tolist(), u=0.5)
              for s, q in zip(stamps, Q, strict=True)]  # fmt: skip
    notes = [{"joint": {"names": ["a", "b"], "q": q.tolist()}, "on": True, "text": "x"} for q in Q]
    path = write_mcap(tmp_path / "a.mcap", {"/state": (schema, ns(T), states), "/json": (plain_json(), ns(T), notes)})
    fields = {topic.name: topic.fields for topic in reader(path).topics(path)}
    assert fields["/state"] == ("timestamp.seconds", "timestamp.nanos", "q[0]", "q[1]", "u")
    assert fields["/json"] == ("joint.q[a]", "joint.q[b]", "on")
    tracks = _read(path, state=("q[1]", "u"), json=("joint.q[a]", "on"))
    np.testing.assert_array_equal(tracks["/state"].values["q[1]"], Q[:, 1])
    np.testing.assert_array_equal(tracks["/state"].t, stamps)
    np.testing.assert_array_equal(tracks["/json"].values["joint.q[a]"], Q[:, 0])
    assert tracks["/state"].values["u"][0] == 0.5 and tracks["/json"].values["on"][0] == 1.0


AXES = {  # how a group says its times, and the unit
    "name": ("time", lambda t: t, {}),
    "whole ns": ("stamps", lambda t: np.round(t * 1e9).astype(np.int64) + EPOCH, {"axis": "time"}),
    "us by attribute": ("clock", lambda t: 1e6 * t, {"units": "us"}),
}


@pytest.mark.parametrize("name, made, attributes", AXES.values(), ids=AXES)
def test_hdf5_finds_its_time_axis(tmp_path, name, made, attributes):
    path = write_hdf5(tmp_path / "a.h5", {"arm/state": {name: made(T), "q": Q, "u": U, "gains": np.ones(7)}})
    with h5py.File(path, "a") as file:
        file[f"arm/state/{name}"].attrs.update(attributes)
    (topic,) = (t for t in reader(path).topics(path) if "q[0]" in t.fields)
    assert (topic.name, topic.fields, topic.messages) == ("/arm/state", ("q[0]", "q[1]", "u"), 300)
    with h5py.File(path, "a") as file:  # a group without times has those of the group above it
        file["arm/state/motor/v"] = Q[:, 0]
    assert _read(path, **{"arm/state/motor": ("v",)})["/arm/state/motor"].t.size == T.size
    track = _read(path, **{"arm/state": ("q[1]", "u")})["/arm/state"]
    np.testing.assert_array_equal(track.values["q[1]"], Q[:, 1])
    np.testing.assert_allclose((track.t - track.t[0]) * 1e-9, T, rtol=0, atol=2e-9)  # ns, rounded twice


CLOCKS = {  # header stamps, the clock that is taken, and what is said
    "there": (ns(T - 0.01), "header stamp", ""),
    "all 0": (0 * ns(T), "log time", "header stamps are all 0"),
    "backwards": (ns(T) - 3 * (np.arange(300) == 50) * 10**7, "log time", "run backwards (1 times)"),
    "twice": (ns(np.round(T, 1)), "header stamp", "messages with the time of the next one"),
}


@pytest.mark.parametrize("stamps, clock, note", CLOCKS.values(), ids=CLOCKS)
def test_which_clock_is_taken_and_why(tmp_path, stamps, clock, note):
    joints = ros2(*JOINTS), ns(T), joint_states(("a",), Q[:, :1], stamps=stamps)
    track = _read(write_mcap(tmp_path / "a.mcap", {"/js": joints}), js=("position[a]",))["/js"]
    assert track.clock == clock and note in "".join(track.notes)
    assert (np.diff(track.t) > 0).all() and bool(track.notes) == bool(note)


def test_what_is_whole_of_a_cut_file_is_read_and_told(tmp_path):
    """Its end was lost in the middle of a chunk."""
    path = _log(tmp_path / "a.mcap")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    assert {topic.name for topic in reader(path).topics(path)} == {"/js", "/cmd", "/rest"}
    content = reader(path).read(path, {"/cmd": ("data[0]",)})
    values = content.tracks["/cmd"].values["data[0]"]
    assert 50 < values.size < 300
    np.testing.assert_array_equal(values, U[: values.size])
    assert "the file is cut short" in content.notes[0] and "what is whole was read" in content.notes[0]


def _flipped(path):
    _log(path, compression=CompressionType.NONE)
    content = bytearray(path.read_bytes())
    place = content.index(struct.pack("<d", Q[7, 1]))
    content[place] ^= 1
    path.write_bytes(content)
    return path


BAD = {  # the file, what writes it, and words of the message
    "no MCAP file": ("a.mcap", lambda p: p.write_text("hello, world"), "no MCAP file"),
    "a changed bit": ("a.mcap", _flipped, "damaged (crc validation failed | another copy"),
    "unknown encoding": ("a.mcap", lambda p: write_mcap(p, {"/js": (
        ("robot.State", "bfbs", b"...", "flatbuffer", lambda m: m), ns(T), [b"1234"] * 300)}),
        "'/js' | in 'flatbuffer' | are not read | JSON or protobuf"),
    "no JSON": ("a.mcap", lambda p: write_mcap(p, {"/js": ((*plain_json()[:4], lambda m: m), ns(T),
        [b'{"q": 1'] * 300)}),
        "'/js' | does not fit its schema (Expecting | write it as"),
    "HDF5 without times": ("a.h5", lambda p: write_hdf5(p, {"js": {"time": np.where(T[5] == T, np.nan, T), "q": T}}),
        "'/js/time' | no numbers | cut the rows"),
    "no time axis": ("a.h5", lambda p: write_hdf5(p, {"js": {"q": T}}), "'/js' | no time axis (holds q) | `time`"),
    "another kind": ("a.dat", lambda p: p.write_text("x"), "logs end in .mcap, .db3, .bag, .h5 | rename"),
}  # fmt: skip


@pytest.mark.parametrize("name, make, words", BAD.values(), ids=BAD)
def test_what_cannot_be_read_is_refused_with_its_mend(tmp_path, name, make, words):
    path = tmp_path / name
    make(path)
    with pytest.raises(DataError) as refused:
        source = reader(path)
        source.topics(path)
        source.read(path, {"" if name.endswith("csv") else "/js": ("q",)})
    for word in (str(path), *words.split(" | ")):
        assert word in str(refused.value)
    assert ";" in str(refused.value)


@pytest.mark.parametrize("module, name", [("mcap", "a.mcap"), ("rosbags", "a.bag"), ("h5py", "a.h5")])
def test_without_the_extra_the_message_names_it(tmp_path, monkeypatch, module, name):
    (tmp_path / name).write_bytes(b"any")
    for each in [m for m in sys.modules if m.startswith(f"{module}.")] + [module]:
        monkeypatch.setitem(sys.modules, each, None)
    with pytest.raises(DataError, match=r"cannot be read without .*; pip install \"nnap-em\[logs\]\""):
        reader(tmp_path / name).topics(tmp_path / name)
