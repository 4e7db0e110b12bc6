"""The observer on the paper's acrobot with theta2 hidden: beside the filter of the true model, its time, C and Python.

python benchmarks/observer.py --table docs/results/observer.md           # some minutes
python benchmarks/observer.py --steps 10000000                           # with the long run under sanitizers
"""

import argparse
import platform
import subprocess
import sys
import tempfile
import time
from datetime import date
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from observer_c import SANITIZED, held, paper_rig, play, replay, rough, wild

import nnap_em
from nnap_em.data.dataset import Dataset
from nnap_em.fit.identify import Identified, identify
from nnap_em.fit.observer import RESTARTED, Observer, functions, observer, restart_prior
from nnap_em.model.simulate import paper_experiment, paper_model
from nnap_em.portable.online import write_observer
from nnap_em.smoother.kalman import CUBATURE


def hidden_error(online: Observer, data: Dataset, x: np.ndarray, settled: int = 100) -> tuple[float, int]:
    """RMS error of theta2 [rad] after the first rows of every sequence, and the number of new starts."""

    def every(state, row):
        state = jax.vmap(online.step)(state, *row)
        return state, (state.mean, state.flags)

    rows = tuple(jnp.swapaxes(jnp.asarray(a), 0, 1) for a in (jax.vmap(held)(data.u), data.y))
    begin = jax.vmap(online.start)(jnp.asarray(data.t[:, 0]))
    mean, flags = jax.jit(lambda: jax.lax.scan(every, begin, rows)[1])()
    error = np.asarray(mean)[settled:, :, 1] - np.asarray(x)[:, settled:, 1].T
    restarts = int(np.sum(np.asarray(flags) & RESTARTED > 0))
    return float(np.sqrt(np.mean(((error + np.pi) % (2 * np.pi) - np.pi) ** 2))), restarts


def python_time(online: Observer, u: np.ndarray, y: np.ndarray) -> float:
    """Median time of a step [s], the last half of a log."""
    state, times = online.start(), []
    for row in zip(u, y, strict=True):
        begin = time.perf_counter()
        state = online.step(state, *row)
        state.mean.block_until_ready()
        times.append(time.perf_counter() - begin)
    return float(np.median(times[len(times) // 2 :]))


def main() -> int:
    """Fit, compare, time."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--sequences", type=int, default=20, help="test sequences of 5 s (20)")
    arguments.add_argument("--rows", type=int, default=10_000, help="rows of C beside Python (10,000)")
    arguments.add_argument("--steps", type=int, default=0, help="steps under the sanitizers (0)")
    arguments.add_argument("--table", type=Path, help="page to write")
    args = arguments.parse_args()
    jax.config.update("jax_enable_x64", True)
    truth, key_fit, key_test, key_long = paper_model(), *jax.random.split(jax.random.key(48), 3)
    train = paper_experiment(truth, 20, 499, key=key_fit).data
    fitted = identify(paper_rig(), train, key=jax.random.key(0))
    test = paper_experiment(truth, args.sequences, 499, key=key_test)
    online, known = observer(fitted), true_observer(fitted, truth)
    lines = []
    (error, restarts), (best, _) = (hidden_error(one, test.data, test.x) for one in (online, known))
    lines.append(f"| hidden theta2 from 1 s on, RMSE, {args.sequences} sequences of 5 s | {error:.4f} rad |")
    lines.append(f"| the same by the filter of the true model | {best:.4f} rad, ratio {error / best:.3f} |")
    lines.append(f"| new starts in these | {restarts} |")
    long = paper_experiment(truth, 1, args.rows - 1, key=key_long).data
    t, u, y = np.asarray(long.t[0]), held(np.asarray(long.u[0])), rough(long.y[0])
    states = replay(online, t, u, y)
    std = np.sqrt(np.diagonal(states.cov, axis1=1, axis2=2))
    with tempfile.TemporaryDirectory() as folder:
        for name, kind in (("arm", np.float64), ("arm32", np.float32)):
            source = Path(folder, f"{name}.c")
            write_observer(fitted, source, single=kind is np.float32)
            found = play(source, t, u, y, 4, kind)
            gap = np.max(np.abs(found.mean - states.mean) / std)
            same = int(np.sum(found.flags != np.asarray(states.flags)))
            label = "32" if kind is np.float32 else "64"
            lines.append(
                f"| C in {label} bits beside Python, {args.rows} rows with gaps and spikes: mean | {gap:.1e} standard "
                f"deviations; {same} rows with other flags |"
            )
            whole = play(source, t[:4000], u[:4000], np.asarray(long.y[0])[:4000], 4, kind)
            lines.append(f"| a step in C, {label} bits | {1e6 * whole.seconds:.1f} us |")
            if args.steps:
                counts = wild(source, args.steps, *SANITIZED)
                words = "new starts, {:d} rows with several branches, {:d} jumps of time, {:d} rows with outliers"
                lines.append(
                    f"| {args.steps} wild steps in {label} bits, sanitizers | clean; {counts[0]} "
                    f"{words.format(*counts[1:])} |"
                )
    lines.append(
        f"| a step in Python, jitted | {1e6 * python_time(online, u[:1000], np.asarray(long.y[0])[:1000]):.0f} us |"
    )
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False)
    where = f"{date.today()}, {platform.processor() or platform.machine()}, nnap_em {nnap_em.__version__}, "
    where += f"commit {commit.stdout.strip()}"
    table = "\n".join(["| | |", "| --- | --- |", *lines])
    print(where, table, sep="\n")
    if args.table:
        head = args.table.read_text().partition("<!-- table -->")[0] if args.table.exists() else ""
        args.table.write_text(f"{head}<!-- table -->\n\n{where}, `{' '.join(sys.argv)}`\n\n{table}\n")
    return 0


def true_observer(fitted: Identified, truth) -> Observer:
    """The observer of the model that made the logs."""
    start, step = functions(truth, fitted.bank.angles, restart_prior(truth), 16, CUBATURE)
    return observer(fitted)._replace(start=start, step=step)


if __name__ == "__main__":
    sys.exit(main())
