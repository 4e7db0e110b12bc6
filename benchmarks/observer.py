"""The observer on the paper's acrobot with theta2 hidden: beside the filter of the true model, its time, C and Python.

python benchmarks/observer.py --table docs/results/observer.md           # some minutes
python benchmarks/observer.py --steps 10000000                           # with the long run under sanitizers
"""

import argparse
import ctypes
import platform
import subprocess
import sys
import tempfile
import time
from datetime import date
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import nnap_em
from nnap_em.data.dataset import Dataset
from nnap_em.data.rig import Declared, Rig
from nnap_em.fit.identify import Identified, identify
from nnap_em.fit.observer import RESTARTED, Observation, Observer, functions, observer, restart_prior
from nnap_em.model.simulate import paper_experiment, paper_model
from nnap_em.portable.online import write_observer
from nnap_em.smoother.kalman import CUBATURE
from nnap_em.systems.acrobot import table_i

SANITIZED = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-g")
LOOP = """
#include "SOURCE.c"
void play(int rows, const double *time, const real *u, const real *y, real *mean, real *cov, real *innovation,
          int *flags)
{
    SOURCE_state s;
    SOURCE_start(&s, time[0]);
    for (int k = 0; k < rows; k++) {
        flags[k] = SOURCE_step(&s, time[k], u + k * COLUMNS, y + k * M);
        for (int i = 0; i < N; i++) mean[k * N + i] = s.mean[i];
        SOURCE_covariance(&s, cov + k * N * N);
        for (int i = 0; i < M; i++) innovation[k * M + i] = s.innovation[i];
    }
}
"""
"""Rows of a log, one after the other."""
WILD = """
#include "SOURCE.c"
#include <stdio.h>
#include <stdlib.h>
static unsigned long long seed = 1;
static double uniform(void)
{
    seed = seed * 6364136223846793005ULL + 1442695040888963407ULL;
    return (double)(seed >> 11) / 9007199254740992.0;
}
static double wild(double common)
{
    const double odd[] = {NAN, INFINITY, -INFINITY, 1e300, -1e30, 1e-300, 1e6, 50, 0};
    return uniform() < 0.98 ? common : odd[(int)(uniform() * 9)];
}
int main(int argc, char **argv)
{
    const long steps = argc > 1 ? atol(argv[1]) : 0;
    double time = 0, offset = 0;
    long restarts = 0, ambiguous = 0, jumps = 0, outliers = 0;
    SOURCE_state s;
    SOURCE_start(&s, 0);
    for (long k = 0; k < steps; k++) {
        real u[COLUMNS + 1], y[M];
        if (uniform() < 1e-6) SOURCE_start(&s, time);
        if (uniform() < 1e-3) offset = 3 * (uniform() - 0.5);
        time += DT * (uniform() < 0.01 ? floor(12 * uniform()) - 2 : 1);
        for (int i = 0; i < COLUMNS; i++) u[i] = (real)wild(0.2 * sin(3 * time));
        for (int i = 0; i < M; i++)
            y[i] = (real)wild(uniform() < 0.3 ? NAN : offset + 0.3 * sin(2 * time + i) + 0.005 * uniform());
        const int flags = SOURCE_step(&s, wild(time), u, y);
        restarts += !!(flags & SOURCE_RESTARTED);
        ambiguous += !!(flags & SOURCE_AMBIGUOUS);
        jumps += !!(flags & SOURCE_JUMP);
        outliers += !!(flags & SOURCE_OUTLIER);
        int good = isfinite(s.misfit) && isfinite(s.weight);
        for (int i = 0; i < N; i++) good = good && isfinite(s.mean[i]) && isfinite(s.std[i]);
        for (int i = 0; i < M; i++) good = good && isfinite(s.innovation[i]);
        if (!good) return printf("no number in step %ld\\n", k), 1;
    }
    printf("%ld %ld %ld %ld\\n", restarts, ambiguous, jumps, outliers);
    return 0;
}
"""
"""Steps with NaN, infinity, huge values, jumps of time and of the readings, and starts; counts what was flagged."""


class Played(NamedTuple):
    """Estimates of a compiled observer, row by row."""

    mean: np.ndarray
    cov: np.ndarray
    innovation: np.ndarray
    flags: np.ndarray
    seconds: float
    """Processor time of a step."""


