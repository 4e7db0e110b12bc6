"""A real acrobot, from public logs to a finding: as it was recorded, and with one effect more than its log says.

Eight swing-ups of a double pendulum are downloaded (14 MB, kept in the user's cache), brought to one grid by
`nnap-em import`, and diagnosed twice by `nnap-em diagnose`.  For the second time a law is taken out of the torque log:
where the motor gave u, the log says u minus the torque of the law.  For a reader of that log the machine has the law in
addition, with parameters that are known exactly; everything else stays real.  Written into `out/measured_loop/`: the
logs, both reports, `finding.png` and `errors.png`.

    python examples/measured_loop.py                               # some minutes on two cores
    python examples/measured_loop.py --from FOLDER                 # the eight files are there: no download
    python examples/measured_loop.py --plant cogging               # another law
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import plant
from measured_figures import MissingTorque, errors_figure, finding_figure
from recordings import RecordingError, beginning, recordings, write

from nnap_em import Identified, horizon_errors, load, predict, read_logs
from nnap_em.cli.common import MISFIT_STATUS, set_up
from nnap_em.cli.main import main as nnap_em
from nnap_em.explain.diagnosis.residual import residual

RIG = Path(__file__).resolve().parent / "machines" / "dfki_acrobot.toml"
TEST = 2
"""Last recordings, which no fit sees."""
LAWS: dict[str, dict[str, Any]] = {
    "torsional_spring": {"joint": 2, "k": 0.6, "theta0": 0.2},
    "cogging": {"joint": 2, "amplitude": 0.4, "k": 3.0, "phase": 0.5},
    "eddy_brake": {"joint": 2, "c": 0.05, "center": 0.5},
}
"""Choices of --plant, in SI units; the formulas are those of plant.py."""
STRENGTH = {"torsional_spring": ("k", "N m/rad"), "cogging": ("amplitude", "N m"), "eddy_brake": ("c", "N m s/rad")}
"""The number of each law that the table compares."""
STARTS = np.arange(0.5, 3.51, 0.25)
"""Predictions of a test recording start there [s]."""
HORIZONS = (0.1, 0.25, 0.5, 1.0)
"""[s]"""


def torque(name: str, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Torque of a law [N m] at angles and rates of its joint."""
    return plant.JOINT[name](LAWS[name], q, v)


def write_logs(source: list[Path], out: Path, law: str | None) -> list[Path]:
    """The beginnings of all recordings; where a law is named, it is taken out of the torque of its joint."""
    for recording in source:
        names, rows = beginning(recording)
        if law is not None:
            drive, q, v = (names.index(f"{name}_meas{LAWS[law]['joint']}") for name in ("tau", "pos", "vel"))
            rows[:, drive] -= torque(law, rows[:, q], rows[:, v])
        write(out / recording.name, names, rows)
    return sorted(out.iterdir())


class Diagnosis(NamedTuple):
    """Results of a diagnosis."""

    folder: Path
    """Folder of the data set."""
    report: dict[str, Any]
    before: Identified
    after: Identified


def prepared(source: list[Path], out: Path, law: str | None) -> None:
    """Write the logs, and bring them to one grid; raises SystemExit where that fails."""
    shutil.rmtree(out, ignore_errors=True)
    logs = map(str, write_logs(source, out / "logs", law))
    if status := nnap_em(["import", *logs, "--rig", str(RIG), "--out", str(out / "data"), "--test", str(TEST)]):
        raise SystemExit(status)


def diagnose(folders: list[Path]) -> None:
    """Find what the model lacks in every folder, all at once and on one core each; raises SystemExit where it fails."""
    environment = os.environ | {"JAX_NUM_CPU_DEVICES": "1"}
    command = [sys.executable, "-m", "nnap_em.cli.main", "diagnose"]
    processes = {
        folder.name: subprocess.Popen(
            [*command, str(folder / "data"), "--out", str(folder / "found")],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=environment,
        )
        for folder in folders
    }
    try:
        with ThreadPoolExecutor(len(processes)) as pool:
            list(pool.map(print_lines, processes, processes.values()))
    finally:
        for process in processes.values():
            process.kill()
            process.wait()
    if any(process.returncode not in (0, MISFIT_STATUS) for process in processes.values()):
        raise SystemExit(1)


def print_lines(name: str, process: subprocess.Popen[str]) -> None:
    """Print the lines of a process behind its name, until it ends."""
    assert process.stdout is not None
    for line in process.stdout:
        print(f"{name:9s}| {line.removeprefix('nnap-em: ')}", end="", flush=True)
    process.wait()


def read(out: Path) -> Diagnosis:
    """Results of a diagnosis, from its folder."""
    report = json.loads((out / "found" / "report.json").read_text())
    models = (load(out / "found" / f"{name}.npz") for name in ("before", "after"))
    return Diagnosis(out / "data", report, *models)


