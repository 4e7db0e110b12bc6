"""Predict from the first readings of each sequence and all inputs.

examples:
  nnap-em predict fit bench/test --given 1.0 --out prediction
  nnap-em predict fit/model.npz bench/test --given 2.0 --out prediction --seed 3

Uses the readings up to the given time after a sequence's first row, and all inputs.  DIR gets a CSV file per sequence:
time, all states, and their standard deviations without measurement noise.  Exit status 3, and a line, where the fit
does not describe its motion.
"""

import argparse
import warnings

import jax
import numpy as np

from ..base.digits import counted
from ..base.log import Log
from ..errors import DataWarning
from ..estimate.predict import given_samples, predict
from ..estimate.store import load, model_file
from ..explain.diagnosis.keys import listed
from ..logs.read import read_logs
from .common import MISFIT_STATUS, write_states


def run(args: argparse.Namespace, log: Log) -> int:
    """Write the distribution of every state after the readings up to the given time."""
    fitted = load(model_file(args.model))
    logs = read_logs(args.folder, fitted.rig, trust=args.trust_readings, until=args.given)
    known, valid = given_samples(logs.data, args.given), np.asarray(logs.data.valid)
    if ended := [file for file, ahead in zip(logs.files, valid & ~known, strict=True) if not ahead.any()]:
        given = f"{args.given:g} {fitted.rig.time_unit}"
        problem = f"no row of {listed(ended)} is later than --given {given}: nothing is predicted there"
        warnings.warn(f"{args.folder}: {problem}", DataWarning, 2)
    prediction = predict(fitted, logs.data, args.given, key=jax.random.key(args.seed))
    mean, std = np.asarray(prediction.mean), np.asarray(prediction.std)
    write_states(args.out, logs, fitted.model.system.readable, mean, std)
    log(f"wrote {counted(len(logs.files), 'file')} to {args.out}")
    if fitted.misfit.text:
        log(fitted.misfit.text)
    return MISFIT_STATUS if fitted.misfit.useless else 0
