"""The next experiment, end to end from a seed: what few logs leave open, and inputs that narrow it.

The rig is simulated by `plant.py`, which shares no code with the library: an acrobot whose second joint nobody
measures and whose drive acts a little late.  `nnap-em design` proposes six sequences more than the six of sines, the
plant plays them, and old and new logs are diagnosed together.  Written into `out/next_experiment/`: the logs, both
reports and the design.

    python examples/next_experiment.py                             # some six minutes on two cores
    python examples/next_experiment.py --effect actuator_lag       # the other law as the true one
"""

import argparse
import json
import sys
from pathlib import Path

import numpy as np
import plant

from nnap_em.cli.common import MISFIT_STATUS
from nnap_em.cli.main import main as nnap_em

EFFECTS = {
    "input_delay": {"name": "input_delay", "joint": 2, "delay": 0.004},
    "actuator_lag": {"name": "actuator_lag", "joint": 2, "tau": 0.004},
}
SEQUENCES = 6


def rig_of(effect: str, seed: int) -> plant.Case:
    """An acrobot whose drive is late, and six sequences of sines."""
    noise = (0.002, 0.02)
    return plant.Case(effects=(EFFECTS[effect],), sequences=SEQUENCES, tests=2, torque="sine", noise=noise, seed=seed)


def play(case: plant.Case, folder: Path, out: Path) -> None:
    """The machine plays the inputs of a design: logs of it, from starts that are set by hand."""
    machine, rng = plant.build(case), np.random.default_rng([case.seed, 99])
    proposal = json.loads((folder / "design.json").read_text())
    t, u = (
        np.stack([np.genfromtxt(folder / file, delimiter=",", names=True)[name] for file in proposal["inputs"]])
        for name in ("time", "u")
    )
    start = np.asarray([[s[name] for name in plant.SYSTEMS[case.system].states] for s in proposal["starts"]])
    start[:, :2] += 0.03 * rng.standard_normal((len(u), 2))
    kicks = case.process * rng.standard_normal((*u.shape, machine.dof))
    x = plant.simulate(machine, start, u, t[:, 0], kicks)
    y = plant.readings(machine._replace(case=case._replace(seed=1000 + case.seed)), x)
    for i, file in enumerate(proposal["inputs"]):
        rows = np.column_stack([t[i], u[i], y[i]])
        (out / Path(file).name).parent.mkdir(parents=True, exist_ok=True)
        header = ",".join(("time", "u", *plant.measured(case)))
        np.savetxt(out / Path(file).name, rows, fmt="%.6f", delimiter=",", header=header, comments="")


def findings(report: Path) -> list[str]:
    """Effects of a report, and their equivalents."""
    lines = []
    for effect in json.loads((report / "report.json").read_text())["effects"]:
        same = " or ".join(other["name"] for other in effect["equivalent"])
        lines.append(effect["description"] + (f", which may be {same}" if same else ""))
    return lines or ["nothing"]


def main() -> int:
    """Log, diagnose, design, log again, diagnose both."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--effect", choices=tuple(EFFECTS), default="input_delay")
    arguments.add_argument("--seed", type=int, default=1)
    arguments.add_argument("--out", type=Path, default=Path("out/next_experiment"))
    args = arguments.parse_args()
    case = rig_of(args.effect, args.seed)
    rig, first, plan, again = (args.out / name for name in ("rig", "first", "plan", "again"))
    plant.write(case, rig)
    commands = (
        ("diagnose", rig, "--out", first),
        ("design", first, "--out", plan, "--seconds", "30"),
        ("diagnose", rig, "--more", args.out / "new", "--out", again),
    )
    for command in commands:
        if "--more" in command:
            play(case, plan, args.out / "new")
        if (status := nnap_em([*map(str, command)])) not in (0, MISFIT_STATUS):
            return status
    print("truth:", *(f"{k} {v}" for k, v in EFFECTS[args.effect].items()))
    for name, report in (("six sequences of sines", first), ("and six that were designed", again)):
        print(f"{name}:", *findings(report), sep="\n  ")
    return 0


if __name__ == "__main__":
    sys.exit(main())
