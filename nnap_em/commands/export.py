"""nnap-em export: the model for other programs."""

import argparse

from ..em.store import load
from ..portable.export import export
from .common import Say, model_file


def run(args: argparse.Namespace, say: Say) -> None:
    """Write it as JSON, as a NumPy program and as StableHLO."""
    export(load(model_file(args.model)), args.out)
    say(f"wrote parameters.json, predictor.py and model.stablehlo to {args.out}")
