"""Effects with exact truth on real recordings: make the data sets, run the finder on them, and write the table.

    python benchmarks/planted.py list
    python benchmarks/planted.py make dfki_c1-spring2-strong --out out/case
    python benchmarks/planted.py run --out out/planted [--split look] [--share 1/2] ['dfki_c1-*' ...]
    python benchmarks/planted.py table out/planted [--out docs/results/planted_table.md]

`run` leaves one JSON file a case, with truth and report; a case that has one is not run again.

How a log is changed: planted_make.py; the laws and the list: planted_cases.py; the scores: planted_table.py.
"""

import argparse
import fnmatch
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
import tomllib
from pathlib import Path
from typing import Any

from planted_cases import CASES, split
from planted_make import ROOT, make
from planted_table import cases, score, table

from nnap_em.commands.common import MISFIT_STATUS
from nnap_em.storage.files import replace_text


def run(name: str, out: Path, limit: float) -> dict[str, Any]:
    """`nnap-em diagnose` on a case in a process of its own, ended after `limit` [s]; writes and returns the record."""
    with tempfile.TemporaryDirectory() as folder:
        case, result = Path(folder, "case"), Path(folder, "found")
        record: dict[str, Any] = {"case": name, "truth": make(name, case), "code": _commit()}
        record["log_seconds"] = sum(
            sum(1 for _ in path.open()) * tomllib.loads((case / "rig.toml").read_text())["sampling"]["dt"]
            for path in case.glob("train/*.csv")
        )
        environment = os.environ | {"JAX_NUM_CPU_DEVICES": "1", "PYTHONPATH": str(ROOT)}
        command = [sys.executable, "-m", "nnap_em.commands.cli", "diagnose", str(case), "--out", str(result), "--quiet"]
        began, spent = time.perf_counter(), _processor()
        with Path(folder, "said").open("w+") as said:
            process = subprocess.Popen(command, env=environment, stdout=said, stderr=said)
            try:
                status = process.wait(limit)
            except subprocess.TimeoutExpired:
                status = f"not done after {limit:.0f} s"
            finally:
                process.kill()
                process.wait()
            said.seek(0)
            last = (said.read().strip().splitlines() or [""])[-1]
        record["seconds"] = time.perf_counter() - began
        record["processor_seconds"] = _processor() - spent
        if status in (0, MISFIT_STATUS):
            record["report"] = json.loads((result / "report.json").read_text())
        else:
            record["failed"] = status if isinstance(status, str) else f"status {status}: {last}"
    out.mkdir(parents=True, exist_ok=True)
    replace_text(out / f"{name}.json", json.dumps(record))
    return record


def _processor() -> float:
    """Processor time of all processes that ended [s]: the clock tells little on a machine that is busy."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _commit() -> str:
    """The commit that is run; empty outside a clone."""
    command = ["git", "rev-parse", "--short", "HEAD"]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False).stdout.strip()


def records(folder: Path) -> list[dict[str, Any]]:
    """All that was run into a folder."""
    return [json.loads(path.read_text()) for path in sorted(folder.glob("*.json"))]


def _chosen(patterns: list[str], part: str, share: str) -> list[str]:
    """Names of the list that match, and names outside the list as they are."""
    first, step = map(int, share.split("/"))
    names = [n for n in CASES if part in ("all", split(n)) and any(fnmatch.fnmatch(n, p) for p in patterns)]
    names += [p for p in patterns if p not in CASES and not set("*?[") & set(p)]
    return names[first % step :: step]


def main() -> None:
    """List the cases, make one, run some, or write the table."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = arguments.add_subparsers(dest="command", required=True)
    commands.add_parser("list", help="names of all cases and their split")
    making = commands.add_parser("make", help="write the data set of a case")
    making.add_argument("case")
    making.add_argument("--out", type=Path, required=True)
    running = commands.add_parser("run", help="nnap-em diagnose on every case that has no record yet")
    running.add_argument("cases", nargs="*", default=["*"], help="names or patterns; all, if none is given")
    running.add_argument("--out", type=Path, required=True)
    running.add_argument("--split", default="all", choices=("look", "kept", "all"))
    running.add_argument("--share", default="0/1", help="i/n: every n-th case from the i-th, for several processes")
    running.add_argument("--limit", type=float, default=1200.0, help="seconds for a case (1200)")
    writing = commands.add_parser("table", help="what the records say: sums as Markdown, every case as CSV beside it")
    writing.add_argument("folder", type=Path)
    writing.add_argument("--out", type=Path, help="write it here instead of printing it")
    args = arguments.parse_args()
    try:
        _do(args)
    except (OSError, ValueError) as error:
        sys.exit(f"error: {error}")


def _do(args: argparse.Namespace) -> None:
    if args.command == "list":
        print("\n".join(f"{split(name)}  {name}" for name in CASES))
    if args.command == "make":
        for effect in make(args.case, args.out)["effects"]:
            print(effect)
    if args.command == "run":
        for name in _chosen(args.cases or ["*"], args.split, args.share):
            if not (args.out / f"{name}.json").exists():
                done = score(run(name, args.out, args.limit), {})
                print(f"{name}: {done.named} of {done.truths}, {done.extras} extra; {done.effects}", flush=True)
    if args.command == "table":
        every = records(args.folder)
        print(table(every)) if args.out is None else replace_text(args.out, table(every))
        if args.out is not None:
            replace_text(args.out.with_suffix(".csv"), cases(every))


if __name__ == "__main__":
    main()
