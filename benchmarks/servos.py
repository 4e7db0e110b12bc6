"""Position servos in every joint, from commands and encoders alone: their gains and delays, and the joints' friction.

    python benchmarks/servos.py [--joints 6] [--seeds 0 1] [--sequences 8] [--seconds 4] [--undeclared delay]

MuJoCo is the truth: its own `<position>` actuators on the arm of `machines.py` (one joint: a pendulum), each command
late by a time of its own, Coulomb, Stribeck and viscous friction as an applied force. Declared are gains 25 % too low
(std 40 %) and delays of 10 +- 10 ms; the damping of the servos is known. A row is a joint: errors of gain [%] and delay
[ms], and of friction as root mean square error over that of the true curve.

With --undeclared the gains are declared as they are, and one thing of joint 1 is not declared at all: the delay of its
command, the limit of its torque, or friction that grows with that torque.  A row is what `diagnose` found.
"""

import argparse
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from machines import arm

from nnap_em.estimate.identify import Identified, identify, parameter_table
from nnap_em.explain.diagnosis.diagnose import diagnose
from nnap_em.explain.diagnosis.findings import findings
from nnap_em.logs.dataset import Dataset
from nnap_em.machines.rig import Rig, read_rig
from nnap_em.machines.systems import specs

jax.config.update("jax_enable_x64", True)
DT, INNER = 0.01, 20
NOISE = 2e-4
"""Standard deviation of the encoders [rad]."""
KP = (400.0, 400.0, 250.0, 60.0, 40.0, 15.0)
KD = (20.0, 20.0, 12.0, 2.0, 1.0, 0.3)
COULOMB = (4.0, 4.0, 2.5, 0.8, 0.5, 0.2)
DELAY = (0.017, 0.0125, 0.0085, 0.0215, 0.006, 0.0142)
"""[s]"""
SHARE = 0.75
"""Declared gain over the true one."""
LIMIT = 0.5
"""Undeclared torque limit over the largest torque of the drive without it."""
LOAD = 0.15
"""Undeclared friction of joint 1 over the torque of its drive."""
UNDECLARED = ("delay", "limit", "load")
PENDULUM = """<mujoco><worldbody><body><joint name="joint1" axis="0 1 0" armature="0.05"/>
<inertial pos="0 0 -.3" mass="3" diaginertia=".1 .1 .1"/></body></worldbody><actuator>
<motor name="tau1" joint="joint1"/></actuator></mujoco>"""
RIG = """format = 1
name = "servos"
[model]
type = "mjcf"
file = "servos.xml"
friction = "unknown"
[sampling]
dt = {dt}
input_hold = "zero-order"
clock = "sequence"
[measurement]
columns = [{joints}]
[input]
delay = {{ mean = 0.01, std = 0.01 }}
"""


def write(folder: Path, joints: int, undeclared: str | None = None) -> Rig:
    """The machine file with servos, and what is declared: gains that are not the true ones, or one thing less."""
    text = PENDULUM if joints == 1 else arm(joints)
    for i in range(joints):
        servo = f'<position name="goal{i + 1}" joint="joint{i + 1}" kp="{KP[i]}" kv="{KD[i]}"/>'
        text = text.replace(f'<motor name="tau{i + 1}" joint="joint{i + 1}"/>', servo)
    (folder / "servos.xml").write_text(text)
    names = ", ".join(f'"joint{i + 1}"' for i in range(joints))
    tables = [f"[input.goal{i + 1}]\nkp = {{ mean = {SHARE * KP[i]}, std = {0.4 * KP[i]} }}\n" for i in range(joints)]
    plain, delay, end = RIG.format(dt=DT, joints=names).partition("delay = { mean = 0.01, std = 0.01 }\n")
    (folder / "rig.toml").write_text(plain + end if undeclared else plain + delay + end + "".join(tables))
    return read_rig(folder / "rig.toml", specs)


def friction(v: np.ndarray, level: np.ndarray) -> np.ndarray:
    """True friction at joint rates [N m]."""
    return -level * ((1.0 + 0.5 * np.exp(-((v / 0.15) ** 2))) * np.tanh(v / 0.03) + 0.6 * v)


