"""Numbers in as many digits as they deserve."""

import math
from typing import Any, SupportsIndex


def finite(value: Any) -> bool:
    """True for a finite number."""
    return isinstance(value, int | float) and math.isfinite(value)


def counted(count: SupportsIndex, noun: str, plural: str = "") -> str:
    """A number of things, with their noun in singular or plural (`noun` + s where no other is given)."""
    return f"{count} {noun if count == 1 else plural or noun + 's'}"


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


def share_of(share: float, whole: str, places: int = 0) -> str:
    """A share of a squared error as a percentage; beyond 1 and -1, where it is none, in words."""
    if share > 1:
        return f"more than all of {whole}"
    if share < -1:
        return f"none of {whole}, which grows to {number(1 - share)} times itself"
    return f"{share:.{places}%} of {whole}"


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
    return f" × {ten(exponent)}"


def ten(exponent: int) -> str:
    """A power of ten with its exponent raised."""
    return "10" + str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))


def _minus(text: str) -> str:
    return text.replace("-", "−")
