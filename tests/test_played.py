"""Laws of the catalogue played by MuJoCo from the written file, beside the library."""

import ctypes
import dataclasses
import shutil
import subprocess
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from helpers import file_rig, optimised

from nnap_em.data.dataset import Dataset
from nnap_em.data.rig import read_rig
from nnap_em.effects import catalogue
from nnap_em.effects.function import Axis, UnknownFunction
from nnap_em.export.c99 import torques, write_c
from nnap_em.export.mjcf import write_mjcf
from nnap_em.export.model import ExportError
from nnap_em.export.urdf import write_urdf
from nnap_em.fit.identify import Identified, begin
from nnap_em.machines.mjcf import read_machine
from nnap_em.systems import specs

a, c = jnp.asarray, catalogue
CART = """<mujoco model="two"><compiler angle="radian"/><worldbody>
<body name="cart"><joint name="rail" type="slide" axis="1 0 0"/>
<inertial pos="0 0 0" mass="1" diaginertia="0.002 0.002 0.002"/>
<body name="pole"><joint name="pole" axis="0 1 0"/>
<inertial pos="0 0 -0.25" mass="0.5" diaginertia="0.005 0.005 0.0001"/><site name="hand" pos="0 0 -0.4"/></body></body>
</worldbody><actuator><motor name="push" joint="rail"/><motor name="turn" joint="pole" gear="2"/></actuator></mujoco>"""
ARM = CART.replace('name="rail" type="slide" axis="1 0 0"', 'name="rail" axis="0 1 0"')
RIG = file_rig("two.xml", ("rail", "pole"), '[input]\ncolumns = ["push", "turn"]', friction="none")
ROWS, X0 = 150, np.array([0.0, 0.3, 0.0, 0.0])


def _fit(folder: Path, effects=(), xml: str = CART, more: str = "") -> tuple[Identified, Dataset]:
    (folder / "two.xml").write_text(xml)
    (folder / "rig.toml").write_text(RIG + more)
    rig, rng, t = read_rig(folder / "rig.toml", specs), np.random.default_rng(0), 0.01 * np.arange(ROWS)
    tones = [np.sin(2 * np.pi * rng.uniform(0.3, 1.8, (4, 1)) * t + rng.uniform(0, 6.28, (4, 1))) for _ in range(2)]
    u = np.stack([size * 1.5 * tone.mean(axis=0) for size, tone in zip((6.0, 0.4), tones, strict=True)], axis=-1)
    data = Dataset(t[None], u[None], np.stack([np.sin(3 * t), np.cos(2 * t)], -1)[None], np.ones((1, ROWS), bool))
    fitted = begin(rig, data, key=jax.random.key(0), effects=effects)
    return fitted._replace(state=fitted.state._replace(hessian=jnp.eye(fitted.state.hessian.shape[0]))), data


def _library(fitted: Identified, data: Dataset) -> np.ndarray:
    """Coordinates of the library's own motion, integrated finely."""
    model = dataclasses.replace(fitted.model, substeps=40)
    x = jnp.concatenate([a(X0), jnp.zeros(model.log_q.shape[0] - 4)])
    with optimised():
        step = lambda x, u: (model.transition(x, u), x)  # noqa: E731
        return np.asarray(jax.lax.scan(step, x, model.inputs(jax.tree.map(lambda v: a(v[0]), data)))[1])[:, :2]


def _played(path: Path, data: Dataset) -> np.ndarray:
    """Coordinates of MuJoCo's motion."""
    model = mujoco.MjModel.from_xml_path(str(path))
    state, out = mujoco.MjData(model), []
    state.qpos[:] = X0[:2]
    for u in data.u[0]:
        out.append(state.qpos.copy())
        state.ctrl[:] = u
        mujoco.mj_step(model, state, round(0.01 / model.opt.timestep))
    return np.array(out)


