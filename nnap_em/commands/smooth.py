"""Estimate all states from all readings of each sequence.

examples:
  nnap-em smooth fit bench/test --out smoothed
  nnap-em smooth fit bench/test --out smoothed --mcap smoothed.mcap

DIR gets a CSV file per sequence: time, all states, and their standard deviations, from all readings of the sequence.
The file of --mcap gets JSON messages, for Foxglove and other viewers: /log, /smoothed, /one_row_ahead (states predicted
from the rows before) and /missing_force (the generalised force that the model lacks, by coordinate).
"""

import argparse
from pathlib import Path

import numpy as np

from ..data.logs import Logs, read_logs
from ..diagnosis.residual import residual
from ..fit.branches import Branch, branches
from ..fit.identify import Identified
from ..fit.predict import smooth
from ..fit.store import load, model_file
from ..import_.mcap_writer import Channel, require_mcap, write_mcap
from ..numerics.digits import counted
from ..storage.log import Log
from .common import log_of, states_of, write_states


def run(args: argparse.Namespace, log: Log) -> None:
    """Write the distribution of every state after all readings of the sequence."""
    if args.mcap is not None:
        require_mcap(args.mcap)
    fitted = load(model_file(args.model))
    logs = read_logs(args.folder, fitted.rig, trust=args.trust_readings)
    state = smooth(fitted, logs.data)
    mean, std = np.asarray(state.mean), np.sqrt(np.diagonal(np.asarray(state.cov), axis1=-2, axis2=-1))
    write_states(args.out, logs, fitted.model.system.readable, mean, std)
    log(f"wrote {counted(len(logs.files), 'file')} to {args.out}")
    for other in branches(fitted.model, logs.data, fitted.smoother.tolerant(), key=fitted.state.key):
        log(_line(other, fitted, logs))
    if args.mcap is not None:
        _write_channels(args.mcap, fitted, logs, states_of(fitted, mean, std))
        log(f"wrote {args.mcap}")


def _line(other: Branch, fitted: Identified, logs: Logs) -> str:
    """The place of another branch and its probability."""
    first, last = other.rows
    t, name = np.asarray(logs.data.t[other.sequence]), fitted.model.system.coordinates[other.angle]
    ends = " to ".join(f"{other.mean[row, other.angle]:.2f}" for row in dict.fromkeys(other.rows))
    span = f"from {t[first]:.2f} to {t[last]:.2f} s"
    return f"{logs.files[other.sequence]}: with probability {other.weight:.2f} {name} is {ends} rad {span} instead"


def _write_channels(path: Path, fitted: Identified, logs: Logs, smoothed: Channel) -> None:
    """The log, smoothed states, their prediction from the rows before, and the missing force, side by side."""
    system, left = fitted.model.system, residual(fitted, logs.data)
    places = system.ports[: left.force.shape[-1]]
    forces = {name: system.port_unit(port) for port, name in enumerate(places, 1)}
    forces |= {f"{name}_std": unit for name, unit in forces.items()}
    channels = {
        "/log": log_of(fitted, logs),
        "/smoothed": smoothed,
        "/one_row_ahead": Channel({name: system.unit(name) for name in system.states}, left.predicted),
        "/missing_force": Channel(forces, np.concatenate([left.force, left.force_std], axis=-1)),
    }
    write_mcap(path, logs, channels)
