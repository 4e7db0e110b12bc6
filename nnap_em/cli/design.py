"""Find the inputs to play next.

examples:
  nnap-em design found --out next                   what the last report leaves open, all together
  nnap-em design fit --out next --seconds 60 --sequences 12
  nnap-em diagnose bench --more next/logs --out again

FIT is the output of identify or diagnose.  OUT gets inputs/*.csv (time and inputs, ready to be played), motion/*.csv
(what should then happen), design.json and design.html (read this one).  Nothing goes beyond [limits] of rig.toml, or
where nothing is declared beyond what the logs visited.
"""

import argparse
import dataclasses
import time

import jax

from ..base.log import Log
from ..estimate.identify import Identified
from ..estimate.store import Stored, model_file, read
from ..explain.design.experiment import design
from ..output.report.design import check_places, write_design
from .common import Bench, logs_of, require_joints, resumable


def run(args: argparse.Namespace, log: Log) -> None:
    """Design, and report."""
    began = time.perf_counter()
    stored = read(model_file(args.folder))
    require_joints(stored.fitted.rig, "design")
    fitted, bench = _logs(args, stored)
    check_places(args.out, args.sequences)
    with resumable(args, bench, log):
        designed = design(
            fitted, bench.train.data, key=jax.random.key(args.seed),
            seconds=args.seconds, sequences=args.sequences, log=log,
        )  # fmt: skip
        write_design(args.out, designed, seed=args.seed, began=began, log=log)


def _logs(args: argparse.Namespace, stored: Stored) -> tuple[Identified, Bench]:
    rig, train = logs_of(model_file(args.folder), stored, args.logs, args.trust_readings)
    limited = dataclasses.replace(stored.fitted.rig, limits=rig.limits)
    return stored.fitted._replace(rig=limited), Bench(limited, train, None)
