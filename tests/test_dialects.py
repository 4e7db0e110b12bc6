"""Formats of drives, PLCs and tools: the numbers that were written come back on the grid, or a line says what helps."""

import functools
import itertools
import re
from datetime import UTC, datetime, timedelta

import dialects
import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import scipy.io
from dialects import DT, Q, T, U, V
from helpers import pendulum_rig
from recorders import imported, ns, plain_json, write_hdf5, write_mcap

from nnap_em.errors import DataError, DataWarning
from nnap_em.logs import formats
from nnap_em.logs.importing import text_file
from nnap_em.logs.importing.columns import in_unit
from nnap_em.logs.importing.recording import Address, Topic, last_word, places
from nnap_em.logs.read import read_logs
from nnap_em.machines.rig import read_rig
from nnap_em.machines.systems import specs

RIG = pendulum_rig(dt=DT)


def _rig(folder, columns=()):
    """The rig, with the addresses of columns that their names do not give."""
    lines = [f"{name} = {at}" for name, at in dict(columns).items()]
    (folder / "rig.toml").write_text("\n".join([RIG, "[import.columns]", *lines]) + "\n")
    return folder / "rig.toml"


def _imported(log, path):
    """The sequences of a log, the columns in the order of the rig: inputs first."""
    return [np.stack([*each.values()], 1) for each in imported(log, path).values]


def _close(tables, rows: int, atol: float, parts: int = 1, apart: int | None = None) -> None:
    """Asserts that so many sequences of so many rows are parts of what was written, each so many rows on."""
    assert [len(table) for table in tables] == [rows] * parts
    for k, table in enumerate(tables):
        part = slice(k * (rows if apart is None else apart), None)
        np.testing.assert_allclose(table.T, [y[part][:rows] for y in (U, Q, V)], atol=atol)


COLUMNS = (T, U, Q, V)
DEGREES = (T, U, np.degrees(Q), V)
JOINT = "/joint_states/joint0"
LISTS = {"theta1": '"observation.state[0]"', "dtheta1": '"observation.state[1]"', "u": '"action[0]"'}
SCOPE = {
    "theta1": '{ from = "clock 1:fAngle [deg]", scale = 0.0174532925199433 }',
    "dtheta1": '"clock 1:fSpeed [rad/s]"',
    "u": '"clock 2:fTorque"',
}
BARE = {name: at.replace(" [deg]", "").replace(" [rad/s]", "") for name, at in SCOPE.items()}
QUANTITIES = {"u": f'"{JOINT}/effort"', "theta1": f'"{JOINT}/position"', "dtheta1": f'"{JOINT}/velocity"'}


def _table(header: str, columns=COLUMNS, separator: str = ",", decimal: str = ".", **more):
    more |= {"separator": separator, "decimal": decimal}
    return functools.partial(dialects.table, header=header, columns=columns, **more)


def _names(separator: str, first: str = "time") -> str:
    return separator.join((first, "u", "theta1", "dtheta1"))


