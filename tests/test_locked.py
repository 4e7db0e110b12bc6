"""A part of a machine file: joints that are held, against MuJoCo's own model of the whole with those joints held."""

import dataclasses
import tomllib
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from helpers import file_rig, written_again
from machines import arm, physics

from nnap_em.errors import MachineError, RigError
from nnap_em.estimate.em.build import build_system
from nnap_em.estimate.identify import begin
from nnap_em.logs.dataset import Dataset
from nnap_em.machines.files.mjcf import Part, read_machine
from nnap_em.machines.rig import read_rig
from nnap_em.machines.systems import specs
from nnap_em.output.export.mjcf import write_mjcf

ROOT = Path(__file__).resolve().parents[1]

GRIPPER = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body name="base" pos="0 0 .2"><joint name="yaw" axis="0 0 1"/>
      <inertial pos=".02 0 .1" mass="2" diaginertia=".02 .03 .01"/>
      <body name="link" pos=".1 0 .3" euler=".3 -.2 .5"><joint name="elbow" axis="0 1 .2" pos="0 .02 .01" ref=".1"/>
        <inertial pos=".1 .02 0" mass="1.2" fullinertia=".01 .02 .015 .001 .002 -.001"/>
        <body name="hand" pos=".3 0 0" quat=".8 .2 -.1 .3">
          <joint name="slide" type="slide" axis="1 1 0"/><joint name="wrist" axis="1 0 .3" pos=".01 0 0"/>
          <joint name="tool" axis="0 1 0" pos="0 0 .03"/>
          <inertial pos="0 .01 .03" mass=".5" diaginertia=".002 .001 .001"/>
          <body name="left" pos="0 .02 .05"><joint name="finger1" type="slide" axis="0 1 0"/>
            <inertial pos="0 0 .02" mass=".1" diaginertia="1e-4 1e-4 1e-4"/></body>
          <body name="right" pos="0 -.02 .05"><joint name="finger2" type="slide" axis="0 -1 0"/>
            <inertial pos="0 0 .02" mass=".1" diaginertia="1e-4 1e-4 1e-4"/><site name="tip" pos="0 .01 .04"/></body>
        </body>
      </body>
    </body>
  </worldbody>
  <tendon><fixed name="split"><joint joint="finger1" coef=".5"/><joint joint="finger2" coef=".5"/></fixed></tendon>
  <equality><joint joint1="finger2" joint2="finger1" polycoef=".001 1 0 0 0"/></equality>
  <actuator><motor name="t1" joint="yaw" gear="2"/><position name="grip" tendon="split" kp="10"/>
    <motor name="t2" joint="wrist" gear="3"/></actuator>
