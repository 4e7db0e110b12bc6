"""Prediction errors before and after."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, NullFormatter, NullLocator

from ..residual.residual import Names
from .style import ACROSS, AFTER, BEFORE, band, dotted, head, limits, panels, styled, symbol
from .wording import reached

_SIDES = {"before": (BEFORE, "s"), "fit": (AFTER, "o"), "after": (AFTER, "o")}


@styled
def error_figure(error: Mapping[str, Any], names: Names) -> Figure:
    """Root mean square error against horizon; `error` as in report.json, a panel for each column."""
    sides = {name: error[name] for name in _SIDES if name in error}
    columns = list(next(iter(sides.values())))
    across = min(len(columns), ACROSS)
    size = (3.3 if across < 4 else 2.7) * across + 0.4, 0.6 + 2.7 * -(-len(columns) // across)
    figure = Figure(figsize=size, layout="constrained")
    (grid,) = panels(figure, len(columns))
    horizons = np.asarray(reached(error), float)
    for ax, name in zip(grid, columns, strict=True):
        for side, values in sides.items():
            colour, mark = _SIDES[side]
            y = np.asarray([math.nan if v is None else v for v in values[name][: len(horizons)]], float)
            dotted(ax, horizons, np.where(y > 0, y, np.nan), colour, side, mark)
        ax.set(title=symbol(name), xlabel="time predicted ahead [s]", ylabel=f"rms error [{names.unit(name)}]")
        _logarithmic(ax, horizons)
    head(figure, "Prediction error on test sequences", list(grid))
    return figure


def _logarithmic(ax: Axes, horizons: Float[np.ndarray, " horizon"]) -> None:
    ax.set_xscale("log")
    ax.xaxis.set_major_locator(FixedLocator(list(horizons)))
    ax.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    ax.xaxis.set_minor_locator(NullLocator())
    if not any(np.isfinite(line.get_ydata()).any() for line in ax.lines):
        return  # no test sequence is longer than what is given, and a logarithmic axis needs a number
    ax.set_yscale("log")
    low, high = ax.get_ylim()
    if high < 30 * low:
        ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        ax.yaxis.set_minor_formatter(NullFormatter())
    ax.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:g}"))


Pair = tuple[Float[Any, "time state"], Float[Any, "time state"]]
"""Mean and standard deviation."""


@styled
def prediction_figure(
    t: Float[Any, " time"],
    y: Float[Any, "time obs"],
    names: Names,
    sides: Mapping[str, Pair],
    given: float,
    *,
    title: str | None = None,
) -> Figure:
    """Predicted distributions of every state and sensor; readings up to `given` [s] were used."""
    states = (*names.coordinates, *names.rates, *names.sensors)
    columns = 1 if len(states) <= ACROSS else 2
    deep = -(-len(states) // columns)
    figure = Figure(figsize=(7.6 if columns == 1 else 10.4, 1.75 * deep + 0.7), layout="constrained")
    grid = figure.subplots(deep, columns, sharex=True, squeeze=False)
    t, y = np.asarray(t) - float(np.asarray(t)[0]), np.asarray(y)
    for s, (ax, name) in enumerate(zip(grid.T.ravel(), states, strict=True)):
        for (label, (mean, std)), colour in zip(sides.items(), (BEFORE, AFTER)[-len(sides) :], strict=True):
            band(ax, t, np.asarray(mean)[:, s], np.asarray(std)[:, s], colour, label)
        shown = np.asarray(list(sides.values())[-1][0])[:, s]
        if name in names.measured:
            shown = y[:, names.measured.index(name)]
            ax.plot(t, shown, ".", color="#222222", ms=2.2, mew=0, label="readings", zorder=6)
        ax.set_ylim(*limits([shown], 0.35))
        ax.axvspan(float(t[0]), given, color="#F1F1F1", lw=0, zorder=0)
        ax.axvline(given, color="#555555", lw=1.0)
        ax.set_ylabel(f"{symbol(name)} [{names.unit(name)}]" + ("" if name in names.measured else "\nnot measured"))
    first = grid[0, 0]
    note = first.text(given, 0.97, " prediction starts", transform=first.get_xaxis_transform(), va="top", fontsize=8)
    note.set(clip_on=True, in_layout=False)  # it may stand behind the end of a short sequence
    for ax in grid[-1]:
        ax.set(xlabel="time [s]", xlim=(float(t[0]), float(t[-1])))
    head(figure, title or f"One test sequence, predicted from its first {given:g} s", list(grid.ravel()))
    return figure