ABOVE = "Prüfstand", "", "2026-01-01;12:00"
HEADER = "Zeit;u;theta1;dtheta1\nms;Nm;°;rad/s"
UNITS = _table(HEADER, (1e3 * T, *DEGREES[1:]), ";", ",", above=ABOVE, encoding="cp1252")
QUOTED = _table('"time [s]","Motor torque, Nm","theta1 [deg]","dtheta1 [rad/s]"', DEGREES)
PATHS = _table(f"__time,{JOINT}/effort,{JOINT}/position,{JOINT}/velocity", (1.7e9 + T, *COLUMNS[1:]))
PLAIN = functools.partial(dialects.twincat, full=False, separator=",", decimal=".")
READ = {  # what writes a file, its name, and the addresses that names do not give
    "TwinCAT Scope": (dialects.twincat, "a.csv", SCOPE),
    "TwinCAT Scope, ticks": (functools.partial(dialects.twincat, ticks=True), "a.csv", SCOPE),
    "TwinCAT Scope, names only": (PLAIN, "a.csv", BARE),
    "CODESYS trace": (dialects.codesys, "a.trace.csv", {}),
    "CODESYS trace in us": (functools.partial(dialects.codesys, flags=36), "a.trace.csv", {}),
    "CODESYS text": (dialects.codesys_text, "a.txt", {}),
    "LabVIEW": (dialects.labview, "a.lvm", {}),
    "LabVIEW, many times": (functools.partial(dialects.labview, x_columns="Multi"), "a.lvm", {}),
    "LabVIEW, no times": (functools.partial(dialects.labview, x_columns="No"), "a.lvm", {}),
    "ControlDesk": (dialects.control_desk, "a.mat", {"u": '"Model Root/u\\\\Out1"'}),
    "Simulink": (dialects.structure_with_time, "a.mat", {}),
    "decimal comma": (_table(_names(";"), COLUMNS, ";", ","), "a.csv", {}),
    "decimal comma in quotes": (_table(_names(","), COLUMNS, ",", ",", quote=True), "a.csv", {}),
    "a comment": (_table(_names(","), above=("# of Monday",)), "a.csv", {}),
    "units": (UNITS, "a.csv", {}),
    "quoted names": (QUOTED, "a.csv", {"u": '"Motor torque, Nm"'}),
    "PlotJuggler": (PATHS, "a.csv", QUANTITIES),
    "NumPy": (_table("# time u theta1 dtheta1", COLUMNS, " "), "a.txt", {}),
    "no time, decimal comma": (_table("u;theta1;dtheta1", COLUMNS[1:], ";", ","), "a.csv", {}),
}


@pytest.mark.parametrize("write, name, columns", READ.values(), ids=READ)
def test_what_was_written_is_read(tmp_path, write, name, columns):
    log = write(tmp_path / name)
    (table,) = _imported(log, _rig(tmp_path, columns))
    # nine digits in the file; PlotJuggler's epoch is known to 2.4e-7 s, at a rate of 3 rad/s and 9 rad/s^2
    close = {"rtol": 2e-8, "atol": 3e-6 if "__time" in log.read_bytes().decode("latin-1") else 2e-8}
    np.testing.assert_allclose(table[:, 1:].T, [Q[: len(table)], V[: len(table)]], **close)
    held = U if not columns.get("u", "").startswith('"clock') else np.repeat(U[::2], 2)  # every other row, held
    np.testing.assert_allclose(table[:, 0], held[: len(table)], **close)
    assert len(table) >= len(T) - 2


