"""nnap-em import: logs as machines write them, brought to one grid as a data set."""

import argparse
import time

from ..data.recordings.bring import Brought, bring
from ..data.recordings.declared import read_plan
from ..data.recordings.folder import completed, places, write_sequences
from ..data.rig import read_rig
from ..report.imported import describe, write_page
from ..storage.files import replace_text, whole_folder
from ..systems import specs
from .common import Say


def run(args: argparse.Namespace, say: Say) -> None:
    """Write the data set, whole or not at all."""
    began = time.perf_counter()
    with whole_folder(args.out) as part:
        rig = read_rig(args.rig, specs)
        plan = read_plan(args.rig, (*rig.input_columns, *rig.measured))
        shifts = dict(args.shift)
        logs = []
        for path in args.logs:
            logs.append(bring(path, rig, specs[rig.system].states, plan, shifts))
            say(f"{path}: {_told(logs[-1])}")
        files = places(logs, args.test)
        write_sequences(part, logs, files, rig)
        replace_text(part / "rig.toml", completed(args.rig.read_text(encoding="utf-8-sig"), logs[0].addresses))
        document = describe(logs, files, rig, plan, shifts, seconds=time.perf_counter() - began)
        write_page(part, document)
    for line in document["look"]:
        say(f"look at this: {line}")
    test = sum(file.startswith("test/") for file in files)
    say(f"wrote {len(files) - test} training and {test} test sequences to {args.out}; read {args.out / 'import.html'}")


def _told(log: Brought) -> str:
    used = [stretch for stretch in log.sequences if not stretch.why]
    return f"{len(used)} sequences, {sum(stretch.rows for stretch in used)} of {log.rows} rows"
