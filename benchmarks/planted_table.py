"""What the reports on planted effects are worth: scores of a case, and the table of all.

A truth is named right by its own name, by an exact equivalent (`SAME`, and the gain of the other input, which is the
same where masses and friction are scaled too), or by its free form, an unknown function of the same signals; all at the
same joint or channel.  A law told in parts (an overtone as a second ripple, harmonics of a square wave) is no extra.
Parameters are scored where the law has its own name: right within 15 % (angles: 0.15 rad), and inside two stated
standard deviations.  An error is that of all measured angles together, root of the sum of squares [rad].
"""

import csv
import io
import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from planted_cases import LAWS, STRENGTHS, WRONG, Law
from runner import made

Entry = Mapping[str, Any]
Place = tuple[str, int | None, str | None]
HORIZONS = (0.25, 0.5, 1.0)
DECIDES = 1
"""Place of the horizon that is judged by, 0.5 s."""
RAISED = 1.02
"""An error beyond this times the one before is one that was raised."""
VISIBLE, SHOUTS = 1.3, 3.0
"""Multiples of the error of the rig as recorded, at some horizon, from which on a planted effect is visible in what is
predicted, and cannot be overlooked."""
SAME: dict[Place, tuple[tuple[Place, ...], ...]] = {
    ("sensor_bias", None, "theta1"): ((("base_tilt", None, None),),),
    ("sensor_delay", None, "all"): ((("input_delay", 1, None), ("input_delay", 2, None)),),
}
"""Models that are the same for the data; each is one or more effects."""
FREE: dict[str, tuple[str, ...]] = {
    "torsional_spring": ("theta",),
    "cogging": ("theta",),
    "motor_gain": ("tau",),
    "dead_zone": ("tau",),
    "position_dependent_friction": ("theta", "dtheta"),
    "eddy_brake": ("theta", "dtheta"),
}
"""Signals of the free form of a law, without the number of the joint."""
ANGLES = {"theta0": math.inf, "phase": 2 * math.pi, "center": math.pi}
"""Parameters that are angles, and their period [rad]."""

GROUP_COLUMNS = (
    "planted",
    "named right",
    "with a false law",
    "test error at 0.5 s not above before",
    f"of those named right, at most {VISIBLE} times as recorded after",
    "parameters within 15 %",
    "truth inside 2 std",
    "no report",
    "median s of a processor",
)
CASE_COLUMNS = (
    "case",
    "split",
    "commit",
    "truth (share of the typical torque)",
    "found",
    "right",
    "error at 0.25, 0.5, 1 s: before / after / unplanted [rad]",
    "s of a processor",
)


class Score(NamedTuple):
    """A case."""

    case: str
    split: str
    strength: str
    truths: int
    named: int
    """How many of the truths are named right."""
    extras: int
    near: tuple[bool, ...]
    """Parameter by parameter."""
    inside: tuple[bool, ...]
    before: tuple[float, ...] | None
    """At the horizons [rad]; None without a report."""
    after: tuple[float, ...] | None
    unplanted: tuple[float, ...] | None
    touches: tuple[int, int, int]
    """True ones, those found, and false ones."""
    seconds: float
    failed: str
    effects: str

    @property
    def right(self) -> bool:
        """All truths named; nothing, where there is none."""
        return self.named == self.truths and not (self.truths == 0 and self.extras)

    @property
    def worse(self) -> bool:
        """Whether the test error rises."""
        return bool(self.before and self.after and self.after[DECIDES] > self.before[DECIDES])

    @property
    def raised(self) -> bool:
        """Whether the test error rises by more than what counts as none."""
        return bool(self.before and self.after and self.after[DECIDES] > RAISED * self.before[DECIDES])

    def grown(self, side: str) -> float:
        """Largest multiple of the error as recorded at any horizon, `before` or `after`; NaN where one is not known."""
        errors = getattr(self, side)
        if not (errors and self.unplanted):
            return math.nan
        return max(error / base for error, base in zip(errors, self.unplanted, strict=True))


def place(entry: Entry) -> Place:
    """Name, joint and channel of an effect, told or true."""
    return entry["name"], entry.get("joint"), entry.get("channel")


def _near(a: float, b: float, share: float = 0.15) -> bool:
    return abs(a - b) <= share * abs(b)


def _value(entry: Entry, name: str) -> float:
    return entry["parameters"].get(name, {}).get("value", math.nan)


def _free(truth: Entry, entry: Entry) -> bool:
    """Whether an unknown function is the free form of a law."""
    if entry["name"] != "unknown_function" or entry["joint"] != truth.get("joint"):
        return False
    signals = truth["inputs"] or [f"{s}{truth.get('joint')}" for s in FREE.get(truth["name"], ())]
    return bool(signals) and set(entry["inputs"]) == set(signals)


