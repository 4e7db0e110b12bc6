"""A designed experiment: what to play, what should then happen, and how narrow bands should become."""

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..experiment.experiment import Design
from ..residual.residual import Names
from .style import AFTER, BEFORE, READING, ZERO_LINE, head, limits, panels, styled, symbol


@styled
def bands_figure(friction: Sequence[Mapping[str, Any]], names: Names) -> Figure:
    """Standard deviation against velocity, a panel for each joint; `friction` as in design.json."""
    figure = Figure(figsize=(max(4.4, 3.8 * min(len(friction), 4)), 3.4 * -(-len(friction) // 4)), layout="constrained")
    (grid,) = panels(figure, len(friction))
    sides = {
        "std_now": (BEFORE, "now"),
        "std_same_time_of_old_inputs": (READING, "old inputs"),
        "std_expected": (AFTER, "designed"),
    }
    for ax, entry, rate in zip(grid, friction, names.rates, strict=True):
        for side, (colour, label) in sides.items():
            ax.plot(entry["velocity"], entry[side], color=colour, label=label)
        ax.set_xscale("symlog", linthresh=entry["near_rest_below"])
        ax.set_xticks([v for v in ax.get_xticks() if v == 0 or abs(v) >= entry["near_rest_below"]])
        ax.set_yscale("log")
        ax.axvspan(
            -entry["near_rest_below"], entry["near_rest_below"], color="#F1F1F1", lw=0, zorder=0, label="near rest"
        )
        ax.set(
            xlabel=f"velocity {symbol(rate)} [{names.unit(rate)}]",
            ylabel=f"std of friction [{names.force_unit(entry['joint'])}]",
        )
        ax.set_title(names.joint(entry["joint"]).replace("j", "J", 1) if len(friction) > 1 else "")
    head(figure, "How well friction is known", list(grid))
    return figure


@styled
def motion_figure(design: Design, names: Names, which: Sequence[int]) -> Figure:
    """Inputs and coordinates of some sequences, one below the other."""
    inputs, states = design.fitted.rig.input_columns, names.coordinates
    rows = len(inputs) + 2 * len(states)
    figure = Figure(figsize=(3.3 * max(len(which), 2), 0.6 + 1.35 * rows), layout="constrained")
    grid = figure.subplots(rows, len(which), sharex=True, sharey="row", squeeze=False)
    for column, i in enumerate(which):
        for k, ax in enumerate(grid[: len(inputs), column]):
            ax.step(design.t, design.u[i, :, k], where="post", color=ZERO_LINE, label="to be played")
            _fence(ax, design.limits.low[k], design.limits.high[k], [design.u[..., k]])
        for s, ax in enumerate(grid[len(inputs) :, column]):
            low, middle, high = (band[i, :, s] for band in (design.low, design.middle, design.high))
            ax.fill_between(design.t, low, high, color=AFTER, alpha=0.25, lw=0, label="98 % of motions")
            ax.plot(design.t, middle, color=AFTER, label="expected")
            _fence(ax, design.limits.lowest[s], design.limits.highest[s], [design.low[..., s], design.high[..., s]])
        grid[0, column].set_title(f"Sequence {i + 1}")
        grid[-1, column].set_xlabel("time [s]")
    units = [names.force_unit(j) for j in design.fitted.model.system.joints] + [
        names.unit(n) for n in (*states, *names.rates)
    ]
    for ax, name, unit in zip(grid[:, 0], (*inputs, *states, *names.rates), units, strict=True):
        ax.set_ylabel(f"{symbol(name)} [{unit}]")
    head(figure, "What to play, and what should happen", list(grid.ravel()))
    return figure


def _fence(ax: Axes, low: float, high: float, shown: Sequence[Any]) -> None:
    """Limits as lines, where they are near what is shown."""
    bottom, top = limits(shown, 0.3)
    for edge in (low, high):
        if bottom <= edge <= top:
            ax.axhline(edge, color=BEFORE, ls="--", lw=0.9, label="limit")
    ax.set_ylim(bottom, top)
