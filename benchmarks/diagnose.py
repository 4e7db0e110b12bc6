"""How often the loop names the right effect: simulated rigs of a simulator that shares nothing with the catalogue.

    python benchmarks/diagnose.py --out out/diagnose                    # everything: hours on a laptop
    python benchmarks/diagnose.py --out out/diagnose --only strong:*:hidden --share 1/2
    python benchmarks/diagnose.py --out out/diagnose --table docs/results/diagnose_table.md  # the table of all runs

A case is group:effect:view:seed; a whole name with another seed runs too.  Each leaves one JSON file in --out; a case
that has one is not run again.
"""

import argparse
import csv
import fnmatch
import io
import json
import math
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from datetime import date
from pathlib import Path
from typing import Any

import jax

sys.path.insert(0, str(Path(__file__).parent.parent / "examples"))
import plant

from nnap_em.commands.common import set_up
from nnap_em.data.logs import read_logs
from nnap_em.data.rig import read_rig
from nnap_em.diagnosis.findings import entry, findings
from nnap_em.diagnosis.search import diagnose
from nnap_em.fit.predict import horizon_errors, predict
from nnap_em.storage.files import replace_text
from nnap_em.systems import specs

OUTSIDE: dict[str, tuple[dict[str, Any], ...]] = {
    "bump": ({"name": "unknown_function", "form": "bump", "joint": 2, "amplitude": 0.05, "center": 1.1, "width": 0.4},),
    "magnet": (
        {"name": "unknown_function", "form": "magnet", "joint": 2, "amplitude": 0.4, "center": 0.5, "width": 0.4},
    ),
    "coupling": ({"name": "unknown_function", "form": "coupling", "joint": 1, "amplitude": 0.08},),
}
INPUTS = {"bump": {"theta2"}, "magnet": {"theta2"}, "coupling": {"theta1", "theta2"}}
VARIANTS: dict[str, tuple[dict[str, Any], ...]] = {
    "hardening_spring": ({"name": "torsional_spring", "joint": 2, "k": 0.04, "theta0": 0.0, "k3": 0.1},),
    "drag_exponent_1.8": ({"name": "air_drag", "joint": None, "c": 0.008, "exponent": 1.8},),
    "cogging_two_harmonics": (
        {"name": "cogging", "joint": 2, "amplitude": 0.03, "k": 4.0, "phase": 0.5, "amplitude2": 0.012, "phase2": 1.0},
    ),
}
PAIRS: dict[str, tuple[dict[str, Any], ...]] = {
    "spring+gain": (*plant.STRONG["torsional_spring"], *plant.WEAK["motor_gain"]),
    "payload+delay": (*plant.STRONG["payload"], *plant.WEAK["input_delay"]),
    "tilt+cogging": (*plant.WEAK["base_tilt"], *plant.STRONG["cogging"]),
}
NOISES = {"low": (0.002, 0.02), "middle": (0.005, 0.05), "high": (0.01, 0.1)}
GROUPS = {"strong": plant.STRONG, "weak": plant.WEAK, "outside": OUTSIDE, "variant": VARIANTS, "pair": PAIRS}
DATA: dict[str, dict[str, Any]] = {
    "six": {"sequences": 6},
    "untold": {"declare_noise": False},
    "missing": {"missing": 0.1},
}
"""Other experiments: six sequences instead of twenty, noise that nobody declared, a tenth of the readings empty."""
WITH = ("torsional_spring", "payload", "air_drag", "cogging", "dead_zone", "input_delay", "clean")
SILENT = {"torque_offset", "motor_back_emf"}
"""What a learned friction map holds: naming nothing is right."""
SAME = {
    ("base_tilt", None, None): {("sensor_bias", None, "theta1")},
    ("input_delay", 2, None): {("sensor_delay", None, "all")},
    ("sensor_bias", None, "theta1"): {("base_tilt", None, None)},
}
"""Models that are the same for the data."""