def _other_gain(truth: Entry, entry: Entry) -> bool:
    """A gain of one input is the inverse gain of the other, with all masses and friction scaled."""
    names = {truth["name"], entry["name"]} == {"motor_gain"}
    return names and entry["joint"] != truth["joint"] and _near(_value(entry, "gain"), 1 / truth["parameters"]["gain"])


def _part(truth: Entry, entry: Entry) -> bool:
    """Whether an effect is a part of a law: an overtone, or a harmonic of a square wave."""
    numbers = truth["parameters"]
    if truth["law"] == "ripple" and place(entry) == place(truth):
        return any(_near(_value(entry, "k"), n * numbers["k"], 0.05) for n in (1, 2))
    if truth["law"] == "square" and entry["name"] == "base_vibration":
        return any(_near(_value(entry, "frequency"), n * numbers["frequency"], 0.02) for n in (1, 3, 5, 7))
    return False


def matched(truth: Entry, left: Sequence[Entry]) -> list[Entry]:
    """Which of the effects told so far unmatched name a truth; the one with its own name, if there is one, first."""
    named = [t for t in left if place(t) == place(truth) and truth["name"] != "unknown_function"]
    parts = [t for t in left if _part(truth, t) and t not in named[:1]]
    if named or parts:
        return [*named[:1], *parts]
    for same in SAME.get(place(truth), ()):
        entries = [t for t in left if place(t) in same]
        if len(entries) == len(same):
            return entries
    return [t for t in left if _free(truth, t) or _other_gain(truth, t)][:1]


def parameters(truth: Entry, entry: Entry, law: Law) -> tuple[list[bool], list[bool]]:
    """Parameter by parameter: right within 15 %, and inside two stated standard deviations."""
    near, inside = [], []
    for name in law.scored if place(entry) == place(truth) and entry["parameters"] else ():
        true, value = truth["parameters"][name], entry["parameters"][name]
        error = abs(value["value"] - true)
        if (period := ANGLES.get(name)) is not None:
            error = min(error % period, period - error % period) if math.isfinite(period) else error
        near.append(error <= (0.15 if name in ANGLES else 0.15 * abs(true)))
        inside.append(error <= 2 * value["std"])
    return near, inside


def errors(report: Entry, side: str) -> tuple[float, ...]:
    """Of the measured angles together at the horizons [rad]."""
    at = [report["error"]["horizons_s"].index(h) for h in HORIZONS]
    angles = [e for name, e in report["error"][side].items() if name.startswith("theta")]
    return tuple(math.hypot(*(e[i] for e in angles)) for i in at)


def _touches(true: Sequence[Entry], reported: Sequence[Entry]) -> tuple[int, int, int]:
    """True touches, those found (middle within 0.1 s, sign right), and what was told beside."""

    def same(a: Entry, b: Entry) -> bool:
        apart = abs(a["from"] + a["to"] - b["from"] - b["to"]) / 2
        return a["file"] == b["file"] and a["joint"] == b["joint"] and apart <= 0.1 and a["size"] * b["size"] > 0

    hits = sum(any(same(t, s) for s in reported) for t in true)
    return len(true), hits, sum(not any(same(t, s) for t in true) for s in reported)


def score(record: Entry, controls: Mapping[str, Entry]) -> Score:
    """A case, from its record and those of the rigs as recorded."""
    report, truths = record.get("report"), record["truth"]["effects"]
    left: list[Entry] = list(report["effects"]) if report else []
    named, near, inside = 0, [], []
    effects = "; ".join(map(words, left)) or "nothing"
    for truth in truths:
        entries = matched(truth, left)
        left = [t for t in left if t not in entries]
        named += bool(entries)
        for one in entries[:1]:
            flags = parameters(truth, one, LAWS[truth["law"]])
            near, inside = near + flags[0], inside + flags[1]
    known = bool(report and report["error"])
    control = controls.get(record["truth"]["rig"], {}).get("report")
    return Score(
        record["case"],
        record["truth"]["split"],
        record["truth"]["strength"],
        len(truths),
        named,
        len(left),
        tuple(near),
        tuple(inside),
        errors(report, "before") if known else None,
        errors(report, "after") if known else None,
        errors(control, "before") if control and control["error"] else None,
        _touches(record["truth"].get("touches", []), report.get("interventions", []) if report else []),
        record["processor_seconds"],
        record.get("failed", ""),
        record.get("failed", "") or effects,
    )


def words(entry: Entry) -> str:
    """An effect as the table names it."""
    where = entry.get("joint") or entry.get("channel") or ""
    of = f" of {', '.join(entry['inputs'])}" if entry.get("inputs") else ""
    return f"{entry['name']} {where}".strip() + of


def _numbers(values: Mapping[str, Any]) -> str:
    show = lambda v: f"{v['value']:.3g} ± {v['std']:.1g}" if isinstance(v, dict) else f"{v:.3g}"  # noqa: E731
    return ", ".join(f"{name} {show(value)}" for name, value in values.items())


