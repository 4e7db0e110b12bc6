"""Residuals of the declared model: the force that it lacks, and its one-step errors."""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import scipy.stats
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..diagnosis.residual import Names, Residual
from ..diagnosis.statistics import LAGS, autocorrelation
from .style import ACROSS, AFTER, BEFORE, NORMAL_90, ZERO_LINE, dotted, head, styled, symbol


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
    deviation = r[known] - table[0][place[known]]
    share = 1 - np.mean(deviation**2) / max(float(np.var(r[known])), 1e-300) if known.any() else 0.0
    return _Bins(0.5 * (edges[1:] + edges[:-1]), *table, share=float(share))


class _Cause(NamedTuple):
    label: str
    values: Float[np.ndarray, "seq time"]
    turn: bool = False
    """True for an angle that makes turns: `values` are continuous, and may be wrapped to one."""

    def wrapped(self) -> "_Cause":
        """The angle within its turn."""
        return _Cause(self.label, (self.values + np.pi) % (2 * np.pi) - np.pi)


def _causes(residual: Residual, names: Names) -> Iterator[_Cause]:
    dof = len(names.coordinates)
    rotary = [j for j in range(dof) if names.rotary[j]]
    for j, name in enumerate(names.coordinates):
        yield _Cause(f"{symbol(name)} [{names.unit(name)}]", residual.state[..., j], names.rotary[j])
    if len(rotary) > 1:
        label = " + ".join(symbol(names.coordinates[j]) for j in rotary) if len(rotary) < 4 else "sum of all angles"
        yield _Cause(f"{label} [rad]", residual.state[..., rotary].sum(-1), True)
    for j, name in enumerate(names.rates):
        yield _Cause(f"{symbol(name)} [{names.unit(name)}]", residual.state[..., dof + j])
    for i, name in enumerate(names.inputs):
        yield _Cause(f"input {name} [{names.unit(name)}]", residual.u[..., i])
    yield _Cause("time [s]", residual.t)


def _followed(residual: Residual) -> Residual:
    """Sequences that are followed; all where there is none."""
    return (residual if residual.used.any() else residual._replace(used=~residual.used)).followed()


_Side = tuple[Residual, str, str]
"""Residual, colour and name of a model."""


def _sides(residual: Residual, after: Residual | None, labels: tuple[str, str]) -> list[_Side]:
    sides = [(_followed(residual), BEFORE, labels[0])]
    return sides if after is None else [*sides, (_followed(after), AFTER, labels[1])]


class _Panel(NamedTuple):
    """The force at one joint against one cause, of every side."""

    kind: _Cause
    edges: Float[np.ndarray, " edge"]
    wrapped: bool
    curves: list[_Bins]

    @property
    def share(self) -> float:
        """Share of the variation under the declared model."""
        return max(self.curves[0].share, 0.0)


