"""The first rig.toml: what a log tells is right, what it does not is asked for by name, and nothing is overwritten."""

import re

import numpy as np
import pytest
from helpers import data_sets

from nnap_em.commands import cli
from nnap_em.data.dataset import DataError
from nnap_em.data.formats import write_csv
from nnap_em.data.rig import RigError, SystemSpec, read_rig
from nnap_em.init.from_log import draft
from nnap_em.systems import specs

DT, ROWS = 0.02, 400
NOISE = {"theta1": 2e-3, "theta2": 1e-3, "dtheta1": 0.02, "dtheta2": 0.05, "x": 1e-3, "dx": 5e-3}


def _log(*names: str, t0: float = 0.0) -> dict[str, np.ndarray]:
    """Smooth signals, with white noise on those that are states."""
    t = DT * np.arange(ROWS)
    rng = np.random.default_rng(0)
    columns = {"time": t0 + t}
    for i, name in enumerate(names):
        columns[name] = np.sin((1 + 0.3 * i) * t + i) + rng.normal(size=ROWS) * NOISE.get(name, 0.0)
    return columns


def _draft(tmp_path, *names: str, system: str | None = None, t0: float = 0.0):
    path = tmp_path / "bench" / "01.csv"
    write_csv(path, _log(*names, t0=t0))
    return draft(path, system, specs)


def _filled(text: str) -> str:
    return re.sub(r"(?m)^# (\w+) = \.\.\.", r"\1 = 0.2", text)


SYSTEMS = {  # columns, system given, the system, inputs and joints that must be told
    "slide": (("f", "x", "dx"), None, "slide", {"f": 1}),
    "pendulum": (("u", "theta1"), "pendulum", "pendulum", {"u": 1}),
    "acrobot": (("tau2", "theta1", "theta2"), None, "acrobot", {"tau2": 2}),
    "pendubot": (("tau1", "theta1", "theta2", "dtheta2"), None, "pendubot", {"tau1": 1}),
    "both driven": (("u1", "u2", "theta2", "dtheta2", "note"), None, "acrobot", {"u1": 1, "u2": 2}),
    "hidden joint": (("u", "theta1", "dtheta1"), "acrobot", "acrobot", {"u": 2}),
}


@pytest.mark.parametrize("names, given, system, inputs", SYSTEMS.values(), ids=SYSTEMS)
def test_what_a_log_tells_is_right(tmp_path, names, given, system, inputs):
    drafted = _draft(tmp_path, *names, system=given)
    assert not drafted.notes
    assert drafted.missing == {"model": [name for name in specs[system].parameters if name != "g"]}
    (tmp_path / "rig.toml").write_text(_filled(drafted.text))
    rig = read_rig(tmp_path / "rig.toml", specs)
    assert (rig.system, rig.name, rig.dt, rig.clock, rig.friction) == (system, "bench", DT, "sequence", True)
    assert dict(zip(rig.input_columns, rig.input_joints, strict=True)) == inputs
    assert rig.measured == tuple(name for name in names if name in specs[system].states)
    for name, std in rig.noise_std.items():
        # the median of 397 third differences, correlated over three: about 8 %
        assert std == pytest.approx(NOISE[name], rel=0.25)
    assert set(rig.noise_std) == set(rig.measured)


def test_lines_that_are_not_filled_in_are_refused_by_name(tmp_path):
    text = _draft(tmp_path, "tau2", "theta1", "theta2").text
    for key in (name for name in specs["acrobot"].parameters if name != "g"):
        (tmp_path / "rig.toml").write_text(re.sub(rf"(?m)^# (?!{key} )(\w+) = \.\.\.", r"\1 = 0.2", text))
        with pytest.raises(RigError, match=rf"rig.toml: \[model\] {key}: missing .*write {key} = 0.2"):
            read_rig(tmp_path / "rig.toml", specs)


FROM_ZERO = {  # columns, then inputs and joints, and the names that the notes ask for
    "all": (("u0", "u1", "q0", "q1"), {"u0": 1, "u1": 2}, ["theta1", "theta2"]),
    "one input": (("u0", "q0", "q1", "dq1"), {"u0": 1}, ["theta1", "theta2", "dtheta2"]),
    "inputs only": (("u0", "u1", "theta1", "theta2"), {"u0": 1, "u1": 2}, []),
    "states only": (("u2", "q0", "q1"), {"u2": 2}, ["theta1", "theta2"]),
}


