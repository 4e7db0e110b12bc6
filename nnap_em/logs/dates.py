"""Dates and times of day as loggers write them, as seconds."""

import functools
import math
import re
from collections.abc import Sequence
from datetime import date

import numpy as np
from jaxtyping import Float

_MOMENT = re.compile(
    r"(?:(\d{1,4})([-./ ])(\d{1,2}|[a-z]{3})\2(\d{1,4})[T ,_]*)?"
    r"(?:(\d{1,2}):(\d{2})(?::(\d{2}(?:[.,:]\d*)?))?\s*([ap]m)?)?\s*(?:Z|UTC|GMT|([+-]\d{2}):?(\d{2})?)?",
    re.IGNORECASE,
)
"""A date, a time of day, or both, with a zone."""


def moments(texts: Sequence[str]) -> Float[np.ndarray, " time"]:
    """Seconds since 1970, UTC where no zone is named, or since midnight without a date; infinite for another text.

    The day or the month of 11/03/2026 is first, as all the dates can be read, and lie closer together.
    """
    ways = (False, True) if texts and re.match(r"\s*\d{1,2}/", texts[0]) else (False,)
    every = [np.array([_moment(text, month_first) for text in texts]) for month_first in ways]
    return min(every, key=lambda t: (np.isinf(t).sum(), float(np.max(t) - np.min(t)) if np.isfinite(t).all() else 0.0))


def _moment(text: str, month_first: bool) -> float:
    text = re.sub(r"^(\d{4})(\d\d)(\d\d)T(\d\d)(\d\d)", r"\1-\2-\3T\4:\5:", text.strip().strip('"').strip())
    match = _MOMENT.fullmatch(text)
    if match is None or (match[1] or match[5]) is None:
        return math.inf
    first, _, middle, last, hour, minute, second, half, *zone = match.groups()
    t = _midnight(first, middle, last, month_first and match[2] == "/") if first else 0.0
    if hour:
        hours = int(hour) % 12 + 12 * (half.lower() == "pm") if half else int(hour)
        t += 3600 * hours + 60 * int(minute) + float(re.sub("[,:]", ".", second or "0"))
    east = 3600 * int(zone[0]) + math.copysign(60 * int(zone[1] or 0), int(zone[0])) if zone[0] else 0.0
    return t - east


@functools.cache
def _midnight(first: str, middle: str, last: str, month_first: bool) -> float:
    """Seconds from 1970 to a date, whose year is last where it is not first."""
    year, month, day = (first, middle, last) if len(first) == 4 else (last, middle, first)
    month, day = (day, month) if month_first and len(first) < 4 else (month, day)
    names = ["jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec"]
    try:
        number = names.index(month.lower()) + 1 if month.isalpha() else int(month)
        return 86400.0 * (date(int(year) + 2000 * (len(year) < 4), number, int(day)) - date(1970, 1, 1)).days
    except ValueError:
        return math.inf


def dated(values: np.ndarray) -> Float[np.ndarray, " time"]:
    """Seconds since 1970 of dates or of their texts; infinite for another text."""
    if values.dtype.kind in "Mm":
        return values.astype(f"{values.dtype.kind}8[ns]").astype(np.int64) * 1e-9
    return moments([text.decode() if isinstance(text, bytes) else str(text) for text in values.tolist()])
