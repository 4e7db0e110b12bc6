"""One log on the grid of its rig: columns, sequences, and an account of what was done."""

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..data.dataset import DataError
from ..data.rig import Rig, nearest
from ..data.units import thousandfold
from ..numerics.digits import counted
from .columns import declared_at, resolve
from .declared import LONGEST, Plan
from .delays import Delay, delay, pairs
from .files import reader
from .readings import as_taken
from .recording import Address, Recording, Topic, Track, refuse
from .segments import LEAST, Gap, Segment, commanded, cut, gaps, grid, longest_silence, reach, spans, watched
from .signals import SLOW, Signal, averaged, held, interpolated

COARSE = 4.0
"""Rows from one reading to the next of the fastest topic from which on the grid is refused as too fine."""


class TopicFacts(NamedTuple):
    """Properties of a topic."""

    name: str
    kind: str
    columns: tuple[str, ...]
    """Columns of the data set; none: the topic is not used."""
    messages: int | None
    clock: str = ""
    start: float = math.nan
    """First message, on the clock of the log's first one [s]."""
    end: float = math.nan
    rate: float = math.nan
    """Messages per second, by the median interval."""
    jitter: float = math.nan
    """Standard deviation of the intervals that are no gap [s]."""
    worst: float = math.nan
    """Largest deviation from the median of an interval that is no gap [s]."""
    gaps: tuple[Gap, ...] = ()
    notes: tuple[str, ...] = ()


class Stretch(NamedTuple):
    """Rows that become one file, or are dropped."""

    start: float
    """Time on the clock of the log [s]."""
    rows: int
    missing: Mapping[str, int]
    """Empty fields of readings."""
    why: str = ""
    """Reason why it is dropped."""


class Resampled(NamedTuple):
    """One log on the grid."""

    path: Path
    origin: int
    """First time of the log's clock [ns]."""
    addresses: Mapping[str, Address]
    topics: tuple[TopicFacts, ...]
    delays: tuple[Delay, ...]
    rows: int
    """Rows of the grid from the first to the last in which all topics are present."""
    sequences: tuple[Stretch, ...]
    values: tuple[Mapping[str, Float[np.ndarray, " row"]], ...]
    """Columns of each sequence that is used, in order."""
    notes: tuple[str, ...]


def resample(
    path: Path,
    rig: Rig,
    states: Sequence[str],
    plan: Plan,
    shifts: Mapping[str, float],
    unwrap: Collection[str] = (),
) -> Resampled:
    """One log on the grid of the rig; `states`: coordinates, then rates; `shifts` [s] are added to the times of topics.

    The columns to `unwrap` lose the jumps of their counters.
    Raises DataError where a column cannot be had.
    """
    for name in unwrap:
        if name not in (known := (*rig.logged_inputs, *rig.measured)):
            raise DataError(f"{path}: --unwrap {name}: no column of this rig; {nearest(name, known)}")
    source = reader(path)
    topics = source.topics(path)
    addresses = resolve(path, topics, rig.logged_inputs, rig.measured, plan.columns)
    twins = {f"{name}'": declared_at(path, topics, at, name) for name, at in plan.duplicates.items()}
    every = addresses | twins
    for topic in shifts:
        if topic not in {at.topic for at in every.values()}:
            known = nearest(topic, sorted({at.topic for at in every.values()}))
            raise DataError(f"{path}: --shift {topic}: no topic of that name is used; {known}")
    fields: dict[str, list[str]] = {}
    for at in every.values():
        fields.setdefault(at.topic, []).append(at.path)
    recording = source.read(path, {topic: tuple(dict.fromkeys(paths)) for topic, paths in fields.items()})
    origin = min(int(track.t[0]) for track in recording.tracks.values())
    clocks = {topic: (track.t - origin) * 1e-9 + shifts.get(topic, 0.0) for topic, track in recording.tracks.items()}
    signals = {name: _signal(recording, name, at, clocks[at.topic]) for name, at in every.items()}
    facts = tuple(_facts(topic, recording, addresses, origin, plan, rig.dt) for topic in topics)
    signals, notes = as_taken(signals, rig, unwrap)
    recording = recording._replace(notes=(*recording.notes, *notes))
    return _gridded(recording, origin, rig, states, plan, addresses, signals, facts)


