"""Report of `nnap-em import`: import.json, and the same as a page."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..data.rig import Rig
from ..import_.declared import Plan
from ..import_.delays import Delay
from ..import_.resample import Resampled
from ..numerics.digits import number
from .document import versions
from .import_plot import timeline
from .page import picture, rendered, write_report

NOTABLE = 0.2
"""Share of a row from which on a delay, where it is surely one, is pointed out."""
CERTAIN_DELAY = 4.0
"""Standard deviations from which on a delay is surely one."""


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
    for log in logs:
        for entry in log.delays:
            if surely(entry) and abs(entry.seconds) > NOTABLE * rig.dt:
                yield f"{log.path.name}: {delay_text(entry)}"
        for topic in log.topics:
            yield from (f"{log.path.name}: {topic.name or 'the table'}: {note}" for note in topic.notes)
        yield from (f"{log.path.name}: {note}" for note in log.notes)


def surely(entry: Delay) -> bool:
    """True where a delay is more than chance."""
    return bool(np.isfinite(entry.seconds) and abs(entry.seconds) > CERTAIN_DELAY * entry.std)


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
