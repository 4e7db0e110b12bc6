"""Topics with clocks of their own on one grid: closed forms, round trips, gaps; what cannot be is refused."""

import functools
import json
import re

import numpy as np
import pytest
from helpers import nnap, pendulum_rig, read_table
from recorders import JOINTS, MULTI, TOPICS, arrays, joint_states, ns, plain_json, ros2, write_mcap

from nnap_em.logs.importing.signals import Signal, averaged, held, interpolated
from nnap_em.logs.read import read_logs
from nnap_em.machines.rig import read_rig
from nnap_em.machines.systems import specs

DT = 0.01
T = DT * np.arange(300)
RIG = pendulum_rig()
COLUMNS = "\n[import]\n{more}" + TOPICS


def _rig(folder, more: str = "", text: str = RIG, columns: str = COLUMNS):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "rig.toml").write_text(text + columns.replace("{more}", more))
    return folder / "rig.toml"


def _theta(t):
    return np.sin(3 * t)


def _write(path, t, command_t, command, theta=_theta):
    """A JointState topic and a command topic."""
    rate = 3 * np.cos(3 * t) if theta is _theta else 0 * t
    states = joint_states(("joint",), theta(t)[:, None], rate[:, None], stamps=ns(t))
    topics = {
        "/js": (ros2(*JOINTS), ns(t + 0.002), states),
        "/cmd": (ros2(*MULTI), ns(command_t), arrays(command)),
    }
    return write_mcap(path, topics)


_import = functools.partial(nnap, "import")


def _imported(log, rig, test=0, name: str = "out"):
    """The folder that an import writes, beside the log."""
    assert _import(log, "--rig", rig, "--out", log.parent / name, "--test", test) == 0
    return log.parent / name


def _tables(out, part: str = "train") -> list[np.ndarray]:
    return [read_table(path, ("time", "u"), ("theta1", "dtheta1")) for path in sorted((out / part).iterdir())]


def _jittered(rng, end, dt, amount):
    """Times about dt apart that never stand."""
    t = dt * np.arange(round(end / dt))
    return t + amount * dt * rng.uniform(-0.5, 0.5, t.size)


def test_two_clocks_with_jitter_come_to_one_grid(tmp_path):
    """Readings within h^2 / 8 max|f''| of the truth, h the largest interval; inputs exactly what was commanded last."""
    rng = np.random.default_rng(0)
    t, command_t = _jittered(rng, 8.0, 0.004, 0.8), _jittered(rng, 8.0, 0.0131, 0.8)
    command = rng.normal(size=command_t.size)
    log = _write(tmp_path / "a.mcap", t, command_t, command)
    (table,) = _tables(out := _imported(log, _rig(tmp_path)))
    document = json.loads((out / "import.json").read_text())
    start = document["logs"][0]["sequences"][0]["start"] + document["logs"][0]["origin_ns"] * 1e-9 - ns(0) * 1e-9
    at = start + table[:, 0]
    h = np.diff(t).max()
    # 12 digits in the file; the origin of 1.7e9 s is known to 2.4e-7 s, at a rate of 3 rad/s and 9 rad/s^2
    assert np.max(np.abs(table[:, 2] - np.sin(3 * at))) < h**2 / 8 * 9 + 1e-6
    assert np.max(np.abs(table[:, 3] - 3 * np.cos(3 * at))) < h**2 / 8 * 27 + 3e-6
    last = np.searchsorted(command_t, at, side="right") - 1
    sure = np.min(np.abs(at[:, None] - command_t), axis=1) > 2e-5  # a thousandth of a row, rounded
    np.testing.assert_allclose(table[sure, 1], command[last][sure], rtol=1e-11)
    assert sure.mean() > 0.99 and table.shape[0] > 780


