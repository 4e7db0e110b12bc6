"""Friction of both joints of a machine of which one is read: declared by an MJCF file, logs from MuJoCo itself.

    python examples/machine_files.py [--machine cartpole|furuta] [--seed 0]

The plant is MuJoCo's own integrator at a twentieth of the sample interval with a friction law of this script, so that
nothing of the library made the logs.  Of the cart and pole the cart is read, of the Furuta pendulum its rod.
"""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from nnap_em import identify
from nnap_em.base.programs import use_older_emitters
from nnap_em.logs.dataset import Dataset
from nnap_em.machines.machine import unpacked
from nnap_em.machines.rig import read_rig
from nnap_em.machines.systems import specs

HERE = Path(__file__).resolve().parent / "machines"
DT, FINE = 0.01, 20
Law = Callable[[np.ndarray], np.ndarray]


class Case(NamedTuple):
    """A machine, its true friction, and how it is driven."""

    coulomb: tuple[float, ...]
    """[N m or N]"""
    viscous: tuple[float, ...]
    """[N m s/rad or N s/m]"""
    knee: tuple[float, ...]
    """Velocity at which dry friction has three quarters of its size."""
    push: float
    """Largest input [N or N m]."""
    noise: float
    """Of the readings [m or rad]."""


CASES = {
    "cartpole": Case((0.8, 0.004), (1.5, 0.003), (0.01, 0.05), 6.0, 0.0005),
    "furuta": Case((0.004, 0.002), (0.002, 0.0008), (0.05, 0.05), 0.04, 0.001),
}
"""Friction on the driven joint, then on the other one."""


def friction(case: Case) -> Law:
    """Smooth Coulomb friction and viscous friction, as torques at velocities."""
    coulomb, viscous, knee = map(np.asarray, case[:3])
    return lambda v: -coulomb * np.tanh(v / knee) - viscous * v


def recorded(
    text: str,
    law: Law,
    push: float,
    noise: np.ndarray,
    *,
    sequences: int,
    rows: int,
    seed: int,
) -> tuple[Dataset, np.ndarray]:
    """Logs of a machine under multi-sines on every motor, and all its states: all joints are read, with noise."""
    rng, model = np.random.default_rng(seed), mujoco.MjModel.from_xml_string(text)
    model.opt.timestep, model.opt.integrator = DT / FINE, int(mujoco.mjtIntegrator.mjINT_RK4)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)  # no stops, no friction of the file's own
    model.dof_damping[:] = 0.0
    t = DT * np.arange(rows)
    u, x = np.zeros((sequences, rows, model.nu)), np.zeros((sequences, rows, 2 * model.nv))
    for s in range(sequences):
        data = mujoco.MjData(model)
        data.qpos[1:] = 0.5 * rng.normal(size=model.nv - 1)
        tones, phases = rng.uniform(0.2, 1.6, (model.nu, 4)), rng.uniform(0, 2 * np.pi, (model.nu, 4))
        u[s] = push * np.mean(np.sin(2 * np.pi * tones[None] * t[:, None, None] + phases[None]), axis=-1) * 1.8
        for k in range(rows):
            x[s, k] = np.concatenate([data.qpos, data.qvel])
            data.ctrl[:] = u[s, k]
            for _ in range(FINE):
                data.qfrc_applied[:] = law(data.qvel)
                mujoco.mj_step(model, data)
    y = x[..., : model.nv] + noise * rng.normal(size=(sequences, rows, model.nv))
    return Dataset(np.tile(t, (sequences, 1)), u, y, np.ones((sequences, rows), bool)), x


def main() -> None:
    """Identify, and say how far the curves are from the truth over the visited velocities."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--machine", choices=CASES, default="cartpole")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--sequences", type=int, default=8)
    parser.add_argument("--rows", type=int, default=400)
    parser.add_argument("--epochs", type=int, default=20)
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    use_older_emitters()
    case = CASES[args.machine]
    text, law = (HERE / f"{args.machine}.xml").read_text(), friction(case)
    rig = read_rig(HERE / f"{args.machine}.toml", specs)
    logs, x = recorded(
        text, law, case.push, np.asarray(case.noise), sequences=args.sequences, rows=args.rows, seed=args.seed
    )
    read = [unpacked(rig.machine).states.index(name) for name in rig.measured]
    data = logs._replace(y=logs.y[..., read])
    fitted = identify(rig, data, key=jax.random.key(args.seed), epochs=args.epochs)
    for j, error in enumerate(errors(fitted.model.unknown, law, x), 1):
        print(f"joint {j}: NRMSE {error:.3f}")


def errors(learned: Callable, law: Law, x: np.ndarray) -> list[float]:
    """Root mean square error of the learned friction over that of the true one, where 95 % of the velocities are."""
    dof = x.shape[-1] // 2
    ends = np.percentile(np.abs(x[..., dof:].reshape(-1, dof)), 95, axis=0)
    grid = np.linspace(-1.0, 1.0, 81)[:, None] * ends[None]
    curves, truth = np.asarray(jax.vmap(learned)(jnp.asarray(grid))), law(grid)
    return list(np.sqrt(np.mean((curves - truth) ** 2, axis=0) / np.mean(truth**2, axis=0)))


if __name__ == "__main__":
    main()
