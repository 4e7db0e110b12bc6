"""The figure of an import: when topics spoke, and which sequences were made."""

from collections.abc import Mapping
from typing import Any

from matplotlib.figure import Figure

from ..import_.resample import TopicFacts
from .style import BLUE, GREEN, READING, TRUTH, VERMILION, ZERO_LINE, head, styled

DRAWN_LOGS = 6
"""Logs that are drawn."""
LOG_AXIS_RATIO = 10.0
"""Times the shortest interval from which on intervals are drawn on a logarithmic axis."""
_SPLITS = {"train": ("training", BLUE), "test": ("test", GREEN), None: ("dropped", READING)}


@styled
def timeline(document: Mapping[str, Any]) -> Figure:
    """A row for each topic that is used and one for the sequences, and the intervals of the messages beside them."""
    logs = document["logs"][:DRAWN_LOGS]
    used = [[topic for topic in log["topics"] if topic.columns and topic.clock] for log in logs]
    heights = [len(topics) + 1 for topics in used]
    figure = Figure(figsize=(9.0, 1.1 + 0.42 * sum(heights) + 0.45 * len(logs)), layout="constrained")
    grid = figure.subplots(len(logs), 2, squeeze=False, width_ratios=[3.2, 1], height_ratios=heights)
    for (left, right), log, topics in zip(grid, logs, used, strict=True):
        names = [topic.name or "table" for topic in topics]
        for y, topic in enumerate(topics):
            _bar(left, y, topic)
            _intervals(right, y, topic)
        for s in log["sequences"]:
            part = s["file"].split("/")[0] if s["file"] else None
            label, colour = _SPLITS[part]
            length = s["rows"] * document["dt"]
            left.barh(len(topics), length, 0.55, s["start"], color=colour, label=label, edgecolor="white", lw=0.6)
        left.set(yticks=range(len(topics) + 1), yticklabels=[*names, "sequences"], xlabel="time [s]")
        left.set_title(log["file"])
        left.set_ylim(len(topics) + 0.5, -0.5)
        right.set(ylim=left.get_ylim(), yticks=[], xlabel="interval [ms]")
        intervals = [1e3 / topic.rate for topic in topics]
        if max(intervals) > LOG_AXIS_RATIO * min(intervals):
            right.set_xscale("log")
        else:
            right.set_xlim(left=0.0)
        right.axvline(1e3 * document["dt"], color=ZERO_LINE, ls="--", lw=1.0, label="one row")
        left.grid(axis="y", visible=False)
    undrawn = len(document["logs"]) - len(logs)
    head(figure, "Topics and sequences", list(grid.ravel()), f"{undrawn} further logs are not drawn" if undrawn else "")
    return figure


def _bar(ax: Any, y: int, topic: TopicFacts) -> None:
    """A topic while it is present; a gap is drawn wide enough to be seen."""
    span = max(topic.end - topic.start, 1e-9)
    ax.barh(y, span, 0.3, topic.start, color=TRUTH, alpha=0.55, label="topic")
    for gap in topic.gaps:
        width = max(gap.end - gap.start, 0.003 * span)
        ax.barh(y, width, 0.55, gap.start, color=VERMILION, label="gap")


def _intervals(ax: Any, y: int, topic: TopicFacts) -> None:
    typical = 1e3 / topic.rate
    low = max(typical - 1e3 * topic.jitter, 0.05 * typical)
    ax.plot([low, typical + 1e3 * topic.jitter], [y, y], color=BLUE, lw=5, alpha=0.4, solid_capstyle="butt")
    ax.plot([typical, typical + 1e3 * topic.worst], [y, y], color=BLUE, lw=1)
    ax.plot(typical, y, "o", color=BLUE, ms=4)
