"""Residuals of the declared model: the force that it lacks, and its one-step errors."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from ..diagnosis.residual import Names, Residual
from ..diagnosis.statistics import LAGS, autocorrelation
from .style import ACROSS, AFTER, BEFORE, NORMAL_90, ZERO_LINE, band, dotted, head, panels, styled, symbol
from .tables import INNER


class _Bins(NamedTuple):
    centre: Float[np.ndarray, " bin"]
    mean: Float[np.ndarray, " bin"]
    half: Float[np.ndarray, " bin"]
    """Half width of the 90 % band of the mean; NaN of a single sequence."""
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
    half = NORMAL_90 * np.sqrt(scatter) / np.maximum(rows, 1)
    return _Bins(0.5 * (edges[1:] + edges[:-1]), mean, half, float(share))


_Cause = tuple[str, list[Float[np.ndarray, "seq time"]]]
"""Label, and values of every side."""


def _causes(residuals: Sequence[Residual], names: Names) -> list[_Cause]:
    """Everything that may cause a force."""
    dof = len(names.coordinates)
    out = [
        _cause(symbol(name), names.unit(name), [residual.state[..., j] for residual in residuals])
        for j, name in enumerate((*names.coordinates, *names.rates))
    ]
    rotary = [j for j in range(dof) if names.rotary[j]]
    if len(rotary) > 1:
        label = " + ".join(symbol(names.coordinates[j]) for j in rotary) if len(rotary) < 4 else "sum of all angles"
        out.insert(dof, _cause(label, "rad", [residual.state[..., rotary].sum(-1) for residual in residuals]))
    out += [
        _cause(f"input {name}", names.unit(name), [residual.u[..., i] for residual in residuals])
        for i, name in enumerate(names.inputs)
    ]
    return [*out, _cause("time", "s", [residual.t for residual in residuals])]


def _cause(label: str, unit: str, values: list[Float[np.ndarray, "seq time"]]) -> _Cause:
    """A signal; an angle that makes more than a turn within one."""
    if unit == "rad" and np.ptp(np.nanpercentile(values[0], INNER)) > 2 * np.pi:
        return f"{label} wrapped [rad]", [(angle + np.pi) % (2 * np.pi) - np.pi for angle in values]
    return f"{label} [{unit}]", values


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

    label: str
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
    rows = [_panels([side for side, _, _ in sides], names, j, bins) for j in range(dof)]
    if dof > 2:
        rows = [sorted(row, key=lambda panel: -panel.share)[:ACROSS] for row in rows]
    columns = min(ACROSS, len(rows[0]))
    deep = -(-len(rows[0]) // columns)
    figure = Figure(figsize=(2.45 * columns + 0.3, 1.75 * deep * dof + 0.75), layout="constrained")
    grid = figure.subplots(deep * dof, columns, squeeze=False).reshape(dof, -1)
    reaches = [_reach(row) for row in rows]
    for j, row in enumerate(rows):
        same_kind = [r for k, r in enumerate(reaches) if names.rotary[k] == names.rotary[j]]
        reach = max(reaches[j], 0.3 * max(same_kind))  # what matters little should look little
        best = max(panel.share for panel in row)
        for c, (ax, panel) in enumerate(zip(grid[j], row, strict=False)):
            for curve, (_, colour, label) in zip(panel.curves, sides, strict=True):
                band(ax, curve.centre, curve.mean, curve.half / NORMAL_90, colour, label)
            ax.axhline(0, color=ZERO_LINE, lw=0.7, zorder=0)
            ax.set(xlabel=panel.label, ylim=(-reach, reach))
            weight = "bold" if panel.share == best > 0.1 else "normal"
            ax.set_title(f"{100 * panel.share:.0f} %", fontsize=8, loc="right", pad=2, weight=weight)
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
    """The force at one joint against every cause."""
    out = []
    for label, values in _causes(residuals, names):
        seen = values[0][np.isfinite(values[0]) & np.isfinite(residuals[0].force[..., joint])]
        low, high = np.percentile(seen, INNER) if seen.size else (-1.0, 1.0)
        edges = np.linspace(low, high if high > low else low + 1.0, bins + 1)
        pairs = zip(values, residuals, strict=True)
        out.append(_Panel(label, [_binned(x, residual.force[..., joint], edges) for x, residual in pairs]))
    return out


def _reach(panels: Sequence[_Panel]) -> float:
    """Half height of the panels of a joint."""
    curves = [curve for panel in panels for curve in panel.curves]
    return 1.15 * max(1e-12, *(float(np.nanmax(np.abs(c.mean) + np.nan_to_num(c.half), initial=0.0)) for c in curves))


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
