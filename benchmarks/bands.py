"""Friction bands near rest, on the paper's acrobot simulated in NumPy: the second table of docs/results/rest.md.

python benchmarks/bands.py [--seeds 10] [--asymmetric]

6 logs of 5 s, joint 1 read; near rest is the half of the nodes of the map next to it, inside the share of nodes at
which the truth lies within two standard deviations.
"""

import argparse
import os
import platform
import sys
import time
from datetime import date

import jax
import numpy as np

from nnap_em.data.dataset import Dataset, pad
from nnap_em.data.rig import Declared, Rig
from nnap_em.fit.identify import friction_table, identify
from nnap_em.systems.acrobot import table_i

DT, ROWS, LOGS, FINE = 0.01, 500, 6, 10
NOISE = np.array([0.01, 0.05])
KICK = np.array([2e-4, 2e-4, 1e-2, 1e-2])
COULOMB, BREAKAWAY, STRIBECK, VISCOUS, SMOOTH = (
    np.array(pair) for pair in ((0.030, 0.017), (0.045, 0.027), (0.35, 0.40), (0.0070, 0.0035), (0.1, 0.1))
)


def friction(v: np.ndarray, asymmetric: bool) -> np.ndarray:
    """Torque against motion of both joints (the last axis) [N m]; 45 % stronger one way and 35 % weaker the other."""
    level = COULOMB + (BREAKAWAY - COULOMB) * np.exp(-((v / STRIBECK) ** 2))
    way = np.where(v > 0, 1.45, 0.65) if asymmetric else 1.0
    return way * (level * np.tanh(v / SMOOTH) + VISCOUS * v)


def slopes(x: np.ndarray, u: np.ndarray, asymmetric: bool) -> np.ndarray:
    """Rates of (q, v) of every log [Spong 1995, eq. 1]."""
    p = table_i
    q, v = x[:, :2], x[:, 2:]
    m22 = p["I2"] + p["m2"] * p["lc2"] ** 2
    coupling, h = (p["m2"] * p["l1"] * p["lc2"] * f(q[:, 1]) for f in (np.cos, np.sin))
    m11 = p["I1"] + p["m1"] * p["lc1"] ** 2 + m22 + p["m2"] * p["l1"] ** 2 + 2 * coupling
    m12 = m22 + coupling
    rotor, gear = p.get("Ir", 0.0), p.get("gr", 1.0)
    m11, m12, m22 = m11 + gear**2 * rotor + rotor, m12 - gear * rotor, m22 + gear**2 * rotor
    outer = p["m2"] * p["lc2"] * p["g"] * np.sin(q[:, 0] + q[:, 1])
    weight = (p["m1"] * p["lc1"] + p["m2"] * p["l1"]) * p["g"] * np.sin(q[:, 0]) + outer
    force = -friction(v, asymmetric)
    one = force[:, 0] - weight + h * v[:, 1] * (2 * v[:, 0] + v[:, 1])
    two = force[:, 1] + u - outer - h * v[:, 0] ** 2
    det = m11 * m22 - m12**2
    return np.stack([v[:, 0], v[:, 1], (m22 * one - m12 * two) / det, (m11 * two - m12 * one) / det], axis=1)


def logs(seed: int, asymmetric: bool) -> Dataset:
    """Sines of another amplitude and period in each log, starts in the upper half plane."""
    rng = np.random.default_rng(seed)
    size, period, phase = rng.uniform(0.05, 0.3, LOGS), rng.uniform(0.5, 3.0, LOGS), rng.uniform(0, 6.28, LOGS)
    t = np.arange(ROWS + 1) * DT
    u = size[:, None] * np.sin(2 * np.pi * t / period[:, None] + phase[:, None])
    x = np.stack(
        [rng.uniform(np.pi / 2, 1.5 * np.pi, LOGS), rng.normal(0, 0.5, LOGS), *rng.normal(0, 0.02, (2, LOGS))], 1
    )
    out, h = [], DT / FINE
    for k in range(ROWS + 1):
        out.append(x)
        for _ in range(FINE):
            a = slopes(x, u[:, k], asymmetric)
            b = slopes(x + 0.5 * h * a, u[:, k], asymmetric)
            c = slopes(x + 0.5 * h * b, u[:, k], asymmetric)
            d = slopes(x + h * c, u[:, k], asymmetric)
            x = x + h / 6 * (a + 2 * b + 2 * c + d)
        x = x + KICK * rng.standard_normal(x.shape)
    path = np.stack(out, axis=1)
    y = path[..., [0, 2]] + NOISE * rng.standard_normal((LOGS, ROWS + 1, 2))
    return pad([(t, u[i, :, None], y[i]) for i in range(LOGS)])


def rig() -> Rig:
    """All but friction and process noise is declared."""
    values = {name: Declared(float(value), 0.0) for name, value in table_i.items()}
    start = {"theta2": Declared(0.0, 0.5), "dtheta2": Declared(0.0, 0.02)}
    noise = {"theta1": 0.01, "dtheta1": 0.05}
    return Rig("acrobot", "acrobot", values, True, ("u",), (2,), DT, "sequence", tuple(noise), noise, start)


def main() -> None:
    """Run the study and print its table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--asymmetric", action="store_true")
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print(
        f"{date.today()}, {platform.machine()}, {len(os.sched_getaffinity(0))} cores, "
        f"Python {platform.python_version()}, jax {jax.__version__}; `{' '.join(['python', *sys.argv])}`\n"
    )
    print(
        "| seed | inside near, joint 1 / 2 | inside far | rms error near [mN m] | stated near | joint 1 at rest",
        end=" ",
    )
    print("| log-likelihood a sequence | epochs | s |\n|" + 9 * " --- |")
    rows = []
    for seed in range(args.seeds):
        begun = time.perf_counter()
        fitted = identify(rig(), logs(seed, args.asymmetric), key=jax.random.key(seed))
        nodes = fitted.m_step.weights(fitted.model).nodes
        table = friction_table(fitted, nodes)
        miss = np.asarray(table.torque) + friction(np.asarray(nodes).T, args.asymmetric).T
        inside = np.abs(miss) <= 2 * np.asarray(table.std)
        near = np.zeros(nodes.shape[1], bool)
        near[10:31] = True
        mean = lambda a, at: np.mean(a[:, at], axis=1)  # noqa: E731
        row = [
            mean(inside, near),
            mean(inside, ~near),
            1e3 * np.sqrt(mean(miss**2, near)),
            1e3 * np.sqrt(mean(np.asarray(table.std) ** 2, near)),
        ]
        rows.append(row)
        pair = lambda a, f="{:.2f}": " / ".join(f.format(v) for v in a)  # noqa: E731
        rest = f"{1e3 * float(table.torque[0, 20]):.1f} ± {1e3 * float(table.std[0, 20]):.1f}"
        print(
            f"| {seed} | {pair(row[0])} | {pair(row[1])} | {pair(row[2])} | {pair(row[3])} | {rest} | "
            f"{np.nanmean(fitted.state.top):.1f} | {fitted.state.epoch} | {time.perf_counter() - begun:.0f} |",
            flush=True,
        )
    means = [" / ".join(f"{v:.2f}" for v in np.mean(column, axis=0)) for column in zip(*rows, strict=True)]
    print(f"| mean | {' | '.join(means)} | | | | |")


if __name__ == "__main__":
    main()
