"""Sensors of a machine file that read no joint: their readings against MuJoCo's own, and what becomes of them."""

import dataclasses
import re
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from helpers import csv_text, file_rig, written_again
from machines import arm

from nnap_em.base.gaussian import Gaussian
from nnap_em.errors import RigError
from nnap_em.estimate.em.build import build_system
from nnap_em.estimate.em.mstep import _noise_floor
from nnap_em.estimate.em.prior import ParameterPrior
from nnap_em.estimate.em.quadratic import local, quadratic, readings_at
from nnap_em.estimate.identify import begin
from nnap_em.estimate.smoother.gaussian import ExtendedKalmanSmoother
from nnap_em.estimate.smoother.kalman import Tangent, kalman_filter, linear_reading
from nnap_em.estimate.smoother.start import StartBank
from nnap_em.estimate.store import load, save
from nnap_em.logs.dataset import Dataset
from nnap_em.logs.draft.from_machine import draft_machine
from nnap_em.machines.rig import read_rig
from nnap_em.machines.systems import specs
from nnap_em.model.base import prepare
from nnap_em.model.effects.sensor import SensorBias
from nnap_em.model.friction import FixedFriction, NoFriction
from nnap_em.model.law import StribeckLaw
from nnap_em.model.simulate import simulate
from nnap_em.model.state_space import Inputs, StateSpaceModel
from nnap_em.output.export.model import parameters

ROOT = Path(__file__).resolve().parents[1]
KINDS = ("gyro", "accelerometer", "framepos")
BRANCH = ("plate", "hand", "base")


def _wired(sites) -> str:
    kinds = {"gyro": "site", "accelerometer": "site", "framepos": 'objtype="site" objname'}
    return "".join(f'<{kind} name="{site}_{kind}" {at}="{site}"/>' for site in sites for kind, at in kinds.items())


def _branch() -> str:
    """The branching machine of the other tests with a turned site at the end of each branch, and one on the base."""
    text = (ROOT / "tests" / "machines" / "branch.xml").read_text()
    for i, body in enumerate(("plate", "hand")):
        site = f'<site name="{body}" pos="0.{i}1 -0.05 0.1" euler="{10 * i} 20 -{30 + i}"/>'
        text = re.sub(rf'(<body name="{body}"[^>]*>)', rf"\1{site}", text)
    text = text.replace("<worldbody>", '<worldbody><site name="base" pos="1 2 3" euler="30 40 50"/>')
    return text.replace("<sensor>", f"<sensor>{_wired(BRANCH)}")


ARM = arm(3).replace('<site name="hand" pos="0 0 0.05"/>', '<site name="hand" pos="0.02 -0.01 0.05" euler="0.3 0 1"/>')
ARM = ARM.replace("</actuator>", f"</actuator><sensor>{_wired(['hand'])}</sensor>")


def _rig(folder: Path, text: str, columns, rest: str = "", model: str = "") -> Path:
    (folder / "machine.xml").write_text(text)
    (folder / "rig.toml").write_text(file_rig("machine.xml", columns, model) + rest)
    return folder / "rig.toml"


def _model(system, measured) -> StateSpaceModel:
    """With a friction that acts in every joint."""
    dof = len(system.coordinates)
    law = StribeckLaw(*(jnp.linspace(0.5, 1.5, dof) * size for size in (0.3, 0.5, 0.4, 0.2, 0.1)))
    return StateSpaceModel(
        system=system,
        unknown=FixedFriction(law, jnp.ones(dof)),
        start=Gaussian(jnp.zeros(2 * dof), jnp.eye(2 * dof)),
        log_q=jnp.zeros(2 * dof),
        log_r=jnp.zeros(len(measured)),
        measured=tuple(system.readable.index(name) for name in measured),
        dt=0.01,
    )


def test_readings_are_those_of_mujoco_under_torque_and_friction(tmp_path):
    text = _branch()
    columns = [f"{site}_{kind}.{axis}" for site in BRANCH for kind in KINDS for axis in "xyz"]
    ours = _model(build_system(read_rig(_rig(tmp_path, text, columns), specs)), columns)
    model = mujoco.MjModel.from_xml_string(text)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    address = {model.sensor(i).name: int(model.sensor_adr[i]) for i in range(model.nsensor)}
    rng = np.random.default_rng(0)
    x, u = rng.uniform(-3.0, 3.0, (6, 2 * model.nv)), rng.uniform(-2.0, 2.0, (6, model.nu))
    read = lambda a: (ours.emission(a[0], Inputs.held(a[1])), ours.unknown(a[0][model.nv :]))  # noqa: E731
    for state, push, seen, rubs in zip(x, u, *jax.jit(lambda x, u: jax.lax.map(read, (x, u)))(x, u), strict=True):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = np.split(state, 2)
        data.ctrl[:], data.qfrc_applied[:] = push, rubs
        mujoco.mj_forward(model, data)
        truth = [data.sensordata[address[c[:-2]] + "xyz".index(c[-1])] for c in columns]
        np.testing.assert_allclose(seen, truth, rtol=1e-10, atol=1e-10)


