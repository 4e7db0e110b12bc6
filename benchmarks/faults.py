"""Number of faults, at random moments, after which a run that is started again ends with the numbers of no fault.

    python benchmarks/faults.py --faults 40 --table docs/results/faults.md     # some ten minutes on one core

A run is killed (SIGKILL, or SIGINT as by Ctrl-C) at a moment drawn from the length of an unbroken run, and started
again, until it ends before the next fault comes.  Its faults count as survived if all numbers, to the
last bit, are those of the unbroken run, and if after every SIGINT it said what it kept and ended with status 130.
"""

import argparse
import json
import os
import platform
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from datetime import date
from pathlib import Path

import jax
import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "examples"))
import plant

from nnap_em.storage.files import replace_text

SPRING = {"name": "torsional_spring", "joint": 1, "k": 20.0, "theta0": 0.05}
SLIDE = plant.Case(system="slide", sequences=6, tests=1, steps=120, seed=2, noise=(5e-4, 5e-3), effects=(SPRING,))


def numbers(out: Path) -> dict:
    """Everything that a run leaves behind but the seconds that it took."""
    contents: dict = {}
    for path in sorted(out.glob("*.npz")):
        with np.load(path) as stored:
            arrays = {n: stored[n].tobytes() for n in stored.files if n not in ("header", "sha256")}
            header = json.loads(stored["header"].tobytes())
            header.pop("notes")
            contents[path.name] = arrays, header
    for path in sorted(out.glob("*.csv")):
        contents[path.name] = path.read_bytes()
    report = json.loads((out / "report.json").read_text())
    report.pop("seconds")
    for epoch in report.get("epochs", []):
        epoch.pop("seconds")
    return contents | {"report": report}


def start(command: str, rig: Path, out: Path) -> subprocess.Popen:
    """The command in a process of its own."""
    order = [sys.executable, "-m", "nnap_em.commands.cli", command, str(rig), "--out", str(out)]
    return subprocess.Popen(order, stderr=subprocess.PIPE, text=True)


def broken(command: str, rig: Path, out: Path, length: float, rng: random.Random) -> tuple[dict[str, int], bool]:
    """A run with faults until it ends: how many of each kind, and whether it was told well what was kept."""
    tried, stated = {"SIGKILL": 0, "SIGINT": 0}, True
    while True:
        run, kind = start(command, rig, out), rng.choice(list(tried))
        try:
            _, said = run.communicate(timeout=rng.uniform(0.0, length))
            if run.returncode:
                raise SystemExit(said)
            return tried, stated
        except subprocess.TimeoutExpired:
            run.send_signal(signal.Signals[kind])
        _, said = run.communicate()
        last = "".join(said.splitlines()[-1:])
        if run.returncode == 0 or "nnap-em: wrote" in last:  # its work was done when the fault came
            return tried, stated
        tried[kind] += 1
        if kind == "SIGINT":
            well = run.returncode == 130 and last.startswith("nnap-em: stopped")
            stated = stated and well
            if not well:
                print(f"status {run.returncode}: {said}", file=sys.stderr)


def main() -> None:
    """Break runs of both commands until there were enough faults, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--faults", type=int, default=40, help="of each command")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--table", type=Path, help="where to write the table")
    args = parser.parse_args()
    rng, rows = random.Random(args.seed), []
    with tempfile.TemporaryDirectory() as spare:
        rig, out = Path(spare) / "rig", Path(spare) / "out"
        plant.write(SLIDE, rig)
        for command in ("identify", "diagnose"):
            began = time.perf_counter()
            run = start(command, rig, Path(spare) / command)
            _, said = run.communicate()
            if run.returncode:
                raise SystemExit(f"{command} fails without a fault: {said}")
            length, whole = time.perf_counter() - began, numbers(Path(spare) / command)
            total, survived, runs = {"SIGKILL": 0, "SIGINT": 0}, 0, 0
            while sum(total.values()) < args.faults:
                tried, stated = broken(command, rig, out, length, rng)
                same = numbers(out) == whole
                total = {kind: total[kind] + tried[kind] for kind in total}
                survived, runs = survived + sum(tried.values()) * (same and stated), runs + 1
                print(f"{command}: {tried}, same numbers: {same}, told: {stated}", file=sys.stderr, flush=True)
                shutil.rmtree(out)
            kinds = " | ".join(str(count) for count in total.values())
            rows.append(f"| `{command}` | {length:.0f} s | {runs} | {kinds} | {survived} of {sum(total.values())} |")
    head = "| command | unbroken | runs | SIGKILL | SIGINT | survived |\n| --- | --- | --- | --- | --- | --- |"
    note = (
        f"`benchmarks/faults.py`, {date.today()}, JAX {jax.__version__}, Python {platform.python_version()}, "
        f"{len(os.sched_getaffinity(0))} core, seed {args.seed}: a slide with an undeclared spring, broken at random "
        "moments and started again. Survived: every number, to the last bit, is that of the unbroken run, and Ctrl-C "
        "was answered with what is kept."
    )
    text = f"# Faults survived\n\n{note}\n\n{head}\n" + "\n".join(rows) + "\n"
    print(text)
    if args.table:
        replace_text(args.table, text)


if __name__ == "__main__":
    main()
