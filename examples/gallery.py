"""The pictures of docs/gallery.md: runs behind them, then drawings for light and for dark pages.

    python examples/gallery.py                    # all eight, half an hour on two cores (`make gallery`)
    python examples/gallery.py friction touch     # some of them

A run leaves its arrays in `out/gallery/NAME.npz` and is not repeated where they are.  Its pictures are
`docs/figures/gallery/NAME.png` and `NAME-dark.png`.
"""

import argparse
import shutil
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import gallery_runs as runs
import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from nnap_em.cli.common import set_up
from nnap_em.output.report.style import NORMAL_90, STYLE

SIZE = (4.4, 2.9)
"""Width and height of a picture [in]."""
DOTS = 160
"""Per inch."""


class Ink(NamedTuple):
    """Colours on a page."""

    text: str
    grid: str
    faint: str
    """Samples and readings."""
    truth: str
    learned: str
    before: str
    third: str


LIGHT = Ink("#1B1F24", "#E3E3E3", "#9AA0A6", "#000000", "#0072B2", "#D55E00", "#009E73")
DARK = Ink("#D6DAE0", "#3A3F4A", "#7C838D", "#FFFFFF", "#56B4E9", "#F0863C", "#2FC29A")
Arrays = Mapping[str, Any]
TRUE: Any = {"ls": (0, (4, 2)), "lw": 1.3, "zorder": 5}


def _band(ax: Axes, x: Any, mean: Any, std: Any, colour: str, label: str) -> None:
    ax.fill_between(x, mean - NORMAL_90 * std, mean + NORMAL_90 * std, color=colour, alpha=0.3, lw=0)
    ax.plot(x, mean, color=colour, label=label)


def friction(figure: Figure, d: Arrays, ink: Ink) -> None:
    """Two joints side by side, about rest."""
    axes = figure.subplots(1, 2)
    for joint, ax in enumerate(axes, 1):
        mine, true = (
            (d[f"{side}_joint"] == joint) & (np.abs(d[f"{side}_velocity"]) < 4.0) for side in ("found", "true")
        )
        v = d["found_velocity"][mine]
        _band(ax, v, d["found_torque"][mine], d["found_torque_std"][mine], ink.learned, "learned")
        ax.plot(d["true_velocity"][true], d["true_torque"][true], color=ink.truth, label="true", **TRUE)
        ax.set(title=f"joint {joint}, {'read' if joint == 1 else 'not read'}", xlabel="velocity [rad/s]")
    axes[0].set_ylabel("friction [N m]")
    axes[0].legend()


def hidden(figure: Figure, d: Arrays, ink: Ink) -> None:
    """The angle over time."""
    ax = figure.subplots()
    _band(ax, d["t"], d["mean"], d["std"], ink.learned, "smoothed, from joint 1 alone")
    ax.plot(d["t"], d["read"], color=ink.truth, label="its encoder, not shown to the fit", **TRUE)
    ax.set(xlabel="time [s]", ylabel="angle of joint 2 [rad]")
    ax.legend()


def law(figure: Figure, d: Arrays, ink: Ink) -> None:
    """Samples, their mean, and two laws."""
    ax = figure.subplots()
    torque = d["torque"] - np.mean(d["torque"])
    ax.plot(d["angle"], torque, ".", color=ink.faint, ms=1.5, mew=0, alpha=0.5)
    ax.plot(*_means(d["angle"], torque), "o", color=ink.before, ms=3.5, label="missing torque, mean")
    ax.plot(*_means(d["angle"], d["found"]), color=ink.learned, lw=2, label="law found")
    ax.plot(*_means(d["angle"], d["true"]), color=ink.truth, label="law taken out of the log", **TRUE)
    reach = 1.5 * np.percentile(np.abs(torque), 97)
    ax.set(xlabel="angle of joint 2 [rad]", ylabel="torque [N m]", ylim=(-reach, reach))
    ax.legend(loc="upper right")


def _means(x: Any, y: Any) -> tuple[Any, Any]:
    """Means over 24 bins of x, without the mean of all."""
    edges = np.linspace(*np.percentile(x, (0.5, 99.5)), 25)
    place = np.digitize(x, edges) - 1
    filled = [b for b in range(24) if np.count_nonzero(place == b) >= 20]
    return [np.mean(x[place == b]) for b in filled], [np.mean(y[place == b]) - np.mean(y) for b in filled]


def errors(figure: Figure, d: Arrays, ink: Ink) -> None:
    """Errors by horizon."""
    ax = figure.subplots()
    ax.plot(d["horizon"], d["before"], "s-", color=ink.before, ms=4, label="before")
    ax.plot(d["horizon"], d["after"], "o-", color=ink.learned, ms=4, label="after")
    ax.plot(d["horizon"], d["goal"], color=ink.truth, label="machine without the law", **TRUE)
    ax.set(xlabel="time predicted ahead [s]", ylabel="error of joint 2, rms [rad]", xlim=(0, None), ylim=(0, None))
    ax.legend()


