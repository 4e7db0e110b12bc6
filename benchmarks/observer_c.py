"""A written observer compiled around logs and around wild input, and an observer in Python on the same logs."""

import ctypes
import subprocess
import time
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from nnap_em.estimate.observer import Observation, Observer
from nnap_em.machines.rig import Declared, Rig
from nnap_em.machines.systems.acrobot import table_i

SANITIZED = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-g")
LOOP = """
#include "SOURCE.c"
void play(int rows, double time, const real *u, const real *y, real *mean, real *cov, real *innovation, int *flags)
{
    SOURCE_state s;
    SOURCE_start(&s, time);
    for (int k = 0; k < rows; k++) {
        flags[k] = SOURCE_step(&s, u + k * COLUMNS, y + k * M);
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
    long restarts = 0, ambiguous = 0, outliers = 0;
    SOURCE_state s;
    SOURCE_start(&s, 0);
    for (long k = 0; k < steps; k++) {
        real u[COLUMNS + 1], y[M];
        if (uniform() < 1e-6) SOURCE_start(&s, time);
        if (uniform() < 1e-3) offset = 3 * (uniform() - 0.5);
        time += DT;
        for (int i = 0; i < COLUMNS; i++) u[i] = (real)wild(0.2 * sin(3 * time));
        for (int i = 0; i < M; i++)
            y[i] = (real)wild(uniform() < 0.3 ? NAN : offset + 0.3 * sin(2 * time + i) + 0.005 * uniform());
        const int flags = SOURCE_step(&s, u, y);
        restarts += !!(flags & SOURCE_RESTARTED);
        ambiguous += !!(flags & SOURCE_AMBIGUOUS);
        outliers += !!(flags & SOURCE_OUTLIER);
        int good = isfinite(s.misfit) && isfinite(s.weight);
        for (int i = 0; i < N; i++) good = good && isfinite(s.mean[i]) && isfinite(s.std[i]);
        for (int i = 0; i < M; i++) good = good && isfinite(s.innovation[i]);
        if (!good) return printf("no number in step %ld\\n", k), 1;
    }
    printf("%ld %ld %ld\\n", restarts, ambiguous, outliers);
    return 0;
}
"""
"""Steps with NaN, infinity, huge values, jumps of the readings, and starts; counts what was flagged."""


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


def play(
    source: Path, t: np.ndarray, u: np.ndarray, y: np.ndarray, states: int, kind: type = np.float64, *options: str
) -> Played:
    """A log through a written observer; `u` are the inputs held from the row before, `options` those of gcc.

    Compiled anew only where the observer was written since.
    """
    out = "".join([source.stem, *options, ".so"])
    path = source.with_name(out)
    if not path.exists() or path.stat().st_mtime_ns < source.stat().st_mtime_ns:
        path = compiled(source, LOOP, out, "-shared", "-fPIC", *options)
    library = ctypes.CDLL(str(path))
    rows = len(t)
    mean, cov, innovation = (np.zeros(s, kind) for s in ((rows, states), (rows, states, states), np.shape(y)))
    flags = np.zeros(rows, np.int32)
    arrays = [*(np.ascontiguousarray(a, kind) for a in (u, y)), mean, cov, innovation, flags]
    begin = time.process_time()
    library.play(rows, ctypes.c_double(t[0]), *(a.ctypes.data_as(ctypes.c_void_p) for a in arrays))
    return Played(mean, cov, innovation, flags, (time.process_time() - begin) / rows)


def wild(source: Path, steps: int, *options: str) -> list[int]:
    """Counts of `WILD`; raises CalledProcessError where a number or a sanitizer finds something."""
    program = compiled(source, WILD, f"{source.stem}_wild", *options)
    done = subprocess.run([program, str(steps)], check=True, capture_output=True, text=True)
    return [int(x) for x in done.stdout.split()]


def held(u):
    """Inputs held until each row, of those held from it on."""
    return jnp.concatenate([jnp.zeros_like(u[:1]), u[:-1]]) if isinstance(u, jax.Array) else np.r_[0 * u[:1], u[:-1]]


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