@styled
def residual_figure(residual: Residual, names: Names, after: Residual | None = None, *, bins: int = 24) -> Figure:
    """Residual generalised force of each joint against every candidate cause, binned; `after`: with the effects.

    A panel is headed by the share of the residual's variance that its cause accounts for.  With three joints or more
    there are too many: a row holds the causes of the largest shares.
    """
    sides = _sides(residual, after, ("declared model", "with what was found"))
    dof = len(names.coordinates)
    rows = [_panels(sides, names, j, bins) for j in range(dof)]
    if dof > 2:
        rows = [sorted(row, key=lambda panel: -panel.share)[:ACROSS] for row in rows]
    columns = min(ACROSS, len(rows[0]))
    deep = -(-len(rows[0]) // columns)
    figure = Figure(figsize=(2.45 * columns + 0.3, 1.75 * deep * dof + 0.75), layout="constrained")
    grid = figure.subplots(deep * dof, columns, squeeze=False).reshape(dof, -1)
    reaches = [_reach([curve for panel in row for curve in panel.curves]) for row in rows]
    for j, row in enumerate(rows):
        same_kind = [r for k, r in enumerate(reaches) if names.rotary[k] == names.rotary[j]]
        reach = max(reaches[j], 0.3 * max(same_kind))  # what matters little should look little
        best = max(panel.share for panel in row)
        for c, (ax, panel) in enumerate(zip(grid[j], row, strict=False)):
            _draw(ax, panel, sides, bold=panel.share == best > 0.1)
            ax.set_ylim(-reach, reach)
            if c % columns:
                ax.tick_params(labelleft=False)
            else:
                where = f"{names.joint(j + 1)}\n" if dof > 1 else ""
                ax.set_ylabel(f"{where}missing force [{names.force_unit(j + 1)}]", fontsize=8.5)
        for ax in grid[j, len(row) :]:
            ax.set_axis_off()
    title = "Force that the declared model lacks, against all that could cause it"
    note = "Line: mean. Dark band: 90 % band of the mean. Light band: 90 % of all samples. A flat line is good."
    head(figure, title, list(grid.ravel()), f"{note}\nPercentage: share of the force's variation that goes with it.")
    return figure


def _panels(sides: Sequence[_Side], names: Names, joint: int, bins: int) -> list[_Panel]:
    """The force at one joint against every cause."""
    out = []
    for causes in zip(*(_causes(residual, names) for residual, _, _ in sides), strict=True):
        kind, edges, wrapped = _scale(causes[0], sides[0][0].force[..., joint], bins)
        values = [(cause.wrapped() if wrapped else cause).values for cause in causes]
        forces = [residual.force[..., joint] for residual, _, _ in sides]
        out.append(_Panel(kind, edges, wrapped, [_binned(x, r, edges) for x, r in zip(values, forces, strict=True)]))
    return out


def _draw(ax: Axes, panel: _Panel, sides: Sequence[_Side], *, bold: bool) -> None:
    for binned, (_, colour, label) in zip(panel.curves, sides, strict=True):
        ax.fill_between(binned.centre, binned.low, binned.high, color=colour, alpha=0.13, lw=0)
        band = binned.mean - binned.half, binned.mean + binned.half
        ax.fill_between(binned.centre, *band, color=colour, alpha=0.4, lw=0)
        ax.plot(binned.centre, binned.mean, color=colour, label=label, lw=1.4)
    ax.axhline(0, color=ZERO_LINE, lw=0.7, zorder=0)
    ax.set(xlabel=panel.kind.label, xlim=(panel.edges[0], panel.edges[-1]))
    if panel.kind.turn or panel.wrapped:
        _turn_ticks(ax, panel.edges)
    share = ax.set_title(f"{100 * panel.share:.0f} %", fontsize=8, loc="right", pad=2, color=ZERO_LINE)
    if bold:
        share.set(color="#222222", weight="bold")


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
        return kind._replace(label=kind.label.replace(" [", " unwrapped [")), plain, False
    return round_._replace(label=kind.label.replace(" [", " wrapped [")), edges, True


def _edges(kind: _Cause, r: Float[np.ndarray, "seq time"], bins: int) -> Float[np.ndarray, " edge"]:
    x = kind.values[np.isfinite(kind.values) & np.isfinite(r)]
    low, high = np.percentile(x, [0.5, 99.5]) if x.size else (-1.0, 1.0)
    return np.linspace(low, high, bins + 1) if high > low else np.linspace(low - 0.5, low + 0.5, bins + 1)


def _turn_ticks(ax: Axes, edges) -> None:
    """Ticks at half turns, or as many as fit, where there are three or more."""
    span = (edges[-1] - edges[0]) / np.pi
    every = max(1, 2 * math.ceil(span / 10)) if span > 3 else 1
    ticks = [k for k in range(math.ceil(edges[0] / np.pi), math.floor(edges[-1] / np.pi + 1e-9) + 1) if k % every == 0]
    if len(ticks) > 2:
        ax.set_xticks([k * np.pi for k in ticks], [_half_turns(k) for k in ticks])


def _half_turns(k: int) -> str:
    return f"{'−' if k < 0 else ''}{abs(k) if abs(k) > 1 else ''}{'π' if k else '0'}"


@styled
def innovation_figure(before: Residual, names: Names, after: Residual | None = None) -> Figure:
    """Autocorrelation with its 95 % bounds and quantile plot of the innovations of every measured channel."""
    sides = _sides(before, after, ("before", "after")) if after else [(_followed(before), AFTER, "fit")]
    count = len(names.measured)
    pairs = 1 if count <= ACROSS else 2  # side by side
    deep = -(-count // pairs)
    figure = Figure(figsize=(7.4 if pairs == 1 else 10.4, 2.3 * deep + 0.7), layout="constrained")
    grid = figure.subplots(deep, 2 * pairs, squeeze=False).reshape(-1, 2)
    for i, ((across, quantile), name) in enumerate(zip(grid, names.measured, strict=False)):
        errors = [(residual.innovation[..., i], colour, label) for residual, colour, label in sides]
        _autocorrelations(across, errors)
        _quantiles(quantile, errors)
        across.set(ylabel=f"{symbol(name)}\nautocorrelation [-]", xlabel="lag [samples]")
        quantile.set(xlabel="quantile of a normal distribution [-]", ylabel="error over its\nstated std [-]")
    for ax in grid[count:].ravel():
        ax.set_axis_off()
    head(figure, "One-step errors: should be independent and bell-shaped", list(grid.ravel()))
    return figure


_Errors = Sequence[tuple[Float[np.ndarray, "_ _"], str, str]]  # the two fits may follow different sequences
"""Sides of one channel: innovations, colour and name of every side."""


def _autocorrelations(ax: Axes, errors: _Errors) -> None:
    correlations = [(*autocorrelation(e, LAGS), colour, label) for e, colour, label in errors]
    bound = 1.96 / np.sqrt(np.maximum(correlations[0][1][1:], 1))
    ax.fill_between(
        np.arange(1, bound.size + 1), -bound, bound, color="#DDDDDD", lw=0, label="95 % bounds if independent"
    )
    for r, _, colour, label in correlations:
        dotted(ax, np.arange(1, r.size), r[1:], colour, label)
    reach = max(0.1, *(1.15 * float(np.max(np.abs(r[1:]), initial=0)) for r, *_ in correlations))
    ax.axhline(0, color=ZERO_LINE, lw=0.7, zorder=0)
    ax.set(ylim=(-reach, reach), xlim=(0.5, LAGS + 0.5))


def _quantiles(ax: Axes, errors: _Errors) -> None:
    most = 3.0
    for e, colour, label in errors:
        x = np.sort(e[np.isfinite(e)])
        p = np.clip(np.concatenate([np.logspace(-4, -2, 20), np.linspace(0.01, 0.5, 40)]), 0.5 / x.size, 1)
        p = np.unique(np.concatenate([p, 1 - p]))
        expected, got = scipy.stats.norm.ppf(p), np.quantile(x, p)
        dotted(ax, expected, got, colour, label)
        most = max(most, float(np.max(np.abs(got))))
    ax.plot([-4, 4], [-4, 4], color=ZERO_LINE, lw=0.9, ls=(0, (4, 2)), label="a right model", zorder=0)
    most = min(most, 12.0) * 1.05
    ax.set(xlim=(-4, 4), ylim=(-most, most))