def all_cases(clean: int = 60) -> list[str]:
    """Names of every case."""
    out = []
    for group, effects in GROUPS.items():
        for i, name in enumerate(effects):
            views = ("hidden", "shown") if group in ("strong", "weak") else ("hidden",)
            out += [f"{group}:{name}:{view}:{11 + i}" for view in views]
    out += [f"{data}:{name}:hidden:{60 + i}" for data in DATA for i, name in enumerate(WITH)]
    out += [f"clean:{noise}:hidden:{100 + i}" for i in range(clean // 3) for noise in NOISES]
    return out


def case_of(name: str) -> plant.Case:
    """The rig of a case."""
    group, effect, view, seed = name.split(":")
    session = effect in plant.SESSION
    case = plant.Case(
        effects=() if "clean" in (group, effect) else GROUPS.get(group, plant.STRONG)[effect],
        hidden=view == "hidden",
        noise=NOISES[effect] if group == "clean" else (0.005, 0.05),
        clock="session" if session else "sequence",
        friction_shape="other" if group == "variant" else "stribeck",
        seed=int(seed),
    )
    return case._replace(**DATA.get(group, {}))


def run(name: str, out: Path) -> None:
    """One case: the loop, the errors on test/ before and after, and those of one who knows the truth."""
    case = case_of(name)
    record: dict[str, Any] = {"case": name, "truth": list(case.effects), "log": [], "code": _commit()}
    with tempfile.TemporaryDirectory() as rig_folder:
        folder = Path(rig_folder)
        plant.write(case, folder)
        rig = read_rig(folder / "rig.toml", specs)
        train, test = (read_logs(folder / part, rig).data for part in ("train", "test"))
        began = time.perf_counter()
        diagnosis = diagnose(rig, train, key=jax.random.key(0), log=record["log"].append)
        reported = findings(diagnosis)
        error = {}
        for side, fitted in (("before", diagnosis.before), ("after", diagnosis.after)):
            prediction = predict(fitted, test, 1.0, key=jax.random.key(0))
            error[side] = horizon_errors(prediction, fitted, test, 1.0)
        record["seconds"] = time.perf_counter() - began
        record |= {"effects": [entry(f) for f in reported], "error": error, "oracle": plant.oracle_errors(case, folder)}
    out.mkdir(parents=True, exist_ok=True)
    replace_text(out / f"{name.replace(':', '_')}.json", json.dumps(record))


def _commit() -> str:
    """The commit that is run; empty outside a clone."""
    process = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], cwd=Path(__file__).parent, capture_output=True, text=True, check=False
    )
    return process.stdout.strip()


def judged(record: dict[str, Any]) -> dict[str, Any]:
    """What a case is worth: named right, extras, parameters within 15 %, truth inside two standard deviations."""
    group, effect, *_ = record["case"].split(":")
    named = record.get("effects", [])
    truth = [] if effect in SILENT else record["truth"]
    left, hits, near, inside = list(named), 0, [], []
    for true in truth:
        place = (true["name"], true.get("joint"), true.get("channel"))
        for reported in left:
            where = (reported["name"], reported["joint"], reported["channel"])
            same = where == place or where in SAME.get(place, ())
            if true["name"] == "unknown_function":
                same = reported["name"] == "unknown_function" and set(reported["inputs"]) == INPUTS[effect]
            if same:
                hits += 1
                left.remove(reported)
                for key, estimate in reported["parameters"].items():
                    if key in true and where == place and group != "variant":
                        error = abs(estimate["value"] - true[key])
                        if key in ("phase", "center"):
                            turn = 2 * math.pi if key == "phase" else math.pi
                            error = min(error % turn, turn - error % turn)
                        near.append(error <= 0.15 * abs(true[key]))
                        inside.append(error <= 2 * estimate["std"])
                break
    at = lambda side: record["error"][side]["theta1"][3]  # noqa: E731
    oracle = record["oracle"]["theta1"][3] if "oracle" in record else math.nan
    before, after = (at("before"), at("after")) if "error" in record else (math.nan, math.nan)
    return {
        "right": hits == len(truth) and not (not truth and left),
        "extras": len(left) if truth else 0,
        "false": bool(left) and not truth,
        "near": near,
        "inside": inside,
        "before": before,
        "after": after,
        "oracle": oracle,
    }


preface = """\
Rigs are simulated by `examples/plant.py`, a NumPy program that shares no code with the library: 20 training and 5 test
sequences of 5 s, noise 0.005 rad and 0.05 rad/s, joint 2 hidden or shown. "six" has six sequences, "untold" declares no
noise, "missing" has a tenth of its readings empty. "True" is a cubature filter and an open-loop prediction by the
simulator itself. Effects that a learned friction map holds (`torque_offset`, `motor_back_emf`) are right when nothing
is named. Seconds are of one busy core. [Every case](diagnose_table.csv) but clean ones without an alarm.
"""


