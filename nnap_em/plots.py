"""Figures in one style: what is learned in colour, truth in black, readings in grey; units on every axis.

Functions take plain arrays and return a `matplotlib.figure.Figure` that belongs to nobody; save it with `savefig`.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from .identify import FrictionTable

# Okabe & Ito's colours for the colour-blind; black is the truth, grey the readings.
BLUE, VERMILION, GREEN, PURPLE = "#0072B2", "#D55E00", "#009E73", "#CC79A7"
TRUTH, READING = "#000000", "#8A8A8A"
EPOCH_COLOURS = ("#F0B429", "#56B4E9", "#D55E00", "#0072B2")
NORMAL_90 = 1.6449
"""Half width of the central 90 % of a normal distribution, in standard deviations."""
STATES = (
    ("θ₁", "angle of joint 1 [rad]"),
    ("θ₂", "angle of joint 2 [rad]"),
    ("ω₁", "velocity of joint 1 [rad/s]"),
    ("ω₂", "velocity of joint 2 [rad/s]"),
)
"""Symbol and axis label of each state of a machine with two joints."""
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


def _styled(draw: Callable[..., Figure]) -> Callable[..., Figure]:
    def wrapped(*args: Any, **kwargs: Any) -> Figure:
        with rc_context(STYLE):
            return draw(*args, **kwargs)

    wrapped.__name__, wrapped.__doc__ = draw.__name__, draw.__doc__
    return wrapped


def _head(figure: Figure, title: str, axes: Sequence[Axes], note: str = "") -> None:
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


def _density(ax: Axes, visited: Float[Any, " sample"], low: float, high: float) -> None:
    """Strip below the curves: the darker, the more often a velocity was visited."""
    inside = np.ravel(np.asarray(visited, float))
    inside = inside[np.isfinite(inside)]
    count, _ = np.histogram(inside, np.linspace(low, high, 121))
    shade = np.sqrt(count / max(count.max(initial=0), 1))[None]
    ax.imshow(shade, extent=(low, high, 0, 1), aspect="auto", cmap="Greys", vmin=0, vmax=1.2, interpolation="nearest")
    ax.set(yticks=[], xlim=(low, high))
    ax.grid(False)
    ax.set_ylabel("visited", rotation=0, ha="right", va="center", fontsize=8)


def _unit(rotary: bool) -> tuple[str, str]:
    return ("joint velocity [rad/s]", "friction torque [N m]") if rotary else ("velocity [m/s]", "friction force [N]")


def _curve(ax: Axes, curve: Curve | FrictionTable, joint: int, colour: str, label: str) -> None:
    v, torque = np.asarray(curve.velocity)[joint], np.asarray(curve.torque)[joint]
    if curve.std is not None:
        half = NORMAL_90 * np.asarray(curve.std)[joint]
        ax.fill_between(v, torque - half, torque + half, color=colour, alpha=0.25, lw=0, label=f"{label}, 90 % band")
    ax.plot(v, torque, color=colour, label=label)


def _joint_title(joint: int, dof: int) -> str:
    return f"Joint {joint + 1}" if dof > 1 else ""


@_styled
def friction_figure(
    curve: Curve | FrictionTable,
    *,
    truth: Float[Any, "dof node"] | None = None,
    visited: Sequence[Float[Any, " sample"]] | None = None,
    rotary: Sequence[bool] | None = None,
    title: str = "Identified friction",
) -> Figure:
    """The learned map of each joint with its 90 % band, the truth where known, and where the data were.

    `visited` holds velocity samples of each joint; `rotary` says which joints turn (all, if left out).
    """
    velocity = np.asarray(curve.velocity)
    dof = velocity.shape[0]
    figure = Figure(figsize=(max(4.4, 4.0 * dof), 3.7), layout="constrained")
    strip = visited is not None
    grid = figure.subplots(2 if strip else 1, dof, squeeze=False, height_ratios=(1, 0.06) if strip else None)
    for j in range(dof):
        ax, v = grid[0, j], velocity[j]
        _curve(ax, curve, j, BLUE, "learned")
        if truth is not None:
            ax.plot(v, np.asarray(truth)[j], color=TRUTH, ls=(0, (4, 2)), lw=1.2, label="true")
        ax.axhline(0, color="#BBBBBB", lw=0.8, zorder=0)
        ax.set_title(_joint_title(j, dof))
        across, up = _unit(rotary is None or rotary[j])
        ax.set(xlim=(v[0], v[-1]), ylabel=up)
        if visited is not None:
            _density(grid[1, j], visited[j], v[0], v[-1])
            ax.tick_params(labelbottom=False)
        grid[-1, j].set_xlabel(across)
    _head(figure, title, list(grid[0]))
    return figure


@_styled
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
                _curve(ax, curve, j, colours[name], name)
            v = np.asarray(curves[epoch][next(iter(colours))].velocity)[j]
            if truth is not None:
                ax.plot(truth.velocity[j], truth.torque[j], color=TRUTH, ls=(0, (4, 2)), lw=1.2, label="true")
                span = 1.5 * float(np.max(np.abs(np.asarray(truth.torque)[j])))
                ax.set_ylim(-span, span)
            ax.set_xlim(v[0], v[-1])
            if j == 0:
                ax.set_title(f"epoch {epoch}")
            if visited is not None:
                _density(grid[2 * j + 1, column], visited[j], v[0], v[-1])
                ax.tick_params(labelbottom=False)
                if column:
                    grid[2 * j + 1, column].set_ylabel("")
            if column == 0:
                ax.set_ylabel(f"joint {j + 1}\n{_unit(True)[1]}")
            else:
                ax.tick_params(labelleft=False)
            if j == dof - 1:
                grid[-1, column].set_xlabel(_unit(True)[0])
    _head(figure, title, list(main.ravel()), note)
    return figure


def _states(figure: Figure, columns: Sequence[str], shared: bool = True) -> np.ndarray:
    grid = figure.subplots(4, len(columns), sharex=True, sharey="row" if shared else False, squeeze=False)
    for column, name in enumerate(columns):
        grid[0, column].set_title(name)
        grid[-1, column].set_xlabel("time [s]")
    return grid


def _limits(values: Sequence[Any], margin: float = 0.25) -> tuple[float, float]:
    """Limits around known values, so that a distribution that runs away does not flatten the picture."""
    finite = np.concatenate([np.ravel(np.asarray(v, float)) for v in values])
    finite = finite[np.isfinite(finite)]
    low, high = (float(np.min(finite)), float(np.max(finite))) if finite.size else (-1.0, 1.0)
    extra = margin * max(high - low, 1e-6)
    return low - extra, high + extra


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


@_styled
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
            ax.set_ylim(*_limits(shown or [np.asarray(last.mean)[:, state]], 0.25 if shown else 0.4))
            ax.set_xlim(float(record.t[0]), float(record.t[-1]))
            if column == 0 or latent:
                symbol, label = STATES[state]
                ax.set_ylabel(
                    f"latent state {state + 1}\n[own unit]" if hidden else f"{symbol}, {label}".replace(" [", "\n[")
                )
    _head(figure, title, list(grid.ravel()), note)
    return figure


@_styled
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
            ax.set_ylim(*_limits(shown or [np.asarray(band.mean)[:, state]], 0.25 if shown else 0.4))
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
    _head(figure, title, list(grid.ravel()), note)
    return figure
