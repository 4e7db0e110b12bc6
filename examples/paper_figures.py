"""The paper's figures 3 to 7: filtered and predicted distributions of all four states, friction during training."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from nnap_em.output.report.style import (
    BLUE,
    GREEN,
    NORMAL_90,
    PURPLE,
    READING,
    TRUTH,
    VERMILION,
    density,
    head,
    limits,
    styled,
)

EPOCH_COLOURS = ("#F0B429", "#56B4E9", "#D55E00", "#0072B2")
STATES = (
    ("θ₁", "angle of joint 1 [rad]"),
    ("θ₂", "angle of joint 2 [rad]"),
    ("ω₁", "velocity of joint 1 [rad/s]"),
    ("ω₂", "velocity of joint 2 [rad/s]"),
)
"""Symbol and axis label of each state of a machine with two joints."""


class Curve(NamedTuple):
    """A friction map of every joint, with its uncertainty where that is known."""

    velocity: Float[Any, "dof node"]
    """[rad/s]"""
    torque: Float[Any, "dof node"]
    """[N m]"""
    std: Float[Any, "dof node"] | None = None
    """[N m]"""


class Band(NamedTuple):
    """Distribution of every state over time."""

    t: Float[Any, " time"]
    """[s]"""
    mean: Float[Any, "time state"]
    std: Float[Any, "time state"]


class Record(NamedTuple):
    """What is known of one sequence."""

    t: Float[Any, " time"]
    """[s]"""
    y: Float[Any, "time obs"]
    measured: tuple[int, ...]
    """Which state each column of y reads."""
    truth: Float[Any, "time state"] | None = None


def _line(ax: Axes, curve: Curve, joint: int, colour: str, label: str) -> None:
    v, torque = np.asarray(curve.velocity)[joint], np.asarray(curve.torque)[joint]
    if curve.std is not None:
        half = NORMAL_90 * np.asarray(curve.std)[joint]
        ax.fill_between(v, torque - half, torque + half, color=colour, alpha=0.25, lw=0, label=f"{label}, 90 % band")
    ax.plot(v, torque, color=colour, label=label)


@styled
def friction_epochs_figure(
    curves: Mapping[int, Mapping[str, Curve]],
    *,
    truth: Curve | None = None,
    visited: Sequence[Float[Any, " sample"]] | None = None,
    title: str = "Learned friction during training",
    note: str = "",
) -> Figure:
    """Friction maps `curves[epoch][model]`: a column for each epoch, a row for each joint [paper, fig. 7]."""
    epochs = list(curves)
    dof = np.asarray(curves[epochs[0]][next(iter(curves[epochs[0]]))].velocity).shape[0]
    figure = Figure(figsize=(2.5 * len(epochs) + 0.6, 2.15 * dof + 1.0), layout="constrained")
    heights = [h for _ in range(dof) for h in (1, 0.06)] if visited is not None else [1] * dof
    grid = figure.subplots(len(heights), len(epochs), squeeze=False, height_ratios=heights)
    main = grid[:: 2 if visited is not None else 1]
    colours = dict(zip(curves[epochs[0]], (VERMILION, BLUE, GREEN, PURPLE), strict=False))
    for j in range(dof):
        for column, epoch in enumerate(epochs):
            ax = main[j, column]
            for name, curve in curves[epoch].items():
                _line(ax, curve, j, colours[name], name)
            v = np.asarray(curves[epoch][next(iter(colours))].velocity)[j]
            if truth is not None:
                ax.plot(truth.velocity[j], truth.torque[j], color=TRUTH, ls=(0, (4, 2)), lw=1.2, label="true")
                span = 1.5 * float(np.max(np.abs(np.asarray(truth.torque)[j])))
                ax.set_ylim(-span, span)
            ax.set_xlim(v[0], v[-1])
            if j == 0:
                ax.set_title(f"epoch {epoch}")
            if visited is not None:
                density(grid[2 * j + 1, column], visited[j], v[0], v[-1])
                ax.tick_params(labelbottom=False)
                if column:
                    grid[2 * j + 1, column].set_ylabel("")
            if column == 0:
                ax.set_ylabel(f"joint {j + 1}\nfriction torque [N m]")
            else:
                ax.tick_params(labelleft=False)
            if j == dof - 1:
                grid[-1, column].set_xlabel("joint velocity [rad/s]")
    head(figure, title, list(main.ravel()), note)
    return figure


def _states(figure: Figure, columns: Sequence[str], shared: bool = True) -> np.ndarray:
    grid = figure.subplots(4, len(columns), sharex=True, sharey="row" if shared else False, squeeze=False)
    for column, name in enumerate(columns):
        grid[0, column].set_title(name)
        grid[-1, column].set_xlabel("time [s]")
    return grid


def _band(ax: Axes, band: Band, state: int, colour: str, label: str, style: Any = "-") -> None:
    mean, half = np.asarray(band.mean)[:, state], NORMAL_90 * np.asarray(band.std)[:, state]
    ax.fill_between(np.asarray(band.t), mean - half, mean + half, color=colour, alpha=0.2, lw=0)
    ax.plot(np.asarray(band.t), mean, color=colour, ls=style, label=label)


def _known(ax: Axes, record: Record, state: int, hidden_truth: bool) -> list[Any]:
    """Readings and truth of a state; returns what the axis should show in full."""
    shown: list[Any] = []
    if state in record.measured:
        y = np.asarray(record.y)[:, record.measured.index(state)]
        ax.plot(np.asarray(record.t), y, ".", color=READING, ms=1.8, mew=0, alpha=0.8, label="readings", zorder=1)
        shown.append(y)
    if record.truth is not None and (hidden_truth or state in record.measured):
        ax.plot(
            np.asarray(record.t),
            np.asarray(record.truth)[:, state],
            color=TRUTH,
            ls=(0, (4, 2)),
            lw=1.1,
            label="true",
            zorder=5,
        )
        shown.append(np.asarray(record.truth)[:, state])
    return shown


@styled
def states_figure(
    bands: Mapping[str, Mapping[int, Band]],
    record: Record,
    *,
    latent: bool = False,
    title: str = "Filtered distributions during training",
    note: str = "",
) -> Figure:
    """Distributions `bands[model][epoch]` of all four states: a column for each model [paper, figs. 3 and 4].

    `latent`: the states that are not read have no meaning of their own, so that no truth is drawn.
    """
    figure = Figure(figsize=(4.4 * len(bands), 8.2), layout="constrained")
    grid = _states(figure, list(bands), shared=not latent)
    for column, epochs in enumerate(bands.values()):
        colours = EPOCH_COLOURS[-len(epochs) :]
        for state in range(4):
            ax = grid[state, column]
            for (epoch, band), colour in zip(epochs.items(), colours, strict=True):
                _band(ax, band, state, colour, f"epoch {epoch}")
            shown = _known(ax, record, state, not latent)
            hidden = latent and state not in record.measured
            last = list(epochs.values())[-1]
            ax.set_ylim(*limits(shown or [np.asarray(last.mean)[:, state]], 0.25 if shown else 0.4))
            ax.set_xlim(float(record.t[0]), float(record.t[-1]))
            if column == 0 or latent:
                symbol, label = STATES[state]
                ax.set_ylabel(
                    f"latent state {state + 1}\n[own unit]" if hidden else f"{symbol}, {label}".replace(" [", "\n[")
                )
    head(figure, title, list(grid.ravel()), note)
    return figure


@styled
def prediction_figure(
    bands: Mapping[str, Band],
    record: Record,
    given: float,
    *,
    latent: bool = False,
    title: str = "Predicted distributions",
    note: str = "",
) -> Figure:
    """Distributions from `given` [s] on, without readings after it: a column for each model [paper, figs. 5 and 6]."""
    figure = Figure(figsize=(4.4 * len(bands), 8.2), layout="constrained")
    grid = _states(figure, list(bands), shared=not latent)
    for column, (band, colour) in enumerate(zip(bands.values(), (VERMILION, BLUE, GREEN, PURPLE), strict=False)):
        for state in range(4):
            ax = grid[state, column]
            _band(
                ax,
                band,
                state,
                colour,
                "predicted, 90 % band" if len(bands) == 1 else list(bands)[column] + ", 90 % band",
            )
            shown = _known(ax, record, state, not latent)
            hidden = latent and state not in record.measured
            ax.set_ylim(*limits(shown or [np.asarray(band.mean)[:, state]], 0.25 if shown else 0.4))
            ax.set_xlim(float(record.t[0]), float(record.t[-1]))
            ax.axvspan(float(record.t[0]), given, color="#F1F1F1", lw=0, zorder=0)
            ax.axvline(given, color="#555555", lw=1.0)
            if state == 0:
                ax.text(given, 0.97, " prediction starts", transform=ax.get_xaxis_transform(), va="top", fontsize=8)
            if column == 0 or latent:
                symbol, label = STATES[state]
                ax.set_ylabel(
                    f"latent state {state + 1}\n[own unit]" if hidden else f"{symbol}, {label}".replace(" [", "\n[")
                )
    head(figure, title, list(grid.ravel()), note)
    return figure
