"""The runs behind the pictures of docs/gallery.md: each returns the arrays of one picture.

What simulates is seeded.  Real recordings are those of `measured_loop.py` and of `../shared/data/measured`; a picture
whose recordings are not there raises FileNotFoundError.
"""

import re
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import measured_loop
import numpy as np

from nnap_em import friction_table, identify, read_logs, read_rig
from nnap_em.cli.common import MISFIT_STATUS
from nnap_em.cli.main import main as nnap_em
from nnap_em.explain.diagnosis.interventions import WINDOWS, averaged, interventions
from nnap_em.explain.diagnosis.residual import residual

ROOT = Path(__file__).resolve().parents[1]
MEASURED = ROOT.parent / "shared" / "data" / "measured"
LAW = "torsional_spring"
"""Taken out of the torque log of the real acrobot."""
SHORT = {"as the library sets it": "default", "one start, one pass": "one pass"}
"""Names of rows of docs/results/throughput.md in a picture."""
Arrays = Mapping[str, Any]


def _command(*words: object) -> None:
    if (status := nnap_em([*map(str, words)])) not in (0, MISFIT_STATUS):
        raise RuntimeError(f"nnap-em {words[0]} ended with {status}")


def _recordings(name: str) -> Path:
    folder = MEASURED / name
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: not there; these recordings are no part of the repository")
    return folder


def _read(path: Path) -> np.ndarray:
    return np.genfromtxt(path, delimiter=",", names=True)


def friction(out: Path) -> Arrays:
    """Friction of both joints of a simulated acrobot of which joint 1 is read, and the true friction."""
    _command("simulate", out / "rig", "--seed", 1)
    _command("identify", out / "rig", "--out", out / "fit", "--quiet")
    learned, true = (_read(path / "friction.csv") for path in (out / "fit", out / "rig" / "truth"))
    return {
        f"{side}_{name}": table[name]
        for side, table in (("found", learned), ("true", true))
        for name in table.dtype.names
    }


def hidden(out: Path) -> Arrays:
    """The second angle of a real arm, smoothed from the first joint alone, and its encoder."""
    folder, name = _recordings("dfki_c1_joint1"), "003_acro05_w0.csv"
    _command("identify", folder, "--out", out / "fit", "--quiet")
    _command("smooth", out / "fit", folder / "test", "--out", out / "smoothed")
    smoothed, read = _read(out / "smoothed" / name), _read(folder / "truth" / "test" / name)
    return {"t": read["time"], "read": read["theta2"], "mean": smoothed["theta2"], "std": smoothed["theta2_std"]}


def _loop() -> tuple[measured_loop.Diagnosis, measured_loop.Diagnosis]:
    """The two diagnoses of `measured_loop.py`, which is run where it has not been."""
    out = Path("out/measured_loop")
    if not (out / "planted" / "found" / "report.json").exists():
        source = ROOT.parent / "shared" / "data" / "raw" / "dfki_c1_pert"
        places = ["--from", str(source)] if source.is_dir() else []
        command = [sys.executable, str(ROOT / "examples" / "measured_loop.py"), "--out", str(out), *places]
        subprocess.run(command, check=True)
    return tuple(measured_loop.read(out / name) for name in ("recorded", "planted"))  # type: ignore[return-value]


def law(out: Path) -> Arrays:
    """The torque that the model of the real acrobot lacks, against the angle, and the law that was found."""
    lack = measured_loop.missing_torque("", _loop()[1], LAW, planted=True)
    return {name: value for name, value in lack._asdict().items() if name != "title" and value is not None}


def errors(out: Path) -> Arrays:
    """Prediction errors of joint 2 of the real acrobot before and after, and without the law that was taken out."""
    recorded, planted = _loop()
    sides = {"before": planted.before, "after": planted.after, "goal": recorded.after}
    folders = {"before": planted.folder, "after": planted.folder, "goal": recorded.folder}
    errors_of = {name: measured_loop.errors(fitted, folders[name])["theta2"] for name, fitted in sides.items()}
    return {"horizon": np.asarray(measured_loop.HORIZONS)} | {name: np.asarray(e) for name, e in errors_of.items()}


def touch(out: Path) -> Arrays:
    """Torque pulses on a real arm that its log does not have, and the disturbances that were found.

    Torques are means over the windows of the search.
    """
    folder = _recordings("dfki_c1_hidden_pert")
    rig = read_rig(folder / "rig.toml")
    logs = read_logs(folder / "train", rig)
    fitted = identify(rig, logs.data, key=jax.random.key(0))
    disturbances = interventions(fitted, logs.data)
    force = residual(fitted, logs.data).force
    count = [sum(each.sequence == i for each in disturbances) for i in range(len(logs.files))]
    number = int(np.argmax(count))
    true = _read(folder / "truth" / "train" / logs.files[number])
    pulses = [each for each in disturbances if each.sequence == number]
    joint = max((1, 2), key=lambda j: sum(each.joint == j for each in pulses))
    spans = [(each.from_s, each.to_s) for each in pulses if each.joint == joint]
    mean = averaged(force, round(WINDOWS[0] / rig.dt))[number]
    torques = {"true": true[f"hidden{joint}"], "torque": mean[:, joint - 1]}
    return {"t": true["time"], "spans": np.asarray(spans), "joint": joint} | torques


def arm(out: Path) -> Arrays:
    """Friction of seven joints of a simulated arm, all read, and the true friction."""
    sys.path.insert(0, str(ROOT / "benchmarks"))
    import arm as bench

    joints = (*bench.JOINTS, bench.Joint(0.08, 0.11, 0.4, 0.06, 0.03, 8.0))
    out.mkdir(parents=True, exist_ok=True)
    data, x = bench.recorded(bench.machine(7, imu=False), joints, 0)
    fitted = identify(bench.declared(out, 7), data, key=jax.random.key(0))
    v = np.stack([np.linspace(*np.percentile(x[..., 7 + j], (1, 99)), 81) for j in range(7)])
    table = friction_table(fitted, jnp.asarray(v))
    true = np.stack([bench.friction(joints)(row) for row in v.T], axis=1)
    return {"v": v, "found": np.asarray(table.torque), "std": np.asarray(table.std), "true": true}


def throughput(out: Path) -> Arrays:
    """Rows smoothed per second, by this library and by dynamax, out of the tables of docs/results/throughput.md."""
    page = (ROOT / "docs" / "results" / "throughput.md").read_text()
    names, whose, speeds = [], [], []
    for kind, head in (("extended", "Extended Kalman filter + RTS"), ("sigma points", "Sigma-point filter + RTS")):
        table = page.partition(f"## {head}\n")[2].partition("\n## ")[0]
        rows = re.findall(r"(?m)^\| (nnap_em|dynamax) \| ([^|]+) \| ([\d.e+]+) \|", table)
        peer = max(float(speed) for who, _, speed in rows if who == "dynamax")  # with its transition or with ours
        for who, row, speed in (*(row for row in rows if row[0] == "nnap_em"), ("dynamax", "dynamax", peer)):
            names.append(f"{kind}, {SHORT.get(row, row)}")
            whose.append(who)
            speeds.append(float(speed))
    return {"name": names, "who": whose, "speed": speeds}
