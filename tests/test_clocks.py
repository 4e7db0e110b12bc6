"""Clocks of logs: wrong stamps, units, two clocks of one log, silences; all compared with what was written."""

import tracemalloc
from datetime import UTC, datetime

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from helpers import pendulum_rig, read_table
from recorders import EPOCH, JOINTS, MULTI, NS, TOPICS, arrays, imported, joint_states, ns, ros2, write_hdf5, write_mcap

from nnap_em.errors import DataError
from nnap_em.logs import dates
from nnap_em.logs.importing import clock
from nnap_em.logs.importing.resample import Resampled
from nnap_em.logs.importing.signals import Signal, sent_on_change

DT = 0.01
RIG = pendulum_rig() + "[import]\n"
ARM = RIG.replace('["u"]', '["u", "v"]').replace("[1]", "[1, 2]").replace("pendulum", "acrobot")
ARM = ARM.replace("m = 0.5\nlc = 0.2\nI = 0.002", "m1 = 1\nm2 = 1\nl1 = 1\nl2 = 1\nlc1 = 1\nlc2 = 1\nI1 = 1\nI2 = 1")
T = DT * np.arange(1000)
DAY = 86400.0


def _columns(t):
    return {"u": np.cos(t), "theta1": np.sin(3 * t), "dtheta1": 3 * np.cos(3 * t)}


def _csv(path, time, columns, name: str = "time"):
    """A CSV file of texts or numbers, with nothing where a number is NaN."""
    rows = zip(time, *(values.tolist() for values in columns.values()), strict=True)
    texts = [",".join(str(x) if x == x else "" for x in row) for row in rows]
    path.write_text("\n".join([",".join([name, *columns]), *texts]) + "\n")
    return path


def _mcap(path, log, stamps, command_t, command):
    joints = joint_states(("joint",), np.sin(3 * T)[:, None], 3 * np.cos(3 * T)[:, None], stamps=stamps)
    return write_mcap(
        path, {"/js": (ros2(*JOINTS), log, joints), "/cmd": (ros2(*MULTI), ns(command_t), arrays(command))}
    )


def _import(path, more: str = "", shifts=None, rig: str = RIG) -> Resampled:
    rig_file = path.with_name("rig.toml")
    rig_file.write_text(rig + more + (TOPICS if path.suffix == ".mcap" else ""))
    return imported(path, rig_file, shifts)


def _notes(log: Resampled) -> str:
    return "; ".join((*log.notes, *(note for topic in log.topics for note in topic.notes)))


def _rows(log: Resampled) -> list[int]:
    return [stretch.rows for stretch in log.sequences if not stretch.why]


def _changed(rows, values):
    t = 1.7e9 + T
    t[rows] = values
    return t


WRONG = {  # stamps [s], the rows that are left out, and the sequences
    "zeros before the clock was set": (_changed(slice(10), 0.0), range(10), [990]),
    "one stamp of 2106": (_changed(500, 2.0**32), [500], [1000]),
    "a pause of three days": (1.7e9 + T + 3 * DAY * (T >= 5), [], [500, 500]),
    "a clock set after 3 s": (1.7e9 * (T >= 3) + T, [], [300, 700]),
}


