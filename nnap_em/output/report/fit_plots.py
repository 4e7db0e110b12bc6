"""Figures of fits: friction, errors, predictions, learned functions and terms."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, NullLocator

from ...estimate.identify import FrictionTable
from ...estimate.predict import Prediction
from ...explain.diagnosis.residual import Names
from ...logs.dataset import Dataset
from ...model.effects.base import Curve
from .style import ACROSS, AFTER, ZERO_LINE, band, coloured, density, dotted, head, limits, panels, styled, symbol
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
    figure, grid = panels(dof, (1.0, 0.06) if visited is not None else (1.0,))
    for j, (ax, rate) in enumerate(zip(grid[0], names.rates, strict=True)):
        for label, table, colour in coloured(tables):
            v, torque, std = (np.asarray(a)[j] for a in (table.velocity, table.torque, table.std))
            band(ax, v, torque, std, colour, label)
            ax.set_xlim(v[0], v[-1])
        if len(tables) > 1:  # a band that is wide where nothing moved hides neither
            ax.set_ylim(*limits([np.asarray(table.torque)[j] for table in tables.values()], 0.2))
        ax.axhline(0, color=ZERO_LINE, lw=0.7, zorder=0)
        ax.set_title(names.joint(j + 1).replace("j", "J", 1) if dof > 1 else "")
        ax.set_ylabel(f"friction [{names.force_unit(j + 1)}]")
        if visited is not None:
            density(grid[1, j], visited[j], *ax.get_xlim())
            ax.tick_params(labelbottom=False)
        grid[-1, j].set_xlabel(f"velocity {symbol(rate)} [{names.unit(rate)}]")
    head(figure, title, list(grid[0]))
    return figure


@styled
def error_figure(error: Mapping[str, Any], names: Names) -> Figure:
    """Root mean square error against horizon; `error` as in report.json, a panel for each column."""
    sides = {name: error[name] for name in ("before", "fit", "after") if name in error}
    columns, horizons = list(next(iter(sides.values()))), np.asarray(reached(error), float)
    ahead = f"time predicted ahead [{names.unit('time')}]"
    figure, (grid,) = panels(len(columns))
    for ax, name in zip(grid, columns, strict=True):
        for side, values, colour in coloured(sides):
            y = np.asarray([math.nan if v is None else v for v in values[name][: len(horizons)]], float)
            dotted(ax, horizons, np.where(y > 0, y, np.nan), colour, side)
        ax.set(title=symbol(name), xlabel=ahead, ylabel=f"rms error [{names.unit(name)}]")
        ax.set_xscale("log")
        ax.set_xticks(horizons, [f"{horizon:g}" for horizon in horizons])
        ax.xaxis.set_minor_locator(NullLocator())
        if any(np.isfinite(line.get_ydata()).any() for line in ax.lines):  # a logarithmic axis needs a number
            ax.set_yscale("log")
            low, high = ax.get_ylim()
            ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 30 * low else (1.0,)))
            ax.yaxis.set_major_formatter("{x:g}")
            ax.yaxis.set_minor_formatter(NullFormatter())
    head(figure, "Prediction error on test sequences", list(grid))
    return figure


@styled
def prediction_figure(
    predicted: Mapping[str, Prediction], data: Dataset, names: Names, given: float, sequence: int = 0
) -> Figure:
    """Predicted distributions of every state and sensor of a sequence; readings up to `given` [s] were used."""
    rows = np.asarray(data.valid[sequence])
    t, y = (np.asarray(part[sequence])[rows] for part in (data.t, data.y))
    sides = {side: [np.asarray(a[sequence])[rows] for a in (p.mean, p.std)] for side, p in predicted.items()}
    states = (*names.coordinates, *names.rates, *names.sensors)
    columns = 1 if len(states) <= ACROSS else 2
    deep = -(-len(states) // columns)
    figure = Figure(figsize=(7.6 if columns == 1 else 10.4, 1.75 * deep + 0.7), layout="constrained")
    grid = figure.subplots(deep, columns, sharex=True, squeeze=False)
    t = t - float(t[0])
    for s, (ax, name) in enumerate(zip(grid.T.ravel(), states, strict=True)):
        for label, (mean, std), colour in coloured(sides):
            band(ax, t, mean[:, s], std[:, s], colour, label)
        shown = list(sides.values())[-1][0][:, s]
        if name in names.measured:
            shown = y[:, names.measured.index(name)]
            ax.plot(t, shown, ".", color="#222222", ms=2.2, mew=0, label="readings", zorder=6)
        ax.set_ylim(*limits([shown], 0.35))
        ax.axvspan(float(t[0]), given, color="#F1F1F1", lw=0, zorder=0)
        ax.axvline(given, color="#555555", lw=1.0)
        ax.set_ylabel(f"{symbol(name)} [{names.unit(name)}]" + ("" if name in names.measured else "\nnot measured"))
    unit = names.unit("time")
    for ax in grid[-1]:
        ax.set(xlabel=f"time [{unit}]", xlim=(float(t[0]), float(t[-1])))
    head(figure, f"One test sequence, predicted from its first {given:g} {unit} (grey)", list(grid.ravel()))
    return figure


@styled
def effect_figure(curve: Curve) -> Figure:
    """A learned function with its 90 % band."""
    figure = Figure(figsize=(5.4, 3.4), layout="constrained")
    ax = figure.subplots()
    band(ax, curve.x, curve.mean, curve.std, AFTER, "learned")
    ax.axhline(0, color=ZERO_LINE, lw=0.7, zorder=0)
    signal = " + ".join(symbol(name) for name in curve.signal.split(" + "))
    ax.set(xlabel=f"{signal} [{curve.signal_unit}]", ylabel=f"{curve.of} at joint {curve.joint} [{curve.unit}]")
    head(figure, "What was found", [ax])
    return figure


@styled
def term_figure(term: dict[str, Any]) -> Figure:
    """An unknown term of equations, as the report has it: with its 90 % band, or of two signals as a surface."""
    figure = Figure(figsize=(5.4, 3.4), layout="constrained")
    ax, (places, values) = figure.subplots(), (np.asarray(term[key]) for key in ("places", "value"))
    x, *y = [f"{symbol(name)} [{unit}]".removesuffix(" []") for name, unit in term["signals"].items()]
    name = f"{term['name']} [{term['unit']}]"
    if y:
        figure.colorbar(ax.tripcolor(places[:, 0], places[:, 1], values, shading="gouraud"), ax=ax, label=name)
    else:
        band(ax, places[:, 0], values, term["std"], AFTER, "learned")
    ax.set(xlabel=x, ylabel=y[0] if y else name)
    head(figure, f"The unknown term {term['name']}", [ax])
    return figure
