"""Print what a command costs at first, later, and with other recordings: processor time, programs and memory.

    JAX_NUM_CPU_DEVICES=1 taskset -c 0 python benchmarks/answers.py --table docs/results/answers.md [JOB ...]

Each command runs in a process of its own: with no program at hand, with those
of the first run, and without the last two recordings, which no other program may need.
"""

import argparse
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from datetime import date
from pathlib import Path
from typing import NamedTuple

from planted_make import ROOT

sys.path.append(str(ROOT / "examples"))
import plant
import tanks

from nnap_em.base.files import cores, replace_text
from nnap_em.cli.common import MISFIT_STATUS

NNAP_EM = [sys.executable, "-m", "nnap_em.cli.main"]
DATA = ROOT.parent / "shared" / "data"


def _paper(folder: Path) -> None:
    subprocess.run([*NNAP_EM, "simulate", str(folder)], check=True)


def _slide(folder: Path) -> None:
    plant.write(plant.Case(system="slide", sequences=8, steps=250, noise=(5e-4, 5e-3)), folder)


def _tanks(folder: Path) -> None:
    tanks.write(tanks.recordings(DATA / "ode" / "cascaded_tanks"), folder)


def _stored(name: str):
    return lambda folder: shutil.copytree(DATA / name, folder, copy_function=shutil.copyfile)


JOBS = {
    "paper": ("identify", _paper),
    "rig_b": ("diagnose", _stored("undeclared/rig_b")),
    "slide": ("diagnose", _slide),
    "dfki_c1": ("diagnose", _stored("measured/dfki_c1")),
    "kr300": ("diagnose", _stored("measured/kr300")),
    "tanks": ("diagnose", _tanks),
}
"""Command, and what writes its data set."""


class Run(NamedTuple):
    """One process."""

    seconds: float
    """Processor time of the process [s]."""
    programs: int
    """Programs that it put into the cache."""
    memory: float
    """Largest memory of the process [GB]."""
    answer: str


def run(command: str, folder: Path, out: Path, cache: Path) -> Run:
    """A command on a data set, in a process of its own."""
    before = len([*cache.rglob("*-cache")])
    with out.with_suffix(".log").open("w+") as said:
        words = [*NNAP_EM, command, str(folder), "--out", str(out)]
        environment = os.environ | {"XDG_CACHE_HOME": str(cache), "PYTHONPATH": str(ROOT)}
        process = subprocess.Popen(words, env=environment, stdout=said, stderr=said)
        _, status, used = os.wait4(process.pid, 0)
        said.seek(0)
        lines = said.read().splitlines()
    if os.waitstatus_to_exitcode(status) not in (0, MISFIT_STATUS):
        raise RuntimeError("\n".join([" ".join(words), *lines]))
    answer = [line.removeprefix("nnap-em: ") for line in lines if line.startswith("nnap-em: ")][-2]
    new = len([*cache.rglob("*-cache")]) - before
    return Run(used.ru_utime + used.ru_stime, new, used.ru_maxrss / 1e6, answer)


def main() -> None:
    """Every job three times, and the table."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("jobs", nargs="*", metavar="JOB", help=f"of {', '.join(JOBS)}; all, if none is given")
    arguments.add_argument("--table", type=Path, required=True)
    args = arguments.parse_args()
    lines = [
        "# Time to an answer\n",
        "Seconds of a processor. The first run finds no cached program, a later one those of the first; others are "
        "recordings of the same machine, two fewer.\n",
        f"{date.today()}, {platform.machine()}, {cores()} cores, Python {platform.python_version()}; "
        "written by `benchmarks/answers.py`.\n",
        "| job | first [s] | programs | memory [GB] | later [s] | others: [s], programs | answer |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for name in args.jobs or JOBS:
        command, make = JOBS[name]
        with tempfile.TemporaryDirectory() as place:
            folder, cache = Path(place, "logs"), Path(place, "cache")
            make(folder)
            first, later = (run(command, folder, Path(place, str(i)), cache) for i in range(2))
            logs, others = sorted(folder.glob("train/*.csv")), "-"
            if len(logs) > 3:
                for log in logs[-2:]:
                    log.unlink()
                third = run(command, folder, Path(place, "2"), cache)
                others = f"{third.seconds:.0f}, {third.programs}"
        row = f"{first.seconds:.0f} | {first.programs} | {max(first.memory, later.memory):.1f} | {later.seconds:.0f}"
        lines.append(f"| {command}, {name} | {row} | {others} | {later.answer} |")
        print(lines[-1], flush=True)
    replace_text(args.table, "\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
