"""A joint that is not read: starts over the whole circle, and sensors that start late: docs/results/hidden.md.

    python benchmarks/hidden.py circle [--seeds 10]
    python benchmarks/hidden.py late [--seeds 3]

The paper's acrobot, joint 1 read.  `circle`: theta2 of the first row is uniform on the circle and not declared; the
true model smooths, once as a single Gaussian and once with the mixture.  A sequence is on the true branch where theta2
is within 0.3 rad of the truth, root mean square, multiples of a turn aside.  `late`: friction identified with and
without the readings of the first 0.3 s, its error over the visited velocities.  Real rigs: `measured.py`.
"""

import argparse
import os
import platform
import sys
import time
from datetime import date

import jax
import jax.numpy as jnp
import numpy as np
from identify import nrmse, paper_rig, visited

from nnap_em.estimate.em.loop import e_step
from nnap_em.estimate.identify import friction_table, identify
from nnap_em.estimate.predict import posterior_of
from nnap_em.estimate.smoother.gaussian import CubatureSmoother
from nnap_em.estimate.smoother.start import StartBank
from nnap_em.model.simulate import paper_experiment, paper_model, simulate

LOST = 0.3
"""Root mean square error of theta2 beyond which a sequence is on another branch [rad]."""
LATE = 30
"""Rows without readings."""


SMOOTHERS = {"one Gaussian": StartBank((1, 13, 1, 1)), "mixture": StartBank((1, 13, 1, 1), (0, 1))}
"""Banks of the start: the first names no angles, so that no mixture is used."""


def circle(seed: int) -> list[dict[str, object]]:
    """Share of the sequences on the true branch by each smoother."""
    key_log, key_start, key_noise = jax.random.split(jax.random.key(seed), 3)
    model = paper_model(start_std=np.pi / 2)
    drawn = paper_experiment(model, key=key_log)
    angle = jax.random.uniform(key_start, drawn.x.shape[:1], float, -np.pi, np.pi)
    logs = simulate(model, drawn.x[:, 0].at[:, 1].set(angle), drawn.data.u, key=key_noise)
    out = []
    for name, bank in SMOOTHERS.items():
        began = time.perf_counter()
        posterior = e_step(model, logs.data, CubatureSmoother(bank).tolerant(), key=jax.random.key(0))
        error = np.asarray(posterior.state.mean - logs.x)[..., 1]
        error = error - 2 * np.pi * np.round(np.median(error, axis=1, keepdims=True) / (2 * np.pi))
        rmse = np.sqrt(np.mean(error**2, axis=1))
        out.append({
            "seed": seed, "smoother": name, "on the true branch": f"{np.sum(rmse < LOST)} of {len(rmse)}",
            "median RMSE [rad]": f"{np.median(rmse):.3f}",
            "mean log-likelihood": f"{np.mean(np.asarray(posterior.loglik)):.0f}",
            "s": f"{time.perf_counter() - began:.1f}",
        })  # fmt: skip
    return out


def late(seed: int) -> list[dict[str, object]]:
    """Friction error of both joints and theta2, all readings there and those of the first rows missing."""
    truth = paper_model(start_std=0.5)
    train = paper_experiment(truth, key=jax.random.fold_in(jax.random.key(seed), 0))
    velocity, count = visited(train.x)
    torque = jax.vmap(truth.unknown)(velocity.T).T
    out = []
    for rows in (0, LATE):
        data = train.data._replace(y=train.data.y.at[:, :rows].set(jnp.nan))
        fitted = identify(paper_rig(0.5), data, key=jax.random.key(seed))
        error = nrmse(friction_table(fitted, velocity).torque - torque, torque, count)
        state = posterior_of(fitted, data).state.mean
        theta2 = np.sqrt(np.mean(np.asarray(state - train.x)[..., 1] ** 2, axis=1))
        out.append({
            "seed": seed, "late by [s]": rows * truth.dt,
            "friction error": ", ".join(f"{e:.4f}" for e in error),
            "theta2, median RMSE [rad]": f"{np.median(theta2):.3f}",
            "on another branch": f"{np.sum(theta2 > LOST)} of {len(theta2)}",
        })  # fmt: skip
    return out


def main() -> None:
    """Run the seeds of a study and print its table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("study", choices=("circle", "late"))
    parser.add_argument("--seeds", type=int, default=3)
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print(
        f"{date.today()}, {platform.machine()}, {len(os.sched_getaffinity(0))} cores, "
        f"Python {platform.python_version()}, jax {jax.__version__}; `{' '.join(['python', *sys.argv])}`\n"
    )
    study = {"circle": circle, "late": late}[args.study]
    for seed in range(args.seeds):
        for i, row in enumerate(study(seed)):
            if seed == i == 0:
                print(f"| {' | '.join(row)} |\n|{' --- |' * len(row)}")
            print(f"| {' | '.join(map(str, row.values()))} |", flush=True)


if __name__ == "__main__":
    main()
