"""The times of topics: their order, stamps of other clocks, and which clock to take."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, Real

from ...base.digits import counted
from ...machines.units import UNITS
from ..dataset import Array
from ..formats import refuse
from .recording import SECOND, Track

BACK = 1.0
"""Seconds that a log may be out of order: writers of several threads are, a clock that was set back is more."""
LATENCY = 0.25
"""Longest latency of a recorder [s]: stamps further behind the log times are of another clock."""
Values = Mapping[str, Float[np.ndarray, " message"]]


class Messages(NamedTuple):
    """Log times and stamps of the messages of a topic [ns], and their numbers."""

    log: Int[np.ndarray, " message"]
    stamp: Int[np.ndarray, " message"] | None
    values: Values


def choose(path: Path, topics: Mapping[str, Messages]) -> dict[str, Track]:
    """Columns at header stamps where these are there and rise, at log times otherwise [ns].

    The stamps of a log are of one clock, and log times the same but for a latency: where the medians of their
    difference, in the first and last fifth of each topic, are further apart than 0.25 s, all topics are at log times.
    Raises DataError where there is no time at all, or it runs backwards.
    """
    late = {topic: _late(*each[:2]) for topic, each in topics.items()}
    apart = float(np.ptp([(0.0, 0.0) if isinstance(each, str) else each for each in late.values()]))
    far = f"are of another clock, {apart:.4g} s from that of the log or of another topic"
    tracks = {}
    for topic, (log, stamp, values) in topics.items():
        where, each = f"topic {topic!r}", late[topic]
        if stamp is not None and not isinstance(each, str) and apart <= LATENCY:
            track = rising(path, where, stamp, values, "header stamp", "message")
            tracks[topic] = track._replace(late=float(np.mean(each)))
            continue
        why = each if isinstance(each, str) else far
        track = rising(path, where, log, values, "log time", "message")
        tracks[topic] = track._replace(notes=(*[f"header stamps {why}: log times are taken"] * bool(why), *track.notes))
    return tracks


def rising(
    path: Path, where: str, t: Int[np.ndarray, " message"], values: Values, name: str, noun: str = "row"
) -> Track:
    """Columns in the order of their times [ns], where these are a little out of it; refused where they are no clock."""
    kept = trusted(t)
    used = t[kept]
    if np.max(np.maximum.accumulate(used) - used) > BACK * SECOND:
        k = int(np.argmin(np.diff(used)))
        hint = "the clock was set back there: cut the file at that place, or take out a row with a wrong time"
        amount = float(used[: k + 1].max() - used[k + 1]) * 1e-9
        refuse(path, where, f"time runs backwards at {noun} {kept[k + 1] + 1}, by {amount:.6g} s", hint)
    if t.size > 1 and used.min() == used.max():
        hint = "record with stamps, or write the time [s] of each"
        refuse(path, where, f"has no stamps: all {kept.size} {noun}s are at {used[0] * 1e-9:g} s", hint)
    return _track(t, kept, values, name, noun)


def nanoseconds(
    path: Path, where: str, t: Real[np.ndarray, " row"], unit: str, days: Callable[[], Array] | None = None
) -> Int[np.ndarray, " row"]:
    """Times in ns, of a unit in `UNITS` or else of that which their size shows; `days` [s]: the midnight before each.

    Times of the day go on over midnight.  Raises DataError, with the unit, where they are too large for the unit.
    """
    if not np.isfinite(t).all():
        refuse(path, where, "holds times that are no numbers", "cut the rows without a time")
    steps, day = np.diff(t), 86400.0
    if unit in ("", "s") and (steps < 0).any() and t.min() >= 0 and t.max() < day:
        t = t + (days() if days else day * np.append(0, np.cumsum(steps < -day / 2)))
    # Seconds since 1970 in 2001 and 2099: numbers of this size are times of a clock in s, a thousandfold in ms
    since_1970 = (1.0e9, 4.1e9)
    low, high = since_1970
    size = float(np.median(np.abs(t.astype(np.float64)), overwrite_input=True))
    shown = next((name for name in ("s", "ms", "us", "ns") if low <= size * UNITS[name] < high), "")
    uptime = 1e14  # numbers from which on times are in ns: 28 hours of uptime, or 3 years in us
    if unit not in UNITS:
        unit = shown or ("ns" if size > uptime else "s")
    if size * UNITS[unit] > high:
        problem = f"holds times of {size:.4g}, too large for {unit}: they look like times in {shown or 'us or ns'}"
        refuse(path, where, problem, f"name it {f'time_{shown}' if shown else 'time_us or time_ns'}")
    # Nanoseconds within which times are held, so that their differences are no overflow: a wild stamp is wild there too
    latest = 4_600_000_000 * SECOND
    if t.dtype.kind in "iu":
        each = round(UNITS[unit] * SECOND)
        return np.clip(t.astype(np.int64), -latest // each, latest // each) * each
    return np.round(np.clip(t * (UNITS[unit] * SECOND), -latest, latest)).astype(np.int64)


def in_a_row(t: Int[np.ndarray, " row"], episode: Float[np.ndarray, " row"]) -> Int[np.ndarray, " row"]:
    """The times of episodes whose clocks restart, one after the other, with a silence between that is a gap."""
    steps = np.diff(t)
    new = np.diff(episode) != 0
    usual = np.mean(steps[~new]) if not new.all() else SECOND  # of single precision, the mean is exact
    # Intervals between two episodes: more than the 5 of a gap, and few enough for rows of the grid to stay in step
    return t[0] + np.append(0, np.cumsum(np.where(new, round(100 * usual), steps)))


def trusted(t: Int[np.ndarray, " message"]) -> Int[np.ndarray, " kept"]:
    """Messages whose times [ns] are of the clock of most: without the few that a silence of a day separates from them,
    zeros before a clock was set, or a wild stamp.
    """
    order = np.argsort(t, kind="stable")
    group = np.cumsum(np.append(0, np.diff(t[order]) > 86400.0 * SECOND)[: t.size])
    size = np.bincount(group)
    few = size <= 50  # rows that are no sequence of a machine that paused for a day
    share = 0.05  # of the times that may be wrong: a clock of which more are wrong was set in the middle of the log
    if not 0 < size[few].sum() <= share * t.size:
        return np.arange(t.size)
    return np.sort(order[~few[group]])


def _track(t: Int[np.ndarray, " m"], order: Int[np.ndarray, " used"], values: Values, name: str, noun: str) -> Track:
    """The last number of each column at each time, NaN where none has one; notes about messages moved or left out."""
    notes: list[str] = []
    if order.size < t.size:
        wild = np.delete(t, order)
        amount, middle = counted(wild.size, noun), float(np.median(t[order])) * 1e-9
        place = f"the first at {wild[0] * 1e-9:.10g} s, {abs(wild[0] * 1e-9 - middle):.3g} s from the others"
        notes.append(f"{amount} with a stamp of another clock dropped ({place})")
    if back := int(np.sum(np.diff(t[order]) < 0)):
        amount = float(np.max(np.maximum.accumulate(t[order]) - t[order])) * 1e-9
        notes.append(f"{counted(back, noun)} out of order by up to {amount:.2g} s: sorted")
        order = order[np.argsort(t[order], kind="stable")]
    t = t[order]
    first = np.flatnonzero(np.append(True, np.diff(t) > 0))
    if same := t.size - first.size:
        amount = counted(same, noun)
        notes.append(f"{amount} with the time of the next one: the last value of each column is taken")

    def last(y: Float[np.ndarray, " used"]) -> Float[np.ndarray, " kept"]:
        known = np.maximum.reduceat(np.where(np.isfinite(y), np.arange(y.size), -1), first)
        return np.where(known >= first, y[known], np.nan)

    columns = {column: last(y[order]) if same else y[order] for column, y in values.items()}
    return Track(t[first], columns, name, tuple(notes))


def _late(log: Int[np.ndarray, " message"], stamp: Int[np.ndarray, " message"] | None) -> tuple[float, float] | str:
    """Medians of log time minus stamp in the first and last fifth of the messages [s], or why stamps are no clock."""
    if stamp is None:
        return ""
    used = stamp[np.argsort(log, kind="stable")]
    used = used[trusted(used)]
    if used.max() == used.min():
        return "are all the same" if used[0] else "are all 0"
    if back := int(np.sum(np.diff(used) < 0)):
        return f"run backwards ({back} times)"
    late, part = (log - stamp) * 1e-9, log.size // 5 + 1
    return float(np.median(late[:part])), float(np.median(late[-part:]))
