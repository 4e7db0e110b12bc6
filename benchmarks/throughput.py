"""Throughput of the smoothers beside their peers and the limit of the machine: docs/results/throughput.md.

    python benchmarks/throughput.py [--quick] [--only filter growth ...]

Peers come with `pip install .[bench]`; a peer that is not installed has no row.  The C transition needs gcc.  All rows
run on one core, except where a number of cores is given; rows of a table are timed in turn in one process.
"""

import argparse
import csv
import importlib.metadata
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from datetime import date
from pathlib import Path

import numpy as np

root = Path(__file__).resolve().parents[1]
titles = {
    "extended": "Extended Kalman filter + RTS",
    "sigma-point": "Sigma-point filter + RTS",
    "filter": "Particle filter, and the transition alone",
    "exact": "Particle filter + exact backward sampling, as many trajectories as particles",
}
axes = {"particles": "particles", "steps": "steps of a sequence", "sequences": "sequences"}
peers = ("dynamax", "cuthbert", "particles")
head = (
    "program",
    "row",
    "work",
    "time [ms]",
    "sequence-steps/s",
    "particle-steps/s",
    "x best peer",
    "compile [s]",
    "peak memory [MB]",
    "theta1 [rad]",
    "theta2 [rad]",
    "omega1 [rad/s]",
    "omega2 [rad/s]",
    "lost",
)
shown = ("program", "row", "sequence-steps/s", "x best peer", "theta2 [rad]")
"""Columns of the numbers, and those of them that the page has."""


