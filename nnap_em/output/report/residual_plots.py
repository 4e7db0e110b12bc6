"""Residuals of the declared model: the force that it lacks, and its one-step errors."""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from ...explain.diagnosis.residual import Names, Residual
from ...explain.diagnosis.statistics import LAGS, autocorrelation
from .style import ACROSS, AFTER, BEFORE, NORMAL_90, ZERO_LINE, band, dotted, head, panels, styled, symbol
from .tables import INNER


class _Bins(NamedTuple):
    """Mean of a force over bins of a cause, with the standard deviation of the mean, which is NaN of one sequence."""

    centre: Float[np.ndarray, " bin"]
    mean: Float[np.ndarray, " bin"]
    std: Float[np.ndarray, " bin"]
    share: float
    """Part of the variance that the bins account for."""


def _binned(x: Float[np.ndarray, "seq time"], r: Float[np.ndarray, "seq time"], edges) -> _Bins:
    """Mean of r over bins of x, its extremes cut off, with its band by the scatter over sequences."""
    bins, place = len(edges) - 1, np.digitize(x, edges) - 1
    seen = np.isfinite(x) & np.isfinite(r) & (place >= 0) & (place < bins)
    low, high = np.percentile(r[seen], INNER) if seen.any() else (0.0, 0.0)
    force, at = np.clip(r[seen], low, high), (bins * np.arange(len(r))[:, None] + place)[seen]
    count, total = (np.bincount(at, each, bins * len(r)).reshape(-1, bins) for each in (None, force))
    rows, parts = count.sum(axis=0), (count > 0).sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = np.where((rows >= 20) & (parts >= min(2, len(r))), total.sum(axis=0) / rows, np.nan)
        scatter = np.sum((total - count * mean) ** 2, axis=0) * np.where(parts > 1, parts / (parts - 1), np.nan)
    left = force - mean[place[seen]]
    known = np.isfinite(left)
    share = 1 - np.mean(left[known] ** 2) / max(float(np.var(force[known])), 1e-300) if known.any() else 0.0
    std = np.sqrt(scatter) / np.maximum(rows, 1)
    return _Bins(0.5 * (edges[1:] + edges[:-1]), mean, std, max(float(share), 0.0))


def _causes(residuals: Sequence[Residual], names: Names) -> Iterator[tuple[str, list[Float[np.ndarray, "seq time"]]]]:
    """Label, and values of every side, of everything that may cause a force."""
    dof, states = len(names.coordinates), (*names.coordinates, *names.rates)
    signals: list[tuple[str, str, Callable]] = [
        (symbol(name), names.unit(name), lambda r, j=j: r.state[..., j]) for j, name in enumerate(states)
    ]
    rotary = [j for j in range(dof) if names.rotary[j]]
    if len(rotary) > 1:
        label = " + ".join(symbol(names.coordinates[j]) for j in rotary) if len(rotary) < 4 else "sum of all angles"
        signals.insert(dof, (label, "rad", lambda r: r.state[..., rotary].sum(-1)))
    signals += [(f"input {name}", names.unit(name), lambda r, i=i: r.u[..., i]) for i, name in enumerate(names.inputs)]
    for label, unit, of in (*signals, ("time", "s", lambda r: r.t)):
        values = [of(residual) for residual in residuals]
        if unit == "rad" and np.ptp(np.nanpercentile(values[0], INNER)) > 2 * np.pi:  # within a turn
            label, values = f"{label} wrapped", [(angle + np.pi) % (2 * np.pi) - np.pi for angle in values]
        yield f"{label} [{unit}]", values


def _followed(residual: Residual) -> Residual:
    return (residual if residual.used.any() else residual._replace(used=~residual.used)).followed()


def _sides(residual: Residual, after: Residual | None, labels: tuple[str, str]) -> list[tuple[Residual, str, str]]:
    sides = [(_followed(residual), BEFORE, labels[0])]
    return sides if after is None else [*sides, (_followed(after), AFTER, labels[1])]


_Panel = tuple[str, list[_Bins]]
"""The force at one joint against one cause: the label of the cause, and the curve of every side."""


