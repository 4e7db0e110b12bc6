"""Friction of a simulated slide and pendulum, position read: last table of docs/results/identify.md.

python benchmarks/one_dof.py [--seeds 5] [--law]

With `--law` the numbers of the Stribeck law of the curve, from few logs (slide: 4 of 1.5 s, those of the README;
pendulum: 4 of 2.5 s): the second table of docs/results/calibration.md.
"""

import argparse
import dataclasses
import os
import platform
import sys
from datetime import date

import jax
import jax.numpy as jnp
import numpy as np

from nnap_em.data.rig import Declared, Rig
from nnap_em.fit.identify import friction_table, identify
from nnap_em.model.law import PARAMETERS, fit_law
from nnap_em.model.simulate import declared, examples, sweep_experiment
from nnap_em.report.tables import visited_nodes

ROWS = {"slide": 150, "pendulum": 250}
"""Rows of each of the 4 logs of `--law`."""


def study(name: str, seed: int, sequences: int = 20, steps: int = 500) -> tuple[float, float, int]:
    """NRMSE over the visited velocities, the share of the 90 % band's hits, and the epochs."""
    truth, sweep = examples[name]()
    key_data, key_fit = jax.random.split(jax.random.key(seed))
    logs = sweep_experiment(truth, sweep, sequences, steps, key=key_data)
    system = truth.system
    parameters = {
        f.name: Declared(float(getattr(system, f.name)), 0.0) for f in dataclasses.fields(system) if f.name != "joints"
    }
    rig = Rig(name, name, parameters, True, ("u",), (1,), truth.dt, "sequence", system.coordinates, {}, {})
    fitted = identify(rig, logs.data, key=key_fit)
    velocity = jnp.asarray(np.quantile(np.asarray(logs.x[..., 1]), np.linspace(0, 1, 2001)))[None]
    torque = jax.vmap(truth.unknown)(velocity.T).T
    table = friction_table(fitted, velocity)
    error = np.asarray(table.torque - torque)
    nrmse = np.sqrt(np.mean(error**2) / np.mean(np.asarray(torque) ** 2))
    return float(nrmse), float(np.mean(np.abs(error) <= 1.645 * np.asarray(table.std))), fitted.state.epoch


def law(name: str, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Errors of the numbers of the law, and their standard deviations."""
    truth, sweep = examples[name]()
    logs = sweep_experiment(truth, sweep, 4, ROWS[name], key=jax.random.key(seed))
    fitted = identify(declared(name, truth), logs.data, key=jax.random.key(0))
    table = friction_table(fitted, jnp.asarray(visited_nodes(np.asarray(logs.x)[..., 1].reshape(-1, 1))))
    found = fit_law(table.velocity, table.torque, table.cov)
    true = [float(getattr(truth.unknown, number)[0]) for number in PARAMETERS[:-1]]
    return found.value[0] - [*true, 0.0], found.std[0]


def print_laws(seeds: int) -> None:
    """A row for each machine and number."""
    print("| machine | number | within 2 std [%] | median error | median std |\n| --- | --- | --- | --- | --- |")
    for name in ROWS:
        error, std = map(np.stack, zip(*(law(name, seed) for seed in range(seeds)), strict=True))
        for i, number in enumerate(PARAMETERS):
            inside = 100 * np.mean(np.abs(error[:, i]) <= 2 * std[:, i])
            sizes = f"{np.median(np.abs(error[:, i])):.2g} | {np.median(std[:, i]):.2g}"
            print(f"| {name} | {number} | {inside:.0f} | {sizes} |", flush=True)


def main() -> None:
    """Run the study and print its table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--law", action="store_true")
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print(
        f"{date.today()}, {platform.machine()}, {len(os.sched_getaffinity(0))} cores, "
        f"Python {platform.python_version()}, jax {jax.__version__}; `{' '.join(['python', *sys.argv])}`\n"
    )
    if args.law:
        print_laws(args.seeds)
        return
    print("| system | friction NRMSE, each seed | median | coverage of the 90 % band, median [%] |")
    print("| --- | --- | --- | --- |")
    for name in ("slide", "pendulum"):
        rows = [study(name, seed) for seed in range(args.seeds)]
        nrmse = [row[0] for row in rows]
        each = ", ".join(f"{v:.3f}" for v in nrmse)
        print(f"| {name} | {each} | {np.median(nrmse):.3f} | {100 * np.median([r[1] for r in rows]):.0f} |", flush=True)


if __name__ == "__main__":
    main()
