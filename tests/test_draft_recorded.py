"""The first rig.toml from topics: what is found is right, and import takes it once it is filled in."""

import re

import numpy as np
import pytest
from recorders import Q, T, V, ns, plain_json, robot_log, write_hdf5, write_mcap

from nnap_em.commands import cli
from nnap_em.data.dataset import DataError
from nnap_em.data.rig import read_rig
from nnap_em.import_.recording import Topic
from nnap_em.init.from_topics import draft_recorded, found_columns
from nnap_em.systems import specs


@pytest.mark.parametrize("command, inputs", [("/effort_controller/commands", "data[0]"), (None, "effort[hip]")])
def test_a_robot_is_drafted_and_imported(tmp_path, command, inputs):
    log = robot_log(tmp_path / "a.mcap", command)
    assert cli.main(["init", str(log), "--system", "acrobot"]) == 0
    path = tmp_path / "rig.toml"
    path.write_text(re.sub(r"(?m)^# (\w+) = \.\.\.", r"\1 = 0.2", path.read_text()))
    rig = read_rig(path, specs)
    assert (rig.dt, rig.measured) == (0.004, ("theta1", "theta2", "dtheta1", "dtheta2"))
    assert dict(zip(rig.input_columns, rig.input_joints, strict=True)) == {"tau1": 1, "tau2": 2}
    assert rig.noise_std["theta1"] == pytest.approx(1e-3, rel=0.1)  # the median of 2000 third differences
    text = path.read_text()
    assert f'"tau1" = "{command or "/joint_states"}:{inputs}"' in text
    assert '"dtheta2" = "/joint_states:velocity[knee]"' in text
    argv = ["import", str(log), "--rig", str(tmp_path / "rig.toml"), "--out", str(tmp_path / "out"), "--test", "0"]
    assert cli.main(argv) == 0
    assert (tmp_path / "out/train/000.csv").read_text().startswith("time,tau1,tau2,theta1,theta2,dtheta1,dtheta2\n")


def test_hdf5_and_names_of_a_json_log(tmp_path):
    groups = {"arm": {"time": T, "q": Q, "qd": V}, "motor": {"time": T, "tau": np.cos(T)}}
    drafted = draft_recorded(write_hdf5(tmp_path / "a.h5", groups), "pendubot", specs)
    for line in ('"theta2" = "/arm:q[1]"', '"dtheta1" = "/arm:qd[0]"', '"tau" = "/motor:tau"', "dt = 0.004"):
        assert line in drafted.text
    notes = [{"pos": float(q), "vel": float(v), "u": 0.5} for q, v in zip(Q[:, 0], V[:, 0], strict=True)]
    log = write_mcap(tmp_path / "a.mcap", {"/slide": (plain_json(), ns(T), notes)})
    drafted = draft_recorded(log, None, specs)
    assert 'type = "slide"' in drafted.text and '"dx" = "/slide:vel"' in drafted.text


def test_joints_are_counted_in_the_order_of_their_topic():
    topic = Topic("/js", "", None, ("position[hip]", "position[knee]", "velocity[knee]"))
    assert {name: str(at) for name, at in found_columns([topic]).items()} == {
        "theta1": "/js:position[hip]", "theta2": "/js:position[knee]", "dtheta2": "/js:velocity[knee]"
    }  # fmt: skip


def test_runs_with_times_of_day_are_drafted(tmp_path):
    """Silences between runs are no readings without noise."""
    rows, rng = ["Date,Time,Torque [Nm],Angle [deg]"], np.random.default_rng(0)
    for run in range(4):
        for k in range(300):
            angle = 20 * np.sin(0.05 * k) + 0.1 * rng.normal()
            rows.append(f"03.11.2026,12:{10 * run:02}:{k / 100:06.3f},{np.cos(0.1 * k):.6f},{angle:.6f}")
    (tmp_path / "a.csv").write_text("\n".join(rows) + "\n")
    assert cli.main(["init", str(tmp_path / "a.csv"), "--system", "pendulum"]) == 0
    text = (tmp_path / "rig.toml").read_text()
    assert "dt = 0.01 " in text and '"Torque" = "Torque [Nm]"' in text and '"theta1" = { from = "Angle [deg]"' in text
    noise = float(re.search(r"(?m)^theta1 = ([\d.e-]+) ", text)[1])
    assert noise == pytest.approx(np.radians(0.1), rel=0.2)  # a median of 1,200


def test_a_log_of_single_messages_is_refused(tmp_path):
    note = [{"pos": 0.1, "vel": 0.0, "u": 0.5}]
    log = write_mcap(tmp_path / "a.mcap", {"/slide": (plain_json(), ns(T[:1]), note)})
    with pytest.raises(DataError, match=r"a\.mcap: its topics have one message each; give a log of a motion"):
        draft_recorded(log, None, specs)


def test_a_log_without_a_machine_is_refused(tmp_path):
    log = write_mcap(tmp_path / "a.mcap", {"/rosout": (plain_json(), ns(T[:9]), [{"level": 3}] * 9)})
    with pytest.raises(DataError, match=r"no topic looks like joints or torques \(topics: /rosout\); write rig.toml"):
        draft_recorded(log, None, specs)
