"""Everything that `nnap-em monitor` leaves behind: monitor.json and monitor.html."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ..comparison.monitor import Reference, Trend
from ..fit.identify import Identified
from ..numerics.digits import counted
from ..storage.log import Log
from .document import versions
from .page import picture, rendered, write_report
from .style import BLUE, READING, VERMILION, band, head, styled


def write_monitor(
    out: Path, fitted: Identified, beside: Reference, seen: Trend, found: Mapping[str, Any], log: Log
) -> None:
    """Write monitor.json and monitor.html into the folder `out`."""
    rows = found["recordings"]
    alarm = seen.alarm and {
        "chart": seen.alarm.chart,
        "file": rows[seen.alarm.at]["file"],
        "since": rows[seen.alarm.since]["file"],
    }
    numbers = zip(beside.names, beside.units, seen.value.T, seen.std.T, strict=True)
    document = {
        "format": 1,
        "rig": fitted.rig.name,
        "system": fitted.rig.system,
        "verdict": verdict(rows, alarm, found.get("since_fit")),
        "changed": alarm is not None,
        "alarm": alarm,
        "threshold": seen.threshold,
        "charts": seen.charts,
        "numbers": [{"name": n, "unit": u, "change": v, "std": s} for n, u, v, s in numbers],
        **found,
        "versions": versions(),
    }
    caption = (
        "Above: multi-step errors of each recording over those of the fit on recordings left out. Below: the chart "
        "that alarms at the dashed line, and every number as a change since the fit, with 90 % bands."
    )
    pictures = [picture("found", "Trend", caption, trend_figure(document))]
    skipped = [f"{row['file']}: {row['reason']}" for row in rows if row["reason"]]
    text = rendered("monitor.html.j2", document=document, pictures=pictures, skipped=skipped)
    write_report(out, "monitor", document, text, fitted.rig.named)
    log(document["verdict"])
    log(f"wrote {out / 'monitor.html'} and monitor.json")


def verdict(rows: Sequence[Mapping[str, Any]], alarm: Mapping[str, str] | None, found: str | None) -> str:
    """The outcome in one or two sentences."""
    skipped = sum(bool(row["reason"]) for row in rows)
    judged = counted(len(rows) - skipped, "recording")
    beside = f"; {skipped} not judged" if skipped else ""
    if alarm is None:
        return f"No change in {judged}{beside}."
    since = f"between {alarm['since']} and" if alarm["since"] != alarm["file"] else "at"
    text = f"Changed {since} {alarm['file']} by the chart of {alarm['chart']} ({judged}{beside})."
    return f"{text} {found}" if found else text


@styled
def trend_figure(document: Mapping[str, Any]) -> Figure:
    """Errors, charts and numbers over the recordings."""
    numbers, x = document["numbers"], np.arange(1, len(document["recordings"]) + 1)
    figure = Figure(figsize=(7.2, 3.4 + 1.25 * len(numbers)), layout="constrained")
    errors, chart, *panels = figure.subplots(2 + len(numbers), 1, sharex=True)
    ratio = [np.nan if row["ratio"] is None else row["ratio"] for row in document["recordings"]]
    errors.plot(x, ratio, ".", color=READING)
    errors.axhline(1.0, color="#BBBBBB", lw=0.8)
    errors.set_ylabel("errors")
    for name, values in document["charts"].items():
        leads = document["alarm"] is not None and name == document["alarm"]["chart"]
        chart.plot(x, values, color=VERMILION if leads else "#CCCCCC", lw=1.4 if leads else 0.8, zorder=2 + leads)
    chart.axhline(document["threshold"], color=VERMILION, ls="--", lw=1.0)
    chart.set_ylim(0, 2 * document["threshold"])
    chart.set_ylabel("charts")
    for ax, each in zip(panels, numbers, strict=True):
        band(ax, x, each["change"], each["std"], BLUE, each["name"])
        ax.axhline(0, color="#BBBBBB", lw=0.8)
        ax.set_title(f"{each['name']} [{each['unit']}]", fontsize=8)
    figure.axes[-1].set_xlabel("recording")
    head(figure, "Each recording beside the fit", [errors])
    return figure
