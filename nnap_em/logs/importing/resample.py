"""One log on the grid of its rig: columns, sequences, and an account of what was done."""

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ...base.digits import counted
from ...errors import DataError
from ...machines.rig import SMOOTH, Rig, nearest
from ...machines.units import other_unit
from ..formats import refuse
from .columns import LONGEST, Plan, in_unit, resolve
from .files import read, reader
from .readings import as_taken
from .recording import UNTIMED, Address, Recording, Track
from .signals import (
    FEWEST_ROWS,
    SLOW,
    Signal,
    Spans,
    Stretch,
    averaged,
    covered,
    cut,
    held,
    hold,
    interpolated,
    longest_silence,
    present,
    runs,
    sent_on_change,
    straight,
)


class TopicFacts(NamedTuple):
    """Properties of a topic."""

    name: str
    kind: str
    columns: tuple[str, ...]
    """Columns of the data set; none: the topic is not used."""
    messages: int | None
    clock: str = ""
    rate: float = math.nan
    """Messages per second, by the median interval."""
    notes: tuple[str, ...] = ()


_Rows = tuple[Stretch, Mapping[str, Float[np.ndarray, " row"]]]


class Resampled(NamedTuple):
    """One log on the grid."""

    path: Path
    origin: int
    """First time of the log's clock [ns]."""
    addresses: Mapping[str, Address]
    topics: tuple[TopicFacts, ...]
    rows: int
    """Rows for which there are readings."""
    sequences: tuple[Stretch, ...]
    values: tuple[Mapping[str, Float[np.ndarray, " row"]], ...]
    """Columns of each sequence that is used, in order."""
    notes: tuple[str, ...]


def resample(path: Path, rig: Rig, plan: Plan, shifts: Mapping[str, float], unwrap: Collection[str] = ()) -> Resampled:
    """One log on the grid of the rig; `shifts` [s] are added to the times of topics.

    The columns to `unwrap` lose the jumps of their counters.
    Raises DataError where a column cannot be had.
    """
    for name in unwrap:
        if name not in (known := (*rig.logged_inputs, *rig.measured)):
            raise DataError(f"{path}: --unwrap {name}: no column of this rig; {nearest(name, known)}")
    topics = reader(path).topics(path)
    found = resolve(path, topics, rig.logged_inputs, rig.measured, plan.columns)
    scaled = {name: in_unit(path, name, at, rig) for name, at in found.items()}
    addresses, units = {name: at for name, (at, _) in scaled.items()}, [note for _, note in scaled.values() if note]
    for topic in shifts:
        if topic not in (used := sorted({at.topic for at in addresses.values()})):
            raise DataError(f"{path}: --shift {topic}: no topic of that name is used; {nearest(topic, used)}")
    recording = read(path, addresses.values())
    recording = recording._replace(tracks={topic: _timed(track, rig) for topic, track in recording.tracks.items()})
    origin = min(int(track.t[0]) for track in recording.tracks.values())
    clocks = {topic: (track.t - origin) / rig.ns + shifts.get(topic, 0.0) for topic, track in recording.tracks.items()}
    least = {name: 1 if name in rig.logged_inputs else 2 for name in addresses}
    signals = {name: _signal(recording, name, at, clocks[at.topic], least[name]) for name, at in addresses.items()}
    signals, notes = as_taken(signals, rig, unwrap)
    for name, s in signals.items():
        on_change = name in rig.logged_inputs and sent_on_change(s, rig.dt)
        signals[name] = replace(s, longest=math.inf if on_change else longest_silence(s, rig.dt, plan.gap))
    rows, sequences = _gridded(path, rig, plan, signals)
    facts = {each.name: TopicFacts(each.name, each.kind, (), each.messages) for each in topics}
    for topic, track in recording.tracks.items():
        columns = tuple(name for name, at in addresses.items() if at.topic == topic)
        rate = 1 / float(np.median(np.diff(clocks[topic]))) if track.t.size > 1 else math.nan
        known = {"columns": columns, "messages": track.t.size, "clock": track.clock, "rate": rate, "notes": track.notes}
        facts[topic] = facts[topic]._replace(**known)
    return Resampled(
        path,
        origin,
        addresses,
        tuple(facts.values()),
        rows,
        tuple(stretch for stretch, _ in sequences),
        tuple(columns for stretch, columns in sequences if not stretch.why),
        (*recording.notes, *units, *notes, *_late(recording.tracks, rig.dt, shifts), *_notes(rig, signals),
         *_dropped(rows, [stretch for stretch, _ in sequences], plan)),
    )  # fmt: skip


