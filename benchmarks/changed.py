"""Study of `diagnose --from` on planted, unchanged and simulated recordings.

    python benchmarks/changed.py planted --out out/changed dfki_c1-spring2-strong dfki_c0-recorded ...
    python benchmarks/changed.py moved --out out/changed slide-coulomb pendulum-none ...
    python benchmarks/changed.py table out/changed [--out docs/results/changed_planted.csv]

planted: a fit of every second recording of a rig as it is, then the others with the effect of the case (planted.py)
planted in them; of `RIG-recorded` nothing is planted.
moved: 8 simulated recordings of 3 s, then 8 of the machine with a number that moved; `slide-coulomb-2` is seed 2.
One JSON file a case; a case that has one is not run again.
"""

import argparse
import csv
import dataclasses
import io
import json
import math
import os
import re
import shutil
import tempfile
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from planted_cases import case_of
from planted_make import DATA, make
from planted_table import score
from runner import Ran, commit, nnap_em

from nnap_em.base.files import replace_text
from nnap_em.logs.formats import write_csv
from nnap_em.machines.rig import Declared, write_rig
from nnap_em.model.simulate import declared, examples, sweep_experiment

CORE = min(os.sched_getaffinity(0))
COLUMNS = "case", "in the recordings", "named", "right", "false", "outcome", "processor [s]", "commit"
UNCERTAIN = {"slide": {"m": 0.1}, "pendulum": {"m": 0.05}, "acrobot": {"m2": 0.06}}
"""Numbers that are estimated, with the standard deviation that is declared [kg]."""
FACTOR = {"coulomb": 1.2, "viscous": 1.2, "mass": 1.05}


def halves(source: Path, rig: Path, out: Path, odd: bool) -> None:
    """Every second recording of a data set, all windows of a recording together."""
    (out / "train").mkdir(parents=True)
    for file in (rig, *source.glob("*.xml")):
        shutil.copy(file, out / ("rig.toml" if file is rig else file.name))
    files = sorted((source / "train").glob("*.csv"))
    recordings = list(dict.fromkeys(re.sub(r"^\d+_|_w\d+$", "", path.stem) for path in files))
    if len(recordings) < 4:
        recordings = [path.stem for path in files]
    for path in files:
        name = re.sub(r"^\d+_|_w\d+$", "", path.stem)
        if recordings.index(name if name in recordings else path.stem) % 2 == odd:
            shutil.copy(path, out / "train" / path.name)


def fit_of(rig: str, out: Path) -> Path:
    """The fit of one half of a rig as it is, made once."""
    fit = out / "fits" / rig
    if not (fit / "model.npz").exists():
        shutil.rmtree(out / "halves" / rig, ignore_errors=True)
        halves(DATA / rig, DATA / rig / "rig.toml", out / "halves" / rig, False)
        nnap_em("identify", out / "halves" / rig, "--quiet", out=fit, core=CORE)
    return fit


def _recorded(ran: Ran) -> dict[str, Any]:
    outcome = {"report": ran.report} if ran.report else {"failed": (ran.said or [""])[-1]}
    return outcome | {"seconds": ran.seconds, "processor_seconds": ran.processor_seconds}


def planted(name: str, out: Path) -> dict[str, Any]:
    """The other half, with the effect of a case."""
    with tempfile.TemporaryDirectory() as folder:
        case, half, found = (Path(folder, part) for part in ("case", "half", "found"))
        truth = make(name, case)
        fit = fit_of(case_of(name).rig, out)
        halves(case, case / "rig.toml", half, True)
        ran = nnap_em("diagnose", half, "--from", fit, out=found, core=CORE)
    return {"case": name, "truth": truth} | _recorded(ran)


def machine(system: str, kind: str):
    """A machine whose last joint, or mass, moved by the step of `FACTOR`."""
    truth, sweep = examples[system]()
    law, last = truth.unknown, jnp.zeros_like(truth.unknown.coulomb).at[-1].set(1.0)
    factor = 1 + (FACTOR.get(kind, 1.0) - 1) * last
    if kind == "coulomb":
        more = law.coulomb * (factor - 1)
        return eqx.tree_at(
            lambda m: (m.unknown.coulomb, m.unknown.breakaway), truth, (law.coulomb + more, law.breakaway + more)
        ), sweep
    if kind == "viscous":
        return eqx.tree_at(lambda m: m.unknown.viscous, truth, law.viscous * factor), sweep
    if kind == "mass":
        (name,) = UNCERTAIN[system]
        return dataclasses.replace(
            truth, system=dataclasses.replace(truth.system, **{name: getattr(truth.system, name) * FACTOR["mass"]})
        ), sweep
    return truth, sweep


