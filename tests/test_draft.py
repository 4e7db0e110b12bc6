"""The first rig.toml: what a log tells is right, the rest is asked for by name, import takes it, nothing is lost."""

import functools
import re
from pathlib import Path

import numpy as np
import pytest
from helpers import nnap
from recorders import Q, robot_log

from nnap_em.cli import main as cli
from nnap_em.errors import DataError, RigError
from nnap_em.logs.draft.draft import common_step, draft
from nnap_em.logs.draft.equations import draft_equations
from nnap_em.logs.draft.from_machine import draft_machine
from nnap_em.logs.formats import write_csv
from nnap_em.logs.read import read_logs
from nnap_em.machines.machine import unpacked
from nnap_em.machines.rig import read_rig
from nnap_em.machines.systems import specs

DT, ROWS = 0.02, 400
NOISE = {"theta1": 2e-3, "theta2": 1e-3, "dtheta1": 0.02, "dtheta2": 0.05, "x": 1e-3, "dx": 5e-3}


def _log(*names: str, t0: float = 0.0) -> dict[str, np.ndarray]:
    """Smooth signals, with white noise on those that are states."""
    t, rng = DT * np.arange(ROWS), np.random.default_rng(0)
    swing = {name: np.sin((1 + 0.3 * i) * t + i) + rng.normal(size=ROWS) * NOISE.get(name, 0.0)
             for i, name in enumerate(names)}  # fmt: skip
    return {"time": t0 + t} | swing


def _draft(tmp_path, *names: str, system: str | None = None):
    path = tmp_path / "bench" / "01.csv"
    write_csv(path, _log(*names))
    return draft(path, system, specs)


def _filled(text: str) -> str:
    return re.sub(r"(?m)^# (\w+) = \.\.\.", r"\1 = 0.2", text)


SYSTEMS = {  # columns, system given, the system, inputs and joints that must be told
    "acrobot": (("tau2", "theta1", "theta2"), None, "acrobot", {"tau2": 2}),
    "pendubot": (("tau1", "theta1", "theta2", "dtheta2"), None, "pendubot", {"tau1": 1}),
    "hidden joint": (("u", "theta1", "dtheta1"), "acrobot", "acrobot", {"u": 2}),
}


@pytest.mark.parametrize("names, given, system, inputs", SYSTEMS.values(), ids=SYSTEMS)
def test_what_a_log_tells_is_right_and_what_is_left_is_refused_by_name(tmp_path, names, given, system, inputs):
    drafted = _draft(tmp_path, *names, system=given)
    numbers = [name for name in specs[system].parameters if name != "g"]
    assert drafted.missing == {"model": numbers} and not drafted.mapped
    (tmp_path / "rig.toml").write_text(_filled(drafted.text.replace(f"# {numbers[-1]} =", "#")))
    with pytest.raises(RigError, match=rf"rig.toml: \[model\] {numbers[-1]}: missing .*write {numbers[-1]} = 0.2"):
        read_rig(tmp_path / "rig.toml", specs)
    (tmp_path / "rig.toml").write_text(_filled(drafted.text))
    rig = read_rig(tmp_path / "rig.toml", specs)
    assert (rig.system, rig.name, rig.dt, rig.clock, rig.friction) == (system, "bench", DT, "sequence", True)
    assert dict(zip(rig.input_columns, rig.input_joints, strict=True)) == inputs
    assert set(rig.noise_std) == set(rig.measured) == {name for name in names if name in specs[system].states}
    for name, std in rig.noise_std.items():
        # the median of 397 third differences, correlated over three: about 8 %
        assert std == pytest.approx(NOISE[name], rel=0.25)


MAPPED = {  # columns, then inputs with their joints, and lines of [import.columns]
    "from 0": (("u0", "u1", "q0", "q1"), {"u0": 1, "u1": 2}, ['"theta1" = "q0"', '"theta2" = "q1"']),
    "other names": (("u", "q1", "qdot1"), {"u": 2}, ['"theta1" = "q1"', '"dtheta1" = "qdot1"']),
    "degrees": (("u", "theta1 [deg]"), {"u": 2}, ['"theta1" = { from = "theta1 [deg]", scale = 0.0174532925 }']),
}


@pytest.mark.parametrize("names, inputs, lines", MAPPED.values(), ids=MAPPED)
def test_columns_with_other_names_or_units_are_mapped(tmp_path, names, inputs, lines):
    drafted = _draft(tmp_path, *names, system="acrobot")
    assert re.findall(r'(?m)^".*', drafted.text.partition("[import.columns]")[2]) == lines
    assert drafted.mapped == bool(lines)
    (tmp_path / "rig.toml").write_text(_filled(drafted.text))
    rig = read_rig(tmp_path / "rig.toml", specs)
    assert dict(zip(rig.input_columns, rig.input_joints, strict=True)) == inputs