def _timed(track: Track, rig: Rig) -> Track:
    """A table without times, its rows `dt` apart, as the rig declares."""
    if track.clock != UNTIMED:
        return track
    note = f"no times in the table: rows are taken as dt = {rig.dt:g} {rig.time_unit} apart"
    return track._replace(t=np.round(1e-9 * rig.dt * rig.ns * track.t).astype(np.int64), notes=(note,))


def _signal(recording: Recording, name: str, at: Address, t: Float[np.ndarray, " message"], least: int) -> Signal:
    """A column at its own times; messages without that number are left out."""
    y = recording.tracks[at.topic].values[at.path]
    finite = np.isfinite(y)
    if np.count_nonzero(finite) < least:
        amount = f"{counted(np.count_nonzero(finite), 'number')} in {counted(y.size, 'message')}"
        problem = f"from {str(at)!r}: {amount}, the rest are NaN or absent"
        hint = "name a field that holds numbers in [import.columns], or take the log out"
        refuse(recording.path, f"column {name!r}", problem, hint)
    scale = at.scale or 1.0
    if finite.all():
        return Signal(at.topic, t, y * scale if scale != 1.0 else y)
    return Signal(at.topic, t[finite], y[finite] * scale)


def _gridded(path: Path, rig: Rig, plan: Plan, signals: Mapping[str, Signal]) -> tuple[int, list[_Rows]]:
    """Number of rows for which there are readings, and the sequences."""
    dt, readings = rig.dt, {name: signals[name] for name in rig.measured}
    end = max(float(s.t[-1]) for s in readings.values())
    watched = {name: present(s) for name, s in readings.items()}
    commanded = {
        name: present(s, hold(s, dt) if s.longest < math.inf else max(end - s.t[-1], 0.0))
        for name, s in signals.items()
        if name in rig.logged_inputs
    }
    common = _common(path, signals, watched | commanded)
    name, fastest = min(readings.items(), key=lambda item: item[1].interval)
    finest = 4.0  # rows from one message to the next of the fastest topic from which on the grid is refused as too fine
    if min(s.interval for s in signals.values() if rig.equations or s.topic == fastest.topic) > finest * dt:
        problem = f"dt = {dt:g} s is much finer than the readings, {fastest.interval:.4g} s apart ({name})"
        other = f"write dt = {float(f'{fastest.interval:.2g}'):g} in rig.toml"
        refuse(path, "[sampling] dt", problem, other_unit(fastest.interval / dt, other))
    spans = covered([*watched.values()], 1)
    pieces = runs(covered([spans, common, *commanded.values()], 2 + len(commanded)), fastest, dt)
    shortest = FEWEST_ROWS if plan.shortest is None else max(math.ceil(plan.shortest / dt), 2)
    longest = max(round((plan.longest or LONGEST) / dt), 2 if plan.longest else 10 * FEWEST_ROWS)
    sequences = [_sequence(stretch, rig, plan.mean, signals) for stretch in cut(pieces, dt, shortest, longest)]
    if all(stretch.why for stretch, _ in sequences):
        most = max((piece.rows for piece in pieces), default=0)
        problem = f"the longest stretch with all topics has {counted(most, 'row')}, a sequence needs {shortest} "
        problem += f"(dt = {dt:g} s, the fastest readings are {fastest.interval:.4g} s apart)"
        other = "record longer, or lower [import] shortest, or raise [import] gap"
        refuse(path, "the log", problem, other_unit(fastest.interval / dt, other))
    return sum(run.rows for run in runs(spans, fastest, dt)), sequences


