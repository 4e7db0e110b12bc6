"""Estimate all states from all readings of each sequence.

examples:
  nnap-em smooth fit bench/test --out smoothed

DIR gets a CSV file per sequence: time, all states, and their standard deviations, from all readings of the sequence.
"""

import argparse

import numpy as np

from ..base.digits import counted
from ..base.log import Log
from ..estimate.predict import smooth
from ..estimate.store import load, model_file
from ..logs.read import read_logs
from .common import write_states


def run(args: argparse.Namespace, log: Log) -> None:
    """Write the distribution of every state after all readings of the sequence."""
    fitted = load(model_file(args.model))
    logs = read_logs(args.folder, fitted.rig, trust=args.trust_readings)
    state = smooth(fitted, logs.data)
    mean, std = np.asarray(state.mean), np.sqrt(np.diagonal(np.asarray(state.cov), axis1=-2, axis2=-1))
    write_states(args.out, logs, fitted.model.system.readable, mean, std)
    log(f"wrote {counted(len(logs.files), 'file')} to {args.out}")
