"""Real rigs: theta2 smoothed from joint 1 alone, and predictions, on test recordings: the table of docs/measured.md.

    python benchmarks/measured.py [--data ../shared/data/measured] [rig ...]

Smoothing is scored against the encoder that a `*_joint1` rig does not show (folder `truth/`).  Predictions start at
0.5, 1.0, ... 4.0 s of every test recording, and their error is the root mean square over all of them.
"""

import argparse
import sys
import time
from pathlib import Path

import jax
import numpy as np
from runner import SHARED, made

from nnap_em.estimate.identify import identify, parameter_table
from nnap_em.estimate.predict import posterior_of, predict
from nnap_em.logs.read import read_logs
from nnap_em.machines.rig import read_rig
from nnap_em.machines.systems import specs

RIGS = ("dfki_c1_joint1", "dfki_c0_joint1", "dfki_a0_joint1", "dfki_c1", "dfki_c0")
BASELINE = {  # plain refit of ten rigid-body and friction parameters: theta1 / theta2 RMSE [rad] at 0.2 s and 0.5 s
    "dfki_c1": ((0.055, 0.053), (0.143, 0.167)),
    "dfki_c0": ((0.031, 0.052), (0.034, 0.058)),
}
STARTS = np.arange(0.5, 4.01, 0.5)


def wrap(angle):
    """Angle difference in (-pi, pi] [rad]."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def encoder(folder: Path, files) -> np.ndarray:
    """Both joints' angles [rad] of the test recordings, as (sequence, time, joint)."""
    truth = folder / "truth" if (folder / "truth").exists() else folder
    tables = [np.genfromtxt(truth / "test" / file, delimiter=",", names=True) for file in files]
    longest = max(len(table) for table in tables)
    out = np.full((len(tables), longest, 2), np.nan)
    for row, table in zip(out, tables, strict=True):
        row[: len(table)] = np.stack([table["theta1"], table["theta2"]], axis=-1)
    return out


def study(folder: Path, seed: int) -> dict:
    """Fit on train/, score on test/."""
    rig = read_rig(folder / "rig.toml", specs)
    train, test = read_logs(folder / "train", rig), read_logs(folder / "test", rig)
    left_out = []
    began = time.perf_counter()
    fitted = identify(
        rig,
        jax.tree.map(jax.numpy.asarray, train.data),
        key=jax.random.key(seed),
        watch=lambda state, seen, used: left_out.append([f for f, u in zip(train.files, used, strict=True) if not u]),
    )
    seconds = time.perf_counter() - began
    data = jax.tree.map(jax.numpy.asarray, test.data)
    angles = encoder(folder, test.files)
    error = wrap(np.asarray(posterior_of(fitted, data).state.mean)[..., :2] - angles)
    smoothing = np.sqrt(np.nanmean(error[..., 1] ** 2, axis=1))
    squares = {0.2: [], 0.5: []}
    for given in STARTS:
        mean = np.asarray(predict(fitted, data, float(given), key=jax.random.key(1)).mean)[..., :2]
        since = np.asarray(test.data.t) - given
        for horizon, collected in squares.items():
            inside = (since > 1e-6) & (since <= horizon + 1e-6) & np.isfinite(angles[..., 0])
            collected.append((wrap(mean - angles) ** 2)[inside])
    prediction = {h: np.sqrt(np.concatenate(s).mean(axis=0)) for h, s in squares.items()}
    return {
        "smoothing": dict(zip(test.files, smoothing, strict=True)),
        "prediction": prediction,
        "parameters": parameter_table(fitted),
        "left_out": left_out[-1],
        "seconds": seconds,
        "epochs": fitted.state.epoch,
    }


def main() -> None:
    """Run the rigs and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rigs", nargs="*", default=RIGS)
    parser.add_argument("--data", type=Path, default=SHARED / "measured")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print(made())
    heads = ["rig", "theta2 smoothed, RMSE per test recording [rad]", "0.2 s theta1 / theta2", "0.5 s theta1 / theta2"]
    heads += ["plain refit 0.2 s; 0.5 s", "left out of the fit", "epochs, seconds"]
    print("| " + " | ".join(heads) + " |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for name in args.rigs:
        row = study(args.data / name, args.seed)
        both = [f"{a:.3f} / {b:.3f}" for a, b in row["prediction"].values()]
        plain = "; ".join(f"{a:.3f} / {b:.3f}" for a, b in BASELINE.get(name.removesuffix("_joint1"), ())) or "-"
        smoothing = ", ".join(f"{v:.3f}" for v in row["smoothing"].values())
        print(
            f"| {name} | {smoothing} | {both[0]} | {both[1]} | {plain} | {', '.join(row['left_out']) or 'none'} "
            f"| {row['epochs']}, {row['seconds']:.0f} |",
            flush=True,
        )
        values = ", ".join(f"{n} {v:.4g} +- {s:.2g}" for n, (v, s) in row["parameters"].items())
        print(f"  {name}: {values}; {row['smoothing']}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
