"""Numbers and effects as a reader of a report would write them."""

import itertools
import math
from collections.abc import Mapping
from typing import Any

from ...base.digits import finite, number, share_of, ten, with_std


def p_value(p: Any) -> str:
    """A p-value; below 1e-6 the tails of a test are not those of its distribution, and no digits mean anything."""
    return f"< {ten(-6)}" if finite(p) and p < 1e-6 else number(p, 2)


def ratio(before: Any, after: Any) -> str:
    """Number of times by which the second is smaller."""
    if not (finite(before) and finite(after)) or after <= 0 or before <= 0:
        return "–"
    times = before / after
    if 0.95 < times < 1.05:
        return "same"
    return f"{number(times, 2)} ×" if times > 1 else f"{number(1 / times, 2)} × larger"


def reached(error: Mapping[str, Any]) -> list[float]:
    """Horizons [s] of prediction errors, the last of them ending with the longest test sequence.

    Those beyond it have the error of all its rows, too, and are left out.
    """
    horizons, reach = error.get("horizons_s") or [], error.get("reach_s", math.inf)
    return [min(horizon, reach) for before, horizon in itertools.pairwise([0.0, *horizons]) if before < reach]


def share(value: float) -> str:
    """A share of the error as a percentage, as far as it is one."""
    return share_of(value, "the error").replace("%", " %")


def quantity(entry: Mapping[str, Any]) -> str:
    """A parameter with its standard deviation and unit."""
    unit = entry.get("unit")
    return with_std(entry.get("value"), entry.get("std")) + ("" if unit in (None, "", "-") else f" {unit}")


def duration(error: Mapping[str, Any], value: float) -> str:
    """A time of the errors of a report with its unit."""
    return f"{number(value, 2)} {error.get('time_unit', 's')}"


def sentence(text: Any) -> str:
    """Text with a capital, a full stop, and no underscores."""
    plain = str(text or "").replace("_", " ").rstrip(".")
    return f"{plain[:1].upper()}{plain[1:]}." if plain else ""
