"""A rig with an effect that nobody declared, end to end from a seed: find it, name it, add it, and see the error fall.

The rig is simulated by `plant.py`, which shares no code with the library: an acrobot whose second joint nobody
measures and whose cable pulls on it like a spring.  Written into `out/diagnose/`: the data set, report.html and
report.json.

    python examples/diagnose.py                                  # some minutes
    python examples/diagnose.py --effect payload --seed 3        # another name of plant.STRONG
    python examples/diagnose.py --effect none                    # a rig that lacks nothing
    python examples/diagnose.py --system slide                   # a slide: spring, dead zone and drag in one
"""

import argparse
import json
import sys
from pathlib import Path

import plant

from nnap_em.cli.common import MISFIT_STATUS
from nnap_em.cli.main import main as nnap_em

SLIDE = (
    {"name": "torsional_spring", "joint": 1, "k": 20.0, "theta0": 0.05},
    {"name": "dead_zone", "joint": 1, "width": 1.0},
    {"name": "air_drag", "joint": 1, "c": 0.8},
)
"""An undeclared spring [N/m], a dead zone [N] and a drag, which the learned friction map rightly takes in."""


def main() -> int:
    """Simulate, diagnose, compare with the truth."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--system", choices=("acrobot", "slide"), default="acrobot")
    arguments.add_argument("--effect", choices=("none", *plant.STRONG), default="torsional_spring")
    arguments.add_argument("--seed", type=int, default=1)
    arguments.add_argument("--out", type=Path, default=Path("out/diagnose"))
    args = arguments.parse_args()
    effects = SLIDE if args.system == "slide" else plant.STRONG.get(args.effect, ())
    clock = "session" if args.effect in plant.SESSION else "sequence"
    noise = (5e-4, 5e-3) if args.system == "slide" else (0.005, 0.05)
    case = plant.Case(system=args.system, effects=effects, seed=args.seed, clock=clock, noise=noise)
    plant.write(case, args.out / "rig")
    status = nnap_em(["diagnose", str(args.out / "rig"), "--out", str(args.out)])
    if status not in (0, MISFIT_STATUS):
        return status
    report = json.loads((args.out / "report.json").read_text())
    print(report["verdict"])
    for effect in report["effects"]:
        print(f"  found: {effect['description']}")
    for effect in effects:
        print(f"  truth: {', '.join(f'{k} {v}' for k, v in effect.items() if v is not None)}")
    column = next(iter(report["error"]["before"]))
    errors = (report["error"]["before"], report["error"]["after"], plant.oracle_errors(case, args.out / "rig"))
    values = [f"{e[column][3]:.3g}" for e in errors]
    print(f"  1 s error of {column}: {values[0]} before, {values[1]} after, {values[2]} for one who knows the truth")
    return 0


if __name__ == "__main__":
    sys.exit(main())
