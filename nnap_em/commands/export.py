"""nnap-em export: the model for other programs."""

import argparse

from ..em.store import load, model_file
from ..portable.export import export
from ..portable.mjcf import write_mjcf
from .common import Say


def run(args: argparse.Namespace, say: Say) -> None:
    """Write it as JSON, as a NumPy program and as StableHLO, or back to the file of a simulator."""
    fitted = load(model_file(args.model))
    if args.mjcf is not None:
        for line in write_mjcf(fitted, args.mjcf):
            say(f"{args.mjcf} has no place for {line}")
        say(f"wrote {args.mjcf}")
    if args.out is not None:
        export(fitted, args.out)
        say(f"wrote parameters.json, predictor.py and model.stablehlo to {args.out}")
