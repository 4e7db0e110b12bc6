"""The friction of a joint in several fits."""

import numpy as np
from matplotlib.figure import Figure

from ..comparison.compare import Comparison, Curve
from .style import BLUE, GREEN, PURPLE, TRUTH, VERMILION, band, head, limits, styled, symbol

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
