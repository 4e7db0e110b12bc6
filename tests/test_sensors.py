"""Sensors of a machine file that read no joint: their readings against MuJoCo's own, and what becomes of them."""

import dataclasses
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from machines import arm

from nnap_em.data.machine import packed, unpacked
from nnap_em.data.rig import RigError, read_rig, write_rig
from nnap_em.em.build import build_system
from nnap_em.model.friction import FixedFriction
from nnap_em.model.law import StribeckLaw
from nnap_em.model.state_space import Inputs, StateSpaceModel
from nnap_em.numerics.gaussian import Gaussian
from nnap_em.systems import specs

ROOT = Path(__file__).resolve().parents[1]
KINDS = ("gyro", "accelerometer", "framepos")
SITES = {"trunk": "trunk", "left": "left", "plate": "plate", "right": "right", "hand": "hand"}


def _sensors(sites) -> str:
    kinds = {"gyro": "site", "accelerometer": "site", "framepos": 'objtype="site" objname'}
    return "".join(f'<{kind} name="{site}_{kind}" {at}="{site}"/>' for site in sites for kind, at in kinds.items())


def _branch() -> str:
    """The branching machine of the other tests with a turned site on every body, and one on the base."""
    text = (ROOT / "tests" / "machines" / "branch.xml").read_text()
    for i, body in enumerate(SITES):
        site = f'<site name="{body}" pos="0.{i}1 -0.05 0.1" euler="{10 * i} 20 -{30 + i}"/>'
        text = re.sub(rf'(<body name="{body}"[^>]*>)', rf"\1{site}", text)
    text = text.replace("<worldbody>", '<worldbody><site name="base" pos="1 2 3" euler="30 40 50"/>')
    return text.replace("<sensor>", f"<sensor>{_sensors((*SITES, 'base'))}")


def _arm(joints: int) -> str:
    text = arm(joints).replace('<site name="hand" pos="0 0 0.05"/>', '<site name="hand" pos="0.02 -0.01 0.05" euler="0.3 0 1"/>')
    return text.replace("</actuator>", f"</actuator><sensor>{_sensors(['hand'])}</sensor>")


MACHINES = {"branch": (_branch(), (*SITES, "base")), "arm3": (_arm(3), ("hand",)), "arm6": (_arm(6), ("hand",))}


def _columns(sites) -> list[str]:
    return [f"{site}_{kind}.{axis}" for site in sites for kind in KINDS for axis in "xyz"]


def _rig(folder: Path, text: str, columns, rest: str = "", friction: str = "unknown") -> Path:
    (folder / "machine.xml").write_text(text)
    names = ", ".join(f'"{column}"' for column in columns)
    (folder / "rig.toml").write_text(
        f'format = 1\nname = "bench"\n[model]\ntype = "mjcf"\nfile = "machine.xml"\nfriction = "{friction}"\n'
        f'[sampling]\ndt = 0.01\ninput_hold = "zero-order"\nclock = "sequence"\n[measurement]\ncolumns = [{names}]\n{rest}'
    )
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


@pytest.mark.parametrize("name", MACHINES)
def test_readings_are_those_of_mujoco_under_torque_and_friction(name, tmp_path):
    text, sites = MACHINES[name]
    columns = _columns(sites)
    system = build_system(read_rig(_rig(tmp_path, text, columns), specs))
    given = _model(system, columns)
    model = mujoco.MjModel.from_xml_string(text)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    address = {model.sensor(i).name: int(model.sensor_adr[i]) for i in range(model.nsensor)}
    rng, read = np.random.default_rng(0), jax.jit(lambda x, u: given.emission(x, u))
    for _ in range(6):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = rng.uniform(-3.0, 3.0, (2, model.nv))
        data.ctrl[:] = u = rng.uniform(-2.0, 2.0, model.nu)
        data.qfrc_applied[:] = np.asarray(given.unknown(jnp.asarray(data.qvel)))
        mujoco.mj_forward(model, data)
        x = jnp.asarray(np.concatenate([data.qpos, data.qvel]))
        truth = [data.sensordata[address[c[:-2]] + "xyz".index(c[-1])] for c in columns]
        np.testing.assert_allclose(read(x, Inputs.held(jnp.asarray(u))), truth, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("name", ["branch", "arm3"])
def test_derivatives_of_readings_are_finite_differences(name, tmp_path):
    text, sites = MACHINES[name]
    columns = _columns(sites)
    given = _model(build_system(read_rig(_rig(tmp_path, text, columns), specs)), columns)
    dof, rng, step = len(given.system.coordinates), np.random.default_rng(1), 1e-6
    x, u = jnp.asarray(rng.uniform(-1.0, 1.0, 2 * dof)), Inputs.held(jnp.asarray(rng.uniform(-1, 1, len(given.system.joints))))
    both = jax.jit(lambda x, force: given.emission(x, u, force))
    found = jnp.concatenate(jax.jacfwd(both, (0, 1))(x, jnp.zeros(dof)), axis=1)
    for i in range(3 * dof):
        dx, force = jnp.split(step * jnp.eye(3 * dof)[i], [2 * dof])
        truth = (both(x + dx, force) - both(x - dx, -force)) / (2 * step)
        np.testing.assert_allclose(found[:, i], truth, rtol=1e-6, atol=1e-6)