CLOCKS = {  # the clock of a log, and what is drafted
    "in ms by its name": (lambda t: {"t_ms": 1000 * t}, "dt = 0.02    # s\n"),
    "in ms": (lambda t: {"time": 1000 * t}, "dt = 20.0    # s; is the clock in ms?"),
    "none": (lambda t: {}, "# dt = ...    # s; the rows of this log have no times"),
    "session": (lambda t: {"time": t + 5.0}, 'clock = "session"'),
}


@pytest.mark.parametrize("clock, line", CLOCKS.values(), ids=CLOCKS)
def test_the_clock_of_a_log_is_read_or_asked_for(tmp_path, clock, line):
    columns = _log("u", "x")
    noise = np.random.default_rng(0).normal(size=ROWS)
    write_csv(tmp_path / "01.csv", clock(columns.pop("time")) | columns | {"dx": noise})
    text = draft(tmp_path / "01.csv", None, specs).text
    assert line in text and re.search(r"(?m)^x = ", text) and re.search(r"(?m)^# dx = ", text)  # dx: no signal


NO_MACHINE = {  # columns, the reason
    "one angle": (("u", "theta1"), "hidden joint.*; give --system acrobot"),
    "both kinds": (("u", "x", "theta2"), "its columns are those of no machine here; give --system acrobot"),
}


@pytest.mark.parametrize("names, reason", NO_MACHINE.values(), ids=NO_MACHINE)
def test_a_system_that_cannot_be_told_is_asked_for(tmp_path, names, reason):
    with pytest.raises(DataError, match=rf"01.csv: .*{reason}"):
        _draft(tmp_path, *names)


def test_the_command_writes_once_and_never_over(tmp_path, capsys):
    write_csv(tmp_path / "bench/train/01.csv", _log("u", "x_mm"))
    argv = ["init", str(tmp_path / "bench/train/01.csv")]
    assert cli.main(argv) == 0
    said = capsys.readouterr().err
    assert f"other names or units: then nnap-em import {argv[1]} --rig {tmp_path / 'bench/rig.toml'}" in said
    assert f"wrote {tmp_path / 'bench/rig.toml'}; fill in [model] m\n" in said
    first = (tmp_path / "bench/rig.toml").read_bytes()
    assert cli.main([*argv, "--system", "slide"]) == 2
    assert "rig.toml: is there already; give another --out" in capsys.readouterr().err
    assert (tmp_path / "bench/rig.toml").read_bytes() == first
    assert cli.main(["init", str(tmp_path / "log.txt"), "--out", str(tmp_path / "other")]) == 2
    assert not (tmp_path / "other").exists()


# --- a machine in a file

LEG = functools.partial(robot_log, command="/torques/commands", joints=("knee", "hip"))
"""A robot's log in which the knee stands first."""
MOTORS = '<motor name="m_hip" joint="hip"/><motor name="m_knee" joint="knee"/>'


def _leg(path: Path, motors: str = MOTORS, sensors: str = "") -> Path:
    path.parent.mkdir(exist_ok=True)
    path.write_text(f"""
<mujoco model="leg"><compiler angle="radian"/><worldbody>
  <body name="thigh"><joint name="hip" axis="0 1 0" armature="0.02"/>
    <inertial pos="0 0 -0.2" mass="1.5" diaginertia="0.02 0.02 0.002"/>
    <body name="shank" pos="0 0 -0.4"><joint name="knee" axis="0 1 0"/>
      <inertial pos="0 0 -0.2" mass="1.0" diaginertia="0.01 0.01 0.001"/></body></body>
</worldbody><actuator>{motors}</actuator><sensor>{sensors}</sensor></mujoco>""")
    return path


@pytest.mark.parametrize(
    ("command", "motors", "inputs"),
    [
        ("/torques/commands", MOTORS, {"m_hip": "/torques/commands:data[0]", "m_knee": "/torques/commands:data[1]"}),
        (None, "", {"tau_hip": "/joint_states:effort[hip]", "tau_knee": "/joint_states:effort[knee]"}),
    ],
)
def test_a_robot_of_a_file_is_drafted_and_imported(tmp_path, command, motors, inputs):
    model = _leg(tmp_path / "models" / "leg.xml", motors)
    log, bench = LEG(tmp_path / "a.mcap", command=command), tmp_path / "bench"
    assert cli.main(["init", str(log), "--model", str(model), "--out", str(bench)]) == 0
    text = (bench / "rig.toml").read_text()
    assert 'file = "../models/leg.xml"' in text
    assert all(f'"{name}" = "{at}"' in text for name, at in inputs.items())
    rig = read_rig(bench / "rig.toml", specs)
    assert (rig.dt, rig.measured, rig.input_columns) == (0.004, ("hip", "knee", "dhip", "dknee"), tuple(inputs))
    assert rig.input_joints == (1, 2)
    out = tmp_path / "out"
    assert cli.main(["import", str(log), "--rig", str(bench / "rig.toml"), "--out", str(out), "--test", "0"]) == 0
    again = read_rig(out / "rig.toml", specs)  # which reaches the file where it is
    one, other = (unpacked(each.machine)._replace(file="") for each in (again, rig))
    assert one == other and unpacked(again.machine).file.endswith("leg.xml")
    q = np.asarray(read_logs(out / "train", again).data.y)[0, :, :2]
    np.testing.assert_allclose(q, Q[: len(q)], atol=6e-3)  # the knee is the knee, although it stands first


