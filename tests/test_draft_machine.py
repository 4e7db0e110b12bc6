"""The first rig.toml for a machine in a file: joints, motors and sensors are found by name, and import takes it."""

import functools
import re
from pathlib import Path

import numpy as np
import pytest
from recorders import Q, T, robot_log

from nnap_em.commands import cli
from nnap_em.data.dataset import DataError
from nnap_em.data.logs import read_logs
from nnap_em.data.rig import read_rig
from nnap_em.init.from_machine import draft_machine
from nnap_em.systems import specs

LOG = functools.partial(robot_log, command="/torques/commands", joints=("knee", "hip"))
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
        (None, MOTORS, {"m_hip": "/joint_states:effort[hip]", "m_knee": "/joint_states:effort[knee]"}),
        (None, "", {"tau_hip": "/joint_states:effort[hip]", "tau_knee": "/joint_states:effort[knee]"}),
    ],
)
def test_a_robot_of_a_file_is_drafted_and_imported(tmp_path, command, motors, inputs):
    model = _leg(tmp_path / "models" / "leg.xml", motors)
    log, bench = LOG(tmp_path / "a.mcap", command=command), tmp_path / "bench"
    bench.mkdir()
    assert cli.main(["init", str(log), "--model", str(model), "--out", str(bench)]) == 0
    text = (bench / "rig.toml").read_text()
    assert 'file = "../models/leg.xml"' in text
    assert all(f'"{name}" = "{at}"' in text for name, at in inputs.items())
    rig = read_rig(bench / "rig.toml", specs)
    assert (rig.dt, rig.measured, rig.input_columns) == (0.004, ("hip", "knee", "dhip", "dknee"), tuple(inputs))
    assert rig.input_joints == (1, 2)
    assert rig.noise_std["hip"] == pytest.approx(1e-3, rel=0.1)  # the median of 2000 third differences
    out = tmp_path / "out"
    assert cli.main(["import", str(log), "--rig", str(bench / "rig.toml"), "--out", str(out), "--test", "0"]) == 0
    data = read_logs(out / "train", read_rig(out / "rig.toml", specs)).data
    q = np.asarray(data.y)[0, :, :2]
    np.testing.assert_allclose(q, Q[: len(q)], atol=6e-3)  # the knee is the knee, although it stands first


def test_servos_of_a_file_are_drafted_with_what_may_be_uncertain(tmp_path):
    """A measured effort is not taken for the goal of a servo."""
    servo = '<position name="m_hip" joint="hip" kp="40" kv="2"/>'
    model = _leg(tmp_path / "leg.xml", servo)
    made = draft_machine(LOG(tmp_path / "a.mcap", command="/goals/commands"), model, tmp_path)
    assert '# [input."m_hip"]    # the goal of a position servo; in the file kp = 40, kd = 2' in made.text
    none = draft_machine(LOG(tmp_path / "b.mcap", command=None), model, tmp_path)
    assert "effort" not in none.text.partition("[import")[0]


def test_what_is_uncertain_can_be_said_by_taking_marks_away(tmp_path):
    made = draft_machine(LOG(tmp_path / "a.mcap"), _leg(tmp_path / "leg.xml"), tmp_path)
    (tmp_path / "rig.toml").write_text(re.sub(r"(?m)^# (\w+\.\w+ = )", r"\1", made.text))
    rig = read_rig(tmp_path / "rig.toml", specs)
    assert {name: (p.mean, p.std) for name, p in rig.parameters.items()} == {
        "thigh.mass": (1.5, 0.15), "shank.mass": (1.0, 0.1), "hip.armature": (0.02, 0.02), "knee.armature": (0.0, 0.01),
    }  # fmt: skip


def test_plain_columns_by_names_of_joints_sensors_and_by_number(tmp_path):
    sensors = '<jointpos name="hip_encoder" joint="hip"/>'
    model = _leg(tmp_path / "leg.xml", '<motor name="m_hip" joint="hip"/>', sensors)

    def drafted(header: str):
        path = tmp_path / "log.csv"
        rows = np.column_stack([T, Q, T**2])
        np.savetxt(path, rows, delimiter=",", header=header, comments="", fmt="%.9g")
        made = draft_machine(path, model, tmp_path)
        (tmp_path / "rig.toml").write_text(made.text)
        return read_rig(tmp_path / "rig.toml", specs), made.text

    rig, text = drafted("time,hip,knee,m_hip")
    assert (rig.measured, rig.input_columns, rig.dt) == (("hip", "knee"), ("m_hip",), 0.004)
    assert "[import.columns]" not in text
    rig, text = drafted("t,hip_encoder,knee,tau_hip")
    assert rig.measured == ("hip_encoder", "knee")
    assert '"m_hip" = "tau_hip"' in text and '"knee"' in text
    rig, text = drafted("t,q0,q1,u")
    assert (rig.measured, rig.input_columns) == (("hip", "knee"), ("m_hip",))
    assert '"hip" = "q0"' in text and '"knee" = "q1"' in text and '"m_hip" = "u"' in text


def test_a_log_of_another_machine_is_refused_by_names(tmp_path):
    log = LOG(tmp_path / "a.mcap", joints=("shoulder", "elbow"), command=None)
    with pytest.raises(DataError, match=r"a\.mcap: nothing in it is called as a joint of .*leg\.xml \(hip, knee\)"):
        draft_machine(log, _leg(tmp_path / "leg.xml"), tmp_path)