# --- what a fit makes of them

CART = """<mujoco><option gravity="0 0 -9.81"/><worldbody><body name="cart">
<joint name="rail" type="slide" axis="1 0 0"/><inertial pos="0 0 0" mass="1.3" diaginertia="1 1 1"/>
<site name="top" euler="0 90 0"/></body></worldbody><actuator><motor name="push" joint="rail"/></actuator>
<sensor><accelerometer name="imu" site="top"/></sensor></mujoco>"""
NODES = jnp.asarray([[-8.0, -2.0, 0.5, 3.0, 9.0]])  # beyond all speeds, so that the nodes interpolate v exactly


class _Pushed(NamedTuple):
    """A model under a small extra force."""

    model: StateSpaceModel
    force: jax.Array

    def transition(self, x, u):
        return self.model.transition(x, u, self.force)

    def emission(self, x, u):
        return self.model.emission(x, u, self.force)


@eqx.filter_jit
def _expanded(model, prior, data: Dataset):
    """Score and information of one sequence; what the likelihood itself says of a constant force and of the mass."""
    seq = jax.tree.map(lambda a: a[0], data)
    prepared = prepare(model, seq)
    posterior = ExtendedKalmanSmoother(StartBank((1, 1)), iterations=20)(model, prepared)
    linear, read = local(model, prior, posterior.state, seq), readings_at(model, (posterior, prepared))
    expansion = quadratic(model.log_q, model.log_r, model.start, linear, NODES, posterior, read)

    def filtered(knobs):
        pushed = _Pushed(prior.write(model, knobs[1:]), knobs[:1])
        about = lambda x, u: Tangent()(pushed, Gaussian(x, jnp.eye(2)), u)  # noqa: E731
        affine = jax.vmap(about)(posterior.state.mean, prepared.inputs)
        reading = jax.vmap(lambda x, u: linear_reading(pushed, x, u))(posterior.state.mean, prepared.inputs)
        out = kalman_filter(model.log_q, model.log_r, model.start, affine, reading, prepared)
        return out.loglik, out.innovation.ravel()

    step = 1e-4
    near = jax.vmap(filtered)(step * jnp.concatenate([jnp.eye(2), -jnp.eye(2)]))
    slope, jac = ((a[:2] - a[2:]) / (2 * step) for a in near)
    return expansion, slope, jac, _noise_floor(jax.tree.map(lambda a: a[None], linear), model.log_q, model.log_r)


def test_what_accelerometers_feel_of_friction_and_mass_counts_in_score_and_information(tmp_path):
    """A cart is linear: both are those of the likelihood itself, exactly."""
    path = _rig(tmp_path, CART, ("rail", "imu.z"), model="[model.uncertain]\ncart.mass = { std = 0.1 }")
    start = Gaussian(jnp.asarray([0.2, 0.0]), jnp.diag(jnp.asarray([0.1, 0.3]) ** 2))
    model = dataclasses.replace(
        _model(build_system(read_rig(path, specs)), ("rail", "imu.z")),
        unknown=NoFriction(jnp.ones(1)),
        start=start,
        log_q=2 * jnp.log(jnp.asarray([0.01, 0.1])),
        log_r=2 * jnp.log(jnp.asarray([0.02, 0.5])),
        dt=0.05,
    )
    u = jnp.sin(0.25 * jnp.arange(40.0))[None, :, None]
    data = simulate(model, start.mean[None], u, key=jax.random.key(0)).data
    data = data._replace(y=data.y.at[0, 7:9, 1].set(jnp.nan))
    prior = ParameterPrior(("cart.mass",), jnp.asarray([1.3]), jnp.asarray([0.1]))
    expansion, slope, jac, floor = _expanded(model, prior, data)
    kick = model.log_q[1] - 2 * jnp.log(model.dt)  # a kick of the rate over one step is an acceleration
    np.testing.assert_allclose(floor, [model.log_r[0], kick], rtol=1e-6)
    both = np.zeros((2, 6))
    both[0, :5], both[1, 5] = 1.0, 1.0  # the weights of the nodes sum to 1: a constant force is one at all of them
    np.testing.assert_allclose(both @ expansion.score, slope, rtol=1e-6)  # differences of step 1e-4
    np.testing.assert_allclose(both @ expansion.information @ both.T, jac @ jac.T, rtol=1e-6)


