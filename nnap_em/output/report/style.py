"""One style for all figures: what is learned in colour, truth in black, readings in grey; units on every axis.

Figures belong to nobody; save one with `savefig`.
"""

from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

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
    "font.size": 9, "axes.titlesize": 10, "axes.titlelocation": "left", "axes.labelsize": 9,
    "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True, "axes.axisbelow": True,
    "grid.color": "#E3E3E3", "grid.linewidth": 0.6, "lines.linewidth": 1.5,
    "legend.frameon": False, "legend.fontsize": 9, "savefig.dpi": 150, "figure.dpi": 150,
}  # fmt: skip
_Side = TypeVar("_Side")
styled = rc_context(STYLE)
"""Decorator of a function that draws in this style."""


def symbol(name: str) -> str:
    """Symbol of a column in a figure: theta1 is θ₁, dtheta1 is ω₁; others as they are."""
    for start, sign in (("dtheta", "ω"), ("theta", "θ")):
        if name.startswith(start):
            return sign + name.removeprefix(start).translate(str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉"))
    return name


def head(figure: Figure, title: str, axes: Sequence[Axes], note: str = "") -> None:
    """Title and note above all panels, one legend for them below."""
    seen: dict[str, Any] = {}
    for ax in axes:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            seen.setdefault(label, handle)
    figure.suptitle(f"{title}\n{note}" if note else title, x=0.02, ha="left", fontsize=10)
    if seen:
        columns = min(len(seen), max(1, int(figure.get_size_inches()[0] / 1.6)))
        figure.legend(seen.values(), seen.keys(), loc="outside lower left", ncols=columns, markerscale=4)


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


def coloured(sides: Mapping[str, _Side]) -> list[tuple[str, _Side, str]]:
    """Name, content and colour of one side or two, the last one in blue."""
    return [(*side, colour) for side, colour in zip(sides.items(), (BEFORE, AFTER)[-len(sides) :], strict=True)]


def panels(count: int, heights: Sequence[float] = (1.0,)) -> tuple[Figure, np.ndarray]:
    """A figure, and axes [part, panel] of `count` panels, `ACROSS` side by side, each of parts of these heights."""
    across, parts = min(count, ACROSS), len(heights)
    deep = -(-count // across)
    figure = Figure(figsize=(max(4.4, (3.6 if across < 3 else 2.9) * across), 0.7 + 2.9 * deep), layout="constrained")
    grid = figure.subplots(deep * parts, across, squeeze=False, height_ratios=list(heights) * deep)
    grid = grid.reshape(deep, parts, across).swapaxes(0, 1).reshape(parts, -1)
    for ax in grid[:, count:].ravel():
        ax.set_axis_off()
    return figure, grid[:, :count]
