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
from helpers import file_rig, optimised, rate, rig_of

from nnap_em.estimate.identify import Identified, begin
from nnap_em.logs.dataset import Dataset
from nnap_em.model.effects import catalogue
from nnap_em.model.effects.function import Axis, UnknownFunction
from nnap_em.model.state_space import with_effects
from nnap_em.output.export.c99 import torques, write_c
from nnap_em.output.export.mjcf import write_mjcf

a, c = jnp.asarray, catalogue
CART = """<mujoco model="two"><compiler angle="radian"/><worldbody>
<body name="cart"><joint name="rail" type="slide" axis="1 0 0"/>
<inertial pos="0 0 0" mass="1" diaginertia="0.002 0.002 0.002"/>
<body name="pole"><joint name="pole" axis="0 1 0"/>
<inertial pos="0 0 -0.25" mass="0.5" diaginertia="0.005 0.005 0.0001"/><site name="hand" pos="0 0 -0.4"/></body></body>
</worldbody><actuator><motor name="push" joint="rail"/><motor name="turn" joint="pole" gear="2"/></actuator></mujoco>"""
RIG = file_rig("two.xml", ("rail", "pole"), '[input]\ncolumns = ["push", "turn"]', friction="none")
ROWS, X0 = 150, np.array([0.0, 0.3, 0.0, 0.0])


@pytest.fixture(scope="module")
def bare(tmp_path_factory) -> tuple[Identified, Dataset]:
    """A fit without laws, and its log."""
    folder = tmp_path_factory.mktemp("bare")
    (folder / "two.xml").write_text(CART)
    rig, rng, t = rig_of(folder, RIG), np.random.default_rng(0), 0.01 * np.arange(ROWS)
    tones = [np.sin(2 * np.pi * rng.uniform(0.3, 1.8, (4, 1)) * t + rng.uniform(0, 6.28, (4, 1))) for _ in range(2)]
    u = np.stack([size * 1.5 * tone.mean(axis=0) for size, tone in zip((6.0, 0.4), tones, strict=True)], axis=-1)
    data = Dataset(t[None], u[None], np.stack([np.sin(3 * t), np.cos(2 * t)], -1)[None], np.ones((1, ROWS), bool))
    fitted = begin(rig, data, key=jax.random.key(0))
    return fitted._replace(state=fitted.state._replace(hessian=jnp.eye(fitted.state.hessian.shape[0]))), data


def _with(fitted: Identified, *laws) -> Identified:
    return fitted._replace(state=fitted.state._replace(best=with_effects(fitted.model, laws)))


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


def _accelerations(model, q, v, u):
    """Accelerations of the library, of a state without an input before it."""
    return rate(model, jnp.concatenate([q, v]), u, jnp.asarray(0.0))[2:]


@pytest.fixture(scope="module")
def accelerations(bare):
    """States and inputs, and accelerations of the library by law."""
    states = np.random.default_rng(0).normal(size=(20, 3, 2)) * [[1.0], [2.0], [4.0]]
    models = {"none": bare[0].model} | {name: _with(bare[0], law).model for name, law in STATIC.items()}
    one = lambda state: {name: _accelerations(model, *state) for name, model in models.items()}  # noqa: E731
    return states, jax.jit(jax.vmap(one))(a(states))


@pytest.mark.parametrize("name", STATIC)
def test_a_law_in_the_file_accelerates_as_in_the_library(name, bare, accelerations, tmp_path):
    """At random states and inputs, by MuJoCo; without it, another way."""
    assert write_mjcf(_with(bare[0], STATIC[name]), tmp_path / "out.xml") == []
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "out.xml"))
    data, played = mujoco.MjData(model), []
    for data.qpos[:], data.qvel[:], data.ctrl[:] in accelerations[0]:
        mujoco.mj_forward(model, data)
        played.append(data.qacc.copy())
    np.testing.assert_allclose(played, accelerations[1][name], rtol=1e-9, atol=1e-9)
    assert np.abs(np.asarray(played) - accelerations[1]["none"]).max() > 0.05