def table(out: Path) -> tuple[str, str]:
    """Sums of the files in `out` as Markdown, and every case but clean ones without an alarm as CSV."""
    rows = [json.loads(path.read_text()) for path in sorted(out.glob("*.json"))]
    lines = io.StringIO()
    writer = csv.writer(lines, lineterminator="\n")
    error = "error before / after / with the true effect [rad, 1 s]"
    writer.writerow(["case", "found", "parameters", "truth", "right", error, "s", "code"])
    groups: dict[str, list[dict[str, Any]]] = {}
    for record in rows:
        score = judged(record)
        group, effect, view, _ = record["case"].split(":")
        level = group
        if group == "weak" and not 3 <= score["before"] / score["oracle"] <= 9:
            level = "weak, other ratio"
        groups.setdefault(f"{level} {view}", []).append(score | {"seconds": record["seconds"]})
        if group == "clean" and not score["false"]:
            continue
        entries = record.get("effects", [])
        effects = "; ".join(_name(e) for e in entries) or "nothing"
        values = "; ".join(
            f"{k} {v['value']:.3g} ± {v['std']:.1g}" for e in entries for k, v in e["parameters"].items()
        )
        true = ", ".join(f"{k} {v}" for t in record["truth"] for k, v in t.items() if isinstance(v, float))
        mark = "yes" if score["right"] and not score["extras"] else "with extras" if score["right"] else "no"
        error = " / ".join(f"{score[side]:.3g}" for side in ("before", "after", "oracle"))
        seconds, code = f"{record['seconds']:.0f}", record.get("code", "")
        writer.writerow([f"{group} {effect} {view}", effects, values, true, mark, error, seconds, code])
    summary = [
        "| group | named right | false or extra | parameters within 15 % | truth inside 2 std "
        "| after / true: median, 90th | median s |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for group, scores in groups.items():
        near, inside = ([flag for s in scores for flag in s[k]] for k in ("near", "inside"))
        ratio = sorted(s["after"] / s["oracle"] for s in scores)
        bad = sum(s["false"] or s["extras"] > 0 for s in scores)
        summary.append(
            f"| {group} | {_share([s['right'] for s in scores])} | {bad} | {_share(near)} | {_share(inside)} "
            f"| {_middle(ratio):.2f}, {ratio[math.ceil(0.9 * len(ratio)) - 1]:.2f} | "
            f"{_middle(sorted(s['seconds'] for s in scores)):.0f} |"
        )
    head = f"{date.today()}, {platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}."
    every = [score for scores in groups.values() for score in scores]
    right, bad = sum(s["right"] for s in every), sum(s["false"] or s["extras"] > 0 for s in every)
    result = f"Of {len(every)} runs {right} are named right; {bad} have a false or an extra effect.\n"
    return "\n".join(["# Diagnosis, the table\n", result, preface, head, "", *summary, ""]), lines.getvalue()


def _name(entry: dict[str, Any]) -> str:
    where = f" {entry['joint']}" if entry["joint"] else f" {entry['channel']}" if entry["channel"] else ""
    return entry["name"] + where + (f" of {', '.join(entry['inputs'])}" if entry["inputs"] else "")


def _share(flags: list[bool]) -> str:
    return f"{sum(flags)} of {len(flags)}" if flags else "-"


def _middle(values: list[float]) -> float:
    return statistics.median(values) if values else math.nan


def main() -> None:
    """Run what is asked for and missing, or print the table."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--out", type=Path, default=Path("out/diagnose"))
    arguments.add_argument("--only", default="*", help="pattern of case names")
    arguments.add_argument("--table", type=Path, help="write the table here and do nothing else")
    arguments.add_argument("--share", default="0/1", help="i/n: every n-th case from the i-th, for several processes")
    args = arguments.parse_args()
    if args.table:
        page, rows = table(args.out)
        args.table.write_text(page)
        args.table.with_suffix(".csv").write_text(rows)
        return
    set_up()
    first, step = map(int, args.share.split("/"))
    pattern = args.only if ":" in args.only else args.only + "*"
    names = [n for n in all_cases() if fnmatch.fnmatch(n, pattern)]
    if not names and pattern.count(":") == 3:
        names = [pattern]  # a case of another seed
    for name in names[first::step]:
        if (args.out / f"{name.replace(':', '_')}.json").exists():
            continue
        run(name, args.out)
        print(name, flush=True)


if __name__ == "__main__":
    main()
