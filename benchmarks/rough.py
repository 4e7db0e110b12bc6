"""Errors of fits to rough logs: the table of docs/results/rough.md.

    python benchmarks/rough.py [--system acrobot slide] [--only clean spikes_10 ...] [--trust]

train/ of a simulated rig is spoilt in one way at a time and identified with default settings and one seed; test/ is
clean.  Errors are those of `identify` (1 s ahead of the first second), and of friction over the visited velocities.
`--trust` fits the logs as they are.
"""

import argparse
import os
import platform
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from datetime import date
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "examples"))
import plant

from nnap_em.cli.common import set_up
from nnap_em.estimate.identify import friction_table, identify
from nnap_em.estimate.predict import REPORTED, horizon_errors, predict
from nnap_em.logs.formats import write_csv
from nnap_em.logs.read import Logs, read_logs
from nnap_em.machines.rig import read_rig
from nnap_em.machines.systems import specs

CASES = {
    "acrobot": plant.Case(seed=1),
    "slide": plant.Case(system="slide", hidden=False, noise=(5e-4, 5e-3), seed=1),
}
KINDS = ("clean", "spikes_5", "spikes_10", "spikes_50", "dropped", "stuck", "late", "saturated", "all")
Columns = dict[str, np.ndarray]


class Spoilt(NamedTuple):
    """One log, and which of its readings are none, per column."""

    columns: Columns
    wrong: dict[str, np.ndarray]
    """As many as the rows of the clean log."""
    kept: np.ndarray
    """Rows of the clean log that are still there."""


Change = Callable[[Spoilt, plant.Case, np.random.Generator], Spoilt]


def _noise(case: plant.Case, name: str) -> float:
    return case.noise[name.startswith("d")]


def _spikes(size: float, share: float = 0.01) -> Change:
    """Single readings off by `size` standard deviations of the noise, either way."""

    def change(log: Spoilt, case: plant.Case, rng: np.random.Generator) -> Spoilt:
        columns, wrong = dict(log.columns), dict(log.wrong)
        for name in wrong:
            hit = rng.random(wrong[name].size) < share
            columns[name] = columns[name] + hit * size * _noise(case, name) * rng.choice([-1, 1], hit.size)
            wrong[name] = wrong[name] | hit
        return log._replace(columns=columns, wrong=wrong)

    return change


def _dropped(log: Spoilt, case: plant.Case, rng: np.random.Generator) -> Spoilt:
    """5 to 10 % of the rows, in blocks of 5 to 15."""
    kept, share = log.kept.copy(), rng.uniform(0.05, 0.1)
    while np.mean(~kept) < share:
        first = rng.integers(30, kept.size - 30)
        kept[first : first + rng.integers(5, 16)] = False
    return log._replace(kept=kept)


def _stuck(log: Spoilt, case: plant.Case, rng: np.random.Generator) -> Spoilt:
    """Each column of a third of the files repeats a reading for 0.5 s."""
    columns, wrong = dict(log.columns), dict(log.wrong)
    for name in wrong:
        if rng.random() < 1 / 3:
            first = rng.integers(50, wrong[name].size - 60)
            rows = np.arange(first + 1, first + 51)
            columns[name] = columns[name].copy()
            columns[name][rows] = columns[name][first]
            wrong[name] = wrong[name] | np.isin(np.arange(wrong[name].size), rows)
    return log._replace(columns=columns, wrong=wrong)


def _late(log: Spoilt, case: plant.Case, rng: np.random.Generator) -> Spoilt:
    """All sensors read 0 for the first 0.3 s."""
    early = np.arange(log.kept.size) < 30
    columns = log.columns | {name: np.where(early, 0.0, log.columns[name]) for name in log.wrong}
    return log._replace(columns=columns, wrong={name: wrong | early for name, wrong in log.wrong.items()})


def _saturated(limit: float, name: str) -> Change:
    """A column is cut off at `limit`."""

    def change(log: Spoilt, case: plant.Case, rng: np.random.Generator) -> Spoilt:
        beyond = log.columns[name] > limit
        columns = log.columns | {name: np.minimum(log.columns[name], limit)}
        return log._replace(columns=columns, wrong=log.wrong | {name: log.wrong[name] | beyond})

    return change


def _all(*changes: Change) -> Change:
    def change(log: Spoilt, case: plant.Case, rng: np.random.Generator) -> Spoilt:
        for one in changes:
            log = one(log, case, rng)
        return log

    return change


def kinds(case: plant.Case, clean: Logs) -> dict[str, Change]:
    """All ways to spoil a log, by name; the saturated column is the last measured one, a rate."""
    limit, name = float(np.nanpercentile(np.asarray(clean.data.y)[..., -1], 90)), plant.measured(case)[-1]
    saturated = _saturated(round(limit, 6), name)
    return {
        "clean": _all(),
        "spikes_5": _spikes(5),
        "spikes_10": _spikes(10),
        "spikes_50": _spikes(50),
        "dropped": _dropped,
        "stuck": _stuck,
        "late": _late,
        "saturated": saturated,
        "all": _all(saturated, _spikes(50), _stuck, _late, _dropped),
    }


