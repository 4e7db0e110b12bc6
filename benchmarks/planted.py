"""Effects with exact truth on real recordings: make the data sets, run the finder on them, and write the table.

    python benchmarks/planted.py list
    python benchmarks/planted.py make dfki_c1-spring2-strong --out out/case
    python benchmarks/planted.py run --out out/planted [--split look] ['dfki_c1-*' ...]
    python benchmarks/planted.py table out/planted [--out docs/results/planted_table.md]

`run` takes a case at a time on every core, and leaves one JSON file a case, with truth and report; a case that has one
is not run again.

How a log is changed: planted_make.py; the laws and the list: planted_cases.py; the scores: planted_table.py.
"""

import argparse
import fnmatch
import json
import os
import queue
import sys
import tempfile
import time
import tomllib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from planted_cases import CASES, split
from planted_make import make
from planted_table import cases, score, table
from runner import commit, nnap_em

from nnap_em.base.files import replace_text


def run(name: str, out: Path, limit: float, core: int) -> dict[str, Any]:
    """`nnap-em diagnose` on a case on one core, ended after `limit` [s]; writes and returns the record."""
    with tempfile.TemporaryDirectory() as folder:
        case = Path(folder, "case")
        record: dict[str, Any] = {"case": name, "truth": make(name, case), "code": commit()}
        record["log_seconds"] = sum(
            sum(1 for _ in path.open()) * tomllib.loads((case / "rig.toml").read_text())["sampling"]["dt"]
            for path in case.glob("train/*.csv")
        )
        ran = nnap_em("diagnose", case, "--quiet", out=Path(folder, "found"), core=core, limit=limit)
    record |= {"seconds": ran.seconds, "processor_seconds": ran.processor_seconds}
    if ran.report:
        record["report"] = ran.report
    else:
        ended = f"status {ran.status}: {(ran.said or [''])[-1]}"
        record["failed"] = f"not done after {limit:.0f} s" if ran.seconds >= limit else ended
    out.mkdir(parents=True, exist_ok=True)
    replace_text(out / f"{name}.json", json.dumps(record))
    return record


def records(folder: Path) -> list[dict[str, Any]]:
    """All that was run into a folder."""
    return [json.loads(path.read_text()) for path in sorted(folder.glob("*.json"))]


def _chosen(patterns: list[str], part: str) -> list[str]:
    """Names of the list that match, and names outside the list as they are."""
    names = [n for n in CASES if part in ("all", split(n)) and any(fnmatch.fnmatch(n, p) for p in patterns)]
    return names + [p for p in patterns if p not in CASES and not set("*?[") & set(p)]


def _run_all(names: list[str], out: Path, limit: float) -> None:
    """A case at a time on every core; the last line has the time of all."""
    began, spent, cores = time.perf_counter(), [], queue.SimpleQueue()
    for core in os.sched_getaffinity(0):
        cores.put(core)

    def one(name: str) -> None:
        core = cores.get()
        try:
            record = run(name, out, limit, core)
        finally:
            cores.put(core)
        done = score(record, {})
        spent.append(record["processor_seconds"])
        print(f"{name}: {done.named} of {done.truths}, {done.extras} extra; {done.effects}", flush=True)

    with ThreadPoolExecutor(cores.qsize()) as pool:
        list(pool.map(one, names))
    print(
        f"{len(spent)} cases in {time.perf_counter() - began:.0f} s on {cores.qsize()} cores, a median of "
        f"{np.median(spent or [0]):.0f} s of a processor a case"
    )


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
        names = [n for n in _chosen(args.cases or ["*"], args.split) if not (args.out / f"{n}.json").exists()]
        _run_all(names, args.out, args.limit)
    if args.command == "table":
        every = records(args.folder)
        print(table(every)) if args.out is None else replace_text(args.out, table(every))
        if args.out is not None:
            replace_text(args.out.with_suffix(".csv"), cases(every))


if __name__ == "__main__":
    main()
