"""Write a fitted model for other programs.

examples:
  nnap-em export fit --out exported
  nnap-em export found/after.npz --out exported
  nnap-em export fit --mjcf arm_identified.xml      back to the machine's file: bodies, friction, laws
  nnap-em export fit --urdf arm.urdf --c arm.c      masses and friction for ROS, feed-forward torque as C99
  nnap-em export fit --observer arm.c               states of the running machine, as C99

OUT gets parameters.json: all numbers with their units.
"""

import argparse

from ..base.log import Log
from ..estimate.store import load, model_file
from ..output.export.c99 import write_c
from ..output.export.mjcf import write_mjcf
from ..output.export.model import write_model
from ..output.export.online import write_observer
from ..output.export.urdf import write_urdf
from .common import require_joints


def run(args: argparse.Namespace, log: Log) -> None:
    """Write its numbers, and it for a simulator, a controller, or as an observer."""
    fitted = load(model_file(args.model))
    for option in ("mjcf", "urdf", "c", "observer"):
        if getattr(args, option) is not None:
            require_joints(fitted.rig, f"--{option}")
    for path, write, problem in (
        (args.mjcf, write_mjcf, "has no place for"),
        (args.urdf, write_urdf, "has no place for"),
        (args.c, write_c, "leaves out"),
    ):
        if path is not None:
            for line in write(fitted, path):
                log(f"{path} {problem} {line}")
            log(f"wrote {path}")
    if args.observer is not None:
        write_observer(fitted, args.observer, single=args.float)
        log(f"wrote {args.observer} and {args.observer.with_suffix('.h').name}")
    if args.out is not None:
        write_model(fitted, args.out)
        log(f"wrote parameters.json to {args.out}")