def test_sensors_are_called_by_name_and_component_with_their_units(tmp_path):
    columns = ("joint1", "hand_gyro.z", "hand_accelerometer.x", "hand_framepos.y")
    noise = '[measurement.noise_std]\nhand_gyro.z = 0.01\n"hand_accelerometer.x" = 0.1\n'
    rig = read_rig(_rig(tmp_path, ARM, columns, noise), specs)
    assert rig.measured == columns
    assert rig.noise_std == {"hand_gyro.z": 0.01, "hand_accelerometer.x": 0.1}
    system = build_system(rig)
    assert system.sensors == {"hand_gyro.z": "rad/s", "hand_accelerometer.x": "m/s^2", "hand_framepos.y": "m"}
    assert (
        [rig.unit(name) for name in columns]
        == [system.unit(name) for name in columns]
        == ["rad", "rad/s", "m/s^2", "m"]
    )
    assert written_again(rig, tmp_path) == rig


BAD = {
    "no component": ("hand_gyro", "'hand_gyro' is no state or sensor of this system; did you mean 'hand_gyro."),
    "another kind": (
        "hand_touch", "of a sensor of type touch; read are joints, and gyro, accelerometer, framepos of a site: take",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("column", "said"), BAD.values(), ids=BAD)
def test_sensors_that_are_not_read_are_refused_by_name(column, said, tmp_path):
    more = '<touch name="hand_touch" site="hand"/>'
    text = ARM.replace("<sensor>", f"<sensor>{more}")
    with pytest.raises(RigError, match=re.escape(said)):
        read_rig(_rig(tmp_path, text, ["joint1", column]), specs)


# --- what is stored, written and drafted

SWING = """<mujoco><worldbody><body name="rod"><joint name="pivot" axis="0 1 0"/>
<inertial pos="0 0 -.2" mass="0.5" diaginertia=".004 .004 .001"/>
<site name="bob" pos="0.01 0 -.3" euler="0 0 90"/></body></worldbody>
<actuator><motor name="push" joint="pivot"/></actuator>
<sensor><gyro name="imu" site="bob"/><accelerometer name="shake" site="bob"/><framepos name="at" objtype="site"
objname="bob"/></sensor></mujoco>"""
SEEN = ("imu.x", "shake.z", "at.x")


def test_sensors_are_shown_exported_and_stored(tmp_path):
    """What a prediction shows of a state is its angle, its rate, and what each sensor reads."""
    rig, t = read_rig(_rig(tmp_path, SWING, SEEN), specs), 0.01 * np.arange(90)
    readings = np.random.default_rng(0).normal(size=(1, 90, 3))
    blank = Dataset(t[None], 0.3 * np.sin(4 * t)[None, :, None], readings, np.ones((1, 90), bool))
    fitted = begin(rig, blank, key=jax.random.key(0), effects=(SensorBias(jnp.asarray(0.3), channel="shake.z"),))
    assert parameters(fitted)["sensors"][1] == {"name": "shake.z", "unit": "m/s^2"}
    save(tmp_path / "model.npz", fitted)
    models, x, u = (load(tmp_path / "model.npz").model, fitted.model), jnp.asarray([0.3, 1.0]), Inputs.held(jnp.ones(1))
    again, own, shown = jax.jit(lambda: [*(model.emission(x, u) for model in models), fitted.model.shown(x, u)])()
    np.testing.assert_array_equal(again, own)
    np.testing.assert_allclose(shown, [*x, *own], rtol=1e-12)


def test_a_first_rig_has_the_sensors_of_the_log_by_name(tmp_path):
    (tmp_path / "swing.xml").write_text(SWING)
    t = 0.01 * np.arange(200)
    header = {"time": t, "pivot": np.sin(t), "imu.x": np.cos(t), "shake.z": np.sin(3 * t), "push": np.cos(2 * t)}
    (tmp_path / "log.csv").write_text(csv_text(header))
    made = draft_machine(tmp_path / "log.csv", tmp_path / "swing.xml", tmp_path)
    (tmp_path / "rig.toml").write_text(made.text)
    assert read_rig(tmp_path / "rig.toml", specs).measured == ("pivot", "imu.x", "shake.z")
    assert re.findall(r'(?m)^"(?:imu.x|shake.z)" = .*# (.*)$', made.text) == ["rad/s", "m/s^2"]