def child(order: dict, cpus: Sequence[int], cache: str, *, measure_memory: bool = False):
    """What benchmarks/throughput_rows.py answers to an order, run on `cpus`."""
    print(order, file=sys.stderr, flush=True)
    threads = str(len(cpus))
    env = os.environ | {"OMP_NUM_THREADS": threads, "OPENBLAS_NUM_THREADS": threads, "JAX_PLATFORMS": "cpu"}
    env["PYTHONPATH"] = os.pathsep.join([str(root), *filter(None, [os.environ.get("PYTHONPATH")])])
    env["JAX_COMPILATION_CACHE_DIR"] = cache
    env["JAX_NUM_CPU_DEVICES"] = threads
    env["TF_CPP_MIN_LOG_LEVEL"] = "3"
    if len(cpus) == 1:
        env["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false"
    if measure_memory:
        env["MALLOC_MMAP_THRESHOLD_"] = str(1 << 20)  # freed arrays go back to the system
    done = subprocess.run(
        [sys.executable, Path(__file__).with_name("throughput_rows.py"), json.dumps(order)],
        env=env,
        stdout=subprocess.PIPE,
        text=True,
        check=True,
        preexec_fn=lambda: os.sched_setaffinity(0, cpus),
    )
    return json.loads(done.stdout.splitlines()[-1])


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a Markdown table."""
    return [f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *rows)]


def work(row: dict) -> float:
    """Sequence-steps of a row."""
    return row["size"][0] * row["size"][1]


def pace(row: dict) -> float:
    """Sequence-steps per second, by the median time."""
    return work(row) / float(np.median(row["times"]))


def speed_rows(rows: list[dict], memory: list[dict]) -> list[list[str]]:
    """One group: time, throughput, ratio to the best peer of the same size, compile time, memory, errors."""
    peaks = {(m["who"], m["what"]): m["memory"] for m in memory}
    lines = []
    for row in rows:
        count = row["size"][2]
        rivals = [pace(r) for r in rows if r["who"] in peers and r["size"][2] == count]
        ratio = f"{pace(row) / max(rivals):.2f}" if rivals and row["who"] == "nnap_em" else ""
        error = [f"{e:.3g}" for e in row.get("rmse", [])] or [""] * 4
        lines.append(
            [
                row["who"],
                row["what"],
                f"{row['size'][0]} x {row['size'][1]}",
                f"{1e3 * np.median(row['times']):.4g}",
                f"{pace(row):.3g}",
                f"{pace(row) * count:.3g}" if count else "",
                ratio,
                f"{row['compile']:.1f}",
                f"{peaks[row['who'], row['what']] / 1e6:.0f}",
                *error,
                str(row.get("lost", "")),
            ]
        )
    return lines


def speed_table(rows: list[dict], lines: list[list[str]]) -> list[str]:
    """The columns of the page, of the rows with the most particles."""
    most = max(row["size"][2] for row in rows if row["who"] == "nnap_em")
    kept = [line for row, line in zip(rows, lines, strict=True) if row["who"] != "limit" and row["size"][2] == most]
    return table(shown, [[line[head.index(name)] for name in shown] for line in kept])


def limit_lines(group: str, rows: list[dict]) -> list[str]:
    """Table of ratios of speed: our smoother over one in C; our particle filter and transition over their limits."""
    mine = [row for row in rows if row["who"] in ("nnap_em", "limit")]
    if group == "extended":
        rate = {row["what"]: pace(row) for row in mine}
        pairs = {f"{row['what']} / C smoother": pace(row) / rate["C smoother"] for row in mine if row["who"] != "limit"}
        return ["", *table(["sequence-steps/s of", "ratio"], [[k, f"{v:.2f}"] for k, v in pairs.items()])]
    rate = {row["what"]: pace(row) * row["size"][2] for row in mine}
    most = max(row["size"][2] for row in rows if row["who"] == "nnap_em")
    ours = rate["our transition alone"]
    pairs = {
        "our transition / C transition": ours / rate["C transition"],
        "our transition / C transition, 512-bit vectors": ours / rate["C transition, 512-bit vectors"],
        "our transition / natural transition": ours / rate["natural transition alone"],
        "bootstrap filter / our transition": rate[f"bootstrap filter, {most}"] / ours,
        "bootstrap filter / C transition": rate[f"bootstrap filter, {most}"] / rate["C transition"],
        "guided filter / our transition": rate[f"guided filter, {most}"] / ours,
    }
    return ["", *table(["particle-steps/s of", "ratio"], [[k, f"{v:.2f}"] for k, v in pairs.items()])]


def start_up(repeats: int) -> list[str]:
    """What a user waits for before anything is computed."""
    names = "import nnap_em; [getattr(nnap_em, name) for name in nnap_em.__all__]"
    cli = "from nnap_em.commands.cli import parser; parser().format_help()"
    programs = {
        "python alone": "",
        "import jax": "import jax",
        "import nnap_em": "import nnap_em",
        "import jax, nnap_em and all its public names": f"import jax; {names}",
        "nnap-em --help": cli,
    }
    env = os.environ | {"PYTHONPATH": str(root)}
    median = {}
    for name, program in programs.items():
        times = []
        for _ in range(repeats + 1):  # the first reads the files
            began = time.perf_counter()
            subprocess.run([sys.executable, "-c", program], env=env, check=True)
            times.append(time.perf_counter() - began)
        median[name] = float(np.median(times[1:]))
    loaded = f"{cli}; import sys; print('jax' in sys.modules)"
    jax_loaded = subprocess.check_output([sys.executable, "-c", loaded], env=env, text=True).strip() == "True"
    median["nnap_em beyond jax"] = median["import jax, nnap_em and all its public names"] - median["import jax"]
    lines = table(["program", "time [s]"], [[name, f"{value:.2f}"] for name, value in median.items()])
    return [*lines, "", f"`nnap-em --help` {'loads' if jax_loaded else 'does not load'} JAX."]


def growth_figure(curves: dict[str, dict[str, list[dict]]], base: Sequence[int]):
    """Time and memory against the size of the work."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    sys.path.insert(0, str(root))
    from nnap_em.report.style import BLUE, STYLE, VERMILION

    colours = {"extended": BLUE, "particle": VERMILION}
    with rc_context(STYLE):
        figure = Figure(figsize=(3.2 * len(curves), 4.6), layout="constrained")
        grid = figure.subplots(2, len(curves), squeeze=False, sharex="col", sharey="row")
        for (axis, lines), (top, bottom) in zip(curves.items(), grid.T, strict=True):
            for name, rows in lines.items():
                at = [row["point"] for row in rows]
                top.loglog(at, [row["time"] for row in rows], "o-", ms=4, color=colours[name], label=f"{name} smoother")
                bottom.loglog(at, [row["memory"] / 1e6 for row in rows], "o-", ms=4, color=colours[name])
                last = rows[-1]
                ideal = [last["time"] * p / last["point"] for p in at]
                top.loglog(at, ideal, ls=(0, (2, 2)), lw=0.8, color=colours[name])
            bottom.set_xlabel(f"{axes[axis]} [-]")
        grid[0, 0].set_ylabel("time of the E-step [s]")
        grid[1, 0].set_ylabel("peak memory [MB]")
        grid[0, -1].legend(loc="upper left")
        note = f"{base[0]} sequences, {base[1]} steps, {base[2]} particles where not on the axis; dotted: linear growth"
        figure.suptitle(note, x=0.01, ha="left", fontsize=9)
    return figure


def machine() -> str:
    """Where and with what this ran."""
    cpu = next(line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name"))
    commit = subprocess.check_output(["git", "describe", "--always", "--dirty"], cwd=root, text=True).strip()
    versions = []
    for name in ("jax", *peers):
        try:
            versions.append(f"{name} {importlib.metadata.version(name)}")
        except importlib.metadata.PackageNotFoundError:
            versions.append(f"{name} not installed: no rows")
    cpus, load = len(os.sched_getaffinity(0)), os.getloadavg()[1]
    lines = (f"{date.today()}, {cpu.split(':')[1].strip()}, {cpus} cores, load of the last 5 minutes {load:.1f}",)
    return f"{lines[0]}; Python {sys.version.split()[0]}, {', '.join(versions)}; commit {commit}"


preface = """\
# Throughput

One pass of the library is faster than that of its fastest peer, with the same errors; with 13 starts, as for an angle
known to 0.5 rad, and one relinearisation more its Gaussian smoothers are slower than dynamax's one pass.

![Rows smoothed per second](../figures/gallery/throughput.png)

The acrobot with a 1-16-16-1 tanh network of friction in each joint, one Runge-Kutta step per 10 ms, 20 sequences of
500 steps, 32 bits; angle and rate of joint 1 read with noise of 0.01 rad and 0.05 rad/s, process noise 2e-4 rad and
0.01 rad/s per step. All rows have the model that made the logs and the same prior of the start, 0.05 rad and 0.05 rad/s
about the arm held out level. Particle rows have 1000 particles ([other numbers of them, compile times,
memory, all errors](throughput_rows.csv)).

The rows of a table take turns on one core. Speed is by the median time of 3 to 7 runs after compilation, theta2 the
root mean square error of the smoothed (filters: filtered) states.

Peers have the transition as their user would write it in jax.numpy, or ours in the rows marked so. dynamax takes the
points of the cubature rule. All resample systematically below half the sample size. particles is NumPy in 64 bits; it
and the exact backward samplers run on the first 2 sequences. Our particle rows include the extended smoother about
whose path particles are stored.
"""


def main() -> None:
    """Run what is asked for and write docs/results/throughput.md, or print a quick run."""
    kinds = [*titles, "growth", "cores", "epoch", "import"]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a small size of everything, to see that it runs")
    parser.add_argument("--only", nargs="+", choices=kinds, default=kinds)
    parser.add_argument("--out", type=Path, help="of the text; that of a full run goes to docs/results/throughput.md")
    args = parser.parse_args()
    size = (3, 60, 200) if args.quick else (20, 500, 1000)
    repeats, budget = (3, 0.0) if args.quick else (7, 5.0)
    cpus = sorted(os.sched_getaffinity(0), reverse=True)  # the first core serves most interrupts
    full = not args.quick and set(args.only) == set(kinds)
    out = args.out or (root / "docs" / "results" / "throughput.md" if full else None)
    began = time.perf_counter()
    lines, numbers = [preface, machine() + "."], [["group", *head]]
    with tempfile.TemporaryDirectory() as cache:
        for group in (g for g in titles if g in args.only):
            order = {"group": group, "size": size, "quick": args.quick}
            rows = child({"task": "speed", **order, "repeats": repeats, "budget": budget}, cpus[:1], cache)
            memory = child({"task": "memory", **order}, cpus[:1], cache, measure_memory=True)
            cells = speed_rows(rows, memory)
            numbers += [[group, *line] for line in cells]
            section = ["", f"## {titles[group]}", "", *speed_table(rows, cells)]
            lines += [*section, *(limit_lines(group, rows) if group in ("extended", "filter") else [])]
            print("\n".join(section), file=sys.stderr, flush=True)  # a later group that fails loses nothing
        if "growth" in args.only:
            lines += growth(args.quick, cpus[:1], cache, out)
        if "cores" in args.only:
            lines += cores(size, cpus, cache)
            lines += large((10, 50, 100) if args.quick else (1000, 500, 1000), cpus, cache)
        if "epoch" in args.only:
            two = cpus[:2]
            timings = child({"task": "epoch", "size": size, "repeats": 3}, two, cache)
            rows = [[name, f"{v['time']:.2f}", f"{v['compile']:.1f}"] for name, v in timings.items()]
            title = f"## One EM epoch of `nnap-em identify` on {len(two)} cores, 64 bits"
            lines += ["", title, "", *table(["smoother", "time [s]", "compile [s]"], rows)]
    if "import" in args.only:
        lines += ["", "## The first seconds", "", *start_up(1 if args.quick else 5)]
    lines += ["", f"The whole run took {(time.perf_counter() - began) / 60:.0f} min."]
    text = "\n".join(lines) + "\n"
    print(text)
    if out:
        out.write_text(text)
        with out.with_name("throughput_rows.csv").open("w", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows(numbers)


def growth(quick: bool, cpus: Sequence[int], cache: str, out: Path | None) -> list[str]:
    """Section and figure of how time and memory grow."""
    base = (2, 500, 100)
    points = {
        "particles": [100, 300, 1000, 3000, 10000],
        "steps": [500, 2000, 10000, 50000],
        "sequences": [1, 10, 100, 1000],
    }
    if quick:
        base, points = (2, 50, 20), {"particles": [20, 40], "steps": [50, 100], "sequences": [1, 2]}
    curves: dict[str, dict[str, list[dict]]] = {}
    rows = []
    for axis, at in points.items():
        curves[axis] = {}
        for smoother in ("particle",) if axis == "particles" else ("extended", "particle"):
            order = {"task": "growth", "smoother": smoother, "axis": axis, "points": at, "base": base}
            runs = curves[axis][smoother] = child(order, cpus, cache, measure_memory=True)
            rows += [
                [smoother, f"{r['point']} {axes[axis]}", f"{r['time']:.3g}", f"{r['memory'] / 1e6:.0f}"] for r in runs
            ]
    titles = ["smoother", "work", "time [s]", "peak memory [MB]"]
    lines = ["", "## How time and memory grow", ""]
    lines.append(f"`e_step` as the library sets it, {base[0]} sequences x {base[1]} steps, {base[2]} particles and")
    lines += ["25 trajectories where nothing else is said; one core.", ""]
    if out:
        picture = out.parents[1] / "figures" / "throughput.png"
        growth_figure(curves, base).savefig(picture)
        lines += [f"![Time and memory of the E-step](../figures/{picture.name})", ""]
        numbers = out.with_suffix(".csv")
        with numbers.open("w", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows([titles, *rows])
        return [*lines, f"[The numbers]({numbers.name})."]
    return [*lines, *table(titles, rows)]


def cores(size: Sequence[int], cpus: Sequence[int], cache: str) -> list[str]:
    """Section of the speed-up by cores."""
    counts = [n for n in (1, 2, 4) if n <= len(cpus)]
    runs = {n: child({"task": "cores", "size": size, "repeats": 5}, cpus[:n], cache) for n in counts}
    rows = [[name, *(f"{runs[n][name]:.3g} ({runs[1][name] / runs[n][name]:.2f})" for n in counts)] for name in runs[1]]
    columns = ["smoother", *(f"{n} core{'s' * (n > 1)} [s] (speed-up)" for n in counts)]
    return ["", f"## Cores: `e_step` on {size[0]} x {size[1]}, as the library sets it", "", *table(columns, rows)]


def large(size: Sequence[int], cpus: Sequence[int], cache: str) -> list[str]:
    """Sentence on work whose whole history would not fit into memory."""
    timing = child({"task": "large", "size": size}, cpus, cache, measure_memory=True)
    return [
        "",
        f"{size[0]} sequences x {size[1]} steps x {size[2]} particles with exact backward sampling of 25 trajectories, "
        f"on {len(cpus)} cores: {timing['time']:.0f} s with compilation, peak memory {timing['memory'] / 1e9:.1f} GB.",
    ]


if __name__ == "__main__":
    main()
