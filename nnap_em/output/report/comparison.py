"""Everything that `nnap-em compare` leaves behind: a table for the screen, compare.json and compare.html."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ...base.digits import number, with_std
from ...explain.compare.compare import CHANGED, Comparison, Quantity
from .document import versions
from .html import Table, rendered, section, write_report
from .wording import p_value

LEGEND = (
    "±: one standard deviation. difference: between the fits, in standard deviations. p-value: chance of such "
    "differences where nothing changed, corrected for the number of quantities; below "
    f"{CHANGED:g} a quantity counts as changed. pooled: one value of all fits, its error widened where they differ by "
    "more than they state. The numbers of a friction curve are tested as one."
)


def write_comparison(out: Path, comparison: Comparison) -> None:
    """Write compare.json and compare.html into the folder `out`."""
    document, (head, *lines) = describe(comparison), rows(comparison)
    text = rendered("Comparison of", document, [section("All numbers", Table(head, lines), LEGEND)])
    write_report(out, "compare", document, text, comparison.rig.named)


def describe(comparison: Comparison) -> dict[str, Any]:
    """The comparison as compare.json holds it."""
    return {
        "format": 2,
        "rig": comparison.rig.name,
        "system": comparison.rig.system,
        "verdict": comparison.verdict,
        "changed": comparison.changed,
        "level": CHANGED,
        "fits": comparison.names,
        "quantities": [{"changed": each.changed, **each._asdict()} for each in comparison.quantities],
        "versions": versions(),
    }


def rows(comparison: Comparison) -> list[list[str]]:
    """The table as texts, its head first."""
    head = ["quantity", *comparison.names, "difference", "p-value", "pooled", ""]
    return [head, *(line for each in comparison.quantities for line in _lines(each))]


def _lines(each: Quantity) -> Iterator[list[str]]:
    chance = p_value(each.test.p_value) if each.test else ""
    verdict = "CHANGED" if each.changed else "" if each.test else "in one fit"
    indent = "  " * (len(each.rows) > 1)
    if indent:
        yield [each.name, *[""] * (len(each.value) + 1), chance, "", verdict]
        chance = verdict = ""
    for i, (name, unit) in enumerate(each.rows):
        pairs = zip(each.value[:, i].tolist(), each.std[:, i].tolist(), strict=True)
        values = [with_std(value, std) if math.isfinite(value) else "–" for value, std in pairs]
        pooled = with_std(float(each.pooled.value[i]), float(each.pooled.std[i]))
        difference = number(float(each.difference[i]), 2) if each.test else ""
        title = indent + name + (f" [{unit}]" if unit not in ("", "-") else "")
        yield [title, *values, difference, chance, pooled, verdict]


def table(comparison: Comparison) -> str:
    """The comparison as text for a screen."""
    lines = rows(comparison)
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    text = [comparison.verdict, ""]
    for first, *others, last in lines:
        cells = [first.ljust(widths[0]), *(cell.rjust(w) for cell, w in zip(others, widths[1:-1], strict=True)), last]
        text.append("  ".join(cells).rstrip())
    return comparison.rig.named("\n".join([*text, "", LEGEND]))