@styled
def residual_figure(residual: Residual, names: Names, after: Residual | None = None, *, bins: int = 24) -> Figure:
    """Residual generalised force of each joint against every candidate cause, binned; `after`: with the effects.

    A panel is headed by the share of the residual's variance that its cause accounts for.  With three joints or more
    there are too many: a row holds the causes of the largest shares.
    """
    sides = _sides(residual, after, ("declared model", "with what was found"))
    dof = len(names.coordinates)
    rows = [_panels([side for side, _, _ in sides], names, j, bins) for j in range(dof)]
    if dof > 2:
        rows = [sorted(row, key=_share, reverse=True)[:ACROSS] for row in rows]
    columns = min(ACROSS, len(rows[0]))
    deep = -(-len(rows[0]) // columns)
    figure = Figure(figsize=(2.45 * columns + 0.3, 1.75 * deep * dof + 0.75), layout="constrained")
    grid = figure.subplots(deep * dof, columns, squeeze=False).reshape(dof, -1)
    reaches = [_reach(row) for row in rows]
    for j, row in enumerate(rows):
        same_kind = [r for k, r in enumerate(reaches) if names.rotary[k] == names.rotary[j]]
        reach = max(reaches[j], 0.3 * max(same_kind))  # what matters little should look little
        best = max(map(_share, row))
        for c, (ax, panel) in enumerate(zip(grid[j], row, strict=False)):
            for curve, (_, colour, label) in zip(panel[1], sides, strict=True):
                band(ax, curve.centre, curve.mean, curve.std, colour, label)
            ax.axhline(0, color=ZERO_LINE, lw=0.7, zorder=0)
            ax.set(xlabel=panel[0], ylim=(-reach, reach))
            weight = "bold" if _share(panel) == best > 0.1 else "normal"
            ax.set_title(f"{100 * _share(panel):.0f} %", fontsize=8, loc="right", pad=2, weight=weight)
            if c % columns:
                ax.tick_params(labelleft=False)
            else:
                where = f"{names.joint(j + 1)}\n" if dof > 1 else ""
                ax.set_ylabel(f"{where}missing force [{names.force_unit(j + 1)}]", fontsize=8.5)
        for ax in grid[j, len(row) :]:
            ax.set_axis_off()
    title = "Mean force that the declared model lacks, against all that could cause it: a flat line is good"
    head(figure, title, list(grid.ravel()), "Percentage: share of the force's variation that goes with it.")
    return figure


def _panels(residuals: Sequence[Residual], names: Names, joint: int, bins: int) -> list[_Panel]:
    out = []
    for label, values in _causes(residuals, names):
        seen = values[0][np.isfinite(values[0]) & np.isfinite(residuals[0].force[..., joint])]
        low, high = np.percentile(seen, INNER) if seen.size else (-1.0, 1.0)
        edges = np.linspace(low, high if high > low else low + 1.0, bins + 1)
        pairs = zip(values, residuals, strict=True)
        out.append((label, [_binned(x, residual.force[..., joint], edges) for x, residual in pairs]))
    return out


def _share(panel: _Panel) -> float:
    """Share of the variation that goes with a cause under the declared model."""
    return panel[1][0].share


def _reach(panels: Sequence[_Panel]) -> float:
    ends = [np.abs(curve.mean) + np.nan_to_num(NORMAL_90 * curve.std) for _, curves in panels for curve in curves]
    return 1.15 * max(1e-12, *(float(np.nanmax(end, initial=0.0)) for end in ends))


@styled
def innovation_figure(before: Residual, names: Names, after: Residual | None = None) -> Figure:
    """Autocorrelation of the innovations of every measured channel with its 95 % bounds."""
    sides = _sides(before, after, ("before", "after")) if after else [(_followed(before), AFTER, "fit")]
    figure, (grid,) = panels(len(names.measured))
    for i, (ax, name) in enumerate(zip(grid, names.measured, strict=True)):
        curves = [autocorrelation(residual.innovation[..., i], LAGS) for residual, _, _ in sides]  # of other sequences
        for (r, _), (_, colour, label) in zip(curves, sides, strict=True):
            dotted(ax, np.arange(1, r.size), r[1:], colour, label)
        lags, bound = np.arange(1, curves[0][1].size), 1.96 / np.sqrt(np.maximum(curves[0][1][1:], 1))
        ax.fill_between(lags, -bound, bound, color="#DDDDDD", lw=0, label="95 % bounds if independent")
        reach = max(0.1, *(1.15 * float(np.max(np.abs(r[1:]), initial=0)) for r, _ in curves))
        ax.axhline(0, color=ZERO_LINE, lw=0.7, zorder=0)
        ax.set(ylim=(-reach, reach), xlim=(0.5, LAGS + 0.5), xlabel="lag [samples]")
        ax.set_ylabel(f"{symbol(name)}\nautocorrelation [-]")
    head(figure, "One-step errors: should be independent", list(grid))
    return figure