def _signal(recording: Recording, name: str, at: Address, t: Float[np.ndarray, " message"]) -> Signal:
    """A column at its own times; messages without that number are left out."""
    y = recording.tracks[at.topic].values[at.path]
    finite = np.isfinite(y)
    if np.count_nonzero(finite) < 2:
        amount = f"{counted(np.count_nonzero(finite), 'number')} in {counted(y.size, 'message')}"
        problem = f"from {str(at)!r}: {amount}, the rest are NaN or absent"
        hint = "name a field that holds numbers in [import.columns], or take the log out"
        refuse(recording.path, f"column {name!r}", problem, hint)
    if finite.all():
        return Signal(at.topic, t, y * at.scale if at.scale != 1.0 else y)
    return Signal(at.topic, t[finite], y[finite] * at.scale)


def _gridded(
    recording: Recording,
    origin: int,
    rig: Rig,
    states: Sequence[str],
    plan: Plan,
    addresses: Mapping[str, Address],
    signals: Mapping[str, Signal],
    facts: tuple[TopicFacts, ...],
) -> Resampled:
    inputs = {name: signals[name] for name in rig.logged_inputs}
    readings = {name: signals[name] for name in rig.measured}
    start, end = _common(recording.path, inputs, readings, rig.dt)
    _fine(recording.path, readings, rig.dt)
    at = grid(readings, start, end, rig.dt)
    longest = {name: longest_silence(s, rig.dt, plan.gap) for name, s in signals.items()}
    present = _present(inputs, readings, at, rig.dt, longest)
    shortest = LEAST if plan.shortest is None else max(math.ceil(plan.shortest / rig.dt), 2)
    longest_part = max(round((plan.longest or LONGEST) / rig.dt), 2 if plan.longest else 10 * LEAST)
    columns = {name: (averaged if plan.mean else held)(s, at, rig.dt) for name, s in inputs.items()}
    columns |= {name: interpolated(s, at, rig.dt, reach(s, rig.dt))[0] for name, s in readings.items()}
    segments = [_checked(segment, columns, rig.measured) for segment in cut(present, shortest, longest_part)]
    used = [segment for segment in segments if not segment.why]
    if not used:
        most = max((segment.end - segment.first for segment in segments), default=0)
        problem = f"the longest stretch in which all topics have messages has {counted(most, 'row')}"
        hint = f"a sequence needs {shortest}: set [import] shortest or gap in rig.toml, or record longer"
        refuse(recording.path, "the log", problem, hint)
    around = tuple(rig.measured)
    joints = dict(zip(rig.input_columns, rig.input_joints, strict=True))
    causes = pairs(joints, states, signals, tuple(plan.duplicates))
    return Resampled(
        recording.path,
        origin,
        addresses,
        facts,
        tuple(delay(pair, signals, around if pair.held else ()) for pair in causes),
        at.size,
        tuple(_sequence(segment, columns, rig, at) for segment in segments),
        tuple({name: y[segment.first : segment.end] for name, y in columns.items()} for segment in used),
        (*recording.notes, *_notes(rig, signals)),
    )


def _common(path: Path, inputs: Mapping[str, Signal], readings: Mapping[str, Signal], dt: float) -> tuple[float, float]:
    """Interval in which all topics are present [s]; DataError where there is none."""
    intervals = spans(inputs, readings, dt)
    start, end = max(first for first, _ in intervals.values()), min(last for _, last in intervals.values())
    if end <= start:
        late = max(intervals, key=lambda topic: intervals[topic][0])
        early = min(intervals, key=lambda topic: intervals[topic][1])
        ranges = ", ".join(f"{topic!r} from {first:.6g} to {last:.6g} s" for topic, (first, last) in intervals.items())
        hint = f"--shift {late}=SECONDS where their clocks differ, or record them together"
        refuse(path, f"topics {early!r} and {late!r}", f"have no time in common ({ranges})", hint)
    return start, end


