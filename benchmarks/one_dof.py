"""Friction of a simulated slide and pendulum, position read: last table of docs/results/identify.md.

python benchmarks/one_dof.py [--seeds 5]
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
from nnap_em.model.simulate import examples, sweep_experiment


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


def main() -> None:
    """Run the study and print its table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print(
        f"{date.today()}, {platform.machine()}, {len(os.sched_getaffinity(0))} cores, "
        f"Python {platform.python_version()}, jax {jax.__version__}; `{' '.join(['python', *sys.argv])}`\n"
    )
    print("| system | friction NRMSE, each seed | median | coverage of the 90 % band, median [%] |")
    print("| --- | --- | --- | --- |")
    for name in ("slide", "pendulum"):
        rows = [study(name, seed) for seed in range(args.seeds)]
        nrmse = [row[0] for row in rows]
        each = ", ".join(f"{v:.3f}" for v in nrmse)
        print(f"| {name} | {each} | {np.median(nrmse):.3f} | {100 * np.median([r[1] for r in rows]):.0f} |", flush=True)


if __name__ == "__main__":
    main()
