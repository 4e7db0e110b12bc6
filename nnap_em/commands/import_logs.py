"""Write a data set from logs as machines write them.

examples:
  nnap-em init run.mcap --system acrobot            a first rig.toml, with a table [import] of the topics
  nnap-em import run.mcap --rig rig.toml --out bench
  nnap-em import day1.mcap day2.mcap --rig rig.toml --out bench --test 0.2 --shift /joint_states=-0.012

Brings topics with clocks of their own to rows that are [sampling] dt apart, cuts sequences at gaps, and reports rates,
jitter, gaps, delays between topics and rows used in FOLDER/import.html.  Where columns come from stands in the
table [import.columns] of rig.toml; what is not there is found by its name.  MCAP (ROS 2, JSON, protobuf) and HDF5 need
pip install "nnap-em[logs]".
"""

import argparse
import os
import re
import time
import tomllib
from pathlib import Path

from ..data.rig import read_rig, toml_text
from ..em.build import build_system
from ..import_.declared import read_plan
from ..import_.folder import completed, places, write_sequences
from ..import_.resample import resample
from ..numerics.digits import counted
from ..report.imported import describe, write_page
from ..storage.files import replace_text, whole_folder
from ..storage.log import Log
from ..systems import specs


def run(args: argparse.Namespace, log: Log) -> None:
    """Write the data set, whole or not at all."""
    began = time.perf_counter()
    with whole_folder(args.out) as part:
        rig = read_rig(args.rig, specs)
        plan = read_plan(args.rig, (*rig.logged_inputs, *rig.measured))
        shifts = dict(args.shift)
        logs = []
        for path in args.logs:
            logs.append(resample(path, rig, build_system(rig).states, plan, shifts, args.unwrap))
            used = [stretch.rows for stretch in logs[-1].sequences if not stretch.why]
            log(f"{path}: {counted(len(used), 'sequence')}, {sum(used)} of {logs[-1].rows} rows")
        files = places(logs, args.test)
        write_sequences(part, logs, files, rig)
        text = _reaching(args.rig.read_text(encoding="utf-8-sig"), args.rig.parent, args.out)
        replace_text(part / "rig.toml", completed(text, logs[0].addresses))
        document = describe(logs, files, rig, plan, shifts, seconds=time.perf_counter() - began)
        write_page(part, document)
    for line in document["look"]:
        log(f"warning: {line}")
    test = sum(file.startswith("test/") for file in files)
    amount = f"{len(files) - test} training and {counted(test, 'test sequence')}"
    log(f"wrote {amount} to {args.out}; read {args.out / 'import.html'}")


def _reaching(text: str, folder: Path, out: Path) -> str:
    """A rig.toml that finds its machine file, which stays where it is, from another folder."""
    file = tomllib.loads(text)["model"].get("file")
    if file is None:
        return text
    path = toml_text(os.path.relpath(folder / file, out))
    return re.sub(r"(?m)^(\s*file\s*=\s*)(\"[^\"\n]*\"|'[^'\n]*')", lambda match: match[1] + path, text, count=1)