def test_the_mean_of_a_held_signal_is_that_of_its_values_on_a_fine_grid():
    rng = np.random.default_rng(1)
    s = Signal("a", np.sort(rng.uniform(0, 1, 40)), rng.normal(size=40))
    rows = np.linspace(s.t[0], s.t[-1] - 0.1, 30)
    parts = (np.arange(10_000) + 0.5) * 1e-5
    at = rows[:, None] + parts
    value = s.y[np.searchsorted(s.t, at, side="right") - 1]
    np.testing.assert_array_equal(held(s, at.ravel(), 0.0), value.ravel())
    # the midpoint rule is wrong by half a part of 1e-4 at each of the 40 knots at most, of up to 5: 40 * 0.5e-4 * 5
    np.testing.assert_allclose(averaged(s, rows, 0.1), value.mean(axis=1), rtol=0, atol=1e-2)


def test_a_reading_is_interpolated_only_between_near_neighbours():
    s = Signal("a", np.array([0.0, 0.01, 0.02, 0.04, 0.05, 0.06]), np.arange(6.0))
    y = interpolated(s, np.array([0.0, 0.005, 0.02, 0.024, 0.03, 0.04, 0.055, 0.06, 0.07]), 0.01)
    np.testing.assert_allclose(
        y, [0, 0.5, 2, 2.2, np.nan, 3, 4.5, 5, np.nan], rtol=1e-12
    )  # a row that was lost is empty


def test_slow_readings_stand_in_their_nearest_rows(tmp_path):
    t, slow = 0.01 * np.arange(1000), 0.04 * np.arange(250) + 0.001
    joints = joint_states(("joint",), None, 3 * np.cos(3 * t)[:, None], stamps=ns(t))
    topics = {
        "/js": (ros2(*JOINTS), ns(t), joints),
        "/camera": (plain_json(), ns(slow), [{"angle": float(x)} for x in _theta(slow)]),
        "/cmd": (ros2(*MULTI), ns(t), arrays(0 * t)),
    }
    log = write_mcap(tmp_path / "a.mcap", topics)
    rig = _rig(tmp_path, columns=COLUMNS.replace("/js:position[joint]", "/camera:angle"))
    theta = _tables(_imported(log, rig))[0][:, 2]
    filled = np.flatnonzero(np.isfinite(theta))
    assert (np.diff(filled) == 4).all() and filled.size > 240
    # straight lines over 0.04 s; taken as they are they would be 0.001 s * 3 rad/s = 0.003 rad off
    assert np.max(np.abs(theta[filled] - _theta(DT * (filled + 1)))) < 0.04**2 / 8 * 9 + 1e-6


GAPS = {  # readings and commands that were lost [s, s), and the sequences that are left [rows]
    "a reading": ((3.0, 3.02), None, [1000]),
    "readings": ((3.0, 3.5), None, [300, 650]),
    "commands": (None, (3.0, 3.5), [300, 650]),
    "a short piece": ((3.0, 3.5), (3.6, 5.0), [300, 500]),
    "a topic stops": (None, (8.0, 99.0), [800]),
}


@pytest.mark.parametrize("readings, commands, rows", GAPS.values(), ids=GAPS)
def test_sequences_are_cut_at_gaps(tmp_path, readings, commands, rows):
    t = DT * np.arange(1000)
    kept, commanded = (t[(t < a - 1e-9) | (t >= b - 1e-9)] for a, b in (x or (99, 99) for x in (readings, commands)))
    log = _write(tmp_path / "a.mcap", kept, commanded, np.cos(commanded))
    tables = _tables(out := _imported(log, _rig(tmp_path, "gap = 0.1")))
    assert [len(table) for table in tables] == pytest.approx(rows, abs=1)  # a gap begins in a row, and ends in one
    document = json.loads((out / "import.json").read_text())["logs"][0]
    for table, s in zip(tables, (s for s in document["sequences"] if s["file"]), strict=True):
        at = table[:, 0] + s["start"]
        at += kept[0] if kept[0] < commanded[0] else commanded[0]
        np.testing.assert_allclose(table[:, 1], np.cos(at), rtol=0, atol=1e-9)
        valid = np.isfinite(table[:, 2])
        np.testing.assert_allclose(table[valid, 2], np.sin(3 * at[valid]), rtol=0, atol=1e-9)
        assert np.sum(~valid) == s["missing"]["theta1"] == (2 if readings == (3.0, 3.02) else 0)
    short = readings == (3.0, 3.5) and commands == (3.6, 5.0)
    assert any("shorter than 50 rows" in s["why"] for s in document["sequences"]) == short
    read_logs(out / "train", read_rig(out / "rig.toml", specs))