def write(folder: Path, system: str, kind: str, count: int, steps: int, seed: int) -> None:
    """Simulated recordings of a machine, with rig.toml."""
    truth, sweep = examples[system]()
    rig = declared(system, truth)
    free = {name: Declared(float(getattr(truth.system, name)), std) for name, std in UNCERTAIN[system].items()}
    (folder / "train").mkdir(parents=True, exist_ok=True)
    write_rig(dataclasses.replace(rig, parameters={**rig.parameters, **free}), folder / "rig.toml")
    model, _ = machine(system, kind)
    data = sweep_experiment(model, sweep, count, steps, key=jax.random.fold_in(jax.random.key(seed), 0)).data
    for i, (t, u, y) in enumerate(zip(data.t, data.u, np.array(data.y), strict=True)):
        if kind == "bias":
            y[:, 0] += 3 * math.exp(0.5 * float(truth.log_r[0]))
        columns = {"time": t, **dict(zip(rig.input_columns, u.T, strict=True))}
        write_csv(folder / "train" / f"{i:03d}.csv", columns | dict(zip(rig.measured, y.T, strict=True)))


def moved(name: str, out: Path) -> dict[str, Any]:
    """A simulated machine before and after a number moved."""
    system, kind, seed = (*name.split("-"), "0")[:3]
    before, fit = out / "sim" / f"{system}-{seed}", out / "fits" / f"sim-{system}-{seed}"
    if not (fit / "model.npz").exists():
        write(before, system, "none", 8, 300, 2 * int(seed))
        nnap_em("identify", before, "--quiet", out=fit, core=CORE)
    after, found = out / "sim" / name, out / "found" / name
    write(after, system, kind, 8, 300, 2 * int(seed) + 1)
    return {"case": name} | _recorded(nnap_em("diagnose", after, "--from", fit, out=found, core=CORE))


def row(record: dict[str, Any]) -> list[str]:
    """A line of the table."""
    report = record.get("report") or {}
    named = "; ".join(effect["description"] for effect in report.get("effects", [])) or "nothing"
    verdict = report.get("verdict") or record["failed"]
    truth = "; ".join(
        f"{e['name']} {e.get('joint') or e.get('channel') or ''} {json.dumps(e['parameters'])}"
        for e in (record.get("truth") or {}).get("effects", [])
    )
    right, false = "", ""
    if record.get("truth") and record.get("report"):
        done = score(record, {})
        right, false = f"{done.named} of {done.truths}", str(done.extras)
    code = str(record.get("code", ""))
    return [record["case"], truth, named, right, false, verdict, f"{record['processor_seconds']:.0f}", code]


def main() -> None:
    """Run some cases, or write the table."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = arguments.add_subparsers(dest="command", required=True)
    kinds = {"planted": planted, "moved": moved}
    for kind in kinds:
        one = commands.add_parser(kind)
        one.add_argument("cases", nargs="+")
        one.add_argument("--out", type=Path, required=True)
    writing = commands.add_parser("table")
    writing.add_argument("folder", type=Path)
    writing.add_argument("--out", type=Path)
    args = arguments.parse_args()
    if args.command == "table":
        records = [json.loads(path.read_text()) for path in sorted(args.folder.glob("*.json"))]
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows([COLUMNS, *map(row, records)])
        print(text.getvalue()) if args.out is None else replace_text(args.out, text.getvalue())
        return
    jax.config.update("jax_enable_x64", True)
    for name in args.cases:
        file = args.out / f"{args.command}-{name}.json"
        if not file.exists():
            record = kinds[args.command](name, args.out) | {"code": commit()}
            args.out.mkdir(parents=True, exist_ok=True)
            replace_text(file, json.dumps(record))
            print(" | ".join(row(record)), flush=True)


if __name__ == "__main__":
    main()
