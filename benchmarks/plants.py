"""`nnap-em diagnose` on measured plants that are written as equations: what is named, errors before and after, seconds.

    python benchmarks/plants.py --out out/plants [--core 0] [CASE ...]

Each case runs in a process of its own; its data set, report and output stay in the folder of --out.  Records of
`test/` give the errors alone.  The data lie in ../shared/data/ode, whose README names their sources.
"""

import argparse
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from runner import ROOT, SHARED, made, nnap_em

sys.path.append(str(ROOT / "examples"))
import tanks

ODE = SHARED / "ode"
HEATERS = """format = 1
name = "heaters"

[model]
type = "equations"
inputs = { Q1 = "%", Q2 = "%" }
states = { H1 = "degC", H2 = "degC", T1 = "degC", T2 = "degC" }
rates = { H1 = "a1*Q1 - k*(H1 - Ta)", H2 = "a2*Q2 - k*(H2 - Ta)", T1 = "(H1 - T1)/tau", T2 = "(H2 - T2)/tau" }
exact = ["T1", "T2"]
a1 = { mean = 0.006, std = 0.003 }
a2 = { mean = 0.004, std = 0.002 }
k = { mean = 0.006, std = 0.003 }
tau = { mean = 20, std = 10 }
Ta = 20.9

[sampling]
dt = 3
input_hold = "zero-order"
clock = "sequence"

[measurement]
columns = ["T1", "T2"]
"""


def _stored(name: str) -> Callable[[Path], None]:
    return lambda folder: shutil.copytree(ODE / name, folder, copy_function=shutil.copyfile)


def _tanks(folder: Path) -> None:
    tanks.write(tanks.recordings(ODE / "cascaded_tanks"), folder)


def _chamber(rate: str) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        (folder / "train").mkdir(parents=True)
        shutil.copyfile(ODE / "air_chamber" / "chamber_015.csv", folder / "train" / "chamber.csv")
        text = (ODE / "air_chamber" / "rig.toml").read_text()
        number = "\nc = { mean = 0.1, std = 0.1 }" if rate != "0" else ""
        (folder / "rig.toml").write_text(text.replace('rates = { p = "0" }', f'rates = {{ p = "{rate}" }}{number}'))

    return write


def _heaters(folder: Path) -> None:
    for part, name in (("train", "pid"), ("test", "steps_a")):
        t, *columns = np.genfromtxt(ODE / "tclab" / f"{name}.csv", delimiter=",", skip_header=1).T
        time = np.arange(0, t[-1], 3.0)
        inputs = [column[np.searchsorted(t, time + 0.5) - 1] for column in columns[:2]]
        table = np.column_stack([time, *inputs, *(np.interp(time, t, column) for column in columns[2:])])
        (folder / part).mkdir(parents=True)
        np.savetxt(folder / part / f"{name}.csv", table, "%.10g", ",", header="time,Q1,Q2,T1,T2", comments="")
    (folder / "rig.toml").write_text(HEATERS)


CASES = {
    "tanks": _tanks,
    "chamber": _chamber("0"),
    "chamber_c": _chamber("-c"),
    "worm_drive": _stored("worm_drive"),
    "model_car": _stored("model_car"),
    "heaters": _heaters,
}
"""Functions that write the data sets."""


def run(name: str, out: Path, core: int) -> str:
    """A line of the table: `nnap-em diagnose` on a case, on one core."""
    folder, found = out / name, out / f"{name}_found"
    for old in (folder, found):
        shutil.rmtree(old, ignore_errors=True)
    CASES[name](folder)
    ran = nnap_em("diagnose", folder, out=found, core=core)
    (out / f"{name}.log").write_text("\n".join(ran.said))
    if not ran.report:
        return f"| {name} | status {ran.status} | | {ran.processor_seconds:.0f} |"
    report, pairs = ran.report, []
    error = report["error"] or {}
    for column, before in error.get("before", {}).items():
        pairs.append(f"{column} {before[-1]:.3g} -> {error['after'][column][-1]:.3g}")
    horizon = f" ({error['horizons_s'][-1]:.3g} s)" if pairs else ""
    return f"| {name} | {report['verdict']} | {'; '.join(pairs)}{horizon} | {ran.processor_seconds:.0f} |"


def main() -> None:
    """Run some cases, one after the other."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", choices=[*CASES, []], help="cases; without any, all")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--core", type=int, default=0)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    print(made())
    print("| plant | what is said | errors before and after | s of a processor |\n| --- | --- | --- | --- |")
    for name in arguments.cases or CASES:
        print(run(name, arguments.out, arguments.core), flush=True)


if __name__ == "__main__":
    main()
