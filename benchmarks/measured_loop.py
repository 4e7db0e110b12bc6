"""What `nnap-em diagnose` finds on the measured rigs, on all of the training recordings and on either half of them.

    python benchmarks/measured_loop.py --out out/measured [--data ../shared/data/measured] [rig ...]
    python benchmarks/measured_loop.py --out out/measured --table --figure docs/figures/measured_loop.svg

Halves are every other recording by name.  A folder that has a report is not run again; test recordings are read for the
reported errors only.
"""

import argparse
import json
import os
import platform
import shutil
import sys
from datetime import date
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from nnap_em.commands import cli

RIGS = ("cloudpendulum", "dfki_c1", "dfki_c0", "dfki_a0", "dfki_c1_pert")
PARTS = ("", "_half0", "_half1")
AT = 3
"""Place of the 1 s horizon among those of a report."""


def half(rig: Path, number: int, out: Path) -> Path:
    """A data set with every other training recording of `rig`."""
    folder = out / "data" / f"{rig.name}_half{number}"
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "train").mkdir(parents=True)
    shutil.copy(rig / "rig.toml", folder)
    shutil.copytree(rig / "test", folder / "test")
    for path in sorted((rig / "train").glob("*.csv"))[number::2]:
        shutil.copy(path, folder / "train")
    return folder


def found(report: dict[str, Any]) -> str:
    """The effects of a report in a few words."""
    out = []
    for effect in report["effects"]:
        where = f" {effect['joint']}" if effect["joint"] else f" {effect['channel']}" if effect["channel"] else ""
        of = f" of {', '.join(effect['inputs'])}" if effect["inputs"] else ""
        numbers = [f"{n} {p['value']:.3g} ± {p['std']:.1g}" for n, p in effect["parameters"].items()]
        gain = f"{effect['evidence']['log_likelihood_gain']:.0f} nat"
        out.append(f"{effect['name']}{where}{of} ({', '.join([*numbers, gain])})")
    return "; ".join(out) or "nothing"


def reports(out: Path, rigs) -> dict[str, list[dict[str, Any] | None]]:
    """The reports of every rig: whole, and both halves; None where there is none."""
    read = lambda path: json.loads(path.read_text()) if path.exists() else None  # noqa: E731
    return {rig: [read(out / f"{rig}{part}" / "report.json") for part in PARTS] for rig in rigs}


def table(told: dict[str, list[dict[str, Any] | None]]) -> str:
    """Markdown: found, on either half, errors before and after."""
    lines = [
        f"{date.today()}, {platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}.",
        "",
        "| rig | found in all training recordings | in the one half | in the other | 1 s error before / after [rad] |",
        "| --- | --- | --- | --- | --- |",
    ]
    for rig, (whole, *halves) in told.items():
        if whole is None:
            continue
        sides = [whole["error"][side] for side in ("before", "after")]
        errors = [f"{n} {sides[0][n][AT]:.3g} / {sides[1][n][AT]:.3g}" for n in sides[0] if not n.startswith("d")]
        parts = [found(part) if part else "not run" for part in halves]
        lines.append(f"| {rig} | {found(whole)} | {parts[0]} | {parts[1]} | {', '.join(errors)} |")
    return "\n".join([*lines, ""])


def figure(told: dict[str, list[dict[str, Any] | None]]) -> Figure:
    """Prediction error over the horizon, before and after, one panel per rig on which something was found."""
    rows = {rig: whole for rig, (whole, *_) in told.items() if whole and whole["effects"]}
    drawn = Figure(figsize=(2.3 * max(len(rows), 2), 2.8), layout="constrained")
    panels = drawn.subplots(1, len(rows), squeeze=False, sharey=True)[0]
    for ax, (rig, report) in zip(panels, rows.items(), strict=True):
        error, horizons = report["error"], report["error"]["horizons_s"]
        for side, style in (("before", "--"), ("after", "-")):
            for name, colour in (("theta1", "#0072B2"), ("theta2", "#D55E00")):
                if name in error[side]:
                    label = f"{name}, {side}"
                    ax.loglog(horizons, error[side][name], style, color=colour, marker="o", ms=3, label=label)
        ax.set_title(rig, loc="left", fontsize=9)
        ax.set_xlabel("horizon [s]", fontsize=8)
        ax.tick_params(labelsize=7)
        ax.grid(color="#E3E3E3", lw=0.6)
    panels[0].set_ylabel("RMSE of the prediction [rad]", fontsize=8)
    panels[0].legend(fontsize=6, frameon=False)
    return drawn


def main() -> None:
    """Run what has no report, or write table and figure of what is there."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    root = Path(__file__).resolve().parent.parent
    arguments.add_argument("rigs", nargs="*", default=[*RIGS, *(f"{rig}_joint1" for rig in RIGS[1:])])
    arguments.add_argument("--data", type=Path, default=root.parent / "shared" / "data" / "measured")
    arguments.add_argument("--out", type=Path, default=Path("out/measured"))
    arguments.add_argument("--table", action="store_true", help="print the table of what is there and run nothing")
    arguments.add_argument("--figure", type=Path, help="with --table: draw the errors here")
    args = arguments.parse_args()
    if args.table:
        told = reports(args.out, args.rigs)
        print(table(told))
        if args.figure:
            figure(told).savefig(args.figure)
        return
    for rig in args.rigs:
        for number, part in enumerate(PARTS):
            out = args.out / f"{rig}{part}"
            if not (out / "report.json").exists():
                folder = args.data / rig if not part else half(args.data / rig, number - 1, args.out)
                if cli.main(["diagnose", str(folder), "--out", str(out)]):
                    sys.exit(1)


if __name__ == "__main__":
    main()
