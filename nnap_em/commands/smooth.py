"""nnap-em smooth: states from all readings of each sequence."""

import argparse

import numpy as np

from ..data.logs import read_logs
from ..em.predict import smoothed_states
from ..em.store import load, model_file
from .common import Say, write_states


def run(args: argparse.Namespace, say: Say) -> None:
    """Write the distribution of every state after all readings of the sequence."""
    fitted = load(model_file(args.model))
    logs = read_logs(args.folder, fitted.rig, trust=args.trust_readings)
    state = smoothed_states(fitted, logs.data)
    std = np.sqrt(np.diagonal(np.asarray(state.cov), axis1=-2, axis2=-1))
    write_states(args.out, logs, fitted.model.system.readable, np.asarray(state.mean), std)
    say(f"wrote {len(logs.files)} files to {args.out}")