def _group(scores: Sequence[Score], title: str) -> str:
    after = [s.grown("after") <= VISIBLE for s in scores if s.right and s.unplanted]
    near, inside = [f for s in scores for f in s.near], [f for s in scores for f in s.inside]
    scored = [s for s in scores if s.before]
    cells = [
        title,
        _of([s.right for s in scores]),
        _of([s.extras > 0 for s in scores]),
        _of([not s.worse for s in scored]),
        _of(after),
        _of(near),
        _of(inside),
        _of([bool(s.failed) for s in scores]),
        f"{statistics.median(s.seconds for s in scores):.0f}",
    ]
    return _row(cells)


def _row(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _of(flags: Sequence[bool]) -> str:
    return f"{sum(flags)} of {len(flags)}" if flags else "-"


def _head(names: Sequence[str]) -> list[str]:
    return [_row(names), _row(["---"] * len(names))]


def table(records: Sequence[Entry]) -> str:
    """Sums of all cases as Markdown: by what is visible, and of the rigs as recorded."""
    controls = {r["truth"]["rig"]: r for r in records if r["truth"]["strength"] == "none"}
    scores = {r["case"]: score(r, controls) for r in records}
    planted = [s for s in scores.values() if s.strength in STRENGTHS]
    outside = {r["case"] for r in records if any(t["name"] == "unknown_function" for t in r["truth"]["effects"])}
    hidden = {r["case"] for r in records if r["truth"]["rig"].endswith("_joint1")}
    groups = {
        f"error raised {SHOUTS:g} times and more": [s for s in planted if s.grown("before") >= SHOUTS],
        f"{VISIBLE} times and more (visible)": [s for s in planted if s.grown("before") >= VISIBLE],
        "less, or not known": [s for s in planted if not s.grown("before") >= VISIBLE],
        "two effects": [s for s in planted if s.truths == 2],
        "off the catalogue": [s for s in planted if s.case in outside],
        "joint 2 hidden": [s for s in planted if s.case in hidden],
        "all": planted,
    }
    commits = ", ".join(sorted({r["code"] for r in records}))
    lines = [made(of=commits, command="python benchmarks/planted.py run --out OUT"), *_head(GROUP_COLUMNS)]
    lines += [_group(group, title) for title, group in groups.items() if group]
    as_recorded = [s for s in scores.values() if s.strength == "none"]
    if as_recorded:
        reported = sum(s.extras > 0 for s in as_recorded)
        raised = sum(s.raised and s.extras > 0 for s in as_recorded)
        lines.append(
            f"\nAs recorded: {len(as_recorded)} rigs, something reported on {reported}, the 0.5 s test error raised"
        )
        lines.append(f"by more than 2 % on {raised}.")
    if off := [s for s in scores.values() if s.strength in WRONG]:
        lines.append(
            f"\nDeclared numbers one or two standard deviations off: {len(off)} runs, something reported on "
            f"{sum(s.extras > 0 for s in off)}."
        )
    true, hits = (sum(s.touches[i] for s in scores.values()) for i in range(2))
    lines += ["", f"External disturbances: {hits} of {true} known ones found; beside them", ""]
    for state, kept in (("as recorded", as_recorded), ("with planted effects", planted)):
        span = sum(r["log_seconds"] for r in records if scores[r["case"]] in kept)
        lines.append(f"- {state}: {sum(s.touches[2] for s in kept)} in {span:.0f} s of training recordings")
    return "\n".join([*lines, ""])


def cases(records: Sequence[Entry]) -> str:
    """Every case as CSV, those as recorded last."""
    controls = {r["truth"]["rig"]: r for r in records if r["truth"]["strength"] == "none"}
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(CASE_COLUMNS)
    for record in sorted(records, key=lambda r: (r["truth"]["strength"] == "none", r["case"])):
        writer.writerow(_cells(record, score(record, controls)))
    return out.getvalue()


def _cells(record: Entry, s: Score) -> Sequence[str]:
    truth = "; ".join(
        f"{words(t)} ({_numbers(t['parameters'])}; {100 * t['share']:.0f} %)" for t in record["truth"]["effects"]
    )
    effects = record["report"]["effects"] if "report" in record else []
    reported = "; ".join(f"{words(e)} ({_numbers(e['parameters'])})" if e["parameters"] else words(e) for e in effects)
    mark = "yes" if s.right and not s.extras else "with extras" if s.right else f"{s.named} of {s.truths}"
    if not s.truths:
        mark = "false" if s.extras else "yes"
    nothing = (math.nan,) * len(HORIZONS)
    sides = zip(*(side or nothing for side in (s.before, s.after, s.unplanted)), strict=True)
    error = ", ".join(" / ".join(f"{e:.3g}" for e in three) for three in sides)
    return (
        s.case,
        s.split,
        record["code"],
        truth or "-",
        s.failed or reported or "nothing",
        mark,
        error,
        f"{s.seconds:.0f}",
    )
