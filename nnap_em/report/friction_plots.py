"""Learned friction maps, before and after."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from ..fit.identify import FrictionTable
from ..residual.residual import Names
from .style import ACROSS, AFTER, BEFORE, band, density, head, limits, panels, styled, symbol


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
