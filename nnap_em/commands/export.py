"""nnap-em export: the model for other programs."""

import argparse

import jax

from ..em.store import load, model_file
from ..portable.c99 import write_c
from ..portable.draws import TABLE, write_draws
from ..portable.export import export
from ..portable.mjcf import write_mjcf
from ..portable.urdf import write_urdf
from .common import Say


def run(args: argparse.Namespace, say: Say) -> None:
    """Write it as JSON, NumPy and StableHLO, for a simulator, for a controller, or as draws of its posterior."""
    fitted = load(model_file(args.model))
    if args.mjcf is not None:
        for line in write_mjcf(fitted, args.mjcf, alone=args.alone):
            say(f"{args.mjcf} has no place for {line}")
        say(f"wrote {args.mjcf}")
    if args.urdf is not None:
        for line in write_urdf(fitted, args.urdf):
            say(f"{args.urdf} has no place for {line}")
        say(f"wrote {args.urdf}")
    if args.c is not None:
        for line in write_c(fitted, args.c):
            say(f"{args.c} leaves out {line}")
        say(f"wrote {args.c}")
    if args.draws is not None:
        write_draws(fitted, args.out, args.draws, key=jax.random.key(args.seed))
        say(f"wrote {args.draws} draws of the posterior to {args.out}: {TABLE}")
    elif args.out is not None:
        export(fitted, args.out)
        say(f"wrote parameters.json, predictor.py and model.stablehlo to {args.out}")
