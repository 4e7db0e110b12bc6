"""Numbers and effects as a reader of a report would write them."""

import math
from collections.abc import Mapping
from typing import Any

from ..diagnose.keys import words


def finite(value: Any) -> bool:
    """True for a finite number."""
    return isinstance(value, int | float) and math.isfinite(value)


def number(value: Any, digits: int = 3) -> str:
    """A number in so many significant digits; a dash where there is none, a text as it is."""
    if isinstance(value, str):
        return value
    if not finite(value):
        return "–"
    if value == 0 or (isinstance(value, int) and abs(value) < 1e6):
        return str(int(value))
    size = math.floor(math.log10(abs(float(f"{value:.{digits - 1}e}"))))
    if -4 <= size < 6:
        return _minus(f"{value:.{max(digits - 1 - size, 0)}f}")
    return _minus(f"{value / 10.0**size:.{digits - 1}f}") + power(size)


def with_std(value: Any, std: Any) -> str:
    """A value and its standard deviation, both to the second digit of the latter."""
    if not finite(value) or not finite(std) or std <= 0:
        return number(value, 4)
    places, size = 1 - math.floor(math.log10(std)), math.floor(math.log10(max(abs(value), std)))
    if -4 <= size < 6:
        places = min(max(places, 0), 12)
        return _minus(f"{value:.{places}f} ± {std:.{places}f}")
    places = min(max(places + size, 0), 12)
    return _minus(f"({value / 10.0**size:.{places}f} ± {std / 10.0**size:.{places}f})") + power(size)


def power(exponent: int) -> str:
    """A factor of a power of ten."""
    return f" × {_ten(exponent)}"


def chance(p: float) -> str:
    """A small probability in words."""
    if p < 1e-12:
        return "less than one in a million million"
    if p < 1e-3:
        return f"about one in {_ten(round(-math.log10(p)))}"
    return f"about one in {1 / p:.0f}" if p < 0.1 else number(p, 2)


def p_value(p: Any) -> str:
    """A p-value; one that is too small for a number is below the smallest."""
    return f"< {_ten(-300)}" if p == 0 else number(p, 2)


def ratio(before: Any, after: Any) -> str:
    """Number of times by which the second is smaller."""
    if not (finite(before) and finite(after)) or after <= 0 or before <= 0:
        return "–"
    times = before / after
    if 0.95 < times < 1.05:
        return "same"
    return f"{number(times, 2)} ×" if times > 1 else f"{number(1 / times, 2)} × larger"


def quantity(entry: Mapping[str, Any]) -> str:
    """A parameter with its standard deviation and unit."""
    unit = entry.get("unit")
    return with_std(entry.get("value"), entry.get("std")) + ("" if unit in (None, "", "-") else f" {unit}")


def label(effect: Mapping[str, Any]) -> str:
    """An effect, or what else has a name, a joint, a channel and inputs, as a reader would call it."""
    name, joint, channel, inputs = (effect.get(part) for part in ("name", "joint", "channel", "inputs"))
    return words((str(name or "unnamed"), joint, channel, tuple(inputs or ())))


def sentence(text: Any) -> str:
    """Text with a capital, a full stop, and no underscores."""
    told = str(text or "").replace("_", " ").rstrip(".")
    return f"{told[:1].upper()}{told[1:]}." if told else ""


def _ten(exponent: int) -> str:
    return "10" + str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))


def _minus(text: str) -> str:
    return text.replace("-", "−")
