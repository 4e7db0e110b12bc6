"""The times of topics: their order, stamps of other clocks, which clock to take, and one for all of a log."""

from collections.abc import Callable, Collection, Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, Real

from ..data.dataset import Array
from ..data.formats import refuse
from ..data.units import UNITS
from ..numerics.digits import counted
from .recording import SECOND, Lag, Recording, Track

BACK = 1.0
"""Seconds that a log may be out of order: writers of several threads are, a clock that was set back is more."""
Values = Mapping[str, Float[np.ndarray, " message"]]


def choose(
    path: Path, topic: str, log: Int[np.ndarray, " message"], stamp: Int[np.ndarray, " message"] | None, values: Values
) -> Track:
    """Columns at header stamps where they are there, rise and are of the log's clock; at log times otherwise [ns].

    Raises DataError where there is no time at all, or it runs backwards.
    """
    notes: tuple[str, ...] = ()
    if stamp is not None:
        order = np.argsort(log, kind="stable")
        used = order[trusted(stamp[order])]
        reason = _odd(stamp[used], log[used])
        if reason is None:
            track = _track(stamp, used, values, "header stamp", "message")
            return track._replace(lag=lags(stamp[used], log[used]))
        notes = (f"header stamps {reason}: log times are taken",)
    track = rising(path, f"topic {topic!r}", log, values, "log time", "message")
    return track._replace(notes=notes + track.notes, lag=((int(log[0]), 0),))


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


def lags(stamp: Int[np.ndarray, " message"], log: Int[np.ndarray, " message"]) -> Lag:
    """Median of stamp minus log time in parts of a topic, at the median stamp of each [ns]."""
    most = 20  # parts of a topic for each of which its stamps are compared with the log times
    least = 50  # messages of such a part at least, so that its median is no chance
    parts = np.array_split(np.arange(stamp.size), min(max(stamp.size // least, 1), most))
    return tuple((int(np.median(stamp[k])), int(np.median(stamp[k] - log[k]))) for k in parts)


def on_one_clock(recording: Recording, dt: float, shifted: Collection[str]) -> Recording:
    """The recording with its topics on the clock of the log, where their clocks differ by what is no latency.

    A stamp is behind the log time of its message by the latency of the recorder: never ahead of it, by no more than
    0.25 s, and by the same at the end as at the start, to a row each.  Within this, a difference of more than a row is
    reported, save for topics in `shifted`.
    """
    lag_of = {topic: np.array(track.lag, float).T for topic, track in recording.tracks.items() if track.lag}
    clocks = {track.clock for track in recording.tracks.values() if not track.lag}
    if len(clocks) > 1:
        names = " and ".join(repr(name) for name in sorted(clocks))
        return recording._replace(notes=(*recording.notes, f"times are of {names}: are these of one clock?"))
    if len(lag_of) < 2:
        return recording
    at = np.unique(np.concatenate([stamps for stamps, _ in lag_of.values()]))
    behind = {topic: -1e-9 * np.interp(at, *lag) for topic, lag in lag_of.items()}
    late = np.stack([*behind.values()])
    apart = late.max(0) - late.min(0)
    if apart.max() <= dt:
        return recording
    words = {
        topic: f"{topic} are {abs(np.median(each)):.3f} s {'behind' if np.median(each) > 0 else 'ahead of'}"
        for topic, each in behind.items()
        if np.abs(each).max() > dt
    }
    note = f"header stamps of {', those of '.join(words.values())} the clock of the log"
    latency = 0.25  # longest one of a recorder [s]: stamps that are more behind the log times are of another clock
    if late.min() < -dt or late.max() > latency or np.ptp(apart) > dt:
        tracks = dict(recording.tracks)
        for topic in words:
            t = tracks[topic].t
            tracks[topic] = tracks[topic]._replace(t=t - np.round(np.interp(t, *lag_of[topic])).astype(np.int64))
        note += ": taken out, all topics are on the clock of the log"
        return recording._replace(tracks=tracks, notes=(*recording.notes, note))
    if set(words) <= set(shifted):
        return recording
    hint = ", ".join(f"--shift {topic}={np.median(behind[topic]):.3g}" for topic in words)
    note += f", not those of other topics: where this is no latency, {hint} takes it out"
    return recording._replace(notes=(*recording.notes, note))


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


def _odd(stamp: Int[np.ndarray, " message"], log: Int[np.ndarray, " message"]) -> str | None:
    """Reason why stamps are no clock."""
    if stamp.max() == stamp.min():
        return "are all the same" if stamp[0] else "are all 0"
    back = np.flatnonzero(np.diff(stamp) < 0)
    if back.size:
        return f"run backwards ({back.size} times)"
    offset = float(np.median(np.abs(stamp - log))) * 1e-9
    if offset > 10.0:  # seconds between stamp and log time from which on they are those of two clocks
        return f"are of another clock, {offset:.4g} s from that of the log"
    knots = np.array(lags(stamp, log), dtype=float)
    set_ = np.abs(np.diff(knots[:, 1])) > 0.5 * np.diff(knots[:, 0])
    return "were set within the log" if set_.any() else None