STATIC = {
    "torsional_spring": c["torsional_spring"].of(0.8, 0.3, 0.1, 0.2, joint=2),
    "torque_offset": c["torque_offset"](a(0.3), joint=2),
    "motor_back_emf": c["motor_back_emf"](a(0.5), joint=1),
    "payload": c["payload"](a(0.2), joint=2),
    "motor_gain": c["motor_gain"](a(0.1), joint=1),
    "saturation": c["saturation"](a(3.0), joint=1),
}
"""Laws without a memory that the file holds."""
OVER_TIME = {"input_delay": c["input_delay"](a(0.0234), joint=1), "actuator_lag": c["actuator_lag"](a(0.03), joint=2)}
UNPLACED = {
    "dead_zone": c["dead_zone"](a(0.8), joint=1),
    "cogging": c["cogging"].of(0.2, 0.1, 5.97, 6.0, 0.05, 0.03, joint=2),
    "load_friction": c["load_friction"](a(0.1), a(0.1), names=("push", "drail"), joint=1),
    "unknown_function": UnknownFunction(
        a(0.2 * np.sin(np.arange(20.0))), (Axis(("pole",), -2.0, 2.0, False, 20),), joint=2
    ),
    "eddy_brake": c["eddy_brake"](a(0.05), a(0.02), joint=2),
}


def _accelerations(fitted: Identified, q, v, u) -> np.ndarray:
    """Those of the library, of states without an input before them."""
    rows = Dataset(np.zeros(1), u[None], np.zeros((1, 2)), np.ones(1, bool))
    inputs = jax.tree.map(lambda x: x[0], fitted.model.inputs(rows))
    return np.asarray(fitted.model.rate(a([*q, *v]), inputs, jnp.zeros(2)))[2:4]


@pytest.mark.parametrize("name", STATIC)
def test_a_law_in_the_file_accelerates_as_in_the_library(tmp_path, name):
    """At random states and inputs, by MuJoCo; without it, another way."""
    (fitted, _), (bare, _) = _fit(tmp_path, (STATIC[name],)), _fit(tmp_path)
    assert write_mjcf(fitted, tmp_path / "out.xml") == []
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "out.xml"))
    state, other = mujoco.MjData(model), []
    for q, v, u in np.random.default_rng(0).normal(size=(20, 3, 2)) * [[1.0], [2.0], [4.0]]:
        state.qpos[:], state.qvel[:], state.ctrl[:] = q, v, u
        mujoco.mj_forward(model, state)
        np.testing.assert_allclose(state.qacc, _accelerations(fitted, q, v, u), rtol=1e-9, atol=1e-9)
        other.append(np.abs(state.qacc - _accelerations(bare, q, v, u)).max())
    assert np.max(other) > 0.05


@pytest.mark.parametrize("name", OVER_TIME)
def test_a_command_over_time_moves_as_in_the_library(tmp_path, name):
    (fitted, data), (bare, _) = _fit(tmp_path, (OVER_TIME[name],)), _fit(tmp_path)
    assert write_mjcf(fitted, tmp_path / "out.xml") == []
    with_law, without = _library(fitted, data), _library(bare, data)
    off = np.linalg.norm(_played(tmp_path / "out.xml", data) - with_law)
    assert off < 0.01 * np.linalg.norm(with_law - without)  # half a time step of 5e-4 s


def test_laws_without_a_plain_element_are_named_and_the_file_is_that_without_them(tmp_path):
    (fitted, _), (bare, _) = _fit(tmp_path, tuple(UNPLACED.values())), _fit(tmp_path)
    left = write_mjcf(fitted, tmp_path / "out.xml")
    assert [line.split()[0] for line in left] == [*UNPLACED]
    assert write_mjcf(bare, tmp_path / "bare.xml") == []
    one, other = (mujoco.MjModel.from_xml_path(str(tmp_path / file)) for file in ("out.xml", "bare.xml"))
    np.testing.assert_array_equal(one.body_mass, other.body_mass)
    assert one.nu == other.nu == 2 and "Not in here:" in (tmp_path / "out.xml").read_text()


def test_a_limit_before_a_law_without_an_element_has_none_either(tmp_path):
    effects = STATIC["saturation"], UNPLACED["dead_zone"], STATIC["motor_gain"]
    (fitted, _) = _fit(tmp_path, effects)
    left = write_mjcf(fitted, tmp_path / "out.xml")
    assert [line.split()[0] for line in left] == ["saturation", "dead_zone"]
    assert "it acts before dead_zone" in left[0]