</mujoco>
"""
"""Fingers that follow each other, driven by a servo over a tendon; a hand with three joints."""


def _rig(folder: Path, machine: str, model: str, name: str = "machine.xml", measured: str = "") -> Path:
    (folder / name).write_text(machine)
    (folder / "rig.toml").write_text(file_rig(name, (measured,), f"{model}\n[input]\ncolumns = []\njoints = []\n"))
    return folder / "rig.toml"


CASES = {  # name: (machine, what is held, joints that are held besides)
    "a chain, its base and its end": (
        arm(4), 'joints = ["joint2", "joint3"]\nlocked = { joint4 = 0.4 }', {"joint1": 0.0},
    ),
    "a tree": ((ROOT / "tests/machines/branch.xml").read_text(), "locked = { left = -0.6, trunk_x = 0.2 }", {}),
    "a gripper that follows": (
        GRIPPER, 'joints = ["yaw", "wrist"]\nlocked = { finger1 = 0.02 }',
        {"finger2": 0.021, "elbow": 0.1, "slide": 0.0, "tool": 0.0},
    ),
}  # fmt: skip


@pytest.mark.filterwarnings("ignore:.*are left out, as friction is learned:nnap_em.machines.rig.RigWarning")
@pytest.mark.parametrize(("machine", "line", "held"), CASES.values(), ids=CASES)
def test_mass_and_bias_are_those_of_the_whole_with_joints_held(machine, line, held, tmp_path):
    model, held = mujoco.MjModel.from_xml_string(machine), tomllib.loads(line)["locked"] | held
    names = [model.joint(j).name for j in range(model.njnt)]
    free = [j for j, name in enumerate(names) if name not in held]
    system = build_system(read_rig(_rig(tmp_path, machine, line, measured=names[free[0]]), specs))
    assert system.coordinates == tuple(names[j] for j in free)
    rng = np.random.default_rng(0)
    q, v = rng.uniform(-3.0, 3.0, (5, model.nv)), np.zeros((5, model.nv))
    q[:, [names.index(name) for name in held]] = list(held.values())
    v[:, free] = rng.uniform(-3.0, 3.0, (5, len(free)))
    forces = lambda row: (system.mass(row[0]), system.bias(*row))  # noqa: E731
    masses, biases = jax.jit(lambda rows: jax.lax.map(forces, rows))((jnp.asarray(q[:, free]), jnp.asarray(v[:, free])))
    mass, bias = physics(model, np.stack([q, v], axis=1))
    np.testing.assert_allclose(masses, mass[:, free][..., free], atol=1e-10, rtol=1e-10)
    np.testing.assert_allclose(biases, bias[:, free], atol=1e-10, rtol=1e-10)


def test_a_loop_that_held_joints_close_is_no_obstacle(tmp_path):
    """A connection of two bodies that hold still against each other."""
    loop = GRIPPER.replace("</equality>", '<connect body1="left" body2="right" anchor="0 0 0"/></equality>')
    (tmp_path / "loop.xml").write_text(loop)
    part = Part(None, {"finger1": 0.0, "finger2": 0.001})
    assert [joint.name for joint in read_machine(tmp_path / "loop.xml", part).joints][-1] == "tool"
    open_loop = GRIPPER.replace("</equality>", '<connect body1="link" body2="right" anchor="0 0 0"/></equality>')
    (tmp_path / "loop.xml").write_text(open_loop)
    said = (
        r"1 equality constraints on joints that move; .* \[model\] locked = \{ slide = 0.0, wrist = 0.0, tool = 0.0 \}"
    )
    with pytest.raises(MachineError, match=said):
        read_machine(tmp_path / "loop.xml", part)


BALL = arm(1).replace("</worldbody>", '<body><joint name="ball" type="ball"/><geom size=".1"/></body></worldbody>')
BAD = {
    "a ball at a number": (BALL, "locked = { ball = 0.3 }", "'ball' turns as a ball.*; name those that move in joints"),
    "an unknown joint is held": (GRIPPER, "locked = { elbo = 0.0 }", r"locked names 'elbo', .*did you mean 'elbow'"),
    "no names": (GRIPPER, "joints = []", r"\[model\] joints: found \[\]; write the names of the joints that move"),
    "nothing moves": (arm(1), "locked = { joint1 = 0.0 }", "it has no joint, or all are held"),
}


@pytest.mark.filterwarnings("ignore::nnap_em.machines.rig.RigWarning")
@pytest.mark.parametrize(("machine", "line", "said"), BAD.values(), ids=BAD)
def test_what_cannot_be_held_is_refused_with_the_line_to_add(machine, line, said, tmp_path):
    with pytest.raises(RigError, match=said):
        read_rig(_rig(tmp_path, machine, line, measured="yaw"), specs)


def test_a_part_is_written_back_as_the_part(tmp_path):
    """Without the held joints and what hung on them; sites of joined bodies stand where they stood."""
    line = "locked = { finger1 = 0.0, finger2 = 0.0, wrist = 0.9, elbow = 0.0 }"
    rig = read_rig(_rig(tmp_path, GRIPPER, line, measured="yaw"), specs)
    assert written_again(rig, tmp_path) == rig
    rig = dataclasses.replace(rig, measured=("yaw", "slide", "tool"), friction=False)
    t = 0.01 * np.arange(30.0)[None]
    logs = Dataset(t, np.zeros((1, 30, 0)), np.repeat(np.sin(t)[..., None], 3, axis=2), np.ones((1, 30), bool))
    fitted = begin(rig, logs, key=jax.random.key(0))
    write_mjcf(fitted, tmp_path / "out.xml")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "out.xml"))
    assert [model.joint(j).name for j in range(model.njnt)] == ["yaw", "slide", "tool"]
    assert (model.nbody, model.neq, model.ntendon, model.site("tip").id) == (3, 0, 0, 0)
    data, whole = mujoco.MjData(model), mujoco.MjModel.from_xml_string(GRIPPER)
    mass, other = np.zeros((3, 3)), mujoco.MjData(whole)
    data.qpos[:] = other.qpos[[0, 2, 4]] = 0.3, -0.05, 0.7
    other.qpos[[1, 3, 5, 6]] = 0.0, 0.9, 0.0, 0.0
    for one, of in ((data, model), (other, whole)):
        mujoco.mj_forward(of, one)
    mujoco.mj_fullM(model, data, mass)
    np.testing.assert_allclose(mass, jax.jit(lambda q: fitted.model.system.mass(q))(jnp.asarray(data.qpos)), atol=1e-12)
    np.testing.assert_allclose(data.site("tip").xpos, other.site("tip").xpos, atol=1e-12)
