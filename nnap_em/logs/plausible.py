"""Plausibility of numbers of a valid form: wrong units and signs, wrapped angles, swapped columns, dead sensors,
copies.
"""

import math
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..base.digits import counted
from .counters import counter

Columns = Mapping[str, Float[np.ndarray, " time"]]
STRETCH = 20  # rows that two sequences do not have in common by chance
_DEGREES = "it looks like degrees: write rad and rad/s"
_ANGLE = (  # factor of an angle's rate of change over its rate column, the wrong one of the two, and the hint
    (math.degrees(1), "", _DEGREES),
    (math.radians(1), "d", _DEGREES),
    (1 / (2 * math.pi), "", "it looks like turns: write rad"),
    (2 * math.pi, "d", "it looks like turns/s: write rad/s"),
    (math.pi / 30, "d", "it looks like rpm: write rad/s"),
)
_ANY = (
    (1e3, "", "it looks like thousandths (mm, mrad): write SI units"),
    (1e-3, "d", "it looks like thousandths (mm/s, mrad/s), or time and dt are in ms: write SI units"),
)


class Implausible(NamedTuple):
    """Implausible part of a column, from which row on, and the hint."""

    ruins: bool
    """True where a fit would be wrong without a word; False where it may be meant."""
    column: str
    row: int | None
    problem: str
    hint: str


class Repeat(NamedTuple):
    """Rows that stand in two sequences, their clocks aside."""

    name: str
    row: int
    other: str
    there: int
    whole: bool
    """True where the sequences are the same from end to end."""


def implausible(
    readings: Columns, dt: float, unit: Callable[[str], str], pairs: Sequence[tuple[str, str]]
) -> Iterator[Implausible]:
    """Implausible parts of the columns of one sequence, sampled every `dt` [s]; `pairs` are coordinates and rates."""
    for name, values in readings.items():
        observed = values[np.isfinite(values)]
        if not observed.size:
            hint = "take the file out, or the column out of [measurement]"
            yield Implausible(True, name, None, "no sample at all", hint)
            return
        if observed.size > 1 and np.ptp(observed) == 0:
            yield Implausible(False, name, None, f"constant at {observed[0]:g}", "is the sensor alive?")
    for name, values in readings.items():
        if unit(name) in ("rad", "m"):
            yield from _wrapped(name, values, unit(name) == "rad")
    for name, rate in pairs:
        yield from _pair(name, rate, readings, dt, unit(name) == "rad")
    fastest = 30.0  # rad/s, as the median speed of a joint
    for name, values in readings.items():
        rate = unit(name) == "rad/s"
        if (rate or unit(name) == "rad") and (speed := _speed(values, dt, rate)) > fastest:
            yield Implausible(False, name, None, f"turns at {speed:.0f} rad/s", "is it in degrees? write rad and rad/s")


def repeats(sequences: Columns | Mapping[str, Float[np.ndarray, "time column"]]) -> Iterator[Repeat]:
    """The first stretch of each sequence that an earlier one holds too; standstill is no copy."""
    seen: dict[bytes, tuple[str, int]] = {}
    for name, rows in sequences.items():
        stretches = dict(_stretches(np.asarray(rows) + 0.0))  # no -0
        if same := next((content for content in stretches if content in seen), None):
            other, there = seen[same]
            yield Repeat(name, stretches[same], other, there, np.array_equal(rows, sequences[other], equal_nan=True))
        seen = {content: (name, row) for content, row in stretches.items()} | seen


def bridge(values: Float[np.ndarray, " time"]) -> Float[np.ndarray, " time"]:
    """Missing samples by straight lines between their neighbours."""
    k = np.flatnonzero(np.isfinite(values))
    return np.interp(np.arange(values.size), k, values[k])


def _stretches(rows: Float[np.ndarray, "time column"]) -> Iterator[tuple[bytes, int]]:
    """Every stretch of the sequence as its content and first row, those aside in which half the rows are the same."""
    length = min(STRETCH, len(rows))
    known = np.nan_to_num(rows, nan=math.inf)  # missing samples are alike
    kinds = np.unique(known, axis=0, return_inverse=True)[1].ravel() if rows.size else np.zeros(0)
    for k, window in enumerate(np.lib.stride_tricks.sliding_window_view(kinds, length)):
        if len(set(window.tolist())) > length / 2:
            yield np.ascontiguousarray(rows[k : k + length]).tobytes(), k


