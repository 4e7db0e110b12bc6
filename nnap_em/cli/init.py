"""Write a first rig.toml for a log.

examples:
  nnap-em init log.csv --system acrobot --out mine  writes mine/rig.toml
  nnap-em init mine/train/01.csv                    the same: rig.toml stands beside train/
  nnap-em init run.mcap --system acrobot --out mine  with a table [import] of what was found where
  nnap-em init run.mcap --model arm.xml --out mine  joints, motors and sensors by the names of the file
  nnap-em init log.csv --model equations --out mine  states, inputs and rates to be written as formulas

Reads columns, units, sample interval and noise off the log.  What it cannot read stands as a line  # key = ...  to be
filled in.  Columns with other names or units are mapped in [import.columns], by which nnap-em import reads the log.  A
rig.toml that is there is never overwritten.
"""

import argparse
from pathlib import Path

from ..base.files import replace_text
from ..base.log import Log
from ..errors import DataError
from ..logs.draft.draft import draft
from ..logs.draft.equations import draft_equations
from ..logs.draft.from_machine import draft_machine
from ..logs.importing.text_file import plain_csv
from ..machines.systems import specs


def run(args: argparse.Namespace, log: Log) -> None:
    """Write it, to be filled in; one that is there stays as it is."""
    home = args.log.parent.parent if args.log.parent.name in ("train", "test") else args.log.parent
    path = (args.out or home) / "rig.toml"
    if path.exists():
        raise DataError(f"{path}: is there already; give another --out, or remove it")
    if args.model == Path("equations"):
        drafted = draft_equations(args.log)
    elif args.model is not None:
        drafted = draft_machine(args.log, args.model, path.parent)
    else:
        drafted = draft(args.log, args.system, specs)
    replace_text(path, drafted.text)
    if drafted.mapped or not (args.log.suffix.lower() in (".parquet", ".mat") or plain_csv(args.log)):
        other = "names or units" if drafted.mapped else "marks, lines or clocks"
        log(f"the log has other {other}: then nnap-em import {args.log} --rig {path} --out FOLDER")
    missing = "; ".join(f"[{table}] {', '.join(keys)}" for table, keys in drafted.missing.items())
    log(f"wrote {path}" + (f"; fill in {missing}" if missing else ""))
