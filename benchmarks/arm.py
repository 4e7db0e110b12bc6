"""Friction of every joint of an industrial arm of which all joints are read: declared by its file, logs from MuJoCo.

    python benchmarks/arm.py [--joints 6] [--seeds 3] [--first 0] [--imu]

The arm follows sums of sines under gravity compensation and a PD controller; friction is Coulomb, viscous and Stribeck,
of another size in every joint. 10 sequences of 5 s at 100 Hz. Seconds are those of `identify`. The first seed is cold
where the cache of compiled programs (XDG_CACHE_HOME) is empty. With `--imu` the last joint has no encoder, and the hand
a gyroscope and an accelerometer.
"""

import argparse
import os
import platform
import sys
import time
from collections.abc import Callable
from datetime import date
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import jax
import mujoco
import numpy as np
from machines import arm

from nnap_em import identify
from nnap_em.cli.common import set_up
from nnap_em.logs.dataset import Dataset
from nnap_em.machines.rig import Rig, read_rig
from nnap_em.machines.systems import specs

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))
from machine_files import DT, FINE, errors

SIZE = 10, 501
"""Sequences and rows."""
NOISE = 1e-3
"""Of the readings [rad]."""
IMU = {"gyro": 0.005, "accelerometer": 0.05}
"""Of the sensors at the hand [rad/s, m/s^2]."""
BANDWIDTH = 12.0
"""Of the controller [rad/s]."""


class Joint(NamedTuple):
    """Friction of a joint [N m, rad/s, N m s/rad], and how fast it moves [rad/s]."""

    coulomb: float
    breakaway: float
    stribeck: float
    knee: float
    viscous: float
    speed: float


JOINTS = (
    Joint(1.5, 2.2, 0.30, 0.06, 0.80, 3.0),
    Joint(3.0, 3.9, 0.40, 0.06, 1.50, 2.5),
    Joint(2.0, 3.2, 0.25, 0.05, 1.00, 3.5),
    Joint(0.5, 0.7, 0.30, 0.06, 0.20, 5.0),
    Joint(0.3, 0.36, 0.50, 0.08, 0.12, 5.0),
    Joint(0.1, 0.15, 0.40, 0.06, 0.04, 8.0),
    Joint(0.06, 0.09, 0.40, 0.06, 0.02, 8.0),
)


def machine(joints: int, *, imu: bool) -> str:
    """The arm as MJCF, with or without sensors at its hand."""
    sensors = "".join(f'<{kind} name="hand_{kind}" site="hand"/>' for kind in IMU if imu)
    return arm(joints).replace("</mujoco>", f"<sensor>{sensors}</sensor></mujoco>")


def friction(joints: tuple[Joint, ...]) -> Callable[[np.ndarray], np.ndarray]:
    """Torque at velocities [N m]."""
    coulomb, breakaway, stribeck, knee, viscous, _ = map(np.asarray, zip(*joints, strict=True))

    def law(v: np.ndarray) -> np.ndarray:
        level = coulomb + (breakaway - coulomb) * np.exp(-((v / stribeck) ** 2))
        return -level * np.tanh(v / knee) - viscous * v

    return law