def simulated(
    path: Path, joints: int, sequences: int, rows: int, seed: int, undeclared: str | None = None, limit: float = np.inf
) -> Dataset:
    """Logs of commands and encoders, as MuJoCo moves; `limit` is that of the first drive [N m]."""
    model = mujoco.MjModel.from_xml_path(str(path))
    if np.isfinite(limit):
        model.actuator_forcelimited[0], model.actuator_forcerange[0] = True, (-limit, limit)
    model.opt.timestep, model.opt.integrator = DT / INNER, mujoco.mjtIntegrator.mjINT_RK4
    rng, t, level = np.random.default_rng(seed), DT * np.arange(rows), np.asarray(COULOMB[:joints])
    late = np.asarray(DELAY[:joints]) / DT * (undeclared in (None, "delay"))
    commands, readings = np.empty((2, sequences, rows, joints))
    for s in range(sequences):
        size, period, phase = np.moveaxis(rng.uniform((0.1, 0.6, 0.0), (0.4, 3.0, 6.3), (4, joints, 3)), -1, 0)[
            ..., None
        ]
        u = np.sum(size * np.sin(2 * np.pi * t / period + phase), axis=0)
        u = u + np.repeat(rng.uniform(-0.3, 0.3, (joints, -(-rows // 80))), 80, axis=1)[:, :rows]
        data = mujoco.MjData(model)
        data.qpos[:] = u[:, 0]
        for k in range(rows):
            readings[s, k] = data.qpos + NOISE * rng.normal(size=joints)
            for j in range(INNER):
                row = np.maximum(np.floor(k + (j + 1e-6) / INNER - late), 0).astype(int)
                data.ctrl[:] = u[np.arange(joints), row]
                data.qfrc_applied[:] = friction(data.qvel, level)
                if undeclared == "load":
                    data.qfrc_applied[0] -= LOAD * abs(data.actuator_force[0]) * np.tanh(data.qvel[0] / 0.03)
                mujoco.mj_step(model, data)
        commands[s] = u.T
    times = np.broadcast_to(t, (sequences, rows))
    return Dataset(times, commands, readings, np.ones((sequences, rows), bool))


def judged(fit: Identified, joints: int, data: Dataset) -> list[str]:
    """A row of the table for every joint."""
    table, out = parameter_table(fit), []
    speed = np.percentile(np.abs(np.diff(np.asarray(data.y), axis=1)) / DT, 99, axis=(0, 1))
    v = speed[:, None] * np.linspace(-1.0, 1.0, 101)
    curve = np.asarray(jax.vmap(fit.model.unknown)(jnp.asarray(v.T))).T
    for i in range(joints):
        gain = 100 * (table[f"goal{i + 1}.kp"][0] / KP[i] - 1)
        delay = 1e3 * (table[f"goal{i + 1}.delay"][0] - DELAY[i])
        truth = friction(v[i], np.asarray(COULOMB[i]))
        missed = np.linalg.norm(curve[i] - truth) / np.linalg.norm(truth)
        out.append(f"| joint{i + 1} | {gain:+.1f} | {delay:+.2f} | {missed:.3f} |")
    return out


def searched(folder: Path, joints: int, shape: tuple[int, int], seed: int, undeclared: str) -> str:
    """A row on what `diagnose` found of a thing that is not declared."""
    rig, path = write(folder, joints, undeclared), folder / "servos.xml"
    limit = np.inf
    if undeclared == "limit":
        free = simulated(path, joints, *shape, seed, undeclared)
        rate = np.gradient(np.asarray(free.y), DT, axis=1)
        limit = LIMIT * float(np.abs(KP[0] * (free.u - free.y) - KD[0] * rate)[..., 0].max())
    data = simulated(path, joints, *shape, seed, undeclared, limit)
    began = time.perf_counter()
    reported = findings(diagnose(rig, data, key=jax.random.key(seed)))
    laws = "; ".join(
        f"{one.effect.name} of joint {one.effect.joint} "
        + ", ".join(f"{name} {number.value:.4g} ± {number.std:.1g}" for name, number in one.parameters.items())
        for one in reported
    )
    true = {"delay": f"{1e3 * DELAY[0]:g} ms", "limit": f"{limit:.3g} N m", "load": f"{LOAD:g}"}[undeclared]
    return f"| {undeclared}, {true} | {seed} | {laws or 'nothing'} | {time.perf_counter() - began:.0f} |"


def main() -> None:
    """Print a table for every seed, or a row for every search."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--joints", type=int, default=6, choices=(1, 6))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--sequences", type=int, default=8)
    parser.add_argument("--seconds", type=float, default=4.0)
    parser.add_argument("--epochs", type=int, default=20)
    parser.add_argument("--undeclared", nargs="+", default=[], choices=UNDECLARED)
    args = parser.parse_args()
    shape = args.sequences, round(args.seconds / DT) + 1
    for seed, what in ((seed, what) for what in args.undeclared for seed in args.seeds):
        with TemporaryDirectory() as folder:
            print(searched(Path(folder), args.joints, shape, seed, what), flush=True)
    if args.undeclared:
        return
    for seed in args.seeds:
        with TemporaryDirectory() as folder:
            rig = write(Path(folder), args.joints)
            data = simulated(Path(folder) / "servos.xml", args.joints, *shape, seed)
        began = time.perf_counter()
        fit = identify(rig, data, key=jax.random.key(seed), epochs=args.epochs)
        took = time.perf_counter() - began
        print(f"seed {seed}: {took:.0f} s, {fit.model.steps} integration steps of a sample")
        print("| joint | kp [%] | delay [ms] | friction NRMSE |\n| --- | --- | --- | --- |")
        print("\n".join(judged(fit, args.joints, data)), flush=True)


if __name__ == "__main__":
    main()
