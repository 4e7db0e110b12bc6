"""The two figures of `measured_loop.py`: the force that the model lacks, and how far predictions are off."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from nnap_em.output.report.style import AFTER, BEFORE, READING, TRUTH, ZERO_LINE, dotted, head, styled


class MissingTorque(NamedTuple):
    """Torque that a model lacks at one joint, and laws that may explain it, by sample."""

    title: str
    angle: Float[Any, " sample"]
    """[rad]"""
    torque: Float[Any, " sample"]
    """[N m]"""
    laws: Float[Any, " sample"] | None = None
    """Torque of the laws that the search found [N m]; None: it found none."""
    true: Float[Any, " sample"] | None = None
    """Torque of the law that was taken out of the log [N m]."""


BINS = 24
FEWEST = 20
"""Samples of a bin whose mean is drawn."""


@styled
def finding_figure(panels: Sequence[MissingTorque], joint: int) -> Figure:
    """The missing torque against the angle, a panel for each log; samples, and means over bins of the angle.

    Every torque is drawn without its mean: a constant is part of the learned friction.
    """
    figure = Figure(figsize=(3.7 * len(panels) + 0.3, 3.7), layout="constrained")
    axes = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for ax, panel in zip(axes, panels, strict=True):
        _draw(ax, panel)
        ax.set(title=panel.title, xlabel=f"angle of joint {joint} [rad]")
    reach = 1.6 * max(np.percentile(np.abs(panel.torque - panel.torque.mean()), 97) for panel in panels)
    axes[0].set(ylabel="torque that the model lacks [N m]", ylim=(-reach, reach))
    head(figure, f"What the model of the machine lacks at joint {joint}", list(axes))
    return figure


def _draw(ax: Axes, panel: MissingTorque) -> None:
    torque = panel.torque - np.mean(panel.torque)
    ax.plot(panel.angle, torque, ".", color=READING, ms=1.6, mew=0, alpha=0.5, label="each sample", rasterized=True)
    ax.plot(*_means(panel.angle, torque), "o", color=BEFORE, ms=4, zorder=3)
    ax.plot([], [], "o", color=BEFORE, ms=1.2, mew=0, label="their mean")  # marks of a legend are four times as large
    if panel.laws is not None:
        ax.plot(*_means(panel.angle, panel.laws), color=AFTER, lw=2.2, label="law that was found", zorder=4)
    if panel.true is not None:
        dashes = (0, (4, 2))
        ax.plot(*_means(panel.angle, panel.true), color=TRUTH, ls=dashes, lw=1.4, label="law taken out", zorder=5)
    ax.axhline(0, color=ZERO_LINE, lw=0.7, zorder=0)


def _means(angle: Float[Any, " sample"], torque: Float[Any, " sample"]) -> tuple[list[float], list[float]]:
    """Centres of bins of the angle, and the mean torque in each, without the mean of all."""
    edges = np.linspace(*np.percentile(angle, (0.5, 99.5)), BINS + 1)
    place = np.digitize(angle, edges) - 1
    filled = [b for b in range(BINS) if np.count_nonzero(place == b) >= FEWEST]
    centres = [float(np.mean(angle[place == b])) for b in filled]
    return centres, [float(np.mean(torque[place == b]) - np.mean(torque)) for b in filled]


@styled
def errors_figure(horizons: Sequence[float], errors: Mapping[str, Mapping[str, Sequence[float]]]) -> Figure:
    """Root mean square prediction errors by horizon, `errors[model][column]`; the last model is the goal."""
    looks = ((BEFORE, "s"), (AFTER, "o"))
    columns = [name for name in next(iter(errors.values())) if name.startswith("theta")]
    figure = Figure(figsize=(3.7 * len(columns) + 0.3, 3.5), layout="constrained")
    axes = figure.subplots(1, len(columns), squeeze=False)[0]
    for ax, column in zip(axes, columns, strict=True):
        *sides, (goal, best) = errors.items()
        for (label, values), (colour, mark) in zip(sides, looks, strict=True):
            dotted(ax, horizons, values[column], colour, label, mark)
        ax.plot(horizons, best[column], color=TRUTH, ls=(0, (4, 2)), lw=1.4, label=goal)
        ax.set(title=f"joint {column.removeprefix('theta')}", xlabel="time predicted ahead [s]", xlim=(0, None))
        ax.set_ylim(0, None)
    axes[0].set_ylabel("root mean square error [rad]")
    head(figure, "How far predictions of unseen recordings are off", list(axes))
    return figure