def _fine(path: Path, readings: Mapping[str, Signal], dt: float) -> None:
    """Refuse a grid on which next to no row would have a reading."""
    name, best = min(readings.items(), key=lambda item: item[1].interval)
    if best.interval > COARSE * dt:
        place = f"in {best.topic!r} ({name})" if best.topic else f"({name})"
        problem = f"dt = {dt:g} s is much finer than the readings, {best.interval:.4g} s apart {place}"
        other = f"write dt = {float(f'{best.interval:.2g}'):g} in rig.toml"
        hint = "one of the two is in ms: write s" if thousandfold(best.interval / dt) else other
        refuse(path, "[sampling] dt", problem, hint)


def _present(
    inputs: Mapping[str, Signal],
    readings: Mapping[str, Signal],
    at: Float[np.ndarray, " row"],
    dt: float,
    longest: Mapping[str, float],
) -> Bool[np.ndarray, " row"]:
    """Rows in which every input is known, and some topic of readings is present."""
    present = np.ones(at.size, bool)
    for name, s in _one_each(inputs):
        present &= commanded(s, at, dt, longest[name])
    seen = np.zeros(at.size, bool)
    for name, s in _one_each(readings):
        seen |= watched(s, at, dt, longest[name])
    return present & seen


def _one_each(signals: Mapping[str, Signal]) -> Iterator[tuple[str, Signal]]:
    """One of the columns that have the same times."""
    known = set()
    for name, s in signals.items():
        key = (s.topic, s.t.size)
        if key not in known:
            known.add(key)
            yield name, s


def _checked(segment: Segment, columns: Mapping[str, Float[np.ndarray, " row"]], measured: Sequence[str]) -> Segment:
    """A segment in which a column of readings is empty is dropped: no other command takes it."""
    for name in measured:
        if not segment.why and np.count_nonzero(np.isfinite(columns[name][segment.first : segment.end])) < 2:
            return segment._replace(why=f"{name} has no reading there")
    return segment


def _sequence(segment: Segment, columns: Mapping[str, np.ndarray], rig: Rig, at: Float[np.ndarray, " row"]) -> Stretch:
    rows = slice(segment.first, segment.end)
    missing = {name: int(np.isnan(columns[name][rows]).sum()) for name in rig.measured}
    return Stretch(float(at[segment.first]), segment.end - segment.first, missing, segment.why)


def _facts(
    topic: Topic, recording: Recording, addresses: Mapping[str, Address], origin: int, plan: Plan, dt: float
) -> TopicFacts:
    """Rate, jitter and gaps of a topic that was read; of others, the entries of the file."""
    track: Track | None = recording.tracks.get(topic.name)
    used = tuple(name for name, at in addresses.items() if at.topic == topic.name)
    if track is None:
        return TopicFacts(topic.name, topic.kind, used, topic.messages)
    t = (track.t - origin) * 1e-9
    steps = np.diff(t)
    typical = float(np.median(steps)) if steps.size else math.nan
    signal = Signal(topic.name, t, t)
    longest = longest_silence(signal, dt, plan.gap)
    usual = steps[steps <= longest]
    return TopicFacts(
        topic.name,
        topic.kind,
        used,
        t.size,
        track.clock,
        float(t[0]),
        float(t[-1]),
        1 / typical if typical > 0 else math.nan,
        float(np.std(usual)) if usual.size else math.nan,
        float(np.max(np.abs(usual - typical), initial=0.0)),
        tuple(gaps(signal, longest)),
        track.notes,
    )


def _notes(rig: Rig, signals: Mapping[str, Signal]) -> Iterator[str]:
    """Messages about readings lost or interpolated between topics and rows."""
    reported = set()
    for name in rig.measured:
        s = signals[name]
        rate = s.interval / rig.dt
        if s.topic in reported or (0.6 < rate <= SLOW):
            continue
        reported.add(s.topic)
        if rate > SLOW:
            yield f"readings of {s.topic or 'the table'} come every {rate:.3g} rows: the rows between are empty"
        else:
            yield f"{s.topic or 'the table'} has {1 / rate:.3g} messages a row: those between rows are not used"
