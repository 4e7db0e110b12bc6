"""SI units: of parameters and states by their names, of what belongs to an angle or to a position."""

import math
import re
from collections.abc import Callable, Mapping, Sequence

_UNIT_OF = {  # of parameters and states, by their names
    r"g": "m/s^2", r"gr": "-", r"x": "m", r"dx": "m/s", r"theta\w*": "rad", r"dtheta\w*": "rad/s",
    r"mc?\d*": "kg", r"lc?\d*": "m", r"I[cr]?\d*": "kg m^2",
}  # fmt: skip
UNITS = {
    "s": 1.0, "sec": 1.0, "seconds": 1.0, "ms": 1e-3, "milliseconds": 1e-3, "us": 1e-6, "µs": 1e-6,
    "microseconds": 1e-6, "ns": 1e-9, "nanoseconds": 1e-9, "days": 86400.0,
}  # fmt: skip
"""Seconds in the units of times."""
SIZES = {  # units at the end of a name: the SI unit, and how many of it
    "deg/s": ("rad/s", math.pi / 180), "°/s": ("rad/s", math.pi / 180), "deg": ("rad", math.pi / 180),
    "°": ("rad", math.pi / 180), "rpm": ("rad/s", math.pi / 30), "mm/s": ("m/s", 1e-3), "mm": ("m", 1e-3),
    "mnm": ("N m", 1e-3), "nmm": ("N m", 1e-3), "rad/s": ("rad/s", 1.0), "rad": ("rad", 1.0), "m/s": ("m/s", 1.0),
    "nm": ("N m", 1.0), "n m": ("N m", 1.0), "n": ("N", 1.0), "m": ("m", 1.0),
    **{unit: ("s", size) for unit, size in UNITS.items()},
}  # fmt: skip
_TIME_NAMES = re.compile(r"_*(?:t|times?|timestamps?|stamp|clock|tout|x_value|zeit|zeitstempel)", re.IGNORECASE)
"""Names of a column of times: __time of PlotJuggler, tout of Simulink, X_Value of LabVIEW."""
_UNIT = re.compile(rf"(.+?)(?:[ _,]*[\[(]|[ _,]+)({'|'.join(SIZES)})[\])]?$", re.IGNORECASE)


def named_unit(name: str, *, brackets: bool = False) -> tuple[str, str]:
    """A name without the unit at its end, and that unit as in `SIZES`, or nothing; `brackets`: only in such."""
    match = None if brackets and name[-1:] not in ("]", ")") else _UNIT.match(name)
    return (match[1], match[2].lower()) if match else (name, "")


def is_time(name: str) -> bool:
    """True for the name of a column of times, which may end in a unit of times."""
    word, unit = named_unit(name)
    return bool(_TIME_NAMES.fullmatch(word)) and (not unit or unit in UNITS)


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
