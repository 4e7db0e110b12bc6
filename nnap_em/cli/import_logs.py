"""Write a data set from logs as machines write them.

examples:
  nnap-em init run.mcap --system acrobot            a first rig.toml, with a table [import] of the topics
  nnap-em import run.mcap --rig rig.toml --out bench
  nnap-em import day1.mcap day2.mcap --rig rig.toml --out bench --test 0.2 --shift /joint_states=-0.012

Brings topics with clocks of their own to rows that are [sampling] dt apart, cuts sequences at gaps, and reports rates
and rows used in FOLDER/import.json.  Where columns come from stands in the table [import.columns] of
rig.toml; what is not there is found by its name.  MCAP (ROS 2, JSON, protobuf), ROS bags, workbooks and HDF5 need
pip install "nnap-em[logs]".
"""

import argparse
import os
import re
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ..base.digits import counted
from ..base.files import replace_text, whole_folder
from ..base.log import Log
from ..logs.importing.columns import read_plan
from ..logs.importing.folder import places, write_sequences
from ..logs.importing.resample import Resampled, resample
from ..machines.rig import SMOOTH, read_rig, toml_text
from ..machines.systems import specs
from ..output.report.document import versions
from ..output.report.tables import json_text


def run(args: argparse.Namespace, log: Log) -> None:
    """Write the data set, whole or not at all."""
    began = time.perf_counter()
    with whole_folder(args.out) as part:
        rig = read_rig(args.rig, specs)
        plan = read_plan(args.rig, (*rig.logged_inputs, *rig.measured))
        shifts = dict(args.shift)
        logs = []
        for path in args.logs:
            logs.append(resample(path, rig, plan, shifts, args.unwrap))
            used = [stretch.rows for stretch in logs[-1].sequences if not stretch.why]
            log(f"{path}: {counted(len(used), 'sequence')}, {sum(used)} of {logs[-1].rows} rows")
        files = places(logs, args.test)
        write_sequences(part, logs, files, rig)
        text = _reaching(args.rig.read_text(encoding="utf-8-sig"), args.rig.parent, args.out)
        replace_text(part / "rig.toml", text)
        names = iter(files)
        entries = [_entry(each, names) for each in logs]
        rows = sum(s["rows"] for each in entries for s in each["sequences"] if s["file"])
        document = {
            "format": 1,
            "rig": rig.name,
            "dt": rig.dt,
            "input": "line" if rig.input_hold == SMOOTH else "mean" if plan.mean else "hold",
            "shifts": shifts,
            "rows_used": rows,
            "rows_dropped": sum(each["rows"] for each in entries) - rows,
            "logs": entries,
            "look": [line for each in logs for line in _remarks(each)],
            "seconds": time.perf_counter() - began,
            "versions": versions(),
        }
        replace_text(part / "import.json", json_text(document))
    for line in document["look"]:
        log(f"warning: {line}")
    test = sum(file.startswith("test/") for file in files)
    amount = f"{len(files) - test} training and {counted(test, 'test sequence')}"
    log(f"wrote {amount} to {args.out}; numbers in {args.out / 'import.json'}")


def _entry(log: Resampled, files: Iterator[str]) -> dict[str, Any]:
    """A log in import.json; times in seconds after its first message."""
    return {
        "file": log.path.name,
        "origin_ns": log.origin,
        "columns": {name: {"from": str(at), "scale": at.scale} for name, at in log.addresses.items()},
        "topics": log.topics,
        "rows": log.rows,
        "sequences": [{**s._asdict(), "file": None if s.why else next(files)} for s in log.sequences],
        "notes": log.notes,
    }


def _remarks(log: Resampled) -> Iterator[str]:
    """Warnings for the owner before a fit."""
    for topic in log.topics:
        yield from (f"{log.path.name}: {topic.name or 'the table'}: {note}" for note in topic.notes)
    yield from (f"{log.path.name}: {note}" for note in log.notes)


def _reaching(text: str, folder: Path, out: Path) -> str:
    """A rig.toml that finds its machine file, which stays where it is, from another folder."""
    file = tomllib.loads(text)["model"].get("file")
    if file is None:
        return text
    path = toml_text(os.path.relpath(folder / file, out))
    return re.sub(r"(?m)^(\s*file\s*=\s*)(\"[^\"\n]*\"|'[^'\n]*')", lambda match: match[1] + path, text, count=1)
