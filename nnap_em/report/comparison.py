"""Everything that `nnap-em compare` leaves behind: a table for the screen, compare.json and compare.html."""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ..comparison.compare import CHANGED, LEAST_SHARED, Comparison, Curve, Number
from ..comparison.pooling import JointTest, Pooled
from ..numerics.digits import number, with_std
from .document import versions
from .page import picture, rendered, write_report
from .style import BLUE, GREEN, PURPLE, TRUTH, VERMILION, band, head, limits, styled, symbol
from .wording import p_value

LEGEND = (
    "±: one standard deviation. pooled: the answer of all fits together. between: standard deviation between fits "
    "beyond those that they state. p-value: chance of such differences where nothing changed, corrected for the number "
    f"of quantities (indented lines: for those of their curve); below {CHANGED:g} a quantity counts as changed."
)


def write_comparison(out: Path, comparison: Comparison) -> None:
    """Write compare.json and compare.html into the folder `out`."""
    document, pictures = describe(comparison), []
    caption = "With 90 % bands, on the velocities that all fits visited; below, the same minus the pooled curve."
    for curve in comparison.curves:
        title = f"{curve.name[0].upper()}{curve.name[1:]}"
        pictures.append(picture("found", title, caption, comparison_figure(comparison, curve)))
    content = {"document": document, "rows": rows(comparison), "legend": LEGEND, "pictures": pictures}
    text = rendered("compare.html.j2", **content)
    write_report(out, "compare", document, text, comparison.fits[0].fitted.rig.named)


# --- in numbers


def describe(comparison: Comparison) -> dict[str, Any]:
    """The comparison as compare.json holds it."""
    rig, names = comparison.fits[0].fitted.rig, comparison.names
    return {
        "format": 1,
        "rig": rig.name,
        "system": rig.system,
        "verdict": comparison.verdict,
        "cause": comparison.cause,
        "changed": comparison.changed,
        "widened": comparison.widened,
        "level": CHANGED,
        "least_shared": LEAST_SHARED,
        "fits": [
            {"name": fit.name, "visited": _ranges(fit.velocity), "load": _ranges(fit.load)} for fit in comparison.fits
        ],
        "friction": [_curve(curve, names) for curve in comparison.curves],
        "numbers": [_number(each, names) for each in comparison.numbers],
        "differences": comparison.differences,
        "warnings": comparison.warnings,
        "versions": versions(),
    }


def _ranges(values: np.ndarray) -> list[list[float] | None]:
    return [pair.tolist() if np.isfinite(pair).all() else None for pair in values]


def _curve(curve: Curve, names: Sequence[str]) -> dict[str, Any]:
    fits = zip(curve.fits, curve.torque, curve.std, curve.cov, strict=True)
    return {
        "joint": curve.joint,
        "units": {"velocity": curve.units[0], "torque": curve.units[1]},
        "velocity": curve.velocity,
        "fits": {names[i]: {"torque": t, "std": s, "cov": c} for i, t, s, c in fits},
        "pooled": curve.pooled,
        "test": curve.test,
        "changed": curve.changed,
        "law": [_number(each, names) | {"changed": each in curve.parts} for each in curve.law],
    }


def _number(each: Number, names: Sequence[str]) -> dict[str, Any]:
    rows = zip(names, each.value.tolist(), each.std.tolist(), strict=True)
    return {
        "name": each.name,
        "unit": each.unit,
        "fits": {name: {"value": value, "std": std} for name, value, std in rows if math.isfinite(value)},
        "pooled": {part: float(values[0]) for part, values in each.pooled._asdict().items()},
        "test": each.test,
        "changed": each.changed,
    }


# --- in a table


def rows(comparison: Comparison) -> list[dict[str, Any]]:
    """Rows of the table, as texts: `name`, one of `values` per fit, `pooled`, `between`, `p_value` and `verdict`.

    `inner` rows belong to the curve above them.
    """
    out: list[dict[str, Any]] = []
    for curve in comparison.curves:
        reach = f"{number(float(curve.velocity[0]))} to {number(float(curve.velocity[-1]))} {curve.units[0]}"
        blank = {"values": [""] * len(comparison.fits), "pooled": "", "between": ""}
        out.append({"name": f"{curve.name}, {reach}", "inner": False} | blank | _judgement(curve.test, curve.changed))
        out += _along(curve, len(comparison.fits))
        out += [_row(each, True) | _judgement(each.test, each in curve.parts, inner=True) for each in curve.law]
    return out + [_row(each, False) | _judgement(each.test, each.changed) for each in comparison.numbers]


def _along(curve: Curve, count: int) -> Iterator[dict[str, Any]]:
    """Some points of a curve; compare.json has all."""
    for at in np.linspace(0, len(curve.velocity) - 1, 5).astype(int):
        values = ["–"] * count
        for i, torque, std in zip(curve.fits, curve.torque[:, at], curve.std[:, at], strict=True):
            values[i] = with_std(float(torque), float(std))
        name = f"at {number(float(curve.velocity[at]), 2)} {curve.units[0]} [{curve.units[1]}]"
        pooled = Pooled(*(part[at : at + 1] for part in curve.pooled))
        yield {"name": name, "inner": True, "values": values, "p_value": "", "verdict": ""} | _pooled(pooled)


