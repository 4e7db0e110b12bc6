"""SI units: of parameters and states by their names, of what belongs to an angle or to a position."""

import functools
import math
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence

_UNIT_OF = {  # of parameters and states, by their names
    r"g": "m/s^2", r"gr": "-", r"x": "m", r"dx": "m/s", r"theta\w*": "rad", r"dtheta\w*": "rad/s",
    r"mc?\d*": "kg", r"lc?\d*": "m", r"I[cr]?\d*": "kg m^2",
}  # fmt: skip
UNITS = {
    "s": 1.0, "sec": 1.0, "seconds": 1.0, "ms": 1e-3, "milliseconds": 1e-3, "us": 1e-6, "µs": 1e-6,
    "microseconds": 1e-6, "ns": 1e-9, "nanoseconds": 1e-9, "min": 60.0, "minutes": 60.0, "h": 3600.0, "hours": 3600.0,
    "days": 86400.0,
}  # fmt: skip
"""Seconds in the units of times."""
_SIZES = {  # names of units, how many of another unit each is, and that one; of itself: nothing simpler
    **{unit: (size, "s") for unit, size in UNITS.items()}, "Hz": (1.0, "1/s"),
    **dict.fromkeys(("deg", "°", "degree", "degrees", "Grad"), (math.pi / 180, "rad")), "radians": (1.0, "rad"),
    **dict.fromkeys(("turn", "turns", "rev", "U"), (2 * math.pi, "rad")), "rpm": (math.pi / 30, "rad/s"),
    **dict.fromkeys(("nm", "Nm"), (1.0, "N m")), "Ncm": (0.01, "N m"), "Nmm": (1e-3, "N m"), "in": (0.0254, "m"),
    "lbf": (4.4482216, "N"), "kgf": (9.80665, "N"), "ozin": (7.0615518e-3, "N m"), "g": (9.80665, "m/s^2"),
    "bar": (1e5, "Pa"), "l": (1e-3, "m^3"),
    **{unit: (1.0, unit) for unit in ("rad", "m", "s", "N", "kg", "A", "V", "W", "ohm", "Pa", "K", "°C")},
}  # fmt: skip
_WORDS = ("deg/s", "°/s", "deg", "°", "rpm", "mm/s", "mm", "mnm", "nmm", "rad/s", "rad", "m/s", "nm", "n m", "n", "m",
          "ma", *UNITS)  # fmt: skip
_TIME_NAMES = re.compile(
    r"_*(?:t|times?|timestamps?|stamp|clock|tout|x_value|(?:uhr|datum[ _/]*)?zeit|zeitstempel|date[ _/]*time|"
    r"(?:milli)?seconds|minutes|hours|days)",
    re.IGNORECASE,
)
"""Names of a column of times: __time of PlotJuggler, tout of Simulink, X_Value of LabVIEW."""
_UNITS = (  # in brackets, but for `position[m]`, in which are joints; behind a slash; behind a word, or run together
    re.compile(r"(?!(?:.*[./:])?(?:position|velocity|effort|data)\[)(.+?)[ _,]*[\[({]([^][(){}]+)[\])}]"),
    re.compile(r"(.+?)(?:\s+/\s*|\s*/\s+|\s+in\s+)(.+)"),
    re.compile(rf"(.+?)[ _,]+({'|'.join(_WORDS)})", re.IGNORECASE),
    re.compile(r"(.*[a-z\d])(Deg|RPM|Rpm|Mm)"),
)


def named_unit(name: str, *, brackets: bool = False) -> tuple[str, str]:
    """A name without the unit at its end, and that unit, or nothing; `brackets`: only in such, or behind a slash."""
    for pattern in _UNITS[: 2 if brackets else None]:
        if (match := pattern.fullmatch(name)) and _parsed(match[2]) is not None:
            return match[1], match[2].lower() if match[2].lower() in UNITS else match[2]
    return name, ""


def si(unit: str) -> tuple[str, float]:
    """The SI unit of a unit, where it has a usual name here, and how many of that it is; of an unknown one 1."""
    usual = ("rad/s", "rad", "m/s", "m", "N m", "N", "s", "m/s^2")
    alike = (known for known in usual if not math.isnan(factor(unit, known) or math.nan))
    return next(alike, ""), (_parsed(unit) or (1.0,))[0]


def factor(unit: str, other: str) -> float | None:
    """Size of one unit in the other; NaN where they measure different things, None where one is unknown."""
    one, two = _parsed(unit), _parsed(other)
    if one is None or two is None:
        return None
    return one[0] / two[0] if one[1] == two[1] else math.nan