def errors(fitted: Identified, folder: Path) -> dict[str, list[float]]:
    """Root mean square errors of predictions of the test recordings, by column and horizon, over all starts."""
    data = read_logs(folder / "test", fitted.rig).data
    squares = []
    for start in STARTS:
        prediction = predict(fitted, data, float(start), key=jax.random.key(0))
        squares.append(horizon_errors(prediction, fitted, data, float(start), HORIZONS))
    names = squares[0]
    return {n: list(np.sqrt(np.mean([np.square(one[n]) for one in squares], axis=0))) for n in names}


def missing_torque(title: str, done: Diagnosis, law: str, *, planted: bool) -> MissingTorque:
    """Samples of the force that the declared model lacks at the joint of the law, and of the laws."""
    joint = LAWS[law]["joint"] - 1
    left = residual(done.after, read_logs(done.folder / "train", done.after.rig).data).followed()
    seen = np.isfinite(left.force[..., joint])
    q, v = (left.state[..., column][seen] for column in (joint, joint + 2))
    lacked, remainder = left.partial_force[..., joint][seen], left.force[..., joint][seen]
    true = torque(law, q, v) if planted else None
    return MissingTorque(title, q, lacked, lacked - remainder if done.report["effects"] else None, true)


def lines(recorded: Diagnosis, planted: Diagnosis, law: str, off: dict[str, float]) -> list[tuple[str, str]]:
    """The eight lines of the table; `off`: errors 1 s ahead [rad]."""
    name, unit = STRENGTH[law]
    number = next((e["parameters"][name] for e in planted.report["effects"] if e["name"] == law), None)
    logs = [len(list((recorded.folder / part).glob("*.csv"))) for part in ("train", "test")]
    what = f"{law.replace('_', ' ')} at joint {LAWS[law]['joint']}"
    joint = f"joint {LAWS[law]['joint']}, 1 s ahead"
    return [
        ("recordings of a real acrobot", f"{logs[0]} to fit, {logs[1]} to test"),
        ("as recorded, the model lacks", summary(recorded)),
        (f"with a {what} taken out of the log", summary(planted)),
        (f"its {name}, taken out", f"{LAWS[law][name]:.3g} {unit}"),
        (f"its {name}, found", f"{number['value']:.3g} ± {number['std']:.1g} {unit}" if number else "not found"),
        (f"prediction error of {joint}: without it", f"{off['before']:.3f} rad"),
        (f"prediction error of {joint}: with it", f"{off['after']:.3f} rad"),
        (f"prediction error of {joint}: as recorded", f"{off['recorded']:.3f} rad"),
    ]


def summary(done: Diagnosis) -> str:
    """Effects that a report lists as missing."""
    report = done.report
    suspects = "".join(f"; a suspect: {s['law']}" for s in report.get("suspects", [])[:1])
    laws = "; ".join(f"{e['description'].partition(':')[0]}{share_removed(e['evidence'])}" for e in report["effects"])
    return laws or ("it cannot tell what" if report.get("undecided") else f"nothing{suspects}")


def share_removed(evidence: dict[str, float | None]) -> str:
    """Share of the squared prediction error that a law removes, where that is known."""
    share = evidence.get("share_of_error")
    return "" if share is None or not np.isfinite(share) else f" (removes {share:.0%} of the error)"


def main() -> int:
    """Get the logs, diagnose them twice, and compare with the truth."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--from", dest="folder", type=Path, metavar="FOLDER", help="folder of the published files")
    parser.add_argument("--plant", choices=LAWS, default="torsional_spring", help="law that is taken out of the log")
    parser.add_argument("--out", type=Path, default=Path("out/measured_loop"))
    args = parser.parse_args()
    try:
        source = recordings(args.folder)
    except RecordingError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    law, words = args.plant, args.plant.replace("_", " ")
    folders = [args.out / "recorded", args.out / "planted"]
    for folder, taken_out in zip(folders, (None, law), strict=True):
        prepared(source, folder, taken_out)
    diagnose(folders)
    recorded, planted = map(read, folders)
    set_up()
    panels = [
        missing_torque("as recorded", recorded, law, planted=False),
        missing_torque(f"{words} taken out of the log", planted, law, planted=True),
    ]
    finding_figure(panels, LAWS[law]["joint"]).savefig(args.out / "finding.png")
    models = {"before": planted.before, "after": planted.after, "recorded": recorded.after}
    folders = {"before": planted.folder, "after": planted.folder, "recorded": recorded.folder}
    off = {name: errors(fitted, folders[name]) for name, fitted in models.items()}
    labels = {"before": f"without the {words}", "after": "with what was found", "recorded": "the machine as recorded"}
    errors_figure(HORIZONS, {labels[name]: values for name, values in off.items()}).savefig(args.out / "errors.png")
    column = f"theta{LAWS[law]['joint']}"
    print()
    for name, value in lines(recorded, planted, law, {name: values[column][-1] for name, values in off.items()}):
        print(f"{name:58s} {value}")
    print(f"\nfigures: {args.out / 'finding.png'}, {args.out / 'errors.png'}; pages: {args.out}/*/found/report.html")
    return 0


if __name__ == "__main__":
    sys.exit(main())
