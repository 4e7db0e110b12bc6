"""A model whose machine came from a file: stored and exported without that file, and written back for MuJoCo."""

import dataclasses
import re
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import machine_files
import mujoco
import numpy as np
import pytest
from helpers import file_rig, rig_of
from machine_files import CASES, DT, FINE, errors, friction, recorded
from machines import physics

from nnap_em import identify
from nnap_em.errors import ExportError
from nnap_em.estimate.identify import Identified, begin
from nnap_em.estimate.store import load, save
from nnap_em.machines.files.mjcf import read_machine
from nnap_em.machines.machine import Machine, unpacked
from nnap_em.machines.rig import Declared, Rig, read_rig
from nnap_em.machines.systems import specs
from nnap_em.model.effects.actuator import ActuatorLag, Saturation
from nnap_em.model.effects.body import Payload
from nnap_em.model.effects.friction import BackEmf
from nnap_em.model.effects.position import Cogging, TorsionalSpring
from nnap_em.model.simulate import declared, paper_model
from nnap_em.model.state_space import Inputs
from nnap_em.output.export.friction import FrictionForm, friction_form
from nnap_em.output.export.mjcf import as_it_is, write_mjcf
from nnap_em.output.export.model import write_model
from nnap_em.output.export.urdf import write_urdf

HELD = Inputs.held(jnp.ones(1))
MACHINES = Path(machine_files.__file__).parent / "machines"


def _rig(**changes) -> Rig:
    rig = read_rig(MACHINES / "cartpole.toml", specs)
    return dataclasses.replace(rig, **changes)


def _logs(rig: Rig, sequences: int = 2, rows: int = 40, seed: int = 0):
    case, text = CASES["cartpole"], (MACHINES / "cartpole.xml").read_text()
    noise = np.asarray([case.noise, 0.002])
    logs, x = recorded(text, friction(case), case.push, noise, sequences=sequences, rows=rows, seed=seed)
    places = [unpacked(rig.machine).states.index(name) for name in rig.measured]
    return logs._replace(y=logs.y[..., places]), x


def _begun(effects=(), **changes) -> Identified:
    rig = _rig(**changes)
    fitted = begin(rig, _logs(rig)[0], key=jax.random.key(0), effects=effects)
    return fitted._replace(state=fitted.state._replace(hessian=jnp.eye(fitted.state.hessian.shape[0])))


# --- stored and exported


@pytest.fixture(scope="module")
def uncertain() -> Identified:
    return _begun(parameters={"pole.mass": Declared(0.2, 0.05), "pole.com.z": Declared(-0.25, 0.02)})


def test_a_model_is_loaded_and_exported_without_the_file_and_mujoco(uncertain, tmp_path, monkeypatch):
    save(tmp_path / "model.npz", uncertain)
    monkeypatch.setitem(sys.modules, "mujoco", None)
    again = load(tmp_path / "model.npz")
    assert again.rig == uncertain.rig
    x = jnp.asarray([0.1, 0.4, -0.3, 1.0])
    one, other = (eqx.filter_jit(lambda m: m.transition(x, HELD))(fit.model) for fit in (uncertain, again))
    np.testing.assert_array_equal(one, other)
    write_model(again, tmp_path / "out")
    assert '"unit": "kg"' in (tmp_path / "out/parameters.json").read_text()


# --- written back


def _of_file(folder: Path, file: str, more: str, effects=()) -> tuple[Machine, Identified]:
    """A machine of `machines/`, and a fit of it before its first epoch, its first joint read and driven."""
    (folder / file).write_text((Path(__file__).parent / "machines" / file).read_text())
    machine = read_machine(folder / file)
    rig = rig_of(folder, file_rig(file, [machine.joints[0].name], more, friction="none"))
    t = 0.01 * np.arange(30.0)
    logs = machine_files.Dataset(t[None], np.sin(t)[None, :, None], np.sin(t)[None, :, None], np.ones((1, 30), bool))
    return machine, begin(rig, logs, key=jax.random.key(0), effects=effects)


SERVO = [
    "the position servo of u: kp = 9",
    "actuator_lag at joint 1: tau = 0.03 (its command is that of a servo)",
]
INPUT = '[input]\ncolumns = ["u"]\njoints = [1]\n'