def touch(figure: Figure, d: Arrays, ink: Ink) -> None:
    """Torque over time, with the pushes that were found."""
    ax = figure.subplots()
    ax.plot(d["t"], d["torque"], color=ink.before, lw=1.0, label="torque that the model lacks")
    ax.plot(d["t"], d["true"], color=ink.truth, label="pushes that the log does not have", **TRUE)
    for i, (first, last) in enumerate(d["spans"]):
        ax.axvspan(first, last, color=ink.learned, alpha=0.3, lw=0, label="" if i else "found")
    reach = 1.2 * max(np.max(np.abs(d["true"])), np.nanpercentile(np.abs(d["torque"]), 98))
    ax.set(xlabel="time [s]", ylabel=f"torque at joint {int(d['joint'])} [N m]", ylim=(-reach, 1.8 * reach))
    ax.legend(loc="upper left", ncols=2)


def arm(figure: Figure, d: Arrays, ink: Ink) -> None:
    """A small panel for each joint, and the legend in the eighth."""
    axes = figure.subplots(2, 4).ravel()
    for j, ax in enumerate(axes[:7]):
        _band(ax, d["v"][j], d["found"][j], d["std"][j], ink.learned, "learned")
        ax.plot(d["v"][j], d["true"][j], color=ink.truth, label="true", **TRUE)
        ax.set_title(f"joint {j + 1}", fontsize=7)
        ax.tick_params(labelsize=6)
    axes[7].set_axis_off()
    axes[7].legend(*axes[0].get_legend_handles_labels(), loc="center")
    figure.supxlabel("velocity [rad/s]", fontsize=8)
    figure.supylabel("friction [N m]", fontsize=8)


def throughput(figure: Figure, d: Arrays, ink: Ink) -> None:
    """A bar for each way to smooth."""
    ax = figure.subplots()
    for name, who, speed in zip(d["name"], d["who"], d["speed"], strict=True):
        ax.barh(str(name), speed / 1e3, color=ink.faint if who == "dynamax" else ink.learned)
    ax.invert_yaxis()
    ax.grid(axis="y", visible=False)
    ax.set_xlabel("thousand rows per second, one core")


class Picture(NamedTuple):
    """A picture: the run behind it, and its drawing."""

    run: Callable[[Path], Arrays]
    draw: Callable[[Figure, Arrays, Ink], None]


PICTURES = {
    "friction": Picture(runs.friction, friction),
    "hidden": Picture(runs.hidden, hidden),
    "law": Picture(runs.law, law),
    "errors": Picture(runs.errors, errors),
    "touch": Picture(runs.touch, touch),
    "arm": Picture(runs.arm, arm),
    "throughput": Picture(runs.throughput, throughput),
}


def drawn(picture: Picture, arrays: Arrays, ink: Ink) -> Figure:
    """The picture in these colours, on no ground of its own."""
    edges = {
        name: ink.text for name in ("text.color", "axes.labelcolor", "xtick.color", "ytick.color", "axes.edgecolor")
    }
    look = STYLE | edges | {"grid.color": ink.grid, "axes.titlesize": 8, "axes.labelsize": 8, "legend.fontsize": 7}
    look |= {"font.size": 8, "axes.facecolor": "none", "figure.facecolor": "none"}
    with rc_context(look):
        figure = Figure(figsize=SIZE, layout="constrained")
        picture.draw(figure, arrays, ink)
        figure.canvas.draw()
    return figure


def arrays(name: str, out: Path) -> Arrays:
    """Result of a run, from its file where there is one."""
    file = out / f"{name}.npz"
    if not file.exists():
        shutil.rmtree(out / name, ignore_errors=True)  # of a run that was stopped
        result = PICTURES[name].run(out / name)
        out.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(file, **result)
    with np.load(file) as stored:
        return dict(stored)


def main() -> int:
    """Run and draw; a picture whose recordings are not there is left as it is."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(PICTURES))
    parser.add_argument("--out", type=Path, default=Path("out/gallery"), help="folder of the runs")
    parser.add_argument("--pictures", type=Path, default=runs.ROOT / "docs" / "figures" / "gallery")
    args = parser.parse_args()
    if unknown := set(args.names) - set(PICTURES):
        parser.error(f"no picture of that name: {', '.join(sorted(unknown))}; there are {', '.join(PICTURES)}")
    set_up()
    args.pictures.mkdir(parents=True, exist_ok=True)
    for name in args.names or PICTURES:
        try:
            results = arrays(name, args.out)
        except FileNotFoundError as error:
            print(f"{name}: {error}", file=sys.stderr)
            continue
        for end, ink in (("", LIGHT), ("-dark", DARK)):
            path = args.pictures / f"{name}{end}.png"
            drawn(PICTURES[name], results, ink).savefig(path, dpi=DOTS, transparent=True)
        print(f"{name}: {args.pictures / name}.png, {name}-dark.png")
    return 0


if __name__ == "__main__":
    sys.exit(main())
