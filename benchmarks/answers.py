"""Print what a command costs at first, later, and with other recordings: processor time, programs and memory.

    JAX_NUM_CPU_DEVICES=1 taskset -c 0 python benchmarks/answers.py --table docs/results/answers.md [JOB ...]

Each command runs in a process of its own: with no program at hand, with those
of the first run, and without the last two recordings, which no other program may need.
"""

import argparse
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from runner import ROOT, SHARED, Ran, made, nnap_em

sys.path.append(str(ROOT / "examples"))
import plant
import tanks

from nnap_em.base.files import replace_text


def _paper(folder: Path) -> None:
    subprocess.run([sys.executable, "-m", "nnap_em.cli.main", "simulate", str(folder)], check=True)


def _slide(folder: Path) -> None:
    plant.write(plant.Case(system="slide", sequences=8, steps=250, noise=(5e-4, 5e-3)), folder)


def _tanks(folder: Path) -> None:
    tanks.write(tanks.recordings(SHARED / "ode" / "cascaded_tanks"), folder)


def _stored(name: str):
    return lambda folder: shutil.copytree(SHARED / name, folder, copy_function=shutil.copyfile)


JOBS = {
    "paper": ("identify", _paper),
    "rig_b": ("diagnose", _stored("undeclared/rig_b")),
    "slide": ("diagnose", _slide),
    "dfki_c1": ("diagnose", _stored("measured/dfki_c1")),
    "kr300": ("diagnose", _stored("measured/kr300")),
    "tanks": ("diagnose", _tanks),
}
"""Command, and what writes its data set."""


def run(command: str, folder: Path, out: Path, cache: Path) -> tuple[Ran, int, str]:
    """A command on a data set, the number of programs that it put into the cache, and its answer."""
    before = len([*cache.rglob("*-cache")])
    ran = nnap_em(command, folder, out=out, cache=cache)
    if not ran.report:
        raise RuntimeError("\n".join([f"{command} {folder}", *ran.said]))
    answer = [line.removeprefix("nnap-em: ") for line in ran.said if line.startswith("nnap-em: ")][-2]
    return ran, len([*cache.rglob("*-cache")]) - before, answer


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
        made(),
        "| job | first [s] | programs | memory [GB] | later [s] | others: [s], programs | answer |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for name in args.jobs or JOBS:
        command, make = JOBS[name]
        with tempfile.TemporaryDirectory() as place:
            folder, cache = Path(place, "logs"), Path(place, "cache")
            make(folder)
            (first, programs, _), (later, _, answer) = (
                run(command, folder, Path(place, str(i)), cache) for i in range(2)
            )
            logs, others = sorted(folder.glob("train/*.csv")), "-"
            if len(logs) > 3:
                for log in logs[-2:]:
                    log.unlink()
                third, more, _ = run(command, folder, Path(place, "2"), cache)
                others = f"{third.processor_seconds:.0f}, {more}"
        memory = max(first.memory, later.memory)
        row = f"{first.processor_seconds:.0f} | {programs} | {memory:.1f} | {later.processor_seconds:.0f}"
        lines.append(f"| {command}, {name} | {row} | {others} | {answer} |")
        print(lines[-1], flush=True)
    replace_text(args.table, "\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