@pytest.mark.parametrize(
    ("file", "servo", "left"),
    [("branch.xml", "", []), ("arm.urdf", 'kind = "position"\nkp = 9.0\n', SERVO)],
    ids=["branch", "urdf, servo"],
)
def test_a_written_machine_is_the_same_in_mujoco(tmp_path, file, servo, left):
    effects = (ActuatorLag.of(0.03, joint=1),) if servo else ()
    machine, fitted = _of_file(tmp_path, file, INPUT + servo, effects)
    joints = [joint.name for joint in machine.joints]
    assert write_mjcf(fitted, tmp_path / "out.xml") == left
    written, system = mujoco.MjModel.from_xml_path(str(tmp_path / "out.xml")), fitted.model.system
    states = np.random.default_rng(0).uniform(-2.0, 2.0, (3, len(joints)))
    forces = jax.jit(lambda states: jax.lax.map(lambda q: (system.mass(q), system.bias(q, 0.0 * q)), states))
    for q, mass, bias in zip(states, *forces(states), strict=True):
        (other,), (force,) = physics(written, [(q, 0.0 * q)])
        np.testing.assert_allclose(other, mass, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(force, bias, atol=1e-8)
    np.testing.assert_allclose(written.dof_damping, [joint.damping for joint in machine.joints])
    np.testing.assert_allclose(written.dof_frictionloss, [joint.dry for joint in machine.joints])
    again = read_machine(tmp_path / "out.xml")
    motors = [motor[:2] for motor in machine.motors]
    assert [motor[:2] for motor in again.motors] == [*motors, ("u", 0)]  # the rig drives a joint without a motor
    assert again.joint_sensors == machine.joint_sensors


@pytest.mark.parametrize("part", ["", "locked = { reach = 0.1 }\n"], ids=["whole", "a joint held"])
def test_a_urdf_file_is_written_again_with_the_numbers_of_the_fit(tmp_path, part):
    """MuJoCo's mass matrix and weight of it, which has all its joints; shapes, limits and fixed links stay."""
    uncertain = (
        "[model.uncertain]\nforearm.mass = { mean = 1.3, std = 0.1 }\nlift.armature = { mean = 0.2, std = 0.1 }\n"
    )
    effects = (
        Payload(jnp.asarray(0.4), joint=3 if not part else 2),
        BackEmf.of(0.5, joint=2),
        Saturation.of(7.0, joint=1),
    )
    _, fitted = _of_file(tmp_path, "arm.urdf", part + uncertain + INPUT, effects)
    left = write_urdf(fitted, tmp_path / "out.urdf")
    assert left == ["the armature of lift"]
    text = (tmp_path / "out.urdf").read_text()
    for kept in ("package://arm/meshes/shoulder.stl", '<link name="flange" />', 'lower="-2" upper="2" effort="50"'):
        assert kept in text
    model = mujoco.MjModel.from_xml_string(re.sub(r"(?s)<visual>.*?</visual>", "", text))
    np.testing.assert_allclose(model.dof_damping[:2], [0.0, 0.8])
    np.testing.assert_allclose(model.dof_frictionloss[:2], [0.0, 0.5])
    assert 'effort="7.0"' in text
    system = as_it_is(fitted)
    dof = len(system.coordinates)
    for q in np.random.default_rng(0).uniform(-1.0, 1.0, (3, 3)):
        q[2] = 0.1 if part else q[2]
        mass, weight = jax.jit(lambda q: (system.mass(q), system.bias(q, 0.0 * q)))(q[:dof])
        (other,), (force,) = physics(model, [(q, 0.0 * q)])
        np.testing.assert_allclose(other[:dof, :dof] + np.diag([0.0, 0.2, 0.0][:dof]), mass, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(force[:dof], weight, rtol=1e-9, atol=1e-9)


OWNED = """<mujoco model="owned">
<!-- the arm by the window -->
<compiler meshdir="meshes"/>
<default><joint damping="0.3"/><default class="red"><geom rgba="1 0 0 1"/><joint armature="0.0123456789012"/></default></default>
<asset><mesh name="hull" file="hull.obj"/></asset>
<worldbody><geom name="floor" type="plane" size="1 1 0.1"/><frame pos="0 0 0.1" euler="0 0 30">
  <body name="upper" childclass="red"><joint name="a" axis="0 1 0" range="-90 90"/>
    <geom name="tube" type="capsule" fromto="0 0 0 0.3333333333333 0 0" size="0.02"/>
    <body name="lower" pos="0.3333333333333 0 0"><joint name="b" axis="0 1 0"/>
      <inertial pos="0.1 0 0" mass="0.3" diaginertia="0.001 0.002 0.002"/><geom name="shell" type="mesh" mesh="hull"/>
    </body></body></frame></worldbody>
<contact><exclude body1="upper" body2="lower"/></contact>
<actuator><motor name="m" joint="a" gear="2" ctrlrange="-3 3"/></actuator>
<sensor><jointpos name="encoder" joint="a"/></sensor>
</mujoco>"""  # noqa: E501
HULL = "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nv 0 0 0.1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
OWNED_RIG = file_rig("owned.xml", ("encoder", "b"), friction="none")


def _owned(folder: Path) -> Identified:
    """A fit of a machine with shapes, one of them in a file, frames, classes and degrees."""
    (folder / "meshes").mkdir()
    for name, text in {"owned.xml": OWNED, "rig.toml": OWNED_RIG, "meshes/hull.obj": HULL}.items():
        (folder / name).write_text(text)
    t = 0.01 * np.arange(30.0)[None]
    read = np.stack([np.sin(t), np.cos(t)], -1)
    logs = machine_files.Dataset(t, np.sin(t)[..., None], read, np.ones((1, 30), bool))
    return begin(read_rig(folder / "rig.toml", specs), logs, key=jax.random.key(0))


def test_a_written_file_is_that_of_its_owner(tmp_path):
    """Shapes, classes, frames, limits, the comment; mass matrix and bias to 1e-12 of their size."""
    (tmp_path / "elsewhere").mkdir()
    assert write_mjcf(_owned(tmp_path), tmp_path / "elsewhere" / "out.xml") == []
    text = (tmp_path / "elsewhere" / "out.xml").read_text()
    for part in ("the arm by the window", 'meshdir="../meshes"', '<default class="red">', "<frame", "<exclude"):
        assert part in text
    one, other = (mujoco.MjModel.from_xml_path(str(tmp_path / file)) for file in ("owned.xml", "elsewhere/out.xml"))
    for field in ("geom_type", "geom_size", "geom_pos", "geom_quat", "geom_rgba", "jnt_range", "actuator_ctrlrange"):
        np.testing.assert_allclose(getattr(other, field), getattr(one, field), rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose([other.dof_armature, other.dof_damping], [[0.0123456789012] * 2, [0.3] * 2], rtol=1e-14)
    assert [other.geom(i).name for i in range(other.ngeom)] == ["floor", "tube", "shell"]
    states = np.random.default_rng(0).uniform(-3.0, 3.0, (5, 2, 2))
    for ours, theirs in zip(physics(other, states), physics(one, states), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-12)


def test_a_fit_that_has_no_machine_file_is_refused(uncertain, tmp_path):
    with pytest.raises(ExportError, match=r"cartpole.xml is no URDF file; write --mjcf"):
        write_urdf(uncertain, tmp_path / "out.urdf")
    model = dataclasses.replace(uncertain.model, system=paper_model().system)
    built_in = uncertain._replace(rig=declared("acrobot", paper_model()), state=uncertain.state._replace(best=model))
    with pytest.raises(ExportError, match="'acrobot' is built in, and has no file to be written back to; "):
        write_mjcf(built_in, tmp_path / "out.xml")


def test_found_springs_loads_and_changed_numbers_are_written_and_the_rest_is_told(tmp_path):
    spring = TorsionalSpring.of(0.8, 0.4, 0.0, 0.0, joint=2)
    effects = (spring, Payload(jnp.asarray(0.1), joint=2), Cogging.of(0.1, 0.0, 6.0, joint=1))
    fitted = _begun(effects, parameters={"cart.mass": Declared(1.3, 0.1), "rail.armature": Declared(0.2, 0.1)})
    left = write_mjcf(fitted, tmp_path / "out.xml")
    reason = "cogging at joint 1: amplitude = 0.1, k = 6, phase = 0 (it has no plain element in MuJoCo)"
    assert [line for line in left if "friction" not in line] == [reason]
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "out.xml"))
    assert model.body("pole").mass[0] == pytest.approx(0.3)
    assert model.body("cart").mass[0] == pytest.approx(1.3)
    np.testing.assert_allclose([np.ravel(model.jnt_stiffness[1])[0], model.qpos_spring[1]], [0.8, 0.5])
    assert model.dof_armature[0] == pytest.approx(0.2)


V = np.linspace(-2.0, 2.0, 160)


def _form(torque, std: float = 1e-3, v=V) -> FrictionForm:
    return friction_form(v, torque, np.full(160, std))


def test_coulomb_and_viscous_friction_are_read_off_a_curve():
    form = _form(-0.3 * np.sign(V) - 0.2 * V, 0.01)
    np.testing.assert_allclose([form.coulomb, form.viscous, form.offset, form.missed], [0.3, 0.2, 0.0, 0.0], atol=1e-6)
    form = _form(0.1 * V, 0.01)
    assert (form.coulomb, form.viscous) == (0.0, 0.0) and form.missed == pytest.approx(1.0)  # friction never pushes
    form = _form(0.05 - (0.3 + 0.2 * np.exp(-((V / 0.15) ** 2))) * np.tanh(V / 0.02) - 0.2 * V)
    np.testing.assert_allclose(form[:4], [0.3, 0.5, 0.2, 0.05], rtol=0.01)  # with a dip and a constant


def test_a_dip_that_the_sign_hides_is_none():
    """Friction that rises over 2 rad/s, a little faster at first: no torque breaks away."""
    form = _form(-(0.3 + 0.6 * np.exp(-((4 * V / 0.5) ** 2))) * np.tanh(4 * V / 2.0), v=4 * V)
    assert form.breakaway == form.coulomb


# --- identified, from logs that MuJoCo made


def _ahead(text: str, x: np.ndarray, u: np.ndarray, rows: int = 100) -> float:
    """RMS error of the coordinates of MuJoCo with a file, every half second begun at the true state [m or rad]."""
    model = mujoco.MjModel.from_xml_string(text)
    model.opt.timestep, model.opt.integrator = DT / FINE, int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
    model.jnt_limited[:] = 0
    wrong = []
    for path, push in zip(x, u, strict=True):
        for start in range(0, len(path) - rows, 50):
            data = mujoco.MjData(model)
            data.qpos[:], data.qvel[:] = np.split(path[start], 2)
            for k in range(start, start + rows):
                data.ctrl[:] = push[k]
                mujoco.mj_step(model, data, FINE)
                if k + 1 - start in (25, 50, 100):
                    wrong.append(data.qpos - path[k + 1, : model.nv])
    return float(np.sqrt(np.mean(np.square(wrong))))


@pytest.mark.slow  # fast: test_a_written_machine_is_the_same_in_mujoco
def test_friction_of_an_unread_pole_is_found_and_the_written_file_predicts_better(tmp_path):
    rig = _rig(parameters={"pole.mass": Declared(0.23, 0.05)})  # the owner's belief is off; the plant has 0.2
    data, x = _logs(rig, sequences=8, rows=400)
    fitted = identify(rig, data, key=jax.random.key(0), epochs=20)
    cart, pole = errors(fitted.model.unknown, friction(CASES["cartpole"]), x)
    assert cart < 0.03 and pole < 0.1
    assert abs(float(fitted.model.system.parameter("pole.mass")) - 0.2) < 0.01
    before = (MACHINES / "cartpole.xml").read_text().replace('mass="0.2"', 'mass="0.23"')
    write_mjcf(fitted, tmp_path / "identified.xml")
    logs, x = _logs(rig, sequences=4, rows=110, seed=7)
    texts = ((tmp_path / "identified.xml").read_text(), before)
    after, believed = (_ahead(text, x, logs.u) for text in texts)
    assert after < 0.3 * believed
    mass = mujoco.MjModel.from_xml_path(str(tmp_path / "identified.xml")).body("pole").mass
    np.testing.assert_allclose(mass, float(fitted.model.system.parameter("pole.mass")), rtol=1e-6)
