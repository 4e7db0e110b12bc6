"""Figures of fits: friction, errors, predictions, learned functions and terms, and the first screening round."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, NullFormatter, NullLocator

from ..diagnosis.residual import Names
from ..effects.base import Curve
from ..fit.identify import FrictionTable
from .style import (
    ACROSS,
    AFTER,
    BEFORE,
    READING,
    ZERO_LINE,
    band,
    density,
    dotted,
    head,
    limits,
    panels,
    styled,
    symbol,
)
from .wording import reached


@styled
def friction_figure(
    tables: Mapping[str, FrictionTable],
    names: Names,
    visited: Sequence[Float[Any, " sample"]] | None = None,
    *,
    title: str = "Identified friction",
) -> Figure:
    """The maps of every joint, the last one in blue; `visited`: velocity samples of each joint."""
    dof = len(names.coordinates)
    across = min(dof, ACROSS)
    size = max(4.4, (4.0 if dof < 3 else 2.9) * across), 0.7 + 3.0 * -(-dof // across)
    figure = Figure(figsize=size, layout="constrained")
    grid = panels(figure, dof, (1.0, 0.06) if visited is not None else (1.0,))
    for j, (ax, rate) in enumerate(zip(grid[0], names.rates, strict=True)):
        for (label, table), colour in zip(tables.items(), (BEFORE, AFTER)[-len(tables) :], strict=True):
            v, torque, std = (np.asarray(a)[j] for a in (table.velocity, table.torque, table.std))
            band(ax, v, torque, std, colour, label)
            ax.set_xlim(v[0], v[-1])
        if len(tables) > 1:  # a band that is wide where nothing moved hides neither
            ax.set_ylim(*limits([np.asarray(table.torque)[j] for table in tables.values()], 0.2))
        ax.axhline(0, color="#BBBBBB", lw=0.8, zorder=0)
        ax.set_title(names.joint(j + 1).replace("j", "J", 1) if dof > 1 else "")
        ax.set_ylabel(f"friction [{names.force_unit(j + 1)}]")
        if visited is not None:
            density(grid[1, j], visited[j], *ax.get_xlim())
            ax.tick_params(labelbottom=False)
        grid[-1, j].set_xlabel(f"velocity {symbol(rate)} [{names.unit(rate)}]")
    head(figure, title, list(grid[0]))
    return figure


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


@styled
def effect_figure(curve: Curve) -> Figure:
    """A learned function with its 90 % band."""
    figure = Figure(figsize=(5.4, 3.4), layout="constrained")
    ax = figure.subplots()
    band(ax, curve.x, curve.mean, curve.std, AFTER, "learned")
    ax.axhline(0, color=ZERO_LINE, lw=0.7, zorder=0)
    signal = " + ".join(symbol(name) for name in curve.signal.split(" + "))
    ax.set(xlim=(curve.x[0], curve.x[-1]), xlabel=f"{signal} [{curve.signal_unit}]")
    ax.set_ylabel(f"force at joint {curve.joint} [{curve.unit}]")
    head(figure, "What was found", [ax])
    return figure


@styled
def term_figure(term: dict[str, Any]) -> Figure:
    """An unknown term of equations, as the report has it: with its 90 % band, or of two signals as a surface."""
    figure = Figure(figsize=(5.4, 3.4), layout="constrained")
    ax, (places, values) = figure.subplots(), (np.asarray(term[key]) for key in ("places", "value"))
    names = [f"{symbol(name)} [{unit}]".removesuffix(" []") for name, unit in term["signals"].items()]
    names.append(f"{term['name']} [{term['unit']}]")
    if len(names) == 2:
        band(ax, places[:, 0], values, term["std"], AFTER, "learned")
    else:
        figure.colorbar(ax.tripcolor(places[:, 0], places[:, 1], values, shading="gouraud"), ax=ax, label=names[2])
    ax.set(xlabel=names[0], ylabel=names[1])
    head(figure, f"The unknown term {term['name']}", [ax])
    return figure


@styled
def screen_figure(
    entries: Sequence[tuple[str, float]],
    measure: str = "expected gain in log-likelihood [nat]",
    *,
    chosen: str | None = None,
) -> Figure:
    """Screening scores of the candidates, in the `measure`, as bars; the `chosen` label in colour."""
    top = sorted(entries, key=lambda e: -e[1])
    figure = Figure(figsize=(7.4, 0.28 * max(len(top), 1) + 1.0), layout="constrained")
    ax = figure.subplots()
    colours = [AFTER if label == chosen else READING for label, _ in top]
    ax.barh([label for label, _ in top], [gain for _, gain in top], color=colours, height=0.7)
    ax.invert_yaxis()
    ax.grid(axis="y", visible=False)
    ax.axvline(0, color=ZERO_LINE, lw=0.7)
    ax.set_xlabel(measure)
    head(figure, "Screening scores", [ax])
    return figure
