"""A load of unknown mass and centre on a machine from a file, found in logs of a motion in closed form."""

import jax
import numpy as np
import pytest

from nnap_em import close_the_loop, findings, read_rig, specs
from nnap_em.data.dataset import Dataset
from nnap_em.effects import catalogue

GRAVITY, MASS, LENGTH, INERTIA = 9.81, 1.2, 0.25, 0.01
"""Of a rod on a hinge: its centre [m] below the axis, its inertia about it [kg m^2]."""
LOAD, AWAY = 0.5, (0.15, -0.3)
"""Mass of what hangs on it [kg], and its place in the plane [m]."""
DT, ROWS, SEQUENCES = 0.02, 150, 6
FILE = f"""<mujoco><compiler angle="radian"/><worldbody><body name="rod"><joint name="hinge" axis="0 -1 0"/>
<inertial pos="0 0 -{LENGTH}" mass="{MASS}" diaginertia="{INERTIA} {INERTIA} {INERTIA}"/>
<site name="tip" pos="0 0 -0.4"/></body></worldbody><actuator><motor name="tau" joint="hinge"/></actuator></mujoco>"""


def _acceleration(q, v, u):
    """Of the rod with its load and friction, as a textbook has it; x to the side, z up, turned by q about -y."""
    x, z = AWAY
    inertia = INERTIA + MASS * LENGTH**2 + LOAD * (x**2 + z**2)
    turn = GRAVITY * (LOAD * (x * np.cos(q) - z * np.sin(q)) + MASS * LENGTH * np.sin(q))
    return (u - turn - 0.05 * v - 0.1 * np.tanh(v / 0.1)) / inertia


def _logs(seed: int) -> Dataset:
    """Sums of sines as torques, 20 Runge-Kutta steps a sample, noise of 1e-3 rad and 1e-2 rad/s."""
    rng, h = np.random.default_rng(seed), DT / 20
    t = DT * np.arange(ROWS)
    tones = rng.uniform(1.0, 9.0, (SEQUENCES, 3, 1)), rng.uniform(0, 2 * np.pi, (SEQUENCES, 3, 1))
    u = rng.uniform(0.5, 2.5, (SEQUENCES, 1)) * np.sum(np.sin(tones[0] * t + tones[1]), axis=1)
    y, x = np.zeros((SEQUENCES, ROWS, 2)), np.stack([rng.uniform(-1, 1, SEQUENCES), np.zeros(SEQUENCES)])
    rate = lambda x, u: np.stack([x[1], _acceleration(x[0], x[1], u)])  # noqa: E731
    for k in range(ROWS):
        y[:, k] = x.T
        for _ in range(20):
            a = rate(x, u[:, k])
            b = rate(x + 0.5 * h * a, u[:, k])
            c = rate(x + 0.5 * h * b, u[:, k])
            x = x + h / 6 * (a + 2 * b + 2 * c + rate(x + h * c, u[:, k]))
    y = y + rng.normal(size=y.shape) * [1e-3, 1e-2]
    return Dataset(np.tile(t, (SEQUENCES, 1)), u[..., None], y, np.ones((SEQUENCES, ROWS), bool))


def _rig(folder):
    (folder / "rod.xml").write_text(FILE)
    (folder / "rig.toml").write_text(
        'format = 1\nname = "rod"\n[model]\ntype = "mjcf"\nfile = "rod.xml"\nfriction = "unknown"\n'
        f'[sampling]\ndt = {DT}\ninput_hold = "zero-order"\nclock = "sequence"\n'
        '[measurement]\ncolumns = ["hinge", "dhinge"]\n[measurement.noise_std]\nhinge = 1e-3\ndhinge = 1e-2\n'
    )
    return read_rig(folder / "rig.toml", specs)


def test_mass_and_centre_of_a_load_on_one_joint_are_found(tmp_path):
    """Weight and inertia of a hinge give mass and centre in the plane of its motion; along the axis nothing is seen."""
    closed = close_the_loop(_rig(tmp_path), _logs(0), key=jax.random.key(0))
    (found,) = findings(closed)
    assert found.effect.name == "payload" and found.effect.joint == 1
    told = found.parameters
    for name, truth, within in (("mass", LOAD, 0.1 * LOAD), ("centre_x", AWAY[0], 0.02), ("centre_z", AWAY[1], 0.02)):
        assert told[name].value == pytest.approx(truth, abs=within)
        assert abs(told[name].value - truth) < 4 * told[name].std < 4 * within
    assert told["centre_y"].std > 0.2  # nobody knows
    assert found.parameters.keys() == catalogue["payload"].units.keys()