@pytest.mark.skipif(shutil.which("gcc") is None, reason="needs gcc")
def test_compiled_c_gives_the_torques_of_the_library(tmp_path):
    position = c["position_dependent_friction"].of(0.3, 0.2, 2.0, joint=2)
    laws = (
        STATIC["payload"],
        position,
        *(UNPLACED[n] for n in ("cogging", "load_friction", "unknown_function", "dead_zone")),
    )
    fitted, _ = _fit(tmp_path, laws)
    assert write_c(fitted, tmp_path / "arm.c") == ["dead_zone at joint 1"]
    flags = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC", "arm.c", "-o", "arm.so", "-lm"]
    subprocess.run(["gcc", *flags], cwd=tmp_path, check=True)
    compiled, (_, feedforward, _) = ctypes.CDLL(str(tmp_path / "arm.so")), torques(fitted)
    rng, array = np.random.default_rng(0), lambda values: (ctypes.c_double * len(values))(*values)
    for _ in range(20):
        q, v, acceleration = rng.normal(size=(3, 2))
        out = array([0.0, 0.0])
        compiled.arm_feedforward(array(q), array(v), array(acceleration), array([0.3]), out)
        np.testing.assert_allclose(out, feedforward(a(q), a(v), a(acceleration), a([0.3]))[0], rtol=1e-9, atol=1e-9)
        compiled.arm_friction(array(v), out)
        np.testing.assert_allclose(out, fitted.model.unknown(a(v)), rtol=1e-9, atol=1e-9)


def test_the_feed_forward_torque_gives_its_acceleration(tmp_path):
    fitted, _ = _fit(tmp_path, (STATIC["payload"], UNPLACED["cogging"], UNPLACED["eddy_brake"]))
    q, v, wanted = np.random.default_rng(1).normal(size=(3, 2))
    tau = torques(fitted)[1](a(q), a(v), a(wanted), jnp.zeros(1))[0] / a([1.0, 2.0])  # the second has a gear of 2
    model = fitted.model
    u = jax.tree.map(
        lambda x: x[0], model.inputs(Dataset(np.zeros(1), np.asarray(tau)[None], np.zeros((1, 2)), np.ones(1, bool)))
    )
    np.testing.assert_allclose(model.rate(a([*q, *v]), u, jnp.zeros(2))[2:4], wanted, rtol=1e-9)


@pytest.mark.parametrize("servo", ["", 'kind = "voltage"\nk = 0.3\nR = 2.0', 'kind = "position"\nkp = 9.0'])
@pytest.mark.parametrize("file", ["branch.xml", "arm.urdf"])
def test_a_urdf_is_read_again_as_the_same_machine(tmp_path, file, servo):
    path = Path(__file__).parent / "machines" / file
    machine = read_machine(path)
    (tmp_path / file).write_text(path.read_text())
    text = RIG.replace("two.xml", file).replace('["rail", "pole"]', f'["{machine.joints[0].name}"]')
    inputs = f'columns = ["u"]\njoints = [1]\n{servo}'
    (tmp_path / "rig.toml").write_text(text.replace('columns = ["push", "turn"]', inputs))
    rig, t = read_rig(tmp_path / "rig.toml", specs), 0.01 * np.arange(30.0)
    logs = Dataset(t[None], np.sin(t)[None, :, None], np.sin(t)[None, :, None], np.ones((1, 30), bool))
    fitted = begin(rig, logs, key=jax.random.key(0))
    named = [line for line in write_urdf(fitted, tmp_path / "out.urdf") if "servo of u" in line]
    assert len(named) == bool(servo)
    if servo:
        with pytest.raises(ExportError, match="for; write --urdf or --c instead"):
            write_mjcf(fitted, tmp_path / "out.xml")
    again, model = read_machine(tmp_path / "out.urdf"), mujoco.MjModel.from_xml_path(str(tmp_path / "out.urdf"))
    rubs = [[(joint.damping, joint.dry) for joint in one.joints] for one in (machine, again)]
    np.testing.assert_allclose(*rubs, atol=1e-9)
    assert sum(body.mass for body in again.bodies) == pytest.approx(sum(body.mass for body in machine.bodies), abs=1e-9)
    data, mass = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    for q in np.random.default_rng(0).uniform(-1.0, 1.0, (3, model.nv)):
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, mass)
        armature = np.diag([joint.armature for joint in machine.joints])
        np.testing.assert_allclose(mass, fitted.model.system.mass(a(q)) - armature, atol=1e-9)