def spoil(folder: Path, case: plant.Case, change: Change) -> dict[str, Spoilt]:
    """Change all logs of `folder`/train; what was done, by file."""
    out, rng = {}, np.random.default_rng([case.seed, 99])
    for path in sorted((folder / "train").glob("*.csv")):
        table = np.genfromtxt(path, delimiter=",", names=True)
        columns = {name: table[name] for name in table.dtype.names}
        rows = len(table)
        log = Spoilt(columns, {n: np.zeros(rows, bool) for n in plant.measured(case)}, np.ones(rows, bool))
        log = change(log, case, rng)
        write_csv(path, {name: values[log.kept] for name, values in log.columns.items()})
        out[path.name] = log
    return out


def detection(logs: Logs, done: dict[str, Spoilt]) -> tuple[int, int, int, int]:
    """Wrong readings that are masked, all wrong ones, right ones that are masked, rows that are not used."""
    hits = total = false = cut = 0
    for file, y in zip(logs.files, np.asarray(logs.data.y), strict=True):
        log = done[file]
        cut += sum(entry.amount for entry in logs.masked if entry.file == file and entry.kind == "cut")
        for column, wrong in zip(np.moveaxis(y, -1, 0), log.wrong.values(), strict=True):
            last = int(np.asarray(logs.data.valid)[logs.files.index(file)].sum())
            masked, kept = np.isnan(column[:last]), log.kept[:last]
            hits += np.sum(masked & wrong[:last] & kept)
            total += np.sum(wrong[:last] & kept)
            false += np.sum(masked & ~wrong[:last] & kept)
    return int(hits), int(total), int(false), cut


def friction_error(fitted, case: plant.Case) -> list[float]:
    """Root mean square of learned minus true torque over that of the true one, over visited velocities, per joint."""
    p, u, t = plant.build(case), plant.torques(case), plant.clocks(case)
    kicks = case.process * np.random.default_rng([case.seed, 3]).standard_normal((*u.shape, p.dof))
    x = plant.simulate(p, plant.starts(case), u, t, kicks)[: case.sequences]
    speed = x[..., p.dof : 2 * p.dof].reshape(-1, p.dof)
    nodes = np.quantile(speed, np.linspace(0.0, 1.0, 2001), axis=0).T
    learned = np.asarray(friction_table(fitted, jnp.asarray(nodes)).torque)
    true = np.stack([plant.friction_torque(case.friction_shape, f, w) for f, w in zip(p.friction, nodes, strict=True)])
    return np.sqrt(np.mean((learned - true) ** 2, axis=1) / np.mean(true**2, axis=1)).tolist()


def study(case: plant.Case, kind: str, trust: bool) -> dict[str, float | list[float] | tuple[int, ...]]:
    """One way to spoil the logs of one rig."""
    with tempfile.TemporaryDirectory() as place, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        folder = Path(place)
        plant.write(case, folder)
        rig = read_rig(folder / "rig.toml", specs)
        done = spoil(folder, case, kinds(case, read_logs(folder / "train", rig))[kind])
        train, test = read_logs(folder / "train", rig, trust=trust), read_logs(folder / "test", rig, until=1.0)
    began = time.perf_counter()
    out: list[int] = []
    fitted = identify(
        rig, train.data, key=jax.random.key(0), watch=lambda state, seen, used: out.append(int((~used).sum()))
    )
    seconds = time.perf_counter() - began
    prediction = predict(fitted, test.data, 1.0, key=jax.random.key(0))
    error = horizon_errors(prediction, fitted, test.data, 1.0)[rig.measured[0]][REPORTED.index(1.0)]
    return {
        "error": error,
        "friction": friction_error(fitted, case),
        "detection": detection(train, done),
        "left_out": out[-1],
        "seconds": seconds,
    }


def main() -> None:
    """Run all kinds and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--system", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--only", nargs="+")
    parser.add_argument("--trust", action="store_true", help="mask nothing")
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    set_up()
    print(
        f"{date.today()}, {platform.machine()}, {len(os.sched_getaffinity(0))} cores, "
        f"Python {platform.python_version()}, jax {jax.__version__}; `{' '.join(['python', *sys.argv])}`\n"
    )
    heads = ("system", "logs", "1 s error", "/ clean", "friction NRMSE", "/ clean", "found", "false", "cut", "left out")
    print(f"| {' | '.join((*heads, 'seconds'))} |\n|{' --- |' * (len(heads) + 1)}", flush=True)
    for system in args.system:
        case, first = CASES[system]._replace(seed=args.seed), None
        for kind in args.only or KINDS:
            row = study(case, kind, args.trust)
            first = first or row
            hits, total, false, cut = row["detection"]
            ratio = [a / b for a, b in zip(row["friction"], first["friction"], strict=True)]
            cells = [system, kind, f"{row['error']:.4f}", f"{row['error'] / first['error']:.2f}"]
            cells += [", ".join(f"{v:.4f}" for v in row["friction"]), ", ".join(f"{v:.2f}" for v in ratio)]
            cells += [f"{hits} of {total}", str(false), str(cut), str(row["left_out"]), f"{row['seconds']:.0f}"]
            print(f"| {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