def recorded(text: str, joints: tuple[Joint, ...], seed: int) -> tuple[Dataset, np.ndarray]:
    """Logs of the arm, of its hand in place of the last joint where there are sensors, and all its states."""
    rng, law, dof = np.random.default_rng(seed), friction(joints), len(joints)
    model = mujoco.MjModel.from_xml_string(text)
    model.opt.timestep, model.opt.integrator = DT / FINE, int(mujoco.mjtIntegrator.mjINT_RK4)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    inertia, speed = _inertia(model), np.array([joint.speed for joint in joints])
    sequences, rows = SIZE
    t = DT * np.arange(rows)
    u, x = np.zeros((sequences, rows, dof)), np.zeros((sequences, rows, 2 * dof))
    sensed = np.zeros((sequences, rows, model.nsensordata))
    for s in range(sequences):
        tones, phases = rng.uniform(0.15, 1.2, (dof, 4)), rng.uniform(0, 2 * np.pi, (dof, 4))
        turn = 2 * np.pi * tones[None] * t[:, None, None] + phases[None]
        rate = speed * np.sum(np.cos(turn), axis=-1) / 2.5
        goal = np.sum(speed[:, None] / 2.5 * np.sin(turn) / (2 * np.pi * tones), axis=-1)
        data, known = mujoco.MjData(model), mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = goal[0], rate[0]
        for k in range(rows):
            x[s, k] = np.concatenate([data.qpos, data.qvel])
            known.qpos[:], known.qvel[:] = data.qpos, data.qvel
            mujoco.mj_forward(model, known)
            wish = BANDWIDTH**2 * (goal[k] - data.qpos) + 1.4 * BANDWIDTH * (rate[k] - data.qvel)
            u[s, k] = known.qfrc_bias + inertia * wish
            data.ctrl[:], data.qfrc_applied[:] = u[s, k], law(data.qvel)
            mujoco.mj_forward(model, data)
            sensed[s, k] = data.sensordata
            for _ in range(FINE):
                data.qfrc_applied[:] = law(data.qvel)
                mujoco.mj_step(model, data)
    read = dof - bool(model.nsensor)
    std = np.repeat([NOISE, *IMU.values()][: 1 + model.nsensor], [read, *model.sensor_dim])
    y = np.concatenate([x[..., :read], sensed], axis=-1)
    y = y + std * rng.normal(size=y.shape)
    return Dataset(np.tile(t, (sequences, 1)), u, y, np.ones((sequences, rows), bool)), x


def _inertia(model: mujoco.MjModel) -> np.ndarray:
    """Of every joint at zero [kg m^2]."""
    data, mass = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, mass)
    return np.diag(mass)


def declared(folder: Path, joints: int, *, imu: bool = False) -> Rig:
    """The rig of the arm, written to a folder with its file."""
    (folder / "arm.xml").write_text(machine(joints, imu=imu))
    std = {f"joint{i + 1}": NOISE for i in range(joints - imu)}
    std |= {f"hand_{kind}.{axis}": size for kind, size in IMU.items() for axis in "xyz" if imu}
    names = ", ".join(f'"{name}"' for name in std)
    noise = "".join(f"{name} = {size}\n" for name, size in std.items())
    (folder / "rig.toml").write_text(
        'format = 1\nname = "arm"\n[model]\ntype = "mjcf"\nfile = "arm.xml"\nfriction = "unknown"\n'
        f'[sampling]\ndt = {DT}\ninput_hold = "zero-order"\nclock = "sequence"\n'
        f"[measurement]\ncolumns = [{names}]\n[measurement.noise_std]\n{noise}"
    )
    return read_rig(folder / "rig.toml", specs)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--joints", type=int, default=6, choices=range(1, 8))
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first", type=int, default=0, help="seed")
    parser.add_argument("--imu", action="store_true", help="at the hand, in place of the last encoder")
    args = parser.parse_args()
    set_up()
    joints = JOINTS[: args.joints]
    print(f"{date.today()}, {platform.machine()}, {jax.device_count()} devices, JAX {jax.__version__}, ", end="")
    print(f"load {os.getloadavg()[0]:.1f} before: {' '.join(['python', *sys.argv])}\n")
    seeds = range(args.first, args.first + args.seeds)
    print(f"| seed | {' | '.join(f'joint {i + 1}' for i in range(args.joints))} | epochs | s | processor s |")
    print("| --- " * (args.joints + 4) + "|")
    with TemporaryDirectory() as folder:
        rig = declared(Path(folder), args.joints, imu=args.imu)
        for seed in seeds:
            data, x = recorded(machine(args.joints, imu=args.imu), joints, seed)
            began, spent = time.perf_counter(), time.process_time()
            fitted = identify(rig, data, key=jax.random.key(seed))
            took, spent = time.perf_counter() - began, time.process_time() - spent
            cells = " | ".join(f"{e:.3f}" for e in errors(fitted.model.unknown, friction(joints), x))
            print(f"| {seed} | {cells} | {fitted.state.epoch} | {took:.0f} | {spent:.0f} |", flush=True)


if __name__ == "__main__":
    main()
