"""An arm of up to seven joints as MJCF, for benchmarks and tests, and the physics of a machine file."""

from pathlib import Path

import mujoco
import numpy as np

from nnap_em.machines.files.mjcf import read_machine
from nnap_em.machines.machine import packed, states
from nnap_em.machines.systems import AbstractSystem, systems

AXES = ("0 0 1", "0 1 0", "0 1 0", "0 0 1", "0 1 0", "0 0 1", "0 1 0")
PLACES = ("0 0 0", "0 0 0.15", "0 0 0.3", "0.03 0 0.25", "0 0 0.1", "0 0 0.08", "0 0 0.06")
MASSES = (3.0, 2.5, 1.5, 0.8, 0.5, 0.3, 0.2)
CENTRES = (0.1, 0.15, 0.12, 0.06, 0.05, 0.03, 0.02)


def arm(joints: int) -> str:
    """An industrial arm of up to seven joints as MJCF: axes by turns upright and across, every inertia full."""
    head, tail = [], []
    for i in range(joints):
        k = 0.01 * MASSES[i]
        full = " ".join(f"{share * k:.4g}" for share in (1, 0.9, 0.5, 0.02, 0.01, -0.03))
        head += [
            f'<body name="link{i + 1}" pos="{PLACES[i]}">',
            f'<joint name="joint{i + 1}" axis="{AXES[i]}" armature="{0.05 / (i + 1):.4g}"/>',
            f'<inertial pos="{0.01 * i:.4g} 0.005 {CENTRES[i]}" mass="{MASSES[i]}" fullinertia="{full}"/>',
        ]
        tail += ["</body>"]
    motors = [f'<motor name="tau{i + 1}" joint="joint{i + 1}"/>' for i in range(joints)]
    parts = ['<mujoco model="arm"><compiler angle="radian"/><worldbody>', *head, '<site name="hand" pos="0 0 0.05"/>']
    return "\n".join([*parts, *tail, "</worldbody><actuator>", *motors, "</actuator></mujoco>"])


def tree(path: Path) -> AbstractSystem:
    """The machine in a file, all as it stands there."""
    machine = read_machine(path)
    count = len(machine.joints)
    whole = machine._replace(states=states(machine), gears=(1.0,) * count)
    return systems["mjcf"].declared({}, tuple(range(1, count + 1)), packed(whole))


def physics(model: mujoco.MjModel, states) -> tuple[np.ndarray, np.ndarray]:
    """Mass matrices, and forces without acceleration, of MuJoCo at coordinates and rates, a state a row."""
    data, mass = mujoco.MjData(model), np.zeros((len(states), model.nv, model.nv))
    bias = np.zeros((len(states), model.nv))
    for k, (data.qpos[:], data.qvel[:]) in enumerate(states):
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, mass[k])
        bias[k] = data.qfrc_bias - data.qfrc_spring
    return mass, bias
