"""Figures of a diagnosis: what the declared model lacks, and how far that falls.  Before in vermilion, after in blue.

Functions take plain arrays and return a `matplotlib.figure.Figure` that belongs to nobody; save it with `savefig`.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, NullFormatter, NullLocator

from .identify import FrictionTable
from .plots import BLUE, NORMAL_90, READING, VERMILION, _curve, _density, _head, _joint_title, _limits, _styled, _unit
from .residual import LAGS, Names, Residual, autocorrelation

BEFORE, AFTER = VERMILION, BLUE
_SUBSCRIPT = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")


def symbol(name: str) -> str:
    """How a column is written in a figure: theta1 is θ₁, dtheta1 is ω₁; others as they are."""
    for start, sign in (("dtheta", "ω"), ("theta", "θ")):
        if name.startswith(start):
            return sign + name.removeprefix(start).translate(_SUBSCRIPT)
    return name


class _Bins(NamedTuple):
    centre: Float[np.ndarray, " bin"]
    mean: Float[np.ndarray, " bin"]
    half: Float[np.ndarray, " bin"]
    """Half width of the 90 % band of the mean."""
    low: Float[np.ndarray, " bin"]
    high: Float[np.ndarray, " bin"]
    share: float
    """Part of the variance that the bins account for."""


def _binned(x: Float[np.ndarray, "seq time"], r: Float[np.ndarray, "seq time"], edges) -> _Bins:
    """Mean of r over bins of x, its extremes cut off, with bands; that of the mean by its scatter over sequences."""
    seen = np.isfinite(x) & np.isfinite(r)
    low, high = np.percentile(r[seen], [0.5, 99.5]) if seen.any() else (0.0, 0.0)
    r = np.clip(r, low, high)
    place = np.where(seen, np.digitize(x, edges) - 1, -1)
    rows = []
    for b in range(len(edges) - 1):
        inside = place == b
        count = inside.sum()
        parts = inside.any(1).sum()
        if count < 20 or parts < min(2, r.shape[0]):
            rows.append([math.nan] * 4)
            continue
        mean = r[inside].mean()
        sums = np.sum(np.where(inside, r - mean, 0.0), axis=1)
        error = math.sqrt(np.sum(sums**2) * parts / (parts - 1)) / count if parts > 1 else math.nan
        rows.append([mean, NORMAL_90 * error, *np.percentile(r[inside], [5, 95])])
    table = np.asarray(rows).T
    known = seen & (place >= 0) & (place < len(edges) - 1)
    known[known] = np.isfinite(table[0][place[known]])
    rest = r[known] - table[0][place[known]]
    share = 1 - np.mean(rest**2) / max(float(np.var(r[known])), 1e-300) if known.any() else 0.0
    return _Bins(0.5 * (edges[1:] + edges[:-1]), *table, share=float(share))


class _Cause(NamedTuple):
    label: str
    values: Float[np.ndarray, "seq time"]
    turn: bool = False
    """True for an angle that makes turns: `values` are continuous, and may be wrapped to one."""

    def wrapped(self) -> "_Cause":
        """The angle within its turn."""
        return _Cause(self.label, (self.values + np.pi) % (2 * np.pi) - np.pi)


def _causes(found: Residual, names: Names) -> Iterator[_Cause]:
    dof = len(names.coordinates)
    rotary = [j for j in range(dof) if names.rotary[j]]
    for j, name in enumerate(names.coordinates):
        yield _Cause(f"{symbol(name)} [{names.unit(name)}]", found.state[..., j], names.rotary[j])
    if len(rotary) > 1:
        label = " + ".join(symbol(names.coordinates[j]) for j in rotary)
        yield _Cause(f"{label} [rad]", found.state[..., rotary].sum(-1), True)
    for j, name in enumerate(names.rates):
        yield _Cause(f"{symbol(name)} [{names.unit(name)}]", found.state[..., dof + j])
    for i, name in enumerate(names.inputs):
        yield _Cause(f"input {name} [{names.unit(name)}]", found.u[..., i])
    yield _Cause("time [s]", found.t)


def _followed(found: Residual) -> Residual:
    used = found.used if found.used.any() else ~found.used
    return found._replace(**{f: getattr(found, f)[used] for f in found._fields if f != "used"})


@_styled
def residual_figure(
    residual: Residual,
    names: Names,
    after: Residual | None = None,
    *,
    bins: int = 24,
    title: str = "Force that the declared model lacks, against all that could cause it",
    note: str = "Line: mean. Dark band: 90 % band of the mean. Light band: 90 % of all samples. A flat line is good.",
) -> Figure:
    """Residual generalised force of each joint against every candidate cause, binned; `after`: with the effects.

    A panel is headed by the share of the residual's variance that its cause accounts for.
    """
    sides = _sides(residual, after)
    first = sides[0][0]
    dof, kinds = first.force.shape[-1], list(_causes(first, names))
    columns = min(4, len(kinds))
    deep = -(-len(kinds) // columns)
    figure = Figure(figsize=(2.45 * columns + 0.3, 1.75 * deep * dof + 0.75), layout="constrained")
    grid = figure.subplots(deep * dof, columns, squeeze=False)
    drawn: list[list[tuple[Axes, list[_Bins]]]] = []
    for j in range(dof):
        panels = grid[deep * j : deep * (j + 1)].ravel()
        drawn.append([(ax, _panel(ax, sides, names, j, c, bins)) for c, ax in enumerate(panels[: len(kinds)])])
        for ax in panels[len(kinds) :]:
            ax.set_axis_off()
    reaches = [_reach([b for _, curves in row for b in curves]) for row in drawn]
    for j, row in enumerate(drawn):
        alike = [r for k, r in enumerate(reaches) if names.rotary[k] == names.rotary[j]]
        reach = max(reaches[j], 0.3 * max(alike))  # what matters little should look little
        best = max(curves[0].share for _, curves in row)
        for c, (ax, curves) in enumerate(row):
            ax.set_ylim(-reach, reach)
            share = max(curves[0].share, 0.0)
            told = ax.set_title(f"{100 * share:.0f} %", fontsize=8, loc="right", pad=2, color="#777777")
            if share == best > 0.1:
                told.set(color="#222222", weight="bold")
            if c % columns:
                ax.tick_params(labelleft=False)
            else:
                ax.set_ylabel(_force_label(j, names), fontsize=8.5)
    _head(figure, title, list(grid.ravel()), f"{note}\nPercentage: share of the force's variation that goes with it.")
    return figure


@_styled
def cause_figure(
    residual: Residual,
    names: Names,
    after: Residual | None = None,
    *,
    bins: int = 30,
    title: str | None = None,
) -> Figure:
    """The one panel of `residual_figure` in which the residual goes most with its cause."""
    sides = _sides(residual, after)
    first = sides[0][0]
    places = [(j, c) for j in range(first.force.shape[-1]) for c in range(len(list(_causes(first, names))))]
    sizes = [float(np.nanstd(first.force[..., j])) for j in range(first.force.shape[-1])]
    figure = Figure(figsize=(5.4, 3.5), layout="constrained")
    ax = figure.subplots()

    def weight(place: tuple[int, int]) -> float:
        """Share of the variation, less where the force is small beside that at another joint of the kind."""
        j, c = place
        alike = max(s for s, turns in zip(sizes, names.rotary, strict=True) if turns == names.rotary[j])
        kind, edges, _ = _scale(list(_causes(first, names))[c], first.force[..., j], bins)
        return _binned(kind.values, first.force[..., j], edges).share * sizes[j] / max(alike, 1e-300)

    j, c = max(places, key=weight)
    curves = _panel(ax, sides, names, j, c, bins)
    reach = _reach(curves)
    ax.set_ylim(-reach, reach)
    ax.set_ylabel(_force_label(j, names).replace("\n", ": "))
    _head(figure, title or f"Missing {_kind(j, names)} against its likeliest cause", [ax])
    return figure


_Side = tuple[Residual, str, str]
"""What was left, its colour and its name."""


def _sides(residual: Residual, after: Residual | None) -> list[_Side]:
    sides = [(_followed(residual), BEFORE, "declared model")]
    return sides if after is None else [*sides, (_followed(after), AFTER, "with what was found")]


def _panel(ax: Axes, sides: Sequence[_Side], names: Names, joint: int, place: int, bins: int) -> list[_Bins]:
    """The force at one joint against one cause; what was drawn, for the limits."""
    first = sides[0][0]
    kind, edges, wrap = _scale(list(_causes(first, names))[place], first.force[..., joint], bins)
    curves = []
    for found, colour, label in sides:
        cause = list(_causes(found, names))[place]
        binned = _binned((cause.wrapped() if wrap else cause).values, found.force[..., joint], edges)
        ax.fill_between(binned.centre, binned.low, binned.high, color=colour, alpha=0.13, lw=0)
        band = binned.mean - binned.half, binned.mean + binned.half
        ax.fill_between(binned.centre, *band, color=colour, alpha=0.4, lw=0)
        ax.plot(binned.centre, binned.mean, color=colour, label=label, lw=1.4)
        curves.append(binned)
    ax.axhline(0, color="#777777", lw=0.7, zorder=0)
    ax.set(xlabel=kind.label, xlim=(edges[0], edges[-1]))
    if kind.turn or wrap:
        _turn_ticks(ax, edges)
    return curves


def _kind(joint: int, names: Names) -> str:
    return "torque" if names.rotary[joint] else "force"


def _force_label(joint: int, names: Names) -> str:
    where = f"joint {joint + 1}\n" if len(names.coordinates) > 1 else ""
    return f"{where}missing {_kind(joint, names)} [{names.force_unit(joint)}]"


def _reach(curves: Sequence[_Bins]) -> float:
    """Half height of a panel: means and their bands in full, single samples as far as they do not hide these."""
    means = [float(np.nanmax(np.abs(b.mean) + np.nan_to_num(b.half))) for b in curves if np.isfinite(b.mean).any()]
    single = np.concatenate([np.abs(np.concatenate([b.low, b.high])) for b in curves])
    single = single[np.isfinite(single)]
    wide = float(np.median(single)) if single.size else 0.0
    return 1.15 * max([*means, min(wide, 4 * max(means, default=0.0)), 1e-12])


def _scale(
    kind: _Cause, r: Float[np.ndarray, "seq time"], bins: int
) -> tuple[_Cause, Float[np.ndarray, " edge"], bool]:
    """The cause and its bins; an angle that makes turns as it is or wrapped, whichever the force goes with."""
    plain = _edges(kind, r, bins)
    if not kind.turn or plain[-1] - plain[0] < 2 * np.pi:
        return kind, plain, False
    round_ = kind.wrapped()
    edges = np.linspace(-np.pi, np.pi, bins + 1)
    if _binned(kind.values, r, plain).share > _binned(round_.values, r, edges).share + 0.02:
        return kind._replace(label=kind.label.replace(" [", " over turns [")), plain, False
    return round_._replace(label=kind.label.replace(" [", " in its turn [")), edges, True


def _edges(kind: _Cause, r: Float[np.ndarray, "seq time"], bins: int) -> Float[np.ndarray, " edge"]:
    x = kind.values[np.isfinite(kind.values) & np.isfinite(r)]
    low, high = np.percentile(x, [0.5, 99.5]) if x.size else (-1.0, 1.0)
    return np.linspace(low, high, bins + 1) if high > low else np.linspace(low - 0.5, low + 0.5, bins + 1)


def _turn_ticks(ax: Axes, edges) -> None:
    """Ticks at half turns, or as many as fit."""
    span = (edges[-1] - edges[0]) / np.pi
    if span < 1.2:
        return
    every = max(1, 2 * math.ceil(span / 10)) if span > 3 else 1
    ticks = [k for k in range(math.ceil(edges[0] / np.pi), math.floor(edges[-1] / np.pi + 1e-9) + 1) if k % every == 0]
    ax.set_xticks([k * np.pi for k in ticks], [_half_turns(k) for k in ticks])


def _half_turns(k: int) -> str:
    return f"{'−' if k < 0 else ''}{abs(k) if abs(k) > 1 else ''}{'π' if k else '0'}"


@_styled
def innovation_figure(
    before: Residual,
    names: Names,
    after: Residual | None = None,
    *,
    lags: int = LAGS,
    title: str = "One-step errors: should be independent and bell-shaped",
) -> Figure:
    """Autocorrelation with its 95 % bounds and quantile plot of the innovations of every measured channel."""
    sides = [(_followed(before), BEFORE, "before")] + ([(_followed(after), AFTER, "after")] if after else [])
    count = len(names.measured)
    figure = Figure(figsize=(7.4, 2.3 * count + 0.7), layout="constrained")
    grid = figure.subplots(count, 2, squeeze=False)
    for i, name in enumerate(names.measured):
        across, quantile = grid[i]
        reach, most = 0.1, 3.0
        for k, (found, colour, label) in enumerate(sides):
            e = found.innovation[..., i]
            r, pairs = autocorrelation(e, lags)
            lag = np.arange(1, r.size)
            if k == 0:
                bound = 1.96 / np.sqrt(np.maximum(pairs[1:], 1))
                across.fill_between(lag, -bound, bound, color="#DDDDDD", lw=0, label="95 % bounds if independent")
            across.plot(lag, r[1:], color=colour, lw=1.0, label=label)
            across.plot(lag, r[1:], "o", color=colour, ms=3)
            reach = max(reach, 1.15 * float(np.max(np.abs(r[1:]), initial=0)))
            x = np.sort(e[np.isfinite(e)])
            p = np.unique(
                np.clip(np.concatenate([np.logspace(-4, -2, 20), np.linspace(0.01, 0.5, 40)]), 0.5 / x.size, 1)
            )
            p = np.unique(np.concatenate([p, 1 - p]))
            expected = _normal_quantiles(p)
            got = np.quantile(x, p)
            quantile.plot(expected, got, color=colour, lw=0.8, label=label)
            quantile.plot(expected, got, "o", color=colour, ms=2.5)
            most = max(most, float(np.max(np.abs(got[np.abs(expected) < 3.2]))))
        quantile.plot([-4, 4], [-4, 4], color="#777777", lw=0.9, ls=(0, (4, 2)), label="a right model", zorder=0)
        across.axhline(0, color="#777777", lw=0.7, zorder=0)
        across.set(ylim=(-reach, reach), xlim=(0.5, lags + 0.5), ylabel=f"{symbol(name)}\nautocorrelation [-]")
        most = min(most, 12.0) * 1.05
        quantile.set(xlim=(-4, 4), ylim=(-most, most), ylabel="error over its\nstated std [-]")
    grid[-1, 0].set_xlabel("lag [samples]")
    grid[-1, 1].set_xlabel("quantile of a normal distribution [-]")
    _head(figure, title, list(grid.ravel()))
    return figure


def _normal_quantiles(p: Float[np.ndarray, " point"]) -> Float[np.ndarray, " point"]:
    from statistics import NormalDist

    return np.asarray([NormalDist().inv_cdf(float(v)) for v in p])


@_styled
def error_figure(
    error: Mapping[str, Any],
    units: Mapping[str, str] | None = None,
    *,
    title: str = "Prediction error on test sequences",
) -> Figure:
    """Root mean square error against horizon, before and after; `error` as in report.json, a panel for each column."""
    columns = list(error["before"])
    figure = Figure(figsize=(3.3 * len(columns) + 0.4, 3.3), layout="constrained")
    grid = figure.subplots(1, len(columns), squeeze=False)[0]
    horizons = np.asarray(error["horizons_s"], float)
    for ax, name in zip(grid, columns, strict=True):
        for side, colour, mark in (("before", BEFORE, "s"), ("after", AFTER, "o")):
            values = np.asarray([math.nan if v is None else v for v in error[side][name]], float)
            values = np.where(values > 0, values, np.nan)
            ax.plot(horizons, values, color=colour, label=side)
            ax.plot(horizons, values, mark, color=colour, ms=4)
        ax.set(xscale="log", title=symbol(name), xlabel="time predicted ahead [s]")
        ax.set_ylabel(f"rms error [{(units or {}).get(name) or _guess(name)}]")
        ax.xaxis.set_major_locator(FixedLocator(list(horizons)))
        ax.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
        ax.xaxis.set_minor_locator(NullLocator())
        if not any(np.isfinite(line.get_ydata()).any() for line in ax.lines):
            continue  # no test sequence is longer than what is given, and a logarithmic axis needs a number
        ax.set_yscale("log")
        low, high = ax.get_ylim()
        if high < 30 * low:
            ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            ax.yaxis.set_minor_formatter(NullFormatter())
        ax.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:g}"))
    _head(figure, title, list(grid))
    return figure


def _guess(name: str) -> str:
    angle = name.removeprefix("d").startswith("theta")
    return ("rad" if angle else "m") + ("/s" if name.startswith("d") else "")


@_styled
def friction_pair_figure(
    before: FrictionTable,
    after: FrictionTable,
    visited: Sequence[Float[Any, " sample"]] | None = None,
    *,
    rotary: Sequence[bool] | None = None,
    title: str = "Learned friction: an undeclared effect bends it",
) -> Figure:
    """Both friction maps of each joint with their 90 % bands; `visited`: velocity samples of each joint [rad/s]."""
    dof = np.asarray(before.velocity).shape[0]
    figure = Figure(figsize=(max(4.4, 4.0 * dof), 3.8), layout="constrained")
    strip = visited is not None
    grid = figure.subplots(2 if strip else 1, dof, squeeze=False, height_ratios=(1, 0.06) if strip else None)
    for j in range(dof):
        ax, v = grid[0, j], np.asarray(before.velocity)[j]
        _curve(ax, before, j, BEFORE, "before")
        _curve(ax, after, j, AFTER, "after")
        ax.axhline(0, color="#BBBBBB", lw=0.8, zorder=0)
        ax.set_title(_joint_title(j, dof))
        across, up = _unit(rotary is None or rotary[j])
        ax.set(xlim=(v[0], v[-1]), ylabel=up)
        ax.set_ylim(*_limits([np.asarray(before.torque)[j], np.asarray(after.torque)[j]], 0.2))
        if visited is not None:
            _density(grid[1, j], visited[j], v[0], v[-1])
            ax.tick_params(labelbottom=False)
        grid[-1, j].set_xlabel(across)
    _head(figure, title, list(grid[0]))
    return figure


Pair = tuple[Float[Any, "time state"], Float[Any, "time state"]]
"""Mean and standard deviation."""


@_styled
def prediction_pair_figure(
    t: Float[Any, " time"],
    y: Float[Any, "time obs"],
    names: Names,
    before: Pair,
    after: Pair,
    given: float,
    *,
    title: str | None = None,
) -> Figure:
    """Predicted distributions before and after, a row for each state; readings up to `given` [s] were used."""
    states = (*names.coordinates, *names.rates)
    figure = Figure(figsize=(7.6, 1.75 * len(states) + 0.7), layout="constrained")
    grid = figure.subplots(len(states), 1, sharex=True, squeeze=False)[:, 0]
    t, y = np.asarray(t) - float(np.asarray(t)[0]), np.asarray(y)
    for s, (ax, name) in enumerate(zip(grid, states, strict=True)):
        for (mean, std), colour, label in ((before, BEFORE, "before"), (after, AFTER, "after")):
            m, half = np.asarray(mean)[:, s], NORMAL_90 * np.asarray(std)[:, s]
            ax.fill_between(t, m - half, m + half, color=colour, alpha=0.2, lw=0, label=f"{label}, 90 % band")
            ax.plot(t, m, color=colour, label=label, lw=1.3)
        if name in names.measured:
            shown = y[:, names.measured.index(name)]
            ax.plot(t, shown, ".", color="#222222", ms=2.2, mew=0, label="readings", zorder=6)
        else:
            shown = np.asarray(after[0])[:, s]
        ax.set_ylim(*_limits([shown], 0.35))
        ax.axvspan(float(t[0]), given, color="#F1F1F1", lw=0, zorder=0)
        ax.axvline(given, color="#555555", lw=1.0)
        ax.set_ylabel(f"{symbol(name)} [{names.unit(name)}]" + ("" if name in names.measured else "\nnot measured"))
        if s == 0:
            ax.text(given, 0.97, " prediction starts", transform=ax.get_xaxis_transform(), va="top", fontsize=8)
    grid[-1].set(xlabel="time [s]", xlim=(float(t[0]), float(t[-1])))
    _head(figure, title or f"One test sequence, predicted from its first {given:g} s", list(grid))
    return figure


@_styled
def effect_figure(
    x: Float[Any, " point"],
    mean: Float[Any, " point"],
    std: Float[Any, " point"] | None = None,
    *,
    label_x: str,
    label_y: str,
    title: str = "What was found",
    visited: Float[Any, " sample"] | None = None,
) -> Figure:
    """A learned unknown function with its 90 % band, and where the data were."""
    strip = visited is not None
    figure = Figure(figsize=(5.4, 3.4), layout="constrained")
    grid = figure.subplots(2 if strip else 1, 1, squeeze=False, height_ratios=(1, 0.06) if strip else None)[:, 0]
    x, mean = np.asarray(x), np.asarray(mean)
    if std is not None:
        half = NORMAL_90 * np.asarray(std)
        grid[0].fill_between(x, mean - half, mean + half, color=AFTER, alpha=0.25, lw=0, label="90 % band")
    grid[0].plot(x, mean, color=AFTER, label="learned")
    grid[0].axhline(0, color="#777777", lw=0.7, zorder=0)
    grid[0].set(ylabel=label_y, xlim=(x[0], x[-1]))
    if visited is not None:
        _density(grid[1], visited, x[0], x[-1])
        grid[0].tick_params(labelbottom=False)
    grid[-1].set_xlabel(label_x)
    _head(figure, title, [grid[0]])
    return figure


@_styled
def screen_figure(
    entries: Sequence[tuple[str, float]],
    *,
    chosen: str | None = None,
    best: int = 10,
    title: str = "What the first look suggested",
) -> Figure:
    """Expected gain in log-likelihood of the `best` candidates, as bars; the `chosen` label in colour."""
    top = sorted(entries, key=lambda e: -e[1])[:best]
    figure = Figure(figsize=(7.4, 0.28 * max(len(top), 1) + 1.0), layout="constrained")
    ax = figure.subplots()
    colours = [AFTER if label == chosen else READING for label, _ in top]
    ax.barh([label for label, _ in top], [gain for _, gain in top], color=colours, height=0.7)
    ax.invert_yaxis()
    ax.grid(axis="y", visible=False)
    ax.axvline(0, color="#777777", lw=0.7)
    ax.set_xlabel("expected gain in log-likelihood [nat]")
    _head(figure, title, [ax])
    return figure
