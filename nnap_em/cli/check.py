"""Test whether the logs can identify what is declared.

example:
  nnap-em check bench

One line per subject: ok, warning (a fit may do) or error (a fit would be in vain).  Length, missing samples,
sampling rate, noise, torques, the velocities that each joint visits, and whether the whole state can be observed.
Nothing is fitted and nothing is written.  Exit status 1 where one has an error.
"""

import argparse

import jax

from ..base.digits import counted
from ..base.log import Log
from ..explain.check import ERROR, check
from .common import read_bench


def run(args: argparse.Namespace, log: Log) -> int:
    """A line per subject; 1 where one has an error."""
    bench = read_bench(args.folder, args.trust_readings)
    results = check(*bench, key=jax.random.key(0))
    for finding in results:
        print(f"{finding.mark:7}  {finding.subject:10}  {bench.rig.named(finding.text)}")
    errors = sum(finding.mark == ERROR for finding in results)
    log(counted(errors, "error") if errors else "the logs allow a fit")
    return int(errors > 0)
