"""nnap-em check: test of whether the logs can identify what is declared."""

import argparse

import jax

from ..identifiability.check import BAD, check
from ..storage.log import Log
from .common import read_bench


def run(args: argparse.Namespace, log: Log) -> int:
    """A line per question; 1 where they cannot."""
    bench = read_bench(args.folder, args.trust_readings)
    results = check(*bench, key=jax.random.key(0))
    for finding in results:
        print(f"{finding.mark:4}  {finding.subject:8}  {bench.rig.named(finding.text)}")
    bad = sum(finding.mark == BAD for finding in results)
    log(f"bad answers: {bad} of {len(results)}" if bad else "the logs allow a fit")
    return int(bad > 0)
