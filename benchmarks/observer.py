"""The observer on the paper's acrobot with theta2 hidden: beside the filter of the true model, its time, C and Python.

python benchmarks/observer.py [--table docs/results/observer.md]     # some minutes
"""

import argparse
import itertools
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from observer_c import held, paper_rig, play, replay, rough
from runner import made

from nnap_em.estimate.identify import Identified, identify
from nnap_em.estimate.observer import RESTARTED, Observer, functions, observer, restart_prior
from nnap_em.estimate.store import load, save
from nnap_em.logs.dataset import Dataset
from nnap_em.model.simulate import paper_experiment, paper_model
from nnap_em.model.state_space import StateSpaceModel
from nnap_em.output.export.online import write_observer

NATIVE = "-march=native"


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
    """Time of a step [s], the fastest tenth: other programs run beside this one."""
    state, times = online.start(), []
    for row in zip(u, y, strict=True):
        begin = time.perf_counter()
        state = online.step(state, *row)
        state.mean.block_until_ready()
        times.append(time.perf_counter() - begin)
    return float(np.percentile(times[len(times) // 2 :], 10))


def accuracy(fitted: Identified, truth: StateSpaceModel, sequences: int) -> Iterator[tuple[str, str]]:
    """The hidden joint beside the filter of the true model."""
    test = paper_experiment(truth, sequences, 499, key=jax.random.key(49))
    online, known = observer(fitted), true_observer(fitted, truth)
    (error, restarts), (best, _) = (hidden_error(one, test.data, test.x) for one in (online, known))
    yield f"hidden theta2 from 1 s on, RMSE, {sequences} sequences of 5 s", f"{error:.4f} rad, {restarts} new starts"
    yield "the same by the filter of the true model", f"{best:.4f} rad: ratio {error / best:.3f}"


def alike(fitted: Identified, truth: StateSpaceModel, rows: int, folder: Path) -> Iterator[tuple[str, str]]:
    """C beside Python, and the time of both."""
    long, online = paper_experiment(truth, 1, rows - 1, key=jax.random.key(50)).data, observer(fitted)
    t, u, clean = np.asarray(long.t[0]), held(np.asarray(long.u[0])), np.asarray(long.y[0])
    y = rough(clean)
    states = jax.tree.map(np.asarray, replay(online, t, u, y))
    std = np.sqrt(np.diagonal(states.cov, axis1=1, axis2=2))
    for bits, kind in ((64, np.float64), (32, np.float32)):
        source = folder / f"arm{bits}.c"
        write_observer(fitted, source, single=bits == 32)
        found = play(source, t, u, y, 4, kind)
        gap, other = np.max(np.abs(found.mean - states.mean) / std), np.sum(found.flags != states.flags)
        log = t[:4000], u[:4000], clean[:4000], 4, kind
        seconds = play(source, *log).seconds, play(source, *log, NATIVE).seconds
        yield (
            f"C, {bits} bits, beside Python: {rows} rows with gaps and spikes",
            f"{gap:.1e} standard deviations; {other} rows with other flags",
        )
        yield f"a step in C, {bits} bits, gcc -O2; {NATIVE}", f"{1e6 * seconds[0]:.1f}; {1e6 * seconds[1]:.1f} us"
    yield "a step in Python, jitted, theta2 hidden", f"{1e6 * python_time(online, u[:2000], clean[:2000]):.0f} us"


def main() -> int:
    """Fit, compare, time."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--sequences", type=int, default=20, help="test sequences of 5 s (20)")
    arguments.add_argument("--rows", type=int, default=10_000, help="rows of C beside Python (10,000)")
    arguments.add_argument("--fit", type=Path, default=Path("out/observer_fit/model.npz"), help="kept from run to run")
    arguments.add_argument("--table", type=Path, help="page to write")
    args = arguments.parse_args()
    jax.config.update("jax_enable_x64", True)
    truth = paper_model()
    if not args.fit.exists():
        train = paper_experiment(truth, 20, 499, key=jax.random.key(48)).data
        save(args.fit, identify(paper_rig(), train, key=jax.random.key(0)))
    fitted = load(args.fit)
    print(made())
    table = ["| | |", "| --- | --- |"]
    with tempfile.TemporaryDirectory() as name:
        parts = [accuracy(fitted, truth, args.sequences), alike(fitted, truth, args.rows, Path(name))]
        for what, value in itertools.chain(*parts):
            table.append(f"| {what} | {value} |")
            print(table[-1], flush=True)
    if args.table:
        head = args.table.read_text().partition("<!-- table -->")[0] if args.table.exists() else ""
        args.table.write_text("\n".join([f"{head}<!-- table -->", "", made(), *table, ""]))
    return 0


def true_observer(fitted: Identified, truth: StateSpaceModel) -> Observer:
    """The observer of the model that made the logs."""
    start, step = functions(truth, fitted.bank.angles, restart_prior(truth), 16)
    return observer(fitted)._replace(start=start, step=step)


if __name__ == "__main__":
    sys.exit(main())
