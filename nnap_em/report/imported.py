"""Report of `nnap-em import`: import.json, and the same as a page."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ..data.rig import Rig
from ..import_.declared import Plan
from ..import_.delays import Delay
from ..import_.resample import Resampled, TopicFacts
from ..numerics.digits import number
from .document import versions
from .page import picture, rendered, write_report
from .style import BLUE, GREEN, READING, TRUTH, VERMILION, ZERO_LINE, head, styled

_SPLITS = {"train": ("training", BLUE), "test": ("test", GREEN), None: ("dropped", READING)}


def describe(
    logs: Sequence[Resampled],
    files: Sequence[str],
    rig: Rig,
    plan: Plan,
    shifts: Mapping[str, float],
    *,
    seconds: float,
) -> dict[str, Any]:
    """All that import.json holds; times in seconds after the first message of a log."""
    names = iter(files)
    entries = [_log(log, names) for log in logs]
    rows = sum(s["rows"] for log in entries for s in log["sequences"] if s["file"])
    return {
        "format": 1,
        "rig": rig.name,
        "dt": rig.dt,
        "input": "mean" if plan.mean else "hold",
        "shifts": dict(shifts),
        "rows_used": rows,
        "rows_dropped": sum(log["rows"] for log in entries) - rows,
        "logs": entries,
        "look": list(_remarks(logs, rig)),
        "seconds": seconds,
        "versions": versions(),
    }


def write_page(folder: Path, document: Mapping[str, Any]) -> None:
    """Write import.json and import.html."""
    caption = (
        "Each bar is a topic while it has messages, its gaps in orange; below, the sequences that were made of it, "
        "and what was dropped. On the right the time from one message to the next: its median, one standard deviation, "
        "and the largest that is no gap; the dashed line is one row of the data set."
    )
    figure = picture("found", "Topics and sequences", caption, timeline(document))
    write_report(folder, "import", document, rendered("import.html.j2", document=document, pictures=[figure]))


def _log(log: Resampled, files: Iterator[str]) -> dict[str, Any]:
    return {
        "file": log.path.name,
        "origin_ns": log.origin,
        "columns": {name: {"from": str(at), "scale": at.scale} for name, at in log.addresses.items()},
        "topics": log.topics,
        "delays": log.delays,
        "rows": log.rows,
        "sequences": [{**s._asdict(), "file": None if s.why else next(files)} for s in log.sequences],
        "notes": log.notes,
    }


def _remarks(logs: Sequence[Resampled], rig: Rig) -> Iterator[str]:
    """Warnings for the owner before a fit."""
    notable = 0.2  # share of a row from which on a delay, where it is surely one, is pointed out
    for log in logs:
        for entry in log.delays:
            if surely(entry) and abs(entry.seconds) > notable * rig.dt:
                yield f"{log.path.name}: {delay_text(entry)}"
        for topic in log.topics:
            yield from (f"{log.path.name}: {topic.name or 'the table'}: {note}" for note in topic.notes)
        yield from (f"{log.path.name}: {note}" for note in log.notes)


def surely(entry: Delay) -> bool:
    """True where a delay is more than chance: by four standard deviations."""
    return bool(np.isfinite(entry.seconds) and abs(entry.seconds) > 4.0 * entry.std)


def delay_text(entry: Delay) -> str:
    """A delay, and what would take it out."""
    topics = entry.cause_topic, entry.effect_topic
    early, late = topics if entry.seconds > 0 else topics[::-1]
    amount = abs(entry.seconds)
    return (
        f"{late} is {number(1e3 * amount)} ± {number(1e3 * entry.std, 2)} ms behind {early} (by {entry.cause} and "
        f"{entry.effect}); nothing was shifted. Where the stamps are late, and not the drive, --shift "
        f"{late}={-amount:.4g} takes it out"
    )


# --- in a figure


@styled
def timeline(document: Mapping[str, Any]) -> Figure:
    """A row for each topic that is used and one for the sequences, and the intervals of the messages beside them."""
    logs = document["logs"][:6]
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
        if max(intervals) > 10.0 * min(intervals):
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
