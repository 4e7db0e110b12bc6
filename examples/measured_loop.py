"""A real acrobot, from public logs to a finding: as it was recorded, and with one effect more than its log says.

Eight swing-ups of a double pendulum are downloaded (14 MB, kept in the user's cache), brought to one grid by
`nnap-em import`, and diagnosed twice by `nnap-em diagnose`.  The second time a law is taken out of the torque log:
where the motor gave u, the log says u minus the torque of the law.  For a reader of that log the machine has the law in
addition, with parameters that are known exactly; everything else stays real.  Written into `out/measured_loop/`: the
logs, both reports, `finding.png` and `errors.png`.

    python examples/measured_loop.py                               # some minutes on two cores
    python examples/measured_loop.py --from FOLDER                 # the eight files are there: no download
    python examples/measured_loop.py --plant cogging               # another law
"""

import argparse
import json
import shutil
import sys
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import plant
from measured_figures import Lack, errors_figure, finding_figure
from recordings import RecordingError, recordings

from nnap_em import Identified, horizon_errors, load, predict, read_logs
from nnap_em.commands.cli import main as nnap_em
from nnap_em.residual.residual import residual

RIG = Path(__file__).resolve().parent / "machines" / "dfki_acrobot.toml"
SECONDS = 5.0
"""Of each recording that are used: most of them balance upright afterwards, and show little."""
TEST = 2
"""Last recordings, which no fit sees."""
LAWS: dict[str, dict[str, Any]] = {
    "torsional_spring": {"joint": 2, "k": 0.3, "theta0": 0.2},
    "cogging": {"joint": 2, "amplitude": 0.4, "k": 3.0, "phase": 0.5},
    "eddy_brake": {"joint": 2, "c": 0.05, "center": 0.5},
}
"""What --plant takes, in SI units; the formulas are those of plant.py."""
STRENGTH = {"torsional_spring": ("k", "N m/rad"), "cogging": ("amplitude", "N m"), "eddy_brake": ("c", "N m s/rad")}
"""The number of each law that the table compares."""
STARTS = np.arange(0.5, 3.51, 0.25)
"""Predictions of a test recording start there [s]."""
HORIZONS = (0.1, 0.25, 0.5, 1.0)
"""[s]"""


def torque(name: str, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Torque of a law [N m] at angles and rates of its joint."""
    return plant.JOINT[name](LAWS[name], q, v)


def write_log(recording: Path, out: Path, law: str | None) -> None:
    """The first seconds of a recording, with the law taken out of the torque of its joint."""
    with recording.open() as file:
        names = file.readline().strip().split(",")
        rows = np.loadtxt(file, delimiter=",")
    rows = rows[rows[:, names.index("time")] <= SECONDS]
    if law is not None:
        drive, q, v = (names.index(f"{name}_meas{LAWS[law]['joint']}") for name in ("tau", "pos", "vel"))
        rows[:, drive] -= torque(law, rows[:, q], rows[:, v])
    np.savetxt(out / recording.name, rows, fmt="%.9g", delimiter=",", header=",".join(names), comments="")


def write_logs(source: list[Path], out: Path, law: str | None) -> list[Path]:
    """All recordings, cut and, where a law is named, changed."""
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    for recording in source:
        write_log(recording, out, law)
    return sorted(out.iterdir())


class Diagnosed(NamedTuple):
    """What a diagnosis left."""

    folder: Path
    """Of the data set."""
    report: dict[str, Any]
    before: Identified
    after: Identified


def diagnosed(source: list[Path], out: Path, law: str | None) -> Diagnosed:
    """Write logs, bring them to one grid, and find what the model lacks; raises SystemExit where a command fails."""
    logs, folder, found = (out / name for name in ("logs", "data", "found"))
    shutil.rmtree(folder, ignore_errors=True)
    paths = map(str, write_logs(source, logs, law))
    for command in (
        ("import", *paths, "--rig", str(RIG), "--out", str(folder), "--test", str(TEST)),
        ("diagnose", str(folder), "--out", str(found)),
    ):
        if status := nnap_em([*command]):
            raise SystemExit(status)
    return read(out)


def read(out: Path) -> Diagnosed:
    """What `diagnosed` wrote into a folder."""
    report = json.loads((out / "found" / "report.json").read_text())
    models = (load(out / "found" / f"{name}.npz") for name in ("before", "after"))
    return Diagnosed(out / "data", report, *models)


def errors(fitted: Identified, folder: Path) -> dict[str, list[float]]:
    """Root mean square errors of predictions of the test recordings, by column and horizon, over all starts."""
    data = read_logs(folder / "test", fitted.rig).data
    squares = []
    for start in STARTS:
        prediction = predict(fitted, data, float(start), key=jax.random.key(0))
        squares.append(horizon_errors(prediction, fitted, data, float(start), HORIZONS))
    names = squares[0]
    return {n: list(np.sqrt(np.mean([np.square(one[n]) for one in squares], axis=0))) for n in names}


def lack(title: str, done: Diagnosed, law: str, *, planted: bool) -> Lack:
    """Samples of the force that the declared model lacks at the joint of the law, and of the laws."""
    joint = LAWS[law]["joint"] - 1
    left = residual(done.after, read_logs(done.folder / "train", done.after.rig).data).followed()
    seen = np.isfinite(left.force[..., joint])
    q, v = (left.state[..., column][seen] for column in (joint, joint + 2))
    lacked, rest = left.lacked[..., joint][seen], left.force[..., joint][seen]
    true = torque(law, q, v) if planted else None
    return Lack(title, q, lacked, lacked - rest if done.report["effects"] else None, true)


def lines(recorded: Diagnosed, planted: Diagnosed, law: str, off: dict[str, float]) -> list[tuple[str, str]]:
    """The eight lines of the table; `off`: errors 1 s ahead [rad]."""
    name, unit = STRENGTH[law]
    number = next((e["parameters"][name] for e in planted.report["effects"] if e["name"] == law), None)
    logs = [len(list((recorded.folder / part).glob("*.csv"))) for part in ("train", "test")]
    what = f"{law.replace('_', ' ')} at joint {LAWS[law]['joint']}"
    joint = f"joint {LAWS[law]['joint']}, 1 s ahead"
    return [
        ("recordings of a real acrobot", f"{logs[0]} to fit, {logs[1]} to test"),
        ("as recorded, the model lacks", listed(recorded)),
        (f"with a {what} taken out of the log", listed(planted)),
        (f"its {name}, taken out", f"{LAWS[law][name]:.3g} {unit}"),
        (f"its {name}, found", f"{number['value']:.3g} ± {number['std']:.1g} {unit}" if number else "not found"),
        (f"prediction error of {joint}: without it", f"{off['before']:.3f} rad"),
        (f"prediction error of {joint}: with it", f"{off['after']:.3f} rad"),
        (f"prediction error of {joint}: as recorded", f"{off['recorded']:.3f} rad"),
    ]


def listed(done: Diagnosed) -> str:
    """What a report says is missing."""
    report = done.report
    suspects = "".join(f"; a suspect: {s['law']}" for s in report.get("suspects", [])[:1])
    found = "; ".join(e["description"].partition(":")[0] for e in report["effects"])
    return found or ("it cannot tell what" if report.get("cannot_tell") else f"nothing{suspects}")


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
    recorded = diagnosed(source, args.out / "recorded", None)
    planted = diagnosed(source, args.out / "planted", law)
    lacks = [
        lack("as recorded", recorded, law, planted=False),
        lack(f"{words} taken out of the log", planted, law, planted=True),
    ]
    finding_figure(lacks, LAWS[law]["joint"]).savefig(args.out / "finding.png")
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