@pytest.mark.parametrize("t, dropped, rows", WRONG.values(), ids=WRONG)
def test_stamps_of_another_clock_are_left_out_and_memory_follows_the_samples(tmp_path, t, dropped, rows):
    path = _csv(tmp_path / "a.csv", t, _columns(T))
    tracemalloc.start()
    log = _import(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert _rows(log) == rows and peak < 2e7  # 1000 rows of 4 numbers are 32 kB, the text and its lists the rest
    assert (f"{len(dropped)} row" in _notes(log)) == bool(dropped)
    kept = np.delete(_columns(T)["u"], list(dropped))
    if len(rows) == 1 and rows[0] == kept.size:
        np.testing.assert_array_equal(log.values[0]["u"], kept)


EDGES = {  # times [s] and the number that is used
    "50 times of 1000": (np.r_[T[:950], T[950:] + 2 * DAY], 950),
    "51": (np.r_[T[:949], T[949:] + 2 * DAY], 1000),
    "a late one": (np.r_[T[:1], T[1:] + 1.1 * DAY], 999),
}


@pytest.mark.parametrize("t, count", EDGES.values(), ids=EDGES)
def test_which_times_are_of_one_clock(t, count):
    assert clock.trusted(np.round(t * NS).astype(np.int64)).size == count


BACK = {  # times [s], and the row that is refused
    "0.9 s back": (T - 0.9045 * (T > 9.955), None),
    "1.1 s back": (T - 1.1 * (T > 9.955), 997),
    "a wild one before": (T - 2 * (T > 5) + 3 * DAY * (np.arange(1000) == 300), 502),
}


@pytest.mark.parametrize("t, row", BACK.values(), ids=BACK)
def test_a_clock_that_goes_back_is_refused_at_its_row(tmp_path, t, row):
    t = np.round(t * NS).astype(np.int64)
    if row is None:
        assert clock.rising(tmp_path, "times", t, {}, "time").t.size == t.size
    else:
        with pytest.raises(DataError, match=f"backwards at row {row},"):
            clock.rising(tmp_path, "times", t, {}, "time")


def test_small_steps_back_in_a_table_are_sorted(tmp_path):
    t = T.copy()
    t[[400, 401]] = t[[401, 400]]
    columns = {name: values[np.argsort(np.argsort(t))] for name, values in _columns(T).items()}
    log = _import(_csv(tmp_path / "a.csv", t, columns))
    assert "1 row out of order by up to 0.01 s: sorted" in _notes(log)
    np.testing.assert_array_equal(log.values[0]["u"], _columns(T)["u"])


def test_rows_of_one_stamp_keep_all_their_columns(tmp_path):
    """One row a message: commands in some rows, readings in those that follow, at the same milliseconds."""
    columns = {name: np.full(2 * T.size, np.nan) for name in ("u", "theta1", "dtheta1")}
    for name, values in _columns(T).items():
        columns[name][0 if name == "u" else 1 :: 2] = values
    log = _import(_csv(tmp_path / "a.csv", np.repeat(T, 2), columns))
    for name, values in _columns(T).items():
        np.testing.assert_allclose(log.values[0][name], values, rtol=0, atol=1e-9)  # times are in ns, at 9 rad/s^2
    times = np.array([0, 0, 1, 1, 1, 2])
    track = clock.rising(tmp_path, "times", times, {"u": np.array([1.0, np.nan, np.nan, 2.0, 3.0, np.nan])}, "time")
    np.testing.assert_array_equal(track.values["u"], [1.0, 3.0, np.nan])  # the last of each, if there is one


SIZES = {  # numbers, the unit by the name, and ns of the first or words of the refusal
    "seconds": (1.5, "", 1_500_000_000),
    "ms as named": (1.5, "ms", 1_500_000),
    "ns of a day and more": (1.1e14, "", 110_000 * NS),
    "us or ns": (9e13, "", "look like times in us or ns; name it time_us or time_ns"),
    "ms, named s": (1.7e12, "s", "too large for s: they look like times in ms; name it time_ms"),
}


@pytest.mark.parametrize("number, unit, there", SIZES.values(), ids=SIZES)
def test_times_are_of_the_unit_that_their_name_or_size_shows(tmp_path, number, unit, there):
    for dtype in (float, int) if number > 2 else (float,):
        t = np.array([number, number, number]).astype(dtype)
        if isinstance(there, int):
            assert clock.nanoseconds(tmp_path, "times", t, unit)[0] == there
        else:
            with pytest.raises(DataError, match=there):
                clock.nanoseconds(tmp_path, "times", t, unit)


DATES = {
    "2023-11-14T22:13:20.005": 1_700_000_000.005,
    "2023-11-14T22:13:20.005Z": 1_700_000_000.005,
    "2023-11-14 23:13:20,005+01:00": 1_700_000_000.005,
    "2023/11/14 22:13:20": 1_700_000_000.0,
    "20231114T221320Z": 1_700_000_000.0,
    "14.11.2023 22:13:20": 1_700_000_000.0,
    "11/14/2023 10:13:20 PM": 1_700_000_000.0,
    "14-Nov-2023 12:00:00 AM": 1_699_920_000.0,
    "2023-11-14": 1_699_920_000.0,
    "22:13:20,5": 80_000.5,
    "2023-13-14": np.inf,
    "13:20.5": np.inf,
}


def test_dates_and_times_of_day_are_seconds():
    for text, moment in DATES.items():  # a step of 64 bits since 1970 is 2.4e-7 s
        assert dates.moments([text])[0] == pytest.approx(moment, abs=1e-6), text


TEXTS = [datetime.fromtimestamp(s, UTC).isoformat() for s in (ns(T) * 1e-9).tolist()]
TIMES = {  # suffix, and times as dates
    "texts": ("parquet", TEXTS), "h5": ("h5", TEXTS),
    "dates": ("parquet", pa.array(ns(T), pa.timestamp("ns"))),
    "durations": ("parquet", pa.array(ns(T) - EPOCH, pa.duration("ns"))),
}  # fmt: skip


@pytest.mark.parametrize("suffix, times", TIMES.values(), ids=TIMES)
def test_times_as_dates_give_the_rows_of_times_in_seconds(tmp_path, suffix, times):
    path, columns = tmp_path / f"a.{suffix}", {"time": times} | _columns(T)
    if suffix == "h5":
        write_hdf5(path, {"arm": columns | {"time": np.array(times, "S")}})
    else:
        pq.write_table(pa.table(columns), path)
    log = _import(path)
    np.testing.assert_allclose(log.values[0]["u"], np.cos(T), rtol=1e-12)
    np.testing.assert_allclose(log.values[0]["theta1"], np.sin(3 * T), atol=3 * 1e-6)  # 3 rad/s, dates are in us


def test_fields_are_named_by_their_lines(tmp_path):
    path = _csv(tmp_path / "a.csv", np.round(T, 6), _columns(T))
    np.testing.assert_array_equal(read_table(path, ("time",), ("theta1", "u"))[:, 2], _columns(T)["u"])
    lines = path.read_text().split("\n")
    words = {"1,2,3": "line 701: found 3 fields", "1,2,x,3": "line 701, column 'theta1'", "": "line 701: found 1 field",
             "noon,2,1,3": "line 701, column 'time': found 'noon'"}  # fmt: skip
    for text, said in words.items():
        path.write_text("\n".join([*lines[:700], text, *lines[701:]]))
        with pytest.raises(DataError, match=said):
            read_table(path, ("time",), ("theta1", "u"))


OFFSETS = {  # of the header stamps from log times [s], and what the page has about it
    "a latency": (-0.005, ""),
    "a latency of more than a row": (-0.012, "/js are 0.012 s behind the log times, not those of others"),
    "ahead": (0.02, "--shift /js=-0.02 takes it out"),
    "another clock": (-0.26, "of another clock, 0.26 s from that of the log"),
    "a clock that was set": (5 * (T > 5), "of another clock, 5 s"),
    "since boot": (-1.6e9, "of another clock, 1.6e+09 s from that of the log"),
}


@pytest.mark.parametrize("offset, note", OFFSETS.values(), ids=OFFSETS)
def test_stamps_of_another_clock_are_not_taken_and_late_ones_reported(tmp_path, offset, note):
    """Messages at the same log times; the command is that of its row where all topics are at these."""
    path = _mcap(tmp_path / "a.mcap", ns(T), ns(T + offset), T, np.cos(T))
    log = _import(path)
    assert note in _notes(log) and bool(note) == bool(_notes(log))
    if "another clock" in note:
        assert _rows(log) == [1000]
        np.testing.assert_allclose(log.values[0]["u"], np.cos(T), rtol=1e-12)
        np.testing.assert_allclose(log.values[0]["theta1"], np.sin(3 * T), atol=3e-6)  # 3 rad/s, to 1 us
    elif note:
        assert not _notes(_import(path, shifts={"/js": -offset}))


def test_commands_on_change_hold_to_the_end(tmp_path):
    for more, sent in (("gap = 0.1", {200: 0.4, 230: -0.3, 700: 0.2}), ('input = "mean"', {200: 0.4, 230: -0.3}),
                       ("", {200: 0.4})):  # one command is enough  # fmt: skip
        u = np.full(T.size, np.nan)
        u[[*sent]] = [*sent.values()]
        log = _import(_csv(tmp_path / "a.csv", T, _columns(T) | {"u": u}), more)
        assert _rows(log) == [800] and f"u is sent on change ({len(sent)} value" in _notes(log)
        expected = np.repeat([*sent.values()], np.diff([*sent, T.size]))
        np.testing.assert_allclose(log.values[0]["u"], expected, atol=1e-6)


def test_commands_that_end_are_reported_and_held_as_declared(tmp_path):
    kept, columns = T < 6, _columns(T) | {"u": np.where(T < 6, np.cos(T), np.nan)}
    path = _csv(tmp_path / "a.csv", T, columns)
    log = _import(path)
    assert _rows(log) == [600] and "u ends 4 s before the readings" in _notes(log) and "gap = inf" in _notes(log)
    log = _import(path, "gap = inf")
    assert _rows(log) == [1000]
    np.testing.assert_array_equal(log.values[0]["u"][600:], np.cos(T[kept][-1]))


@pytest.mark.parametrize("interval, count, dt, on_change", [
    (DT, 10, DT, True), (DT, 11, DT, False), (0.5, 40, DT, True), (0.49, 40, DT, False), (15.0, 240, 15.0, False),
])  # fmt: skip
def test_a_few_commands_or_set_points_are_sent_on_change(interval, count, dt, on_change):
    assert sent_on_change(Signal("", interval * np.arange(count), np.zeros(count)), dt) == on_change


def test_an_input_that_is_silent_alone_is_seen(tmp_path):
    """Two inputs of one table with as many values each, of which one is silent for 3 s."""
    half, silent = np.full((2, T.size), np.nan), (T >= 4) & (T < 7)
    half[0, ::2] = np.cos(T[::2])
    places = np.flatnonzero(~silent)
    places = places[np.linspace(0, places.size - 1, 500).astype(int)]
    half[1, places] = np.cos(T[places])
    columns = {"u": half[0], "v": half[1], "theta1": np.sin(3 * T), "dtheta1": 3 * np.cos(3 * T)}
    path = _csv(tmp_path / "a.csv", T, columns)
    log = _import(path, rig=ARM)
    assert np.isfinite(half[0]).sum() == np.isfinite(half[1]).sum()
    assert _rows(log) == pytest.approx([401, 299], abs=2)