def _common(path: Path, signals: Mapping[str, Signal], spans: Mapping[str, Spans]) -> Spans:
    """Interval in which all columns are present [s]; DataError where there is none."""
    ends = {name: (float(each[0, 0]), float(each[-1, 1])) for name, each in spans.items()}
    late, early = max(ends, key=lambda name: ends[name][0]), min(ends, key=lambda name: ends[name][1])
    if ends[early][1] <= ends[late][0]:
        ranges = ", ".join(f"{name!r} from {first:.6g} to {last:.6g} s" for name, (first, last) in ends.items())
        hint = f"--shift {signals[late].topic}=SECONDS where their clocks differ, or record them together"
        refuse(path, f"columns {early!r} and {late!r}", f"have no time in common ({ranges})", hint)
    return np.array([[ends[late][0], ends[early][1]]])


def _sequence(stretch: Stretch, rig: Rig, mean: bool, signals: Mapping[str, Signal]) -> _Rows:
    """Columns of a segment; dropped is one in which a column of readings is empty, which no other command accepts."""
    if stretch.why:
        return stretch, {}
    at = stretch.start + rig.dt * np.arange(stretch.rows)
    value = straight if rig.input_hold == SMOOTH else averaged if mean else held
    columns = {name: value(signals[name], at, rig.dt) for name in rig.logged_inputs}
    for name in rig.measured:
        columns[name] = interpolated(signals[name], at, rig.dt)
    missing = {name: int(np.isnan(columns[name]).sum()) for name in rig.measured}
    why = next((f"{name} has no reading there" for name, count in missing.items() if stretch.rows - count < 2), "")
    return stretch._replace(missing=missing, why=why), columns


def _late(tracks: Mapping[str, Track], dt: float, shifts: Collection[str]) -> Iterator[str]:
    """A message where stamps of topics are behind the log times by different numbers of rows."""
    late = {topic: track.late for topic, track in tracks.items() if topic not in shifts}
    if late and max(late.values()) - min(late.values()) > dt:
        for topic, each in late.items():
            if abs(each) > dt:
                side = "behind" if each > 0 else "ahead of"
                hint = f"where this is no latency, --shift {topic}={each:.3g} takes it out"
                yield f"stamps of {topic} are {abs(each):.3f} s {side} the log times, not those of others: {hint}"


def _dropped(rows: int, sequences: Sequence[Stretch], plan: Plan) -> Iterator[str]:
    """A message where more than a twentieth of the rows are in sequences that are too short."""
    lost = [stretch.rows for stretch in sequences if stretch.why]
    if sum(lost) > 0.05 * rows:
        text = f"{sum(lost)} of {counted(rows, 'row')} are left out, in {counted(len(lost), 'piece')} between silences"
        most = "5 intervals" if plan.gap is None else f"{plan.gap:g} s"
        yield f"{text} of more than {most}: [import] gap = SECONDS bridges longer ones, shortest = SECONDS keeps pieces"


def _notes(rig: Rig, signals: Mapping[str, Signal]) -> Iterator[str]:
    """Messages about commands that are held, and readings lost or interpolated between topics and rows."""
    end = max(float(signals[name].t[-1]) for name in rig.measured)
    for name in rig.logged_inputs:
        if (s := signals[name]).longest == math.inf and sent_on_change(s, rig.dt):
            amount = counted(s.t.size, "value")
            yield f"{name} is sent on change ({amount}, no rate): each is held until the next, the last to the end"
        elif (late := end - float(s.t[-1])) > s.longest:
            hint = "where the drive holds its last command, write [import] gap = inf"
            yield f"{name} ends {late:.3g} s before the readings: rows from there on are left out; {hint}"
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
            yield f"{s.topic or 'the table'} has {1 / rate:.3g} readings a row: those between rows are not used"