@pytest.mark.parametrize("names, inputs, states", FROM_ZERO.values(), ids=FROM_ZERO)
def test_joints_that_a_log_counts_from_0(tmp_path, names, inputs, states):
    zero = [name for name in names if ("u0" in names and name[0] == "u") or name[:2] == "dq"]
    drafted = _draft(tmp_path, *names, system="acrobot")
    assert f"columns = {list(inputs)}".replace("'", '"') in drafted.text
    assert f"joints = {list(inputs.values())}" in drafted.text
    said = "; ".join(drafted.notes)
    assert re.findall(r"name it '(\w+)'", said) == states
    noted = dict(re.findall(r"column '(\w+)': counted from 0, so taken for joint (\d)", said))
    assert noted == {name: str(int(name[-1]) + 1) for name in (*inputs, *names) if name[0] == "q" or name in zero}


@pytest.mark.parametrize("system", [*(name for name, spec in specs.items() if not spec.declare), "cart"])
def test_every_machine_can_be_drafted_and_one_of_ones_own(tmp_path, system):
    """What is drafted and filled in is read."""
    cart = SystemSpec(("x", "theta1", "dx", "dtheta1"), ("mc", "stiffness", "mu"), {"lag": 0.0}, joints=2, driven=2)
    known = {**specs, "cart": cart}
    path = tmp_path / "01.csv"
    write_csv(path, _log("u", known[system].states[0]))
    drafted = draft(path, system, known)
    assert drafted.missing == {"model": [name for name in known[system].parameters if name != "g"]}
    (tmp_path / "rig.toml").write_text(_filled(drafted.text))
    rig = read_rig(tmp_path / "rig.toml", known)
    assert rig.input_joints == (2 if system in ("acrobot", "cart") else 1,)


NOTES = {  # columns, then the notes
    "degrees": (("u", "theta1_deg"), "column 'theta1_deg': name it 'theta1' and convert it from deg to rad"),
    "brackets": (("u", "theta1 [deg]"), "column 'theta1 [deg]': name it 'theta1' and convert it from deg to rad"),
    "other names": (("u", "q1", "qdot1"), "column 'q1': name it 'theta1'; column 'qdot1': name it 'dtheta1'"),
    "dots": (("u", "theta1", "theta1_dot"), "column 'theta1_dot': name it 'dtheta1'"),
    "rpm": (("u", "theta1", "speed1_rpm"), "column 'speed1_rpm': name it 'dtheta1' and convert it from rpm to rad/s"),
    "torque": (("tau1_mNm", "theta1"), "column 'tau1_mNm': convert it from mnm to N m"),
    "SI in the name": (("tau1 [Nm]", "theta1"), ""),
    "twice": (("u", "theta1", "angle1"), ""),
}


@pytest.mark.parametrize("names, notes", NOTES.values(), ids=NOTES)
def test_columns_to_rename_or_convert_are_named(tmp_path, names, notes):
    assert "; ".join(_draft(tmp_path, *names, system="pendulum").notes) == notes


MS = "column 't_ms': name it 'time' and convert it from ms to s"
CLOCKS = {  # the clock of a log as it would be right, and what is noted
    "in ms by its name": (lambda t: {"t_ms": 1000 * t}, MS),
    "in ms": (lambda t: {"time": 1000 * t}, "column 'time': rows are 20 s apart: is the clock in ms? write s"),
    "none": (lambda t: {}, "no column 'time': add one [s], or write [sampling] dt"),
    "set back": (lambda t: {"time": t - DT * (np.arange(ROWS) > 7)},
        "line 10, column 'time': time does not run on: remove or correct the row"),
}  # fmt: skip


@pytest.mark.parametrize("clock, note", CLOCKS.values(), ids=CLOCKS)
def test_a_clock_that_is_none_is_noticed(tmp_path, clock, note):
    columns = _log("u", "x")
    write_csv(tmp_path / "01.csv", clock(columns.pop("time")) | columns)
    drafted = draft(tmp_path / "01.csv", None, specs)
    assert drafted.notes == (note,) and (note != MS or f"dt = {DT}" in drafted.text)
    assert note[:2] != "no" or drafted.missing == {"model": ["m"], "sampling": ["dt"]}


