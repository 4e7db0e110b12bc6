"""A rod on a hinge with a motor, its motion in NumPy: code that shares nothing with the library."""

from pathlib import Path

import numpy as np
from helpers import rig_of, rig_text

from nnap_em.logs.dataset import Dataset
from nnap_em.machines.rig import Rig

GRAVITY, MASS, LENGTH, INERTIA = 9.81, 1.2, 0.25, 0.01
"""Gravity [m/s^2]; mass of the rod [kg], its centre below the axis [m], its inertia about that centre [kg m^2]."""
DT, ROWS, SEQUENCES = 0.02, 150, 6
NOISE = (1e-3, 1e-2)
"""Standard deviations of the readings [rad, rad/s]."""
FILE = f"""<mujoco><compiler angle="radian"/><worldbody><body name="rod"><joint name="hinge" axis="0 -1 0"/>
<inertial pos="0 0 -{LENGTH}" mass="{MASS}" diaginertia="{INERTIA} {INERTIA} {INERTIA}"/>
<site name="tip" pos="0 0 -0.4"/></body></worldbody><actuator><motor name="tau" joint="hinge"/></actuator></mujoco>"""


def logs(seed: int) -> Dataset:
    """Sums of sines as torques, 20 Runge-Kutta steps a sample."""
    rng, h = np.random.default_rng(seed), DT / 20
    t = DT * np.arange(ROWS)
    tones = rng.uniform(1.0, 9.0, (SEQUENCES, 3, 1)), rng.uniform(0, 2 * np.pi, (SEQUENCES, 3, 1))
    u = rng.uniform(0.5, 2.5, (SEQUENCES, 1)) * np.sum(np.sin(tones[0] * t + tones[1]), axis=1)
    inertia = INERTIA + MASS * LENGTH**2

    def rate(state, u):
        q, v = state
        weight = GRAVITY * MASS * LENGTH * np.sin(q)
        friction = 0.05 * v + 0.1 * np.tanh(v / 0.1)
        return np.stack([v, (u - weight - friction) / inertia])

    y, state = np.zeros((SEQUENCES, ROWS, 2)), np.stack([rng.uniform(-1, 1, SEQUENCES), np.zeros(SEQUENCES)])
    for k in range(ROWS):
        y[:, k] = state.T
        for _ in range(20):
            a = rate(state, u[:, k])
            b = rate(state + 0.5 * h * a, u[:, k])
            c = rate(state + 0.5 * h * b, u[:, k])
            state = state + h / 6 * (a + 2 * b + 2 * c + rate(state + h * c, u[:, k]))
    y = y + rng.normal(size=y.shape) * NOISE
    return Dataset(np.tile(t, (SEQUENCES, 1)), u[..., None], y, np.ones((SEQUENCES, ROWS), bool))


def rig(folder: Path, *, pendulum: bool = False) -> Rig:
    """The rod as its file declares it; as a `pendulum` its programs are compiled sooner."""
    (folder / "rod.xml").write_text(FILE)
    joint, model, inputs = "hinge", 'type = "mjcf"\nfile = "rod.xml"', ""
    if pendulum:
        joint, inputs = "theta1", '[input]\ncolumns = ["tau"]\njoints = [1]\n'
        model = f'type = "pendulum"\nm = {MASS}\nlc = {LENGTH}\nI = {INERTIA}\ng = {GRAVITY}'
    text = rig_text(f'{model}\nfriction = "unknown"\n{inputs}', (joint, f"d{joint}"), DT)
    noise = f"[measurement.noise_std]\n{joint} = {NOISE[0]}\nd{joint} = {NOISE[1]}\n"
    return rig_of(folder, text + noise)