def _row(each: Number, inner: bool) -> dict[str, Any]:
    pairs = zip(each.value.tolist(), each.std.tolist(), strict=True)
    unit = f" [{each.unit}]" if each.unit not in ("", "-") else ""
    values = [with_std(value, std) if math.isfinite(value) else "–" for value, std in pairs]
    return {"name": each.name + unit, "inner": inner, "values": values} | _pooled(each.pooled)


def _pooled(pooled: Pooled) -> dict[str, str]:
    between = float(pooled.between[0])
    return {
        "pooled": with_std(float(pooled.value[0]), float(pooled.std[0])),
        "between": number(between, 2) if between > 0 else "none",
    }


def _judgement(test: JointTest | None, changed: bool, inner: bool = False) -> dict[str, str]:
    if test is None:
        return {"p_value": "", "verdict": "in one fit"}
    return {"p_value": p_value(test.p_value), "verdict": "CHANGED" if changed else "" if inner else "no change seen"}


def table(comparison: Comparison) -> str:
    """The comparison as text for a screen."""
    head = ["quantity", *comparison.names, "pooled", "between", "p-value", ""]
    lines = [head]
    for row in rows(comparison):
        name = f"  {row['name']}" if row["inner"] else row["name"]
        lines.append([name, *row["values"], row["pooled"], row["between"], row["p_value"], row["verdict"]])
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    # the name of a curve stands over its empty columns
    widths[0] = max(len(line[0]) for line in lines if any(line[1:-2]))
    judged = [] if comparison.cause is None else [f"{line}." for line in comparison.cause.judged]
    text = [comparison.verdict, *judged, *(f"Warning: {warning}." for warning in comparison.warnings)]
    text += ["", *(_aligned(line, widths) for line in lines), "", LEGEND]
    return comparison.fits[0].fitted.rig.named("\n".join(text))


def _aligned(line: Sequence[str], widths: Sequence[int]) -> str:
    """Name to the left, numbers to the right; a long name takes the room of the empty fields behind it."""
    text, room = "", 0
    for i, (field, width) in enumerate(zip(line, widths, strict=True)):
        room += width + 2 * (i > 0)
        if i == 0 or i == len(line) - 1:
            text = text.ljust(room - width) + field
        elif field:
            text = text.ljust(room - width) + field.rjust(width - max(0, len(text) - (room - width)))
    return text.rstrip()


# --- in figures


COLOURS = (BLUE, VERMILION, GREEN, PURPLE, "#56B4E9", "#E69F00")
"""Colours of the fits, in their order; more fits than colours begin again."""


@styled
def comparison_figure(comparison: Comparison, curve: Curve) -> Figure:
    """Curves with their bands, their differences from the pooled curve, and the velocities that each fit visited."""
    colours = [COLOURS[i % len(COLOURS)] for i in curve.fits]
    figure = Figure(figsize=(6.6, 5.6 + 0.2 * len(curve.fits)), layout="constrained")
    heights = (1.0, 0.7, 0.04 + 0.05 * len(curve.fits))
    above, difference, below = figure.subplots(3, 1, sharex=True, height_ratios=heights)
    for i, colour, torque, std in zip(curve.fits, colours, curve.torque, curve.std, strict=True):
        for ax, mean in ((above, torque), (difference, torque - curve.pooled.value)):
            band(ax, curve.velocity, mean, std, colour, comparison.fits[i].name)
            ax.collections[-1].set_label("_")  # the caption explains the bands
    above.plot(curve.velocity, curve.pooled.value, color=TRUTH, lw=1.0, ls="--", label="pooled")
    above.set_ylim(*limits(list(curve.torque), 0.2))
    above.set_ylabel(f"friction [{curve.units[1]}]")
    difference.set_ylim(*limits(list(curve.torque - curve.pooled.value), 0.5))
    difference.set_ylabel(f"minus pooled [{curve.units[1]}]")
    for ax in (above, difference):
        ax.axhline(0, color="#BBBBBB", lw=0.8, zorder=0)
    for row, (i, colour) in enumerate(zip(curve.fits, colours, strict=True)):
        low, high = comparison.fits[i].velocity[curve.joint - 1]
        below.plot([low, high], [-row, -row], color=colour, lw=4, solid_capstyle="butt")
    below.set_yticks(-np.arange(len(curve.fits)), [comparison.fits[i].name for i in curve.fits])
    below.set_ylim(0.6 - len(curve.fits), 0.6)
    rate = comparison.fits[0].fitted.model.system.rates[curve.joint - 1]
    below.set_xlabel(f"velocity {symbol(rate)} [{curve.units[0]}]; bars: visited by each fit")
    head(figure, f"Friction of joint {curve.joint}", [above])
    return figure