def compiled(source: Path, program: str, out: str, *options: str) -> Path:
    """`program` around a written observer."""
    around = source.with_name(f"{source.stem}_{out}.c")
    around.write_text(program.replace("SOURCE", source.stem))
    words = [
        "gcc",
        "-std=c99",
        "-pedantic",
        "-Wall",
        "-Wextra",
        "-Werror",
        "-O2",
        *options,
        around.name,
        "-o",
        out,
        "-lm",
    ]
    subprocess.run(words, cwd=source.parent, check=True)
    return source.with_name(out)


def play(source: Path, t: np.ndarray, u: np.ndarray, y: np.ndarray, states: int, kind: type = np.float64) -> Played:
    """A log through a written observer; `u` are the inputs held from the row before."""
    library = ctypes.CDLL(str(compiled(source, LOOP, f"{source.stem}.so", "-shared", "-fPIC")))
    rows = len(t)
    mean, cov, innovation = (np.zeros(s, kind) for s in ((rows, states), (rows, states, states), np.shape(y)))
    flags = np.zeros(rows, np.int32)
    arrays = [np.ascontiguousarray(t, np.float64), *(np.ascontiguousarray(a, kind) for a in (u, y))]
    begin = time.process_time()
    library.play(rows, *(a.ctypes.data_as(ctypes.c_void_p) for a in (*arrays, mean, cov, innovation, flags)))
    return Played(mean, cov, innovation, flags, (time.process_time() - begin) / rows)


def wild(source: Path, steps: int, *options: str) -> list[int]:
    """Counts of `WILD`; raises CalledProcessError where a number or a sanitizer finds something."""
    program = compiled(source, WILD, f"{source.stem}_wild", *options)
    done = subprocess.run([program, str(steps)], check=True, capture_output=True, text=True)
    return [int(x) for x in done.stdout.split()]


def held(u: np.ndarray) -> np.ndarray:
    """Inputs held until each row, of those held from it on."""
    return np.concatenate([np.zeros_like(u[:1]), u[:-1]])


def replay(online: Observer, t: np.ndarray, u: np.ndarray, y: np.ndarray) -> Observation:
    """A log through an observer in Python; `u` as in `play`."""

    def one(state, row):
        state = online.step(state, *row)
        return state, state

    rows = jnp.asarray(u), jnp.asarray(y)
    return jax.jit(lambda: jax.lax.scan(one, online.start(float(t[0])), rows)[1])()


def rough(y: np.ndarray, seed: int = 0) -> np.ndarray:
    """Readings with gaps, the second one at a third of the rate, spikes, and a second of which none arrive."""
    rng, y = np.random.default_rng(seed), np.array(y)
    y[rng.random(y.shape) < 0.2] = np.nan
    y[np.arange(len(y)) % 3 != 0, -1] = np.nan
    y[rng.random(len(y)) < 0.002, 0] += 5.0
    y[len(y) // 2 : len(y) // 2 + 100] = np.nan
    return y


def paper_rig() -> Rig:
    """The paper's acrobot as declared: masses are known, friction is not, theta2 is not read."""
    start = {"theta2": Declared(0.0, 0.5), "dtheta1": Declared(0.0, 0.02), "dtheta2": Declared(0.0, 0.02)}
    return Rig(
        "acrobot", "acrobot", {name: Declared(value, 0.0) for name, value in table_i.items()}, True, ("u",), (2,), 0.01,
        "sequence", ("theta1", "dtheta1"), {"theta1": 0.01, "dtheta1": 0.05}, start,
    )  # fmt: skip


def hidden_error(online: Observer, data: Dataset, x: np.ndarray, settled: int = 100) -> tuple[float, int]:
    """RMS error of theta2 [rad] after the first rows of every sequence, and the number of new starts."""
    outcomes = [replay(online, data.t[i], held(np.asarray(data.u[i])), data.y[i]) for i in range(len(x))]
    error = np.stack([np.asarray(o.mean)[settled:, 1] for o in outcomes]) - np.asarray(x)[:, settled:, 1]
    restarts = sum(int(np.sum(np.asarray(o.flags) & RESTARTED > 0)) for o in outcomes)
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
