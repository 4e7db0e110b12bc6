"""Friction from logs that rest most of the time, position alone: the table of docs/results/rest.md.

python benchmarks/rest.py [--share 0.5 0.7 0.8] [--seeds 5]

A slide and pendulums are simulated in NumPy, 6 logs of 6 s each, every 10 ms; the drive is a sum of sines, scaled until
the machine rests for a share of the rows. At rest is a speed below three times that over which the sign of the
friction changes.
"""

import argparse
import time
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from runner import made

from nnap_em.estimate.identify import friction_table, identify
from nnap_em.logs.dataset import Dataset, pad
from nnap_em.machines.rig import Declared, Rig
from nnap_em.model.law import fit_law

DT, ROWS, LOGS, FINE = 0.01, 600, 6, 100


class Machine(NamedTuple):
    """J v' = drive - gravity sin(q) - coulomb tanh(v / smooth) - viscous v, in SI units."""

    system: str
    parameters: dict[str, float]
    coulomb: float
    viscous: float
    smooth: float
    noise: float

    @property
    def inertia(self) -> float:
        """Of the joint [kg m^2, or kg]."""
        p = self.parameters
        return p["m"] if self.system == "slide" else p["I"] + p["m"] * p["lc"] ** 2

    @property
    def gravity(self) -> float:
        """Torque at a quarter turn [N m]."""
        p = self.parameters
        return 0.0 if self.system == "slide" else p["m"] * p["lc"] * p["g"]

    def friction(self, v):
        """Torque against motion [N m, or N]."""
        return self.coulomb * np.tanh(v / self.smooth) + self.viscous * v

    def rig(self) -> Rig:
        """Its declaration: all but friction and noise."""
        declared = {name: Declared(value, 0.0) for name, value in self.parameters.items()}
        read = ("x",) if self.system == "slide" else ("theta1",)
        return Rig(self.system, self.system, declared, True, ("u",), (1,), DT, "sequence", read, {}, {})


BODY = {"m": 0.5, "lc": 0.2, "I": 0.004, "g": 9.81}
MACHINES = {
    "slide": Machine("slide", {"m": 1.0}, 1.0, 0.5, 1e-3, 5e-5),
    "pendulum": Machine("pendulum", BODY, 0.25, 0.01, 0.02, 2e-4),
    "sharp pendulum": Machine("pendulum", BODY, 0.12, 0.01, 0.005, 2e-4),
    "noisy pendulum": Machine("pendulum", BODY, 0.12, 0.01, 0.02, 2e-3),
}


def drive(rng: np.random.Generator) -> np.ndarray:
    """Sums of three sines of 0.1 to 0.8 Hz, a row for every log."""
    t = np.arange(ROWS) * DT
    rate, phase, size = rng.uniform(0.1, 0.8, (3, LOGS, 1)), rng.uniform(0, 6.3, (3, LOGS, 1)), rng.uniform(0.3, 1)
    return np.sum(size * np.sin(2 * np.pi * rate * t + phase), axis=0)


def motion(machine: Machine, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Position and velocity in every row, from rest at 0; the input is held over a row."""
    h = DT / FINE

    def slope(v, q, u):
        return (u - machine.gravity * np.sin(q) - machine.friction(v)) / machine.inertia

    q, v = np.zeros(u.shape[:-1]), np.zeros(u.shape[:-1])
    out = np.zeros((2, *u.shape))
    for k in range(u.shape[-1]):
        out[:, ..., k] = q, v
        for _ in range(FINE):
            a1 = slope(v, q, u[..., k])
            a2 = slope(v + 0.5 * h * a1, q + 0.5 * h * v, u[..., k])
            q, v = q + h * v + 0.5 * h**2 * a1, v + h * a2
    return out[0], out[1]


def logs(machine: Machine, share: float, seed: int) -> tuple[Dataset, np.ndarray]:
    """Logs with some share of their rows at rest, and their velocities."""
    rng = np.random.default_rng(seed)
    shape, sizes = drive(rng), machine.coulomb * np.geomspace(0.4, 12, 24)
    rests = lambda v: np.mean(np.abs(v) < 3 * machine.smooth, axis=(-1, -2))  # noqa: E731
    got = rests(motion(machine, sizes[:, None, None] * shape)[1])
    size = sizes[np.argmin(np.abs(got - share))]
    q, v = motion(machine, size * shape)
    t = np.arange(ROWS) * DT
    u, y = size * shape, q + machine.noise * rng.standard_normal(q.shape)
    return pad([(t, u[i, :, None], y[i, :, None]) for i in range(LOGS)]), v


class Result(NamedTuple):
    """One fit beside the truth."""

    resting: float
    error: float
    """RMS of learned minus true friction where it moves, over Coulomb."""
    inside: float
    """Share of those velocities at which the truth is within two standard deviations."""
    coulomb: float
    """Fitted over true."""
    std: float
    """Of the fitted Coulomb friction, over the true one."""
    top: float
    epochs: int
    seconds: float


def study(machine: Machine, share: float, seed: int) -> Result:
    """Fit one set of logs."""
    data, v = logs(machine, share, seed)
    begun = time.perf_counter()
    fitted = identify(machine.rig(), data, key=jax.random.key(seed))
    moving = np.sort(v[np.abs(v) > 3 * machine.smooth])
    velocity = moving[:: max(1, len(moving) // 400)]
    table = friction_table(fitted, jnp.asarray(velocity)[None])
    miss = np.asarray(table.torque[0]) + machine.friction(velocity)
    top = np.max(np.abs(moving))
    nodes = jnp.asarray(top * np.sinh(np.linspace(-1, 1, 81) * np.arcsinh(100.0)) / 100.0)[None]
    over = friction_table(fitted, nodes)
    law = fit_law(over.velocity, over.torque, over.cov)
    loglik = float(np.nanmean(fitted.state.top))
    return Result(
        float(np.mean(np.abs(v) < 3 * machine.smooth)),
        float(np.sqrt(np.mean(miss**2))) / machine.coulomb,
        float(np.mean(np.abs(miss) <= 2 * np.asarray(table.std[0]))),
        float(law.value[0, 0]) / machine.coulomb,
        float(law.std[0, 0]) / machine.coulomb,
        loglik,
        fitted.state.epoch,
        time.perf_counter() - begun,
    )


def main() -> None:
    """Run the study and print its table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--share", type=float, nargs="+", default=[0.5, 0.7, 0.8])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--only", choices=tuple(MACHINES), help="one machine")
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print(made())
    print(
        "| machine | at rest | seed | friction error / Coulomb | truth inside 2 std | Coulomb, fitted over true",
        end=" ",
    )
    print("| log-likelihood a sequence | epochs | s |\n|" + 9 * " --- |")
    for name in MACHINES if args.only is None else [args.only]:
        for share in args.share:
            for seed in range(args.seeds):
                r = study(MACHINES[name], share, seed)
                print(
                    f"| {name} | {r.resting:.2f} | {seed} | {r.error:.3f} | {r.inside:.2f} | "
                    f"{r.coulomb:.3f} ± {r.std:.3f} | {r.top:.1f} | {r.epochs} | {r.seconds:.1f} |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
