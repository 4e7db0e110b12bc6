"""Friction and inertia from an input that is a smooth signal, read at 25 Hz: the table of docs/results/hold.md.

python benchmarks/hold.py [--seeds 10] [--hold zero-order first-order]

A slide with a load cell and a pendulum with a torque sensor are simulated by scipy under sums of three sines in
continuous time, 5 logs of 12 s each; position, and the force at the same moments, are read every 40 ms. Counted is
whether the truth is within two stated standard deviations: of the inertia, and of friction at 0.3, 0.6 and 0.9 of the
largest speed, both ways.
"""

import argparse
import dataclasses
import os
import platform
import sys
from datetime import date
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

from nnap_em.data.dataset import Dataset, pad
from nnap_em.data.rig import HOLD, SMOOTH, Declared, Rig
from nnap_em.fit.identify import friction_table, identify, parameter_table

DT, ROWS, LOGS = 0.04, 300, 5
SPEEDS = np.array([-0.9, -0.6, -0.3, 0.3, 0.6, 0.9])
"""Speeds at which friction is compared [largest speed]."""


class Machine(NamedTuple):
    """J v' = drive - gravity sin(q) - coulomb tanh(v / smooth) - viscous v, in SI units."""

    rig: Rig
    unknown: str
    """Number that is estimated."""
    true: float
    inertia: float
    gravity: float
    coulomb: float
    viscous: float
    smooth: float
    noise: float
    drive: float

    def friction(self, v):
        """Torque against motion [N m, or N]."""
        return self.coulomb * np.tanh(v / self.smooth) + self.viscous * v


def _rig(system: str, numbers: dict[str, Declared], read: str) -> Rig:
    return Rig(system, system, numbers, True, ("u",), (1,), DT, "sequence", (read,), {}, {})


_BODY = {"m": Declared(0.5, 0.0), "lc": Declared(0.2, 0.0), "g": Declared(9.81, 0.0)}
MACHINES = {
    "slide": Machine(_rig("slide", {"m": Declared(2.1, 0.3)}, "x"), "m", 2.0, 2.0, 0.0, 1.0, 1.5, 0.02, 3e-4, 3.0),
    "pendulum": Machine(
        _rig("pendulum", {**_BODY, "I": Declared(0.005, 0.002)}, "theta1"),
        "I", 0.004, 0.004 + 0.5 * 0.2**2, 0.5 * 0.2 * 9.81, 0.08, 0.02, 0.05, 1e-3, 0.35,
    ),
}  # fmt: skip


def logs(machine: Machine, seed: int) -> tuple[Dataset, float]:
    """The recordings, and the largest speed in them."""
    rng, t, fastest = np.random.default_rng(seed), DT * np.arange(ROWS), 0.0
    sequences = []
    for _ in range(LOGS):
        rate, phase = 2 * np.pi * rng.uniform(0.2, 1.5, 3), rng.uniform(0, 2 * np.pi, 3)
        size = machine.drive * rng.uniform(0.5, 1.5, 3)
        force = lambda t, size=size, rate=rate, phase=phase: np.sum(size * np.sin(rate * t + phase))  # noqa: E731

        def slope(t, x, force=force):
            push = force(t) - machine.gravity * np.sin(x[0]) - machine.friction(x[1])
            return [x[1], push / machine.inertia]

        x = solve_ivp(slope, (0, t[-1]), [0, 0], t_eval=t, rtol=1e-8, atol=1e-10, max_step=DT / 4).y
        fastest = max(fastest, float(np.abs(x[1]).max()))
        y = x[0] + machine.noise * rng.normal(size=ROWS)
        sequences.append((t, np.array([[force(at)] for at in t]), y[:, None]))
    return pad(sequences), fastest


def errors(machine: Machine, hold: str, seed: int) -> tuple[float, float, np.ndarray]:
    """Estimate and error of the inertia, and errors of friction, both in stated standard deviations."""
    data, fastest = logs(machine, seed)
    fitted = identify(dataclasses.replace(machine.rig, input_hold=hold), data, key=jax.random.key(seed))
    value, std = parameter_table(fitted)[machine.unknown]
    v = fastest * SPEEDS
    table = friction_table(fitted, jnp.asarray(v)[None])
    off = (np.asarray(table.torque[0]) + machine.friction(v)) / np.asarray(table.std[0])
    return value, (value - machine.true) / std, off


def main() -> None:
    """Run the study and print its table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--hold", nargs="+", default=[HOLD, SMOOTH], choices=(HOLD, SMOOTH))
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print(
        f"{date.today()}, {platform.machine()}, {len(os.sched_getaffinity(0))} cores, "
        f"Python {platform.python_version()}, jax {jax.__version__}; `{' '.join(['python', *sys.argv])}`\n"
    )
    print("| machine | input_hold | inertia within 2 std | friction within 2 std | median errors [std] |")
    print("|" + 5 * " --- |")
    for name, machine in MACHINES.items():
        for hold in args.hold:
            found = [errors(machine, hold, seed) for seed in range(args.seeds)]
            inertia, friction = np.array([off for _, off, _ in found]), np.concatenate([off for *_, off in found])
            inside = [f"{np.sum(np.abs(off) <= 2)} of {off.size}" for off in (inertia, friction)]
            median = [f"{np.median(np.abs(off)):.1f}" for off in (inertia, friction)]
            print(f"| {name} | {hold} | {' | '.join(inside)} | {', '.join(median)} |", flush=True)


if __name__ == "__main__":
    main()