def _pair(name: str, rate: str, columns: Columns, dt: float, angle: bool) -> Iterator[Implausible]:
    """A coordinate against the integral of its rate: units, sign, and what is swapped."""
    fit, ratio = _follows(columns[name], columns[rate], dt)
    problem = f"the rate of {name!r} is {ratio:.3g} times column {rate!r}"
    for factor, wrong, hint in (*(_ANGLE if angle else ()), *_ANY):
        close = (0.7, 0.7 < ratio / factor < 1.4) if hint == _DEGREES else (0.9, 0.85 < ratio / factor < 1.18)
        if fit > close[0] and close[1]:
            yield Implausible(True, rate if wrong else name, None, problem, hint)
            return
    ways = "units, signs and names of the two"
    if fit > 0.9 and not 0.8 < ratio < 1.25:
        yield Implausible(False, rate, None, problem, f"it should be once: check {ways}")
    elif fit < -0.7 and 0.7 < ratio < 1.4:
        problem = f"the rate of {name!r} is minus column {rate!r}"
        yield Implausible(True, rate, None, problem, "turn the sign of the wrong one: both count in the same direction")
    elif fit < 0.5:
        fit, ratio = _follows(columns[rate], columns[name], dt)
        if fit > 0.95 and 0.8 < ratio < 1.25:
            problem = f"{name!r} is the rate of {rate!r}"
            yield Implausible(True, name, None, problem, f"swap the names {name!r} and {rate!r}")
            return
        if _moves(columns[name]) and _moves(columns[rate]):
            yield Implausible(False, rate, None, f"it is not the rate of {name!r}", f"check {ways}")


def _moves(values: np.ndarray) -> bool:
    """True where a signal is more than noise: its steps are small beside its range."""
    observed = values[np.isfinite(values)]
    return observed.size > STRETCH and float(np.std(np.diff(observed))) < 0.2 * float(np.std(observed))


def _follows(position: np.ndarray, rate: np.ndarray, dt: float) -> tuple[float, float]:
    """Correlation of the way of a coordinate with the integral of its rate, and how many times as long it is."""
    if np.isnan(position).all() or np.isnan(rate).all():
        return 0.0, 0.0
    moved, expected = _advance(position, dt), _advance(np.cumsum(bridge(rate)) * dt, dt)
    size, expected_size = math.sqrt(moved @ moved), math.sqrt(expected @ expected)
    return float(moved @ expected) / max(size * expected_size, 1e-300), size / max(expected_size, 1e-300)


def _advance(values: Float[np.ndarray, " time"], dt: float) -> Float[np.ndarray, " way"]:
    """Change within 0.1 s, which exceeds the noise of single readings."""
    span = min(max(round(0.1 / dt), 1), values.size - 1)
    values = bridge(values)
    return values[span:] - values[:-span]


def _wrapped(name: str, values: Float[np.ndarray, " time"], angle: bool) -> Iterator[Implausible]:
    """Jumps of a counter that starts over."""
    found = counter(values, angle=angle)
    if found is not None:
        row = int(found.rows[0])
        hint = f"take the jumps out: nnap-em import LOG ... --rig rig.toml --out NEW --unwrap {shlex.quote(name)}"
        hint += " (and convert degrees to rad)" if found.size == 360.0 else ""
        problem = f"{found}, in {counted(found.rows.size, 'place')}, here to {values[row]:.6g}"
        yield Implausible(True, name, row, problem, hint)


def _speed(values: np.ndarray, dt: float, rate: bool) -> float:
    """Median speed of an angle, or of the rate of one."""
    if rate:
        return float(np.nanmedian(np.abs(values)))
    span = min(max(round(0.1 / dt), 1), values.size - 1)
    return float(np.median(np.abs(_advance(values, dt)))) / (span * dt)