def test_lists_and_episodes_are_sequences(tmp_path):
    """Lists of LeRobot come in single precision; a table of episodes may lack times."""
    for fixed in (False, True):
        log = dialects.lerobot(tmp_path / f"set {fixed}", fixed=fixed)
        _close(_imported(log, _rig(tmp_path, LISTS)), 100, 1e-6, 2)
    episode = np.repeat([0, 1], len(T) // 2)
    for separator, decimal in ((";", ","), (",", ".")):
        names = separator.join(("episode_index", "u", "theta1", "dtheta1"))
        log = dialects.table(tmp_path / "train/a.csv", names, (episode, U, Q, V), separator, decimal)
        _close(_imported(log, _rig(tmp_path)), 100, 2e-8, 2)
    with pytest.raises(DataError, match=r"line 102, column 'episode_index': another episode begins; `nnap-em im"):
        read_logs(log.parent, read_rig(tmp_path / "rig.toml", specs))


DEG = np.pi / 180
NAMED = {  # the column and its name in the log, mapped as it stands; how many SI units it has, or words of the refusal
    "degrees": ("theta1", "Angle [deg]", DEG), "degree sign": ("theta1", "Angle (°)", DEG),
    "a slash": ("theta1", "Winkel / °", DEG), "the word in": ("dtheta1", "Rate in deg/s", DEG),
    "run together": ("theta1", "AngleDeg", DEG), "a path": ("u", "Drive/N", 1.0),
    "underscore": ("theta1", "angle_deg", DEG), "milliradians": ("theta1", "Angle [mrad]", 1e-3),
    "revolutions": ("theta1", "Angle [rev]", 2 * np.pi), "SI": ("theta1", "Angle [rad]", 1.0),
    "rpm": ("dtheta1", "Speed [RPM]", np.pi / 30), "U/min": ("dtheta1", "n [U/min]", np.pi / 30),
    "degrees a second": ("dtheta1", "Rate [deg/s]", DEG), "mN m": ("u", "Torque [mN·m]", 1e-3),
    "kN m": ("u", "M [kNm]", 1e3), "N m": ("u", "Torque [Nm]", 1.0), "no unit": ("u", "Torque", 1.0),
    "a letter": ("theta1", "angle_s", 1.0), "a joint": ("theta1", "position[m]", 1.0),
    "not known": ("theta1", "Angle [counts]", 1.0),
    "amperes": ("u", "Current [A]", "in A by its name, but N m is read; write [import.columns] u = { from = "
                "\"Current [A]\", scale = ... } with N m per A, or [input] kind = \"affine\""),
    "milliamperes": ("u", "current_mA", "in mA by its name, but N m is read"),
    "volts": ("u", "Drive (V)", "in V by its name, but N m is read"),
    "metres": ("theta1", "Position [mm]", "in mm by its name, but rad is read"),
    "a rate": ("theta1", "Rate [rad/s]", "in rad/s by its name, but rad is read"),
}  # fmt: skip


@pytest.mark.parametrize("column, name, size", NAMED.values(), ids=NAMED)
def test_a_unit_in_the_name_of_a_mapped_column_scales_it_or_is_refused(tmp_path, column, name, size):
    """A scale in the mapping counts instead of the unit in the name."""
    rig, at = read_rig(_rig(tmp_path), specs), Address("", name)
    if isinstance(size, str):
        with pytest.raises(DataError, match=re.escape(size)):
            in_unit(tmp_path, column, at, rig)
    else:
        scaled, note = in_unit(tmp_path, column, at, rig)
        assert scaled.scale == pytest.approx(size, rel=1e-12)
        assert bool(note) == (size != 1 or "counts" in name) and ("counts" in note) == ("counts" in name)
    assert in_unit(tmp_path, column, at._replace(scale=3.0), rig) == (Address("", name, 3.0), "")


@pytest.mark.parametrize("suffix", ["mat", "parquet", "h5", "mcap", "xlsx"])
def test_a_unit_in_a_name_counts_in_every_format(tmp_path, suffix):
    columns = {"time": T, "Torque [Nm]": U, "Angle [deg]": np.degrees(Q), "Speed [rpm]": V * 30 / np.pi}
    log, topic = tmp_path / f"a.{suffix}", "/a:" if suffix in ("h5", "mcap") else ""
    if suffix == "mat":
        axis, record = np.zeros(1, [("Data", "O")]), np.zeros(3, [("Name", "O"), ("Data", "O")])
        axis[0], record[:] = (T,), list(columns.items())[1:]
        scipy.io.savemat(log, {"rec": {"X": axis, "Y": record}})
    elif suffix == "parquet":
        pq.write_table(pa.table(columns), log)
    elif suffix == "h5":
        write_hdf5(log, {"a": columns})
    elif suffix == "xlsx":
        dialects.workbook(log, columns)
    else:
        rows = zip(*(y.tolist() for y in columns.values()), strict=True)
        write_mcap(log, {"/a": (plain_json(), ns(T), [dict(zip(columns, row, strict=True)) for row in rows])})
    names = dict(zip(("u", "theta1", "dtheta1"), list(columns)[1:], strict=True))
    (table,) = _imported(log, _rig(tmp_path, {name: f'"{topic}{at}"' for name, at in names.items()}))
    _close([table[:-1]], len(table) - 1, 1e-5)


def test_a_unit_of_the_file_alone_counts(tmp_path):
    """An attribute of HDF5, or a name that the mapping has without its unit."""
    write_hdf5(tmp_path / "a.h5", {"a": {"time": T, "u": U, "q": np.stack([np.degrees(Q), V], 1), "v": V * 30 / np.pi}})
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        file["a/v"].attrs["units"] = "rpm"
        file["a/q"].attrs["unit"] = b"deg"
    dialects.table(tmp_path / "a.csv", "time;u;q [deg];v (rpm)", (T, U, np.degrees(Q), V * 30 / np.pi), ";")
    for name, theta1, start in (("a.h5", "/a:q[0]", "/a:"), ("a.csv", "q", "")):
        rig = _rig(tmp_path, {"theta1": f'"{theta1}"', "dtheta1": f'"{start}v"', "u": f'"{start}u"'})
        (table,) = _imported(tmp_path / name, rig)
        _close([table], len(table), 1e-7)


MOMENTS = {  # the header, and the texts of a time [s] on 3 November 2026, from before midnight on
    "date and time": ("Date,Time", lambda day, s: f"{day:%d.%m.%Y},{day:%H:%M}:{s:06.3f}"),
    "month first": ("Date,Time", lambda day, s: f"{day:%m/%d/%Y},{day:%H:%M}:{s:06.3f}"),
    "day first": ("Datum,Uhrzeit", lambda day, s: f"{day:%d/%m/%Y},{day:%H:%M}:{s:06.3f}"),
    "with a zone": ("t", lambda day, s: f"{day:%Y-%m-%d %H:%M}:{s:06.3f}+01:00"),
    "AM and PM": ("Date/Time", lambda day, s: f"{day:%d-%b-%Y %I:%M}:{s:06.3f} {day:%p}"),
    "time of day": ("Time [hh:mm:ss]", lambda day, s: f"{day:%H:%M}:{s:06.3f}"),
}
MARKED = [(*moment, *marks) for moment, marks in zip(MOMENTS.values(), itertools.cycle((",.", ";,")), strict=False)]


@pytest.mark.parametrize("header, text, separator, decimal", MARKED, ids=MOMENTS)
def test_runs_of_one_file_with_times_of_day_are_sequences(tmp_path, header, text, separator, decimal):
    """Three runs of 4 s with silences of 20 s, over midnight."""
    start = datetime(2026, 11, 3, 23, 59, 40, tzinfo=UTC)
    moments = np.concatenate([T[:100] + 20.4 * k for k in range(3)])
    rows = [f"{header},u,theta1,dtheta1".replace(",", separator)]
    for t, u, q, v in zip(moments, *(np.tile(y[:100], 3) for y in (U, Q, V)), strict=True):
        day = start + timedelta(seconds=round(float(t), 3) // 1)
        stamp = text(day, day.second + round(float(t) % 1, 3))
        numbers = [f"{x:.9g}".replace(".", decimal) for x in (u, q, v)]
        fields = stamp.split(",") if ":" in stamp else [stamp.replace(".", decimal)]
        rows.append(separator.join([*fields, *numbers]))
    (tmp_path / "a.csv").write_text("\n".join(rows) + "\n")
    _close(_imported(tmp_path / "a.csv", _rig(tmp_path)), 100, 1e-6, 3, apart=0)


def _last(row: str, decimal: str = "."):
    """A table whose last row is another."""
    return _table(_names(";"), COLUMNS, ";", decimal, last=row)


REFUSED = {  # what writes a file, its name, and words of the message
    "bag": (None, "run.bag", "the file is damaged", "use another copy"),
    "db3": (None, "run.db3", "the file is damaged", "use another copy"),
    "xlsx": (None, "a.xlsx", "no workbook, or damaged", "save the sheet as CSV"),
    "TwinCAT recording": (None, "a.svdx", "TC3ScopeExportTool.exe svd="),
    "commas twice": (_table(_names(","), COLUMNS, ",", ","), "a.csv", "fields under 4 names", "decimals with '.'"),
    "a text": (_last("9;x;1;1"), "a.csv", "line 202, column 'u': found 'x'; write a number"),
    "a field too many": (_last("9;1;1;1;1"), "a.csv", "line 202: found 5 fields under 4 names"),
    "a misspelt time": (_table(_names(",", "tme")), "a.csv", "no column of times", "if 'tme' is that"),
    "no header": (_table("0;1;2;3", COLUMNS, ";"), "a.txt", "no column of numbers under a name"),
}


@pytest.mark.parametrize("write, name, words", [(w, n, words) for w, n, *words in REFUSED.values()], ids=REFUSED)
def test_what_is_not_read_is_refused_with_the_line_that_helps(tmp_path, write, name, words):
    log = tmp_path / name
    log.write_bytes(b"x") if write is None else write(log)
    with pytest.raises(DataError) as refused:
        _imported(log, _rig(tmp_path))
    for word in (str(log), *words):
        assert word in str(refused.value)
    assert "\n" not in str(refused.value)


WORDS = {  # a path, and its last word
    "q": "q", "/arm/q": "q", "arm.q[3]": "q[3]", "position[hip.left]": "position[hip.left]", "a/b [rad/s]": "b [rad/s]",
    "/joint_states/joint0/position": "position[joint0]", "Axis1.ActPos": "position[Axis1]", "pos": "pos",
    "vel rad/s": "vel rad/s", "Axis:torque": "effort[Axis]", "Root/u\\Out1": "Out1", "speed_m/s": "speed_m/s",
    "observation.state[2]": "state[2]",
}  # fmt: skip


def test_the_last_word_of_a_path():
    for path, word in WORDS.items():
        assert last_word(path) == word
        ((at, _),) = places([Topic("", "", None, (path if "[" in path else f"{path} [deg]",))])
        assert at.scale == (None if "[" in path else pytest.approx(DEG))


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_a_log_without_times_is_read_where_dt_is_declared(tmp_path, suffix):
    """One whose times have another name is refused."""
    path = tmp_path / f"train/01.{suffix}"
    path.parent.mkdir()
    rig, columns = read_rig(_rig(tmp_path), specs), dict(zip(("u", "theta1", "dtheta1"), COLUMNS[1:], strict=True))
    write = formats.write_csv if suffix == "csv" else lambda path, columns: pq.write_table(pa.table(columns), path)
    write(path, columns)
    with pytest.warns(DataWarning, match=r"no column of times: rows are taken as dt = 0.004 s apart; log the time"):
        data = read_logs(path.parent, rig).data
    np.testing.assert_allclose(data.t[0], T, atol=1e-12)
    np.testing.assert_allclose(data.y[0].T, [Q, V], atol=2e-8)
    write(path, {"t_ms": 1e3 * T} | columns)
    with pytest.raises(DataError, match="column 'time': missing"):
        read_logs(path.parent, rig)


def test_a_plain_csv_file_is_none_of_another_dialect(tmp_path):
    for header in ("time,u,theta1", "time,/a/b,c:d", "a,time,b"):
        assert text_file.plain_csv(dialects.table(tmp_path / "a.csv", header, (T, U, Q)))
    for header in ('time,"a, b",c', "time,a,a", "# time,a,b"):
        assert not text_file.plain_csv(dialects.table(tmp_path / "a.csv", header, (T, U, Q)))
    found = text_file.layout(["Date;Time;u;q", *9 * ["03.11.2026;12:00:00,5;0,5;1,5"]])
    assert found and (found.marks, found.first, found.clocks) == ((";", ","), 1, (1,))
