"""`nnap-em diagnose` on measured plants that are written as equations: what is named, errors before and after, seconds.

    python benchmarks/plants.py --out out/plants [--core 0] [CASE ...]

Each case runs in a process of its own; its data set, report and what it said stay in the folder of --out.  Records of
`test/` give the errors alone.  The data lie in ../shared/data/ode, whose README names their sources.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.append(str(ROOT / "examples"))
import tanks  # noqa: E402

ODE = ROOT.parent / "shared" / "data" / "ode"
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
    environment = os.environ | {"JAX_NUM_CPU_DEVICES": "1", "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "nnap_em.cli.main", "diagnose", str(folder), "--out", str(found)]
    with (out / f"{name}.log").open("w") as said:
        process = subprocess.Popen(command, env=environment, stdout=said, stderr=said)
        os.sched_setaffinity(process.pid, {core})
        _, status, used = os.wait4(process.pid, 0)
    seconds = used.ru_utime + used.ru_stime
    if not (found / "report.json").exists():
        return f"| {name} | status {os.waitstatus_to_exitcode(status)} | | {seconds:.0f} |"
    report = json.loads((found / "report.json").read_text())
    error, pairs = report.get("test_error") or {}, []
    for column, before in error.get("before", {}).items():
        pairs.append(f"{column} {before[-1]:.3g} -> {error['after'][column][-1]:.3g}")
    horizon = f" ({error['horizons_s'][-1]:.3g} s)" if pairs else ""
    return f"| {name} | {report['verdict']} | {'; '.join(pairs)}{horizon} | {seconds:.0f} |"


def main() -> None:
    """Run some cases, one after the other."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", choices=[*CASES, []], help="cases; without any, all")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--core", type=int, default=0)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    print("| plant | what is said | errors before and after | s of a processor |\n| --- | --- | --- | --- |")
    for name in arguments.cases or CASES:
        print(run(name, arguments.out, arguments.core), flush=True)


if __name__ == "__main__":
    main()