def test_a_reading_that_stands_in_several_messages_is_one(tmp_path, capsys):
    """Each stands in 4 messages, between two rows too: nothing is interpolated between a reading and itself."""
    t = DT * np.arange(1000) + 0.003
    log = _write(tmp_path / "a.mcap", t, t, np.cos(t), theta=lambda t: _theta(t[np.arange(t.size) // 4 * 4]))
    theta = _tables(_imported(log, _rig(tmp_path)))[0][:, 2]
    assert "theta1: each reading stands in 4 messages: 750 repeats are left out" in capsys.readouterr().err
    read = np.flatnonzero(np.isfinite(theta))
    assert (np.diff(read) == 4).all() and read.size >= 249
    assert np.max(np.abs(theta[read] - _theta(t[read]))) < 1e-5  # 9 digits of a stamp in the file


def test_two_logs_are_one_data_set_each_on_a_clock_of_its_own_or_on_that_of_the_session(tmp_path):
    """Readings to the last digit but one."""
    columns = {"theta1": _theta(T), "dtheta1": 3 * np.cos(3 * T), "u": np.cos(T)}
    notes = [dict(zip(columns, row, strict=True)) for row in zip(*(y.tolist() for y in columns.values()), strict=True)]
    starts = (0.0, 10.0)
    logs = [write_mcap(tmp_path / f"{s:g}.mcap", {"/state": (plain_json(), ns(T + s), notes)}) for s in starts]
    for clock in ("sequence", "session"):
        out, rig = tmp_path / clock, _rig(tmp_path, text=RIG.replace('"sequence"', f'"{clock}"'), columns="")
        assert _import(*logs, "--rig", rig, "--out", out, "--test", 0) == 0
        for table, start in zip(_tables(out), starts, strict=True):
            np.testing.assert_allclose(table[:, 0], T + start * (clock == "session"), rtol=0, atol=1e-9)
            np.testing.assert_allclose(table[:, 1], columns["u"], rtol=1e-11)  # commands are held, not interpolated
            # readings at stamps that are rounded to ns: 5e-10 s times 9 rad/s^2
            np.testing.assert_allclose(table[:, 2:].T, [columns["theta1"], columns["dtheta1"]], rtol=1e-11, atol=1e-8)
        read_logs(out / "train", read_rig(out / "rig.toml", specs))


def _said(old: str, new: str) -> dict[str, str]:
    return {"columns": COLUMNS.replace(old, new, 1)}


REFUSED = {  # what is wrong with the rig's table, with the log or the words of the command, and words of the message
    "unknown topic": (_said("/cmd:", "/cmmd:"), {}, ["column 'u'", "no topic '/cmmd'", "did you mean '/cmd'"]),
    "unknown field": (_said("data[0]", "dat"), {}, ["column 'u'", "no field 'dat'", "data[0]"]),
    "not declared": ({"columns": ""}, {}, ["column 'u': nothing is called so", "[import.columns] u =", "/cmd:data[0]"]),
    "gap": ({"more": "gap = -1"}, {}, ["[import] gap", "seconds above 0"]),
    "no overlap": ({}, {"command_t": T + 100}, ["columns 'theta1' and 'u'", "no time in common", "--shift /cmd="]),
    "all NaN": (
        {},
        {"command": np.full_like(T, np.nan)},
        ["column 'u'", "0 numbers in 300 messages", "[import.columns]"],
    ),
    "dt too fine": ({"text": RIG.replace("0.01\ninput", "0.001\ninput")}, {}, ["is much finer", "write dt = 0.01"]),
    "unknown shift": ({}, {"words": ("--shift", "/jss=1")}, ["--shift /jss: no topic of that name", "mean '/js'?"]),
    "too short": ({"more": "shortest = 100"}, {}, ["has 300 rows", "a sequence needs 10000"]),
}


@pytest.mark.parametrize("rig, log, words", REFUSED.values(), ids=REFUSED)
def test_what_cannot_be_imported_is_refused_and_nothing_is_written(tmp_path, capsys, rig, log, words):
    log = {"t": T, "command_t": T, "command": np.cos(T), "words": ()} | log
    options = log.pop("words")
    path = _write(tmp_path / "a.mcap", **log)
    assert _import(path, "--rig", _rig(tmp_path, **rig), "--out", tmp_path / "out", *options) == 2
    said = capsys.readouterr().err.strip().split("\n")[-1]
    assert any(str(tmp_path / name) in said for name in ("a.mcap", "rig.toml")) and ";" in said
    for word in words:
        assert word in said
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.mcap", "rig.toml"]


def test_a_name_that_stands_twice_and_a_folder_that_is_not_empty_are_refused(tmp_path, capsys):
    notes = [{"u": 0.1, "theta1": float(x), "dtheta1": 0.0} for x in _theta(T)]
    twice = write_mcap(tmp_path / "b.mcap", {name: (plain_json(), ns(T), notes) for name in ("/one", "/two")})
    log, out = _write(tmp_path / "a.mcap", T, T, np.cos(T)), tmp_path / "out"
    out.mkdir()
    (out / "mine.txt").write_text("mine")
    for path, to, columns, said in (
        (twice, "new", "", "column 'u': may be '/one:u' and '/two:u'; write [import.columns] u"),
        (log, "out", COLUMNS, "out: is there already; give a new folder, or empty this one"),
        (log, "new", COLUMNS, "the logs give 1 sequence, and one is needed to train on"),
    ):
        assert _import(path, "--rig", _rig(tmp_path, columns=columns), "--out", tmp_path / to, "--test", 1) == 2
        assert said in capsys.readouterr().err
    assert [p.name for p in out.iterdir()] == ["mine.txt"] and not (tmp_path / "new").exists()


EQUATIONS = """format = 1
name = "lag"
[model]
type = "equations"
inputs = ["u"]
states = ["x"]
rates = { x = "u - x" }
units = { time = "days" }
[sampling]
dt = 1
input_hold = "zero-order"
clock = "sequence"
[measurement]
columns = ["x"]
"""


def test_rare_readings_beside_an_input_in_every_row_are_imported_in_days(tmp_path, capsys):
    """A reading every tenth day, and rows that end 80 days before the last ones: these are said to be left out."""
    days = np.append(np.arange(200), np.arange(280, 300))
    rows = [f"{k},{k % 7},{k if k % 10 == 0 else ''}" for k in days]
    (tmp_path / "log.csv").write_text("\n".join(["time (days),u,x", *rows]))
    rig = _rig(tmp_path, text=EQUATIONS, columns="")
    table = read_table(next((_imported(tmp_path / "log.csv", rig) / "train").iterdir()), ("time", "u"), ("x",))
    np.testing.assert_array_equal(table[:, 0], np.arange(len(table)))
    np.testing.assert_array_equal(table[:, 1], np.arange(len(table)) % 7)
    np.testing.assert_array_equal(table[:, 2], np.where(np.arange(len(table)) % 10, np.nan, np.arange(len(table))))
    assert re.search(r"of 2\d\d rows are left out, in 1 piece .*shortest = SECONDS keeps", capsys.readouterr().err)
