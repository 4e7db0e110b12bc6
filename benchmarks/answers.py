"""How long the first and a later run of a command take, and what they compile: the time of the one who waits for it.

    python benchmarks/answers.py --table docs/results/answers.md [FOLDER ...]     # half an hour on two idle cores

Simulated rigs, and the data sets in the folders.  Each command runs twice in a process of its own: with no program at
hand (an empty cache), then with those of the first run.
"""

import argparse
import os
import platform
import re
import subprocess
import sys
import tempfile
import time
from datetime import date
from pathlib import Path
from typing import NamedTuple

import diagnose

from nnap_em.storage.files import cores, replace_text

CASES = ("clean:middle:hidden:101", "strong:torsional_spring:hidden:11", "outside:bump:hidden:11")
NNAP_EM = str(Path(sys.executable).with_name("nnap-em"))
ROWS = 14
"""Programs in the table of one."""


class Run(NamedTuple):
    """One process."""

    seconds: float
    programs: int
    compiling: float
    """Tracing, lowering, and compiling or loading [s]."""
    profile: list[str]
    """The programs that took longest, as `--profile` prints them."""
    answer: str


def run(command: str, folder: Path, out: Path, cache: Path) -> Run:
    """A command on a data set, in a process of its own."""
    nnap_em = [NNAP_EM, command, str(folder), "--out", str(out), "--profile"]
    began = time.perf_counter()
    done = subprocess.run(nnap_em, env=os.environ | {"XDG_CACHE_HOME": str(cache)}, capture_output=True, text=True)
    seconds = time.perf_counter() - began
    if done.returncode:
        raise RuntimeError(f"{' '.join(nnap_em)} ended with status {done.returncode}:\n{done.stderr}")
    lines = (done.stdout + done.stderr).splitlines()
    first = next(i for i, line in enumerate(lines) if re.match(r"program +count", line))
    whole = next(line for line in lines if line.startswith("all of "))
    count, *stages = map(float, whole.split("names")[1].split())
    answer = [line.removeprefix("nnap-em: ") for line in lines if line.startswith("nnap-em: ")][-2]
    return Run(seconds, int(count), sum(stages), lines[first : first + ROWS + 1], answer)


def main() -> None:
    """Every job twice, and the tables."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("folders", nargs="*", type=Path, help="data sets to be diagnosed beside the simulated ones")
    arguments.add_argument("--table", type=Path, required=True)
    args = arguments.parse_args()
    lines = [
        "# Time to an answer\n",
        "The first run finds no cached program, and most of its time is compiling; the later run finds those of the "
        "first. Times are of whole processes. `--profile` prints the programs that compile.\n",
        f"{date.today()}, {platform.machine()}, {cores()} cores, Python {platform.python_version()}; "
        "written by `benchmarks/answers.py`.\n",
        "| command | data set | first run [s] | of it compiling [s] | programs | later run [s] | answer |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    with tempfile.TemporaryDirectory() as place:
        work = Path(place)
        jobs = [("identify", "the paper's data set", work / "paper")]
        subprocess.run([NNAP_EM, "simulate", str(work / "paper")], check=True)
        for name in CASES:
            folder = work / name.replace(":", "_")
            diagnose.plant.write(diagnose.case_of(name), folder)
            jobs.append(("diagnose", " ".join(name.split(":")[:3]), folder))
        jobs += [("diagnose", folder.name, folder) for folder in args.folders]
        for number, (command, name, folder) in enumerate(jobs):
            print(command, name, flush=True)
            first, later = (run(command, folder, work / f"{number}_{i}", work / f"cache_{number}") for i in range(2))
            row = f"{first.seconds:.0f} | {first.compiling:.0f} | {first.programs} | {later.seconds:.0f}"
            lines.append(f"| {command} | {name} | {row} | {later.answer} |")
            print(f"what the first {command} of {name} compiles", *first.profile, sep="\n", flush=True)
    replace_text(args.table, "\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
