"""Two tanks in series, from the published recording to the overflow that their equations lack.

A pump fills the upper tank, which runs into the lower one, whose level is read every 4 s.  `machines/tanks.toml` has
Bernoulli's law.  `nnap-em identify` and `nnap-em diagnose` see the recording to fit alone; that to test gives the error
of a free simulation, whose start the first 50 readings determine.  Written into `out/tanks/`: the data set, both
reports and `tanks.png`.

The recordings are the cascaded-tanks benchmark of M. Schoukens, P. Mattsson, T. Wigren and J.-P. Noel (CC BY-SA 4.0,
DOI 10.4121/12960104): `dataBenchmark.csv` as it is published, or `est.csv` and `test.csv` with columns time, u, y.

    python examples/tanks.py --from FOLDER                         # some ten minutes of one core
    python examples/tanks.py --from FOLDER --minutes 5             # the best that is found in that time
"""

import argparse
import json
import shutil
import sys
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from nnap_em import load, predict, read_logs
from nnap_em.cli.common import set_up
from nnap_em.cli.main import main as nnap_em
from nnap_em.errors import DataWarning
from nnap_em.output.report.style import AFTER, BEFORE, READING, head, styled

RIG = Path(__file__).resolve().parent / "machines" / "tanks.toml"
PUBLISHED = "dataBenchmark.csv"
DT = 4.0
"""Sample interval of the published file [s]."""
GIVEN = 49 * DT
"""Time of the last of the first 50 readings [s]: that of the benchmark's score."""


class RecordingError(RuntimeError):
    """A folder without the recordings; the message says what to do."""


class Simulation(NamedTuple):
    """A free simulation of the recording to test."""

    t: Float[np.ndarray, " row"]
    """[s]"""
    reading: Float[np.ndarray, " row"]
    """Level of the lower tank [V], as the sensor reads it."""
    level: Float[np.ndarray, " row"]
    """The same by the model, at the end of the sensor's range where it is beyond it."""

    @property
    def error(self) -> float:
        """Root mean square error after the given readings [V]."""
        return float(np.sqrt(np.mean((self.level - self.reading)[self.t > GIVEN + 1e-6] ** 2)))


def recordings(folder: Path) -> dict[str, Float[np.ndarray, "row column"]]:
    """Time [s], pump [V] and level [V] of the recordings `est` and `test`.

    Raises RecordingError where the folder has neither the published file nor the two of one recording each.
    """
    if (folder / PUBLISHED).is_file():
        table = np.genfromtxt(folder / PUBLISHED, delimiter=",", names=True)
        names = {"est": ("uEst", "yEst"), "test": ("uVal", "yVal")}
        if not set(sum(names.values(), ())) <= set(table.dtype.names or ()):
            raise RecordingError(f"{folder / PUBLISHED}: no columns uEst, yEst, uVal, yVal; download it again")
        time = DT * np.arange(len(table))
        return {part: np.column_stack([time, table[u], table[y]]) for part, (u, y) in names.items()}
    if missing := [name for name in ("est.csv", "test.csv") if not (folder / name).is_file()]:
        hint = f"name a folder that has {PUBLISHED} of DOI 10.4121/12960104, or est.csv and test.csv"
        raise RecordingError(f"{folder / missing[0]}: not there; {hint}")
    return {part: np.loadtxt(folder / f"{part}.csv", delimiter=",", skiprows=1) for part in ("est", "test")}


def write(parts: Mapping[str, Float[np.ndarray, "row column"]], out: Path) -> None:
    """The data set: the declaration, one recording to fit and one to test."""
    out.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(RIG, out / "rig.toml")
    for part, folder in (("est", "train"), ("test", "test")):
        (out / folder).mkdir(exist_ok=True)
        np.savetxt(
            out / folder / f"{part}.csv", parts[part], fmt="%.10g", delimiter=",", header="time,u,y", comments=""
        )


def simulated(model: Path, rig: Path) -> Simulation:
    """The recording to test by a model, from its first readings."""
    fitted = load(model)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)  # the commands named what is not read
        logs = read_logs(rig / "test", fitted.rig, until=GIVEN)
    mean = np.asarray(predict(fitted, logs, GIVEN, key=jax.random.key(0)).mean)[0, :, fitted.model.measured[0]]
    read, top = np.loadtxt(rig / "test" / "test.csv", delimiter=",", skiprows=1)[:, 2], fitted.rig.ranges["y"][1]
    return Simulation(np.asarray(logs.data.t)[0], read, np.minimum(mean, top))  # readings at the end of the range, too


@styled
def figure(sides: Mapping[str, Simulation]) -> Figure:
    """Readings, and free simulations, by time."""
    out = Figure(figsize=(8, 3.6), layout="constrained")
    ax = out.subplots()
    for (label, side), colour in zip(sides.items(), (BEFORE, AFTER), strict=False):
        if colour == BEFORE:
            ax.plot(side.t, side.reading, ".", color=READING, ms=2, mew=0, label="reading")
        ax.plot(side.t, side.level, color=colour, label=f"{label}: {side.error:.2f} V off")
    ax.axvspan(0, GIVEN, color="#EEEEEE", zorder=0)
    ax.set(xlabel="time [s]", ylabel="level of the lower tank [V]")
    head(out, "Free simulation of a recording that no fit has seen, from its shaded beginning", [ax])
    return out


def main() -> int:
    """Write the data set, identify, diagnose, and draw both simulations."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--from", dest="folder", type=Path, metavar="FOLDER", required=True, help="the recordings")
    parser.add_argument("--minutes", type=float, metavar="M", help="time for the diagnosis; without it to the end")
    parser.add_argument("--out", type=Path, default=Path("out/tanks"))
    args = parser.parse_args()
    try:
        parts = recordings(args.folder)
    except RecordingError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    rig, fit, found = (args.out / name for name in ("rig", "fit", "found"))
    write(parts, rig)
    limit = [] if args.minutes is None else ["--minutes", str(args.minutes)]
    for command in (["identify", str(rig), "--out", str(fit)], ["diagnose", str(rig), "--out", str(found), *limit]):
        if status := nnap_em(command):
            return status
    set_up()
    models = {"the declared equations": fit / "model.npz", "with what was found": found / "after.npz"}
    sides = {label: simulated(model, rig) for label, model in models.items()}
    figure(sides).savefig(args.out / "tanks.png")
    print()
    print(json.loads((found / "report.json").read_text())["verdict"])
    for label, side in sides.items():
        print(f"  error of a free simulation of the recording to test, {label}: {side.error:.3f} V")
    print(f"figure: {args.out / 'tanks.png'}; pages: {fit / 'report.html'}, {found / 'report.html'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
