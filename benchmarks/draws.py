"""Coverage of test recordings by simulations of posterior draws: a table of docs/results/machines.md.

python benchmarks/draws.py [--draws 64] [--seeds 10]

A simulated slide whose position is read is identified. Posterior draws, those of `nnap-em export --draws`, are
simulated over the inputs of test recordings from their true first state. A row of a recording is covered where it lies
between the 5 and 95 % quantiles of the simulations: 90 % of the rows if the draws are exact. The true machine is the
control: its paths differ by process noise alone.
"""

import argparse
import os
import platform
import subprocess
import sys
from datetime import date
from pathlib import Path
from tempfile import TemporaryDirectory

import jax
import jax.numpy as jnp
import numpy as np

from nnap_em.commands.common import set_up
from nnap_em.data.formats import read_csv
from nnap_em.export.draws import TABLE, write_draws
from nnap_em.fit.identify import Identified, identify
from nnap_em.fit.predict import Paths, drawn_paths
from nnap_em.model.simulate import Experiment, declared, examples, sweep_experiment
from nnap_em.model.state_space import StateSpaceModel

SEQUENCES, TESTS, STEPS = 8, 20, 300
"""Recordings of a fit, recordings of its test, and intervals of each."""
BAND = (0.05, 0.95)
"""Quantiles of the simulations."""
COLUMNS = tuple(f"x.{what}" for what in ("coulomb", "breakaway", "stribeck", "viscous", "offset"))
"""Friction in draws.csv, that of the slide."""


def tabled(common: Paths, table: Path) -> Paths:
    """Draws whose friction is that of their rows in draws.csv."""
    level, breakaway, stribeck, viscous, offset = jnp.asarray(read_csv(table, COLUMNS).T)[..., None, None]
    v = common.nodes[None]
    dry = (level + (breakaway - level) * jnp.exp(-((v / stribeck) ** 2))) * jnp.sign(v)
    learned = jax.vmap(common.model.unknown)(common.nodes.T).T
    return common._replace(tables=offset - dry - viscous * v - learned)


def simulated(common: Paths, test: Experiment, process: bool, key) -> np.ndarray:
    """States of every draw along every recording, with shape recording, row, draw, state."""
    std = jnp.exp(0.5 * common.model.log_q) * process

    @jax.jit
    def one(x0, seq, key):
        u = common.inputs(seq)
        start = jnp.broadcast_to(x0, (len(common.tables), x0.shape[0]))
        kick = std * jax.random.normal(key, (seq.t.shape[0], *start.shape), x0.dtype)

        def step(x, slices):
            u, kick = slices
            following, _ = common.advance(x, u)
            return following + kick, x

        return jax.lax.scan(step, start, (u, kick))[1]

    keys = jax.random.split(key, len(test.x))
    return np.asarray(jax.vmap(one)(test.x[:, 0], test.data, keys))


def covered(paths: np.ndarray, truth: np.ndarray) -> float:
    """Share of rows after the first in the band of the draws [%]; both have the recording first, then the row."""
    low, high = np.quantile(paths, BAND, axis=2, method="weibull")  # unbiased for few draws
    inside = (truth >= low) & (truth <= high)
    return 100 * float(np.mean(inside[:, 1:]))


def shares(
    fitted: Identified, truth: StateSpaceModel, test: Experiment, draws: int, seed: int
) -> dict[str, tuple[float, float, float]]:
    """Coverage of the readings, of the true position and of the true velocity [%], by what is in the band."""
    key_noise, key_read = jax.random.split(jax.random.key(1000 + seed))
    common = drawn_paths(fitted, draws, key=jax.random.key(seed))
    with TemporaryDirectory() as folder:
        write_draws(fitted, Path(folder), draws, key=jax.random.key(seed))
        written = tabled(common, Path(folder) / TABLE)
    true_machine = common._replace(model=truth, tables=jnp.zeros_like(common.tables))
    read, states = np.asarray(test.data.y)[..., 0], np.asarray(test.x)
    std = float(np.exp(0.5 * np.asarray(fitted.model.log_r)[0]))
    out = {}
    for name, paths, process in (
        ("posterior draws", common, False),
        ("posterior draws, process noise", common, True),
        ("rows of draws.csv, process noise", written, True),
        ("the true machine, process noise", true_machine, True),
    ):
        x = simulated(paths, test, process, key_noise)
        y = x[..., 0] + std * np.asarray(jax.random.normal(key_read, x.shape[:-1]))
        out[name] = covered(y, read), covered(x[..., 0], states[..., 0]), covered(x[..., 1], states[..., 1])
    return out


def main() -> None:
    """Run the study and print its table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=64)
    parser.add_argument("--seeds", type=int, default=10)
    args = parser.parse_args()
    set_up()
    folder = Path(__file__).parent
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], cwd=folder, capture_output=True, text=True)
    print(
        f"{date.today()}, {platform.machine()}, {len(os.sched_getaffinity(0))} cores, load {os.getloadavg()[0]:.1f}, "
        f"jax {jax.__version__}, commit {commit.stdout.strip()}; `{' '.join(['python', *sys.argv])}`\n"
    )
    model, sweep = examples["slide"]()
    rows = []
    for seed in range(args.seeds):
        logs = sweep_experiment(model, sweep, SEQUENCES, STEPS, key=jax.random.key(seed))
        test = sweep_experiment(model, sweep, TESTS, STEPS, key=jax.random.key(100 + seed))
        fitted = identify(declared("slide", model), logs.data, key=jax.random.key(seed))
        rows.append(shares(fitted, model, test, args.draws, seed))
    print("| in the band | readings of the position, each seed | mean | true position | true velocity [%] |")
    print("| --- | --- | --- | --- | --- |")
    for name in rows[0]:
        each = np.array([one[name] for one in rows])
        seeds = ", ".join(f"{share:.0f}" for share in each[:, 0])
        print(f"| {name} | {seeds} | {' | '.join(f'{share:.0f}' for share in each.mean(axis=0))} |")


if __name__ == "__main__":
    main()
