"""Pictures of accepted effects: learned functions, and the first screening round."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ..effects.base import Curve
from .style import AFTER, READING, ZERO_LINE, band, head, styled, symbol


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