def test_jitter_session_lost_columns_and_noise_without_a_signal_are_left_to_the_owner(tmp_path):
    path, columns = tmp_path / "01.csv", _log("note", t0=5.0)
    columns["time"][7] += 0.1 * DT
    write_csv(path, columns)
    drafted = draft(path, "slide", specs)
    lists = {"input": ["columns", "joints"], "sampling": ["dt"], "measurement": ["columns"]}
    assert drafted.missing == {"model": ["m"]} | lists
    assert "0.018 to 0.022 s apart: resample" in drafted.text and 'clock = "session"' in drafted.text
    noise = np.random.default_rng(0).normal(size=ROWS)
    write_csv(path, _log("u") | {"x": noise, "dx": 0 * noise})
    text = draft(path, None, specs).text
    assert re.search(r"(?m)^# x = ", text) and re.search(r"(?m)^# dx = 0 ", text)


@pytest.mark.parametrize(
    "names, reason",
    [
        (("u", "theta1"), "hidden joint"),
        (("a", "b"), "no column is named as a state"),
        (("u", "x", "theta1"), "a coordinate x and an angle are of no machine"),
        (("u", "x", "theta2"), "a coordinate x and an angle are of no machine"),
    ],
)
def test_a_system_that_cannot_be_told_is_asked_for(tmp_path, names, reason):
    with pytest.raises(DataError, match=rf"01.csv: line 1: .*{reason}.*; give --system acrobot"):
        _draft(tmp_path, *names)


NO_COLUMNS = {  # the change of a log, and words of the message
    "decimal commas": (lambda s: s.replace(".", ","), "line 2: found", "decimals with '.'"),
    "no header": (lambda s: s.split("\n", 1)[1], "line 1 holds numbers: write a header"),
    "other names": (
        lambda s: s.replace("time,u,x", "a,b,c"),
        "line 1: no column is recognised",
        "names such as time, u",
    ),
    "dates": (lambda s: s.replace("\n", "\n2026-"), "column 'time': found '2026-0'; write seconds"),
}


@pytest.mark.parametrize("change, words", [(c, w) for c, *w in NO_COLUMNS.values()], ids=NO_COLUMNS)
def test_a_log_without_known_columns_is_refused_and_nothing_is_written(tmp_path, capsys, change, words):
    path = tmp_path / "log.csv"
    write_csv(path, _log("u", "x"))
    path.write_text(change(path.read_text().rstrip()))
    assert cli.main(["init", str(path), "--system", "slide", "--out", str(tmp_path / "mine")]) == 2
    said = capsys.readouterr().err
    for word in words:
        assert word in said
    assert [each.name for each in tmp_path.iterdir()] == ["log.csv"]


def test_the_command_writes_once_and_never_over(tmp_path, capsys):
    write_csv(tmp_path / "bench/train/01.csv", _log("u", "x_mm"))
    argv = ["init", str(tmp_path / "bench/train/01.csv")]
    assert cli.main(argv) == 0
    said = capsys.readouterr().err
    assert "in the log: column 'x_mm': name it 'x' and convert it from mm to m" in said
    assert f"wrote {tmp_path / 'bench/rig.toml'}; fill in [model] m; [measurement] columns" in said
    first = (tmp_path / "bench/rig.toml").read_bytes()
    assert cli.main([*argv, "--system", "slide"]) == 2
    assert "rig.toml: is there already; give another --out" in capsys.readouterr().err
    assert (tmp_path / "bench/rig.toml").read_bytes() == first
    assert cli.main([*argv, "--out", str(tmp_path / "new")]) == 0
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == ["rig.toml"]
    assert cli.main(["init", str(tmp_path / "log.txt"), "--out", str(tmp_path / "other")]) == 2
    assert not (tmp_path / "other").exists()


def test_the_shared_rigs_are_drafted_as_their_owners_declared_them(shared, tmp_path):
    paths = data_sets(shared)
    assert paths
    for path in paths:
        owner = read_rig(path, specs)
        if specs[owner.system].declare:
            continue  # a machine from a file: test_draft_machine.py
        drafted = draft(sorted((path.parent / "train").glob("*.csv"))[0], owner.system, specs)
        assert not drafted.notes
        (tmp_path / "rig.toml").write_text(_filled(drafted.text))
        rig = read_rig(tmp_path / "rig.toml", specs)
        assert (rig.dt, rig.clock) == (owner.dt, owner.clock)
        assert rig.measured[: len(owner.measured)] == owner.measured  # an owner may leave out the rates of a file
        assert dict(zip(rig.input_columns, rig.input_joints, strict=True)) == dict(
            zip(owner.input_columns, owner.input_joints, strict=True)
        )
