"""One style for all figures: what is learned in colour, truth in black, readings in grey; units on every axis.

Figures belong to nobody; save one with `savefig`.
"""

from collections.abc import Callable, Sequence
from typing import Any, ParamSpec

import numpy as np
from jaxtyping import Float
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

# Okabe & Ito's colours for the colour-blind; black is the truth, grey the readings.
BLUE, VERMILION, GREEN, PURPLE = "#0072B2", "#D55E00", "#009E73", "#CC79A7"
TRUTH, READING, ZERO_LINE = "#000000", "#8A8A8A", "#777777"
BEFORE, AFTER = VERMILION, BLUE
NORMAL_90 = 1.6449
"""Half width of the central 90 % of a normal distribution, in standard deviations."""
ACROSS = 4
"""Panels side by side at most."""
STYLE: Any = {
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.labelsize": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#E3E3E3",
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.5,
    "legend.frameon": False,
    "legend.fontsize": 9,
    "savefig.dpi": 150,
    "figure.dpi": 150,
}


_Arguments = ParamSpec("_Arguments")


def styled(draw: Callable[_Arguments, Figure]) -> Callable[_Arguments, Figure]:
    """A function that draws in this style."""

    def wrapped(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> Figure:
        with rc_context(STYLE):
            return draw(*args, **kwargs)

    wrapped.__name__, wrapped.__doc__ = draw.__name__, draw.__doc__
    return wrapped


def symbol(name: str) -> str:
    """Symbol of a column in a figure: theta1 is θ₁, dtheta1 is ω₁; others as they are."""
    for start, sign in (("dtheta", "ω"), ("theta", "θ")):
        if name.startswith(start):
            return sign + name.removeprefix(start).translate(str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉"))
    return name


def head(figure: Figure, title: str, axes: Sequence[Axes], note: str = "") -> None:
    """Title, note and one legend for all panels, above them and in a column each."""
    seen: dict[str, Any] = {}
    for ax in axes:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            seen.setdefault(label, handle)
    width, height = figure.get_size_inches()
    columns = min(len(seen), max(1, int(width / 1.3)))
    rows = -(-len(seen) // max(columns, 1))
    top = 0.30 + 0.17 * (note.count("\n") + 1) * bool(note)
    figure.text(0.08 / width, 1 - 0.08 / height, title, va="top", ha="left", fontsize=11, weight="bold")
    if note:
        figure.text(0.08 / width, 1 - 0.30 / height, note, va="top", ha="left", color="#555555", fontsize=8.5)
    if seen:
        figure.legend(
            seen.values(),
            seen.keys(),
            loc="upper left",
            ncols=columns,
            bbox_to_anchor=(0.0, 1 - top / height),
            borderaxespad=0.2,
            columnspacing=1.4,
            handlelength=1.6,
            markerscale=4,
        )
    figure.get_layout_engine().set(rect=(0, 0, 1, 1 - (top + 0.05 + 0.21 * rows) / height))  # type: ignore[union-attr]


def density(ax: Axes, visited: Float[Any, " sample"], low: float, high: float) -> None:
    """Strip below the curves: the darker, the more often a velocity was visited."""
    inside = np.ravel(np.asarray(visited, float))
    inside = inside[np.isfinite(inside)]
    count, _ = np.histogram(inside, np.linspace(low, high, 121))
    shade = np.sqrt(count / max(count.max(initial=0), 1))[None]
    ax.imshow(shade, extent=(low, high, 0, 1), aspect="auto", cmap="Greys", vmin=0, vmax=1.2, interpolation="nearest")
    ax.set(yticks=[], xlim=(low, high))
    ax.grid(False)
    ax.set_ylabel("visited", rotation=0, ha="right", va="center", fontsize=8)


def limits(values: Sequence[Any], margin: float = 0.25) -> tuple[float, float]:
    """Limits around known values, so that a distribution that runs away does not flatten the picture."""
    finite = np.concatenate([np.ravel(np.asarray(v, float)) for v in values])
    finite = finite[np.isfinite(finite)]
    low, high = (float(np.min(finite)), float(np.max(finite))) if finite.size else (-1.0, 1.0)
    extra = margin * max(high - low, 1e-6)
    return low - extra, high + extra


def band(ax: Axes, x: Any, mean: Any, std: Any, colour: str, label: str) -> None:
    """A line with its 90 % band."""
    half = NORMAL_90 * np.asarray(std)
    ax.fill_between(x, mean - half, mean + half, color=colour, alpha=0.25, lw=0, label=f"{label}, 90 % band")
    ax.plot(x, mean, color=colour, label=label)


def dotted(ax: Axes, x: Any, y: Any, colour: str, label: str, mark: str = "o") -> None:
    """A line with its points marked; the marks are not in the legend, whose marks are larger."""
    ax.plot(x, y, color=colour, lw=1.0, label=label)
    ax.plot(x, y, mark, color=colour, ms=3)


def panels(figure: Figure, count: int, heights: Sequence[float] = (1.0,)) -> np.ndarray:
    """Axes [part, panel] of `count` panels, `ACROSS` side by side, each of parts of these heights below each other."""
    across, parts = min(count, ACROSS), len(heights)
    deep = -(-count // across)
    grid = figure.subplots(deep * parts, across, squeeze=False, height_ratios=list(heights) * deep)
    grid = grid.reshape(deep, parts, across).swapaxes(0, 1).reshape(parts, -1)
    for ax in grid[:, count:].ravel():
        ax.set_axis_off()
    return grid[:, :count]