def test_servos_and_uncertain_numbers_of_a_file_are_drafted_by_taking_marks_away(tmp_path):
    """A measured effort is not taken for the goal of a servo."""
    model = _leg(tmp_path / "leg.xml", '<position name="m_hip" joint="hip" kp="40" kv="2"/>')
    made = draft_machine(LEG(tmp_path / "a.mcap", command="/goals/commands"), model, tmp_path)
    assert '# [input."m_hip"]    # the goal of a position servo' in made.text
    none = draft_machine(LEG(tmp_path / "b.mcap", command=None), model, tmp_path)
    assert "effort" not in none.text.partition("[import")[0]
    made = draft_machine(LEG(tmp_path / "a.mcap"), _leg(tmp_path / "leg.xml"), tmp_path)
    (tmp_path / "rig.toml").write_text(re.sub(r'(?m)^# ("\w+\.\w+" = )', r"\1", made.text))
    rig = read_rig(tmp_path / "rig.toml", specs)
    assert {name: (p.mean, p.std) for name, p in rig.parameters.items()} == {
        "thigh.mass": (1.5, 0.15), "shank.mass": (1.0, 0.1), "hip.armature": (0.02, 0.02), "knee.armature": (0.0, 0.01),
    }  # fmt: skip


def test_equations_are_drafted_with_names_and_units_of_formulas_and_import_reads_them(tmp_path):
    """A recorder's table: lines above, units below the header, decimal commas, grouped thousands, ISO 8601 times."""
    level = 998.0 + 0.5 * np.arange(60)
    comma = lambda x: f"{x:,.2f}".translate(str.maketrans(",.", ".,"))  # noqa: E731
    rows = [f"2026-01-05T23:59:{k // 2:02d}.{k % 2 * 5};{k // 30 * 1.5:g};{comma(y)}" for k, y in enumerate(level)]
    lines = ["Recorder 4", "", "Time;Pump speed;Level", ";[V];[mm]", *(row.replace("1.5;", "1,5;") for row in rows)]
    (tmp_path / "log.csv").write_text("\n".join(lines))
    drafted = draft_equations(tmp_path / "log.csv")
    text = drafted.text
    assert drafted.missing == {"model": ["rates"]} and "dt = 0.5    # s\n" in text
    assert 'inputs = { "Pump_speed" = "V" }' in text and 'states = { "x1" = "mm" }' in text
    (tmp_path / "rig.toml").write_text(text.replace("# rates = ...", 'rates = { x1 = "k*Pump_speed" }\nk = 1.0\n#'))
    assert nnap("import", tmp_path / "log.csv", "--rig", tmp_path / "rig.toml", "--out", tmp_path / "b") == 0
    data = read_logs(tmp_path / "b" / "train", read_rig(tmp_path / "rig.toml", specs), trust=True).data
    np.testing.assert_allclose(np.asarray(data.y)[0, :, 0], level)
    np.testing.assert_allclose(np.asarray(data.u)[0, :, 0], 1.5 * (np.arange(60) >= 30))


def test_the_only_column_beside_time_is_a_reading(tmp_path):
    write_csv(tmp_path / "01.csv", _log("u"))
    text = draft_equations(tmp_path / "01.csv").text
    assert "inputs = []" in text and 'columns = { "u" = "x1" }' in text


STEPS = {  # times of rows 0.1 s apart [rows]
    "jitter": lambda k, rng: k + 0.2 * rng.uniform(-1, 1, k.size),
    "two thirds lost": lambda k, rng: k[rng.uniform(size=k.size) < 1 / 3],
    "jitter and a pause": lambda k, rng: k + 0.2 * rng.uniform(-1, 1, k.size) + 36000.4 * (k > 200),
}


@pytest.mark.parametrize("of", STEPS.values(), ids=STEPS)
def test_the_common_step_of_uneven_rows_is_found(of):
    t = np.sort(of(np.arange(600.0), np.random.default_rng(0)))
    assert common_step(np.round(1e8 * t).astype(np.int64))[0] == pytest.approx(0.1, rel=1e-3)  # 0.2 rows of 600
