"""nnap-em predict: states from the first readings of each sequence and all inputs."""

import argparse

import jax
import numpy as np

from ..data.logs import read_logs
from ..em.predict import predict
from ..em.store import load, model_file
from .common import Say, write_states


def run(args: argparse.Namespace, say: Say) -> None:
    """Write the distribution of every state after the readings up to the given time."""
    fitted = load(model_file(args.model))
    logs = read_logs(args.folder, fitted.rig, trust=args.trust_readings, until=args.given)
    found = predict(fitted, logs.data, args.given, key=jax.random.key(args.seed))
    write_states(args.out, logs, fitted.model.system.readable, np.asarray(found.mean), np.asarray(found.std))
    say(f"wrote {len(logs.files)} files to {args.out}")