@functools.cache
def _parsed(unit: str) -> tuple[float, dict[str, int]] | None:
    """Size of a unit such as `mm/s^2` or `mN m`, and powers of the simple units in it; None where one is unknown."""
    prefixes = {"k": 1e3, "M": 1e6, "d": 0.1, "c": 1e-2, "m": 1e-3, "u": 1e-6, "µ": 1e-6, "μ": 1e-6, "n": 1e-9}
    size, of = _SIZES.get(unit) or (prefixes.get(unit[:1], 0.0) * _SIZES.get(unit[1:], (0.0, ""))[0], "")
    if size:
        of = of or _SIZES[unit[1:]][1]
        inner = (1.0, {of: 1}) if _SIZES.get(of) == (1.0, of) else _parsed(of)
        return inner and (size * inner[0], inner[1])
    text = re.sub(r"^1/", "/", unit.replace("²", "^2").replace("³", "^3"))
    text = re.sub(r"(?<=[^\W\d])(-[1-4]|(?<=/s)[23])$", r"^\1", text)
    factors = re.findall(r"(/|^|[ *·.])\s*([^/ *·.]+)", text)
    if len(factors) < 2 and text[:1] != "/" and "^" not in text:
        return _parsed(unit.lower()) if unit != unit.lower() else None
    size, powers, sign = 1.0, Counter[str](), 1
    for mark, part in factors:
        sign = -1 if mark == "/" else sign
        name, _, power = part.partition("^")
        one = _parsed(name)
        if one is None or not re.fullmatch(r"(-?[1-4])?", power):
            return None
        times = sign * int(power or 1)
        size *= one[0] ** times
        for base, exponent in one[1].items():
            powers[base] += times * exponent
    return size, {name: power for name, power in powers.items() if power}


def is_time(name: str) -> bool:
    """True for the name of a column of times, which may end in a unit of times, or in their format in brackets."""
    word, unit = named_unit(name)
    return bool(_TIME_NAMES.fullmatch(re.sub(r"\s*[\[(][^][()]*[\])]$", "", word))) and (not unit or unit in UNITS)


def clock_of(names: Sequence[str]) -> tuple[str | None, str | None]:
    """The column of the times, and that of the dates beside it, which alone is the times."""
    time = next((name for name in names if is_time(name)), None)
    day = next((name for name in names if re.fullmatch(r"_*dat(e|um)", name.strip(), re.IGNORECASE)), None)
    return (time, day) if time else (day, None)


def is_episode(name: str) -> bool:
    """True for the name of a column that counts the sequences of a file."""
    return bool(re.fullmatch(r"episode(_index|_id)?", name, re.IGNORECASE))


def parameter_unit(name: str) -> str:
    """The SI unit of a parameter or state that is called as in the machines here; "SI" where it is not."""
    return next((unit for names, unit in _UNIT_OF.items() if re.fullmatch(names, name)), "SI")


def quantities(values: Mapping[str, object], unit: Callable[[str], str] = parameter_unit) -> str:
    """Parameters or states as text, with their units."""
    numbers = {name: f"{value:.6g}" if isinstance(value, float) else value for name, value in values.items()}
    return ", ".join(f"{name} = {number} {unit(name)}" for name, number in numbers.items())


def other_unit(ratio: float, otherwise: str) -> str:
    """The hint where of two intervals that should be the same one is in s, the other in ms, us, ns or days."""
    units = ("ms", "us", "ns", "days")
    sizes = ((unit, x * UNITS[unit]) for unit in units for x in (ratio, 1 / ratio if ratio else 0.0))
    return next((f"one of the two is in {unit}: write s" for unit, size in sizes if 0.99 < size < 1.01), otherwise)


def joint_called(coordinates: Sequence[str], joint: int) -> str:
    """A joint, counted from 1, as a reader finds it: by its number, and its name where it has one of its own."""
    name = coordinates[joint - 1] if 0 < joint <= len(coordinates) else ""
    named = name and not re.fullmatch(r"(theta|x|q|joint)\d*", name)
    return f"joint {joint}" + (f" ({name})" if named else "")


def with_names(text: str, coordinates: Sequence[str]) -> str:
    """`text` with the name of every joint behind its number."""
    return re.sub(r"\bjoint (\d+)\b(?! \()", lambda match: joint_called(coordinates, int(match[1])), text)


def state_unit(angle: bool, *, rate: bool) -> str:
    """SI unit of a coordinate or of its rate: of an angle or of a position."""
    return ("rad" if angle else "m") + ("/s" if rate else "")


def force_unit(angle: bool) -> str:
    """SI unit of the generalised force that belongs to an angle or to a position."""
    return "N m" if angle else "N"