def test_a_command_over_time_moves_as_in_the_library(bare, tmp_path):
    """Beside the library's own motion, integrated finely."""
    fits, seq = {"none": bare[0]} | {name: _with(bare[0], law) for name, law in OVER_TIME.items()}, bare[1]
    rows = jax.tree.map(lambda v: a(v[0]), seq)

    def moved(fitted):
        model = dataclasses.replace(fitted.model, substeps=40)
        step = lambda x, u: (model.transition(x, u), x[:2])  # noqa: E731
        return jax.lax.scan(step, jnp.concatenate([a(X0), jnp.zeros(model.log_q.shape[0] - 4)]), model.inputs(rows))[1]

    with optimised():
        paths = jax.jit(lambda: {name: moved(fitted) for name, fitted in fits.items()})()
    for name in OVER_TIME:
        assert write_mjcf(fits[name], tmp_path / "out.xml") == []
        off = np.linalg.norm(_played(tmp_path / "out.xml", seq) - paths[name])
        assert off < 0.01 * np.linalg.norm(paths[name] - paths["none"])  # half a time step of 5e-4 s


def test_laws_without_a_plain_element_are_named_and_the_file_is_that_without_them(bare, tmp_path):
    left = write_mjcf(_with(bare[0], *UNPLACED.values()), tmp_path / "out.xml")
    assert [line.split()[0] for line in left] == [*UNPLACED]
    assert write_mjcf(bare[0], tmp_path / "bare.xml") == []
    one, other = (mujoco.MjModel.from_xml_path(str(tmp_path / file)) for file in ("out.xml", "bare.xml"))
    np.testing.assert_array_equal(one.body_mass, other.body_mass)
    assert one.nu == other.nu == 2 and "Not in here:" in (tmp_path / "out.xml").read_text()


def test_a_limit_behind_a_lag_is_named(bare, tmp_path):
    left = write_mjcf(_with(bare[0], c["actuator_lag"].of(0.03, joint=1), STATIC["saturation"]), tmp_path / "out.xml")
    assert left == ["saturation at joint 1: limit = 3 (it acts behind a lag)"]


@pytest.mark.skipif(shutil.which("gcc") is None, reason="needs gcc")
def test_compiled_c_gives_the_torques_of_the_library(bare, tmp_path):
    """Compiled C gives the torques of feed-forward and friction, and the machine then accelerates as asked."""
    position = c["position_dependent_friction"].of(0.3, 0.2, 2.0, joint=2)
    smooth = "cogging", "load_friction", "unknown_function"
    fitted = _with(bare[0], STATIC["payload"], position, *(UNPLACED[n] for n in (*smooth, "dead_zone")))
    assert write_c(fitted, tmp_path / "arm.c") == ["dead_zone at joint 1"]
    flags = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC", "arm.c", "-o", "arm.so", "-lm"]
    subprocess.run(["gcc", *flags], cwd=tmp_path, check=True)
    compiled, (_, feedforward, _) = ctypes.CDLL(str(tmp_path / "arm.so")), torques(fitted)
    states = np.random.default_rng(0).normal(size=(20, 3, 2))
    array = lambda values: (ctypes.c_double * len(values))(*values)  # noqa: E731
    driven = _with(bare[0], STATIC["payload"], UNPLACED["cogging"], UNPLACED["eddy_brake"])

    def one(q, v, wanted):
        tau = torques(driven)[1](q, v, wanted, jnp.zeros(1))[0] / a([1.0, 2.0])  # the second has a gear of 2
        whole = feedforward(q, v, wanted, a([0.3]))[0]
        return whole, fitted.model.unknown(v), _accelerations(driven.model, q, v, tau)

    whole, friction, reached = jax.jit(jax.vmap(one))(*a(states).swapaxes(0, 1))
    np.testing.assert_allclose(reached, states[:, 2], rtol=1e-9)
    for k, (q, v, wanted) in enumerate(states):
        out = array([0.0, 0.0])
        compiled.arm_feedforward(array(q), array(v), array(wanted), array([0.3]), out)
        np.testing.assert_allclose(out, whole[k], rtol=1e-9, atol=1e-9)
        compiled.arm_friction(array(v), out)
        np.testing.assert_allclose(out, friction[k], rtol=1e-9, atol=1e-9)
