"""The report of a diagnosis as one page: a single HTML file without scripts that fetches nothing.

`document` is what report.json holds; any of its keys may be missing or null.
"""

import base64
import math
import re
import struct
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any, NamedTuple

LEVEL = 0.05
"""Corrected p-value below which a test counts as failed."""

MEANINGS = {
    "torsional_spring": "A joint is pulled back to a rest position, as by a cable or a spring.",
    "base_tilt": "The base is not level: gravity points in another direction than declared.",
    "payload": "There is more mass at the tip than declared.",
    "link_inertia": "A link is harder (or easier) to spin than declared.",
    "link_length": "A link is longer (or shorter) than declared.",
    "center_of_mass": "The centre of mass of a link is not where declared.",
    "air_drag": "A brake that grows with the square of speed, as air does.",
    "motor_gain": "The motor delivers another torque than commanded, in a fixed proportion.",
    "dead_zone": "Small commands have no effect.",
    "saturation": "The motor cannot deliver more than a limit.",
    "input_delay": "Commands act late.",
    "actuator_lag": "The motor follows its command gradually.",
    "cogging": "A torque that repeats with the angle, as from magnets or gear teeth.",
    "torque_offset": "A constant torque at a joint.",
    "backlash": "Play between motor and joint.",
    "presliding_friction": "Friction with memory: before it slides, the joint gives like a spring.",
    "position_dependent_friction": "Friction is stronger at some angles than at others.",
    "friction_drift": "Friction changes with time, as by warming up.",
    "sensor_bias": "A sensor is off by a constant.",
    "sensor_scale": "A sensor reads too large or too small, in a fixed proportion.",
    "sensor_delay": "A sensor reports late.",
    "sensor_quantization": "A sensor reads in steps.",
    "base_vibration": "The base shakes, or something else forces the machine periodically.",
    "payload_step": "The payload changed at a moment of the session.",
    "hard_stop": "A joint meets a stop.",
    "eddy_brake": "A brake that works at some angles, as by a magnet.",
    "joint_flexibility": "The transmission between motor and joint gives elastically.",
    "motor_back_emf": "The torque of the motor falls with its speed.",
    "unknown_function": "A force that no known law describes; its shape was learned.",
}
WORDS = {
    "torsional_spring": {"k": "stiffness", "theta0": "rest position"},
    "base_tilt": {"angle": "tilt"},
    "payload": {"mass": "added mass"},
    "link_inertia": {"dI": "added inertia"},
    "link_length": {"dl": "added length"},
    "center_of_mass": {"dlc": "shift outwards"},
    "air_drag": {"c": "drag coefficient"},
    "motor_gain": {"gain": "delivered / commanded"},
    "dead_zone": {"width": "half width"},
    "saturation": {"limit": "limit"},
    "actuator_lag": {"tau": "time constant"},
    "cogging": {"amplitude": "amplitude", "k": "periods per turn", "phase": "phase"},
    "torque_offset": {"value": "torque"},
    "backlash": {"gap": "play"},
    "presliding_friction": {"sigma0": "stiffness"},
    "position_dependent_friction": {"depth": "relative depth", "n": "periods per turn", "phase": "phase"},
    "friction_drift": {"change": "relative change", "tau": "time constant"},
    "sensor_scale": {"scale": "reading / value"},
    "base_vibration": {"amplitude": "amplitude", "frequency": "frequency", "phase": "phase"},
    "payload_step": {"mass": "added mass", "time": "moment"},
    "hard_stop": {"upper": "upper stop", "lower": "lower stop"},
    "eddy_brake": {"c": "largest damping", "center": "strongest at"},
    "joint_flexibility": {"k": "stiffness"},
    "motor_back_emf": {"b": "torque lost per speed"},
}


class Picture(NamedTuple):
    """A figure of the page."""

    title: str
    caption: str
    image: bytes
    """PNG or SVG."""
    place: str = "residual"
    """Section: "found", "error", "residual" or "details"."""


Figures = Sequence[Picture | tuple[str, str, bytes]]


def page(document: Mapping[str, Any], figures: Figures = ()) -> str:
    """The whole page; raises ValueError where an image is neither PNG nor SVG."""
    pictures = [figure if isinstance(figure, Picture) else Picture(*figure) for figure in figures]
    for picture in pictures:
        if picture.place not in ("found", "error", "residual", "details"):
            raise ValueError(
                f"figure {picture.title!r}: place {picture.place!r}; use found, error, residual or details"
            )

    def drawn(place: str) -> str:
        return "".join(_figure(picture) for picture in pictures if picture.place == place)

    effects = document.get("effects") or []
    parts = [
        _head(document),
        _section("What was found, and how sure", _found(effects, _doubted(document)) + drawn("found")),
        _section("Before and after" if effects else "Prediction error", _before_after(document) + drawn("error")),
        _section("What the declared model leaves unexplained", drawn("residual")),
        _section("What could not be told apart", _alike(effects)),
        _section("What was not used of the logs", _masked(document.get("masked") or [])),
        _section("What to measure next", _list(document.get("next") or [])),
        _section("Details", _details(document, drawn("details"))),
    ]
    title = escape(f"Diagnosis of {document.get('rig') or 'a rig'}")
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta http-equiv="Content-Security-Policy" '
        "content=\"default-src 'none'; img-src data:; style-src 'unsafe-inline'\">\n"
        f"<title>{title}</title>\n<style>{_CSS}</style>\n</head>\n<body>\n<main>\n{''.join(parts)}</main>\n</body>\n</html>\n"
    )


def label(effect: Mapping[str, Any]) -> str:
    """An effect, or what else has a name, a joint, a channel and inputs, as a reader would call it."""
    text = str(effect.get("name") or "unnamed").replace("_", " ")
    if effect.get("inputs"):
        text += f" of {' and '.join(map(str, effect['inputs']))}"
    if effect.get("joint"):
        text += f" at joint {effect['joint']}"
    if effect.get("channel"):
        text += " on all sensors" if effect["channel"] == "all" else f" on {effect['channel']}"
    return text


# --- numbers


def number(value: Any, digits: int = 3) -> str:
    """A number in so many significant digits; a dash where there is none."""
    if value is None or isinstance(value, str) or not math.isfinite(value):
        return "–" if not isinstance(value, str) else value
    if value == 0:
        return "0"
    if isinstance(value, bool | int) and abs(value) < 1e6:
        return str(value)
    size = math.floor(math.log10(abs(float(f"{value:.{digits - 1}e}"))))
    if -4 <= size < 6:
        return f"{value:.{max(digits - 1 - size, 0)}f}".replace("-", "−")
    return _power(value / 10.0**size, size, digits - 1)


def with_std(value: Any, std: Any) -> str:
    """A value and its standard deviation, both to the second digit of the latter."""
    if std is None or not math.isfinite(std) or std <= 0 or value is None or not math.isfinite(value):
        return number(value, 4)
    places = 1 - math.floor(math.log10(std))
    size = math.floor(math.log10(max(abs(value), std)))
    if -4 <= size < 6:
        places = min(max(places, 0), 12)
        return f"{value:.{places}f} ± {std:.{places}f}".replace("-", "−")
    decimals = min(max(places + size, 0), 12)
    scale = 10.0**size
    return f"({value / scale:.{decimals}f} ± {std / scale:.{decimals}f})".replace("-", "−") + _exponent(size)


def _power(mantissa: float, exponent: int, decimals: int) -> str:
    return f"{mantissa:.{decimals}f}".replace("-", "−") + _exponent(exponent)


def _exponent(exponent: int) -> str:
    return f" × 10{_raised(exponent)}"


def _raised(exponent: int) -> str:
    return str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))


def _chance(p: Any) -> str:
    if p is None:
        return ""
    if p < 1e-12:
        return "less than one in a million million"
    if p < 1e-3:
        return f"about one in 10{_raised(round(-math.log10(p)))}"
    return f"about one in {1 / p:.0f}" if p < 0.1 else number(p, 2)


def _p_value(p: Any) -> str:
    return f"&lt; 10{_raised(-300)}" if p == 0 else number(p, 2)


def _ratio(before: Any, after: Any) -> str:
    if not (_finite(before) and _finite(after)) or after <= 0 or before <= 0:
        return "–"
    ratio = before / after
    if 0.95 < ratio < 1.05:
        return "same"
    return f"{number(ratio, 2)} ×" if ratio > 1 else f"{number(1 / ratio, 2)} × larger"


def _finite(value: Any) -> bool:
    return isinstance(value, int | float) and math.isfinite(value)


def _unit(column: str) -> str:
    angle = column.removeprefix("d").startswith("theta")
    return ("rad" if angle else "m") + ("/s" if column.startswith("d") else "")


def _blank(unit: Any) -> str:
    return "" if unit in (None, "", "-") else f" {unit}"


# --- sections


def _head(document: Mapping[str, Any]) -> str:
    rig, system = document.get("rig") or "a rig", document.get("system")
    effects = document.get("effects") or []
    names = " and ".join(label(e) for e in effects)
    verdict = document.get("verdict") or (
        f"The declared model lacks {names}." if effects else "Nothing is missing that these data could show."
    )
    kind = f' <span class="soft">({escape(str(system))})</span>' if system and system != rig else ""
    state = "some" if effects else "none"
    return (
        f'<header><p class="eyebrow">Diagnosis of {escape(str(rig))}{kind}</p>\n'
        f'<h1 class="{state}">{escape(str(verdict))}</h1>{_figures_of_merit(document)}</header>\n'
    )


def _figures_of_merit(document: Mapping[str, Any]) -> str:
    """Two or three numbers under the verdict."""
    tiles = []
    error = document.get("error") or {}
    horizons = error.get("horizons_s") or []
    if horizons:
        at = min(range(len(horizons)), key=lambda i: abs(horizons[i] - 1.0))
        for column, values in list((error.get("before") or {}).items())[:2]:
            before, after = _at(values, at), _at((error.get("after") or {}).get(column), at)
            title = f"error of {column}, {horizons[at]:g} s ahead"
            if document.get("effects"):
                ratio = _ratio(before, after)
                change = f"{number(before, 2)} → {number(after, 2)} {_unit(column)}"
                tiles.append((title, change, f"{ratio} smaller" if ratio.endswith("×") else ratio))
            else:
                tiles.append((title, f"{number(before, 2)} {_unit(column)}", "on test sequences"))
    failed = _failures(document.get("tests"))
    if failed:
        text = f"{failed.before}" if failed.after is None else f"{failed.before} → {failed.after}"
        tiles.append(("failed tests of one-step errors", text, f"of {failed.total}; a right model fails none"))
    cells = "".join(
        f"<li><span>{escape(a)}</span><strong>{escape(b)}</strong><span>{escape(c)}</span></li>" for a, b, c in tiles
    )
    return f'\n<ul class="tiles">{cells}</ul>' if cells else ""


def _at(values: Any, place: int) -> Any:
    return values[place] if values and place < len(values) else None


class _Failed(NamedTuple):
    """How many tests failed before and after (None: there is no after), and how many of these by little."""

    total: int
    before: int
    after: int | None
    slight_before: int
    slight_after: int


def _failures(tests: Any) -> _Failed | None:
    if not (tests and tests.get("before")):
        return None
    sides = [[t for t in tests.get(side) or [] if _fails(t)] for side in ("before", "after")]
    slight = [sum(bool(t.get("slight")) for t in side) for side in sides]
    first, last = (len(side) - little for side, little in zip(sides, slight, strict=True))
    return _Failed(len(tests["before"]), first, last if tests.get("after") else None, *slight)


def _fails(test: Mapping[str, Any]) -> bool:
    p = test.get("p_value")
    return _finite(p) and p < LEVEL  # type: ignore[operator]


def _doubted(document: Mapping[str, Any]) -> bool:
    """Whether the test sequences speak against what was found."""
    error = document.get("error") or {}
    horizons = error.get("horizons_s") or []
    if 1.0 not in horizons or not document.get("effects"):
        return False
    at = horizons.index(1.0)
    pairs = [(error["before"][c][at], error["after"][c][at]) for c in error["before"] if c in error["after"]]
    known = [(b, a) for b, a in pairs if _finite(b) and _finite(a)]
    return bool(known) and known[0][1] >= known[0][0]


def _found(effects: Sequence[Mapping[str, Any]], doubted: bool) -> str:
    if not effects:
        return (
            "<p>No effect of the catalogue, and no unknown force, improves the model by more than chance would. "
            "Weaker effects than these data can show are not excluded.</p>"
        )
    note = (
        '<p class="evidence">nat: the unit of log-likelihood; every 2.3 nat make the data ten times as likely. '
        "±: one standard deviation.</p>"
    )
    return f'<div class="cards">{"".join(_card(e, doubted) for e in effects)}</div>{note}'


def _card(effect: Mapping[str, Any], doubted: bool) -> str:
    name = str(effect.get("name") or "")
    told = [MEANINGS.get(name, "")]
    description = str(effect.get("description") or "")
    if description and ("±" not in description or not told[0]):
        told.append(description[0].upper() + description[1:].rstrip(".").replace("_", " ") + ".")
    rows = []
    for key, entry in (effect.get("parameters") or {}).items():
        value, std, unit = _entry(entry)
        word = WORDS.get(name, {}).get(key)
        gloss = f" <i>{escape(key)}</i>" if word and word != key else ""
        rows.append(
            f"<dt>{escape(word or key)}{gloss}</dt><dd>{escape(with_std(value, std))}{escape(_blank(unit))}</dd>"
        )
    table = f"<dl>{''.join(rows)}</dl>" if rows else ""
    text = "".join(f"<p>{escape(t)}</p>" for t in told if t)
    title = label(effect)
    return (
        f"<article><h3>{escape(title[:1].upper() + title[1:])}</h3>{text}{table}{_evidence(effect, doubted)}</article>"
    )


def _entry(entry: Any) -> tuple[Any, Any, Any]:
    """Value, standard deviation and unit of a parameter, however it is written."""
    if isinstance(entry, Mapping):
        return entry.get("value", entry.get("mean")), entry.get("std"), entry.get("unit")
    if isinstance(entry, list | tuple):
        return tuple([*entry, None, None, None][:3])  # type: ignore[return-value]
    return entry, None, None


def _evidence(effect: Mapping[str, Any], doubted: bool) -> str:
    evidence = effect.get("evidence") or {}
    gain, held, p = (evidence.get(k) for k in ("log_likelihood_gain", "held_out_gain", "p_value"))
    lines = []
    decisive = held if _finite(held) else gain
    if decisive is not None and _finite(decisive):
        steps = ((100, "beyond doubt"), (30, "very sure"), (10, "sure"), (3, "likely"))
        word = next((w for least, w in steps if decisive >= least), "a hint only")
        word = "doubtful: the test sequences are predicted no better with it" if doubted else word
        lines.append(f'<span class="sure">{escape(word[0].upper() + word[1:])}.</span>')
    if _finite(gain):
        lines.append(f"The training data speak for it with {number(gain, 3)} nat.")
    if _finite(held):
        lines.append(f"Sequences that had no part in the fit agree: {number(held, 3)} nat.")
    loss = evidence.get("loss_without_it")
    if _finite(loss):
        lines.append(f"Taking it out again would cost {number(loss, 3)} nat.")
    if _finite(p):
        lines.append(f"Chance of such a gain by luck, all that was tried counted: {escape(_chance(p))}.")
    if not lines:
        return ""
    return f'<p class="evidence">{" ".join(lines)}</p>'


def _before_after(document: Mapping[str, Any]) -> str:
    error = document.get("error") or {}
    columns, horizons = list((error.get("before") or {}).keys()), error.get("horizons_s") or []
    parts = []
    if columns and horizons:
        given = error.get("given_s")
        since = f"the first {number(given, 2)} s" if _finite(given) else "the start"
        parts.append(
            f"<p>Each test sequence is predicted from {since} of its readings, without looking at the rest. "
            "The error is the root mean square of prediction minus reading, up to the time ahead. "
            "Test sequences had no part in any choice.</p>"
        )
        changed = bool(document.get("effects"))
        names = ("before", "after", "smaller by") if changed else ("error",)
        head = '<th rowspan="2">time ahead</th>' + "".join(
            f'<th colspan="{len(names)}" class="group">{escape(c)} [{_unit(c)}]</th>' for c in columns
        )
        second = "".join(f'<th class="{"group" if n == names[0] else ""}">{n}</th>' for _ in columns for n in names)
        rows = []
        for i, horizon in enumerate(horizons):
            cells = [f'<th scope="row">{number(horizon, 2)} s</th>']
            for c in columns:
                before, after = (_at((error.get(s) or {}).get(c), i) for s in ("before", "after"))
                cells.append(f'<td class="group">{number(before)}</td>')
                if changed:
                    cells.append(f'<td><b>{number(after)}</b></td><td class="ratio">{_ratio(before, after)}</td>')
            rows.append(f"<tr>{''.join(cells)}</tr>")
        parts.append(_box(f"<thead><tr>{head}</tr><tr>{second}</tr></thead><tbody>{''.join(rows)}</tbody>"))
    failed = _failures(document.get("tests"))
    if failed:
        parts.append(f"<p>{_tests_told(failed)}</p>")
    if document.get("friction_change"):
        parts.append(f"<p>{escape(str(document['friction_change']))}</p>")
    return "".join(parts)


def _tests_told(failed: _Failed) -> str:
    before, after = failed.before, failed.after
    text = (
        f"Of {failed.total} tests that the errors from one sample to the next are pure noise, {before or 'none'} failed"
    )
    more = [f"{failed.slight_before or 'none'}", f"{failed.slight_after or 'none'}"]
    if after is not None:
        text += f" before and {after or 'none'} {'fails' if after in (0, 1) else 'fail'} after"
    if not (failed.slight_before or failed.slight_after):
        return text + "."
    return (
        f"{text} (not counting {more[0] if after is None else ' and '.join(more)} that failed by too little to matter)."
    )


def _alike(effects: Sequence[Mapping[str, Any]]) -> str:
    if not effects:
        return ""
    rows = []
    for effect in effects:
        others = effect.get("equivalent") or []
        if others:
            rows.append(f"{label(effect)}: the data cannot tell it from {' or '.join(label(o) for o in others)}.")
    if not rows:
        return "<p>Nothing: no other effect that was tried explains these data nearly as well.</p>"
    return _list(row[0].upper() + row[1:] for row in rows)


def _masked(entries: Sequence[Mapping[str, Any]]) -> str:
    if not entries:
        return ""
    head = "".join(f"<th>{h}</th>" for h in ("file", "column", "what", "how many", "first at"))
    rows = []
    for e in entries:
        told = (f"{e.get('part')}/{e.get('file')}", e.get("column") or "all", e.get("kind"), e.get("amount"))
        cells = "".join(f"<td>{escape(str(cell))}</td>" for cell in told)
        rows.append(f"<tr>{cells}<td>{number(e.get('time'), 4)} s</td></tr>")
    return (
        "<p>These readings were taken as missing: they are far from what the rows around them say, or their sensor "
        "stood still while the machine moved. <i>gap</i>: rows that the log lost; <i>cut</i>: rows after a gap that "
        "nothing could bridge. Errors of prediction are against all readings of the test files. "
        "<code>--trust-readings</code> uses the readings as they are.</p>"
    ) + _box(f"<thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody>", "left")


def _list(sentences: Iterable[Any]) -> str:
    items = "".join(f"<li>{escape(str(s).replace('_', ' '))}</li>" for s in sentences)
    return f"<ul>{items}</ul>" if items else ""


# --- details


def _details(document: Mapping[str, Any], pictures: str) -> str:
    parameters = document.get("parameters") or {}
    folds = [
        ("More figures", pictures),
        ("Tests of the one-step errors", _tests(document.get("tests") or {})),
        ("What was looked at, and in what order", "".join(_look(look) for look in document.get("looks") or [])),
        ("Estimated parameters", _pairs(parameters.get("before") or {}, parameters.get("after") or {})),
        ("Noise", _tree(document.get("noise"))),
        ("Models", _tree(document.get("models"))),
        ("Versions and time", _tree(_running(document))),
    ]
    return "".join(f"<details><summary>{escape(t)}</summary>{body}</details>" for t, body in folds if body)


def _running(document: Mapping[str, Any]) -> dict[str, Any]:
    out = dict(document.get("versions") or {})
    if _finite(document.get("seconds")):
        out["took"] = f"{number(document['seconds'])} s"
    return out


def _tests(tests: Mapping[str, Any]) -> str:
    sides = [(side, tests.get(side) or []) for side in ("before", "after")]
    tables = []
    for side, rows in sides:
        cells = []
        for t in sorted(rows, key=lambda t: (t.get("p_value") is None, t.get("p_value"))):
            p = t.get("p_value")
            bad = _fails(t)
            outcome = "✓ passes" if not bad else "✗ slightly" if t.get("slight") else "✗ fails"
            cells.append(
                f'<tr class="{"bad" if bad else "good"}"><td>{outcome}</td>'
                f"<td>{escape(str(t.get('channel') or ''))}</td><td>{escape(str(t.get('name') or ''))}</td>"
                f"<td>{number(t.get('size'), 2)}</td><td>{_p_value(p)}</td>"
                f'<td class="words">{escape(str(t.get("meaning") or ""))}</td></tr>'
            )
        if cells:
            head = "".join(f"<th>{h}</th>" for h in ("", "column", "test", "size", "p-value", "in words"))
            title = f"<h4>{'Declared model' if side == 'before' else 'With what was found'}</h4>"
            tables.append(title + _box(f"<thead><tr>{head}</tr></thead><tbody>{''.join(cells)}</tbody>", "left"))
    if not tables:
        return ""
    return (
        f"<p>A test fails where its p-value is below {LEVEL:g}. A p-value is the chance of such a result from a right "
        "model, corrected for the number of tests (Holm). With many samples even a slight misfit is certain; the size "
        "says whether it matters.</p>" + "".join(tables)
    )


def _look(look: Mapping[str, Any]) -> str:
    accepted = look.get("accepted")
    if isinstance(accepted, Mapping):
        accepted = label(accepted)
    elif isinstance(accepted, list | tuple):
        accepted = label(dict(zip(("name", "joint", "channel", "inputs"), accepted, strict=False)))
    outcome = f"added {accepted}" if accepted else "added nothing"
    title = f"<h4>Over {number(look.get('horizon_s'))} s: {escape(outcome)}</h4>"
    columns = []
    for key, told in (("screened", "expected gain [nat]"), ("refitted", "gain after a refit [nat]")):
        entries = sorted(look.get(key) or [], key=lambda e: -(e.get("gain") or 0.0))[:8]
        rows = "".join(f"<tr><td>{escape(label(e))}</td><td>{number(e.get('gain'), 3)}</td></tr>" for e in entries)
        if rows:
            head = f"<thead><tr><th>effect</th><th>{told}</th></tr></thead>"
            columns.append(_box(f"{head}<tbody>{rows}</tbody>"))
    return title + (f'<div class="pair">{"".join(columns)}</div>' if columns else "")


def _pairs(before: Mapping[str, Any], after: Mapping[str, Any]) -> str:
    rows = []
    for key in dict.fromkeys([*before, *after]):
        cells, unit = [], None
        for side in (before, after):
            value, std, own = _entry(side[key]) if key in side else (None, None, None)
            unit = unit or own
            cells.append(f"<td>{escape(with_std(value, std))}</td>")
        rows.append(
            f'<tr><th scope="row">{escape(str(key))}</th>{"".join(cells)}<td>{escape(str(unit or ""))}</td></tr>'
        )
    head = "<thead><tr><th>parameter</th><th>before</th><th>after</th><th>unit</th></tr></thead>"
    return _box(f"{head}<tbody>{''.join(rows)}</tbody>") if rows else ""


def _tree(value: Any) -> str:
    """Anything that JSON holds, as nested lists."""
    if isinstance(value, Mapping):
        if "value" in value:
            number_, std, unit = _entry(value)
            return escape(with_std(number_, std) + _blank(unit))
        rows = "".join(f"<dt>{escape(str(k))}</dt><dd>{_tree(v)}</dd>" for k, v in value.items())
        return f"<dl>{rows}</dl>" if rows else ""
    if isinstance(value, list | tuple):
        return ", ".join(_tree(v) for v in value)
    if isinstance(value, float):
        return number(value)
    return "" if value is None else escape(str(value))


# --- pieces


def _section(title: str, body: str) -> str:
    return f"<section><h2>{escape(title)}</h2>{body}</section>\n" if body else ""


def _box(table: str, kind: str = "") -> str:
    return f'<div class="box {kind}" tabindex="0" role="region" aria-label="table"><table>{table}</table></div>'


def _figure(picture: Picture) -> str:
    kind, width = _image(picture)
    data = base64.b64encode(picture.image).decode("ascii")
    least = round(0.72 * width) if width > 560 else 0  # wider ones scroll inside their box on a phone
    small = f' style="min-width:{least}px;max-width:{round(1.1 * width)}px"'
    return (
        f'<figure><div class="box" tabindex="0" role="region" aria-label="{escape(picture.title)}">'
        f'<img src="data:{kind};base64,{data}" alt="{escape(picture.title)}"{small if width else ""}></div>'
        f"<figcaption><b>{escape(picture.title)}.</b> {escape(picture.caption)}</figcaption></figure>"
    )


def _image(picture: Picture) -> tuple[str, int]:
    """Media type, and width in CSS pixels (0: unknown; PNG is taken for 150 dots per inch)."""
    image = picture.image
    if image.startswith(b"\x89PNG\r\n\x1a\n"):
        return "image/png", round(struct.unpack(">I", image[16:20])[0] * 96 / 150) if len(image) >= 24 else 0
    head = image[:4000].lstrip()
    if head.startswith((b"<svg", b"<?xml", b"<!DOCTYPE svg")) and b"<svg" in head:
        found = re.search(rb"<svg\b[^>]*?\swidth=[\"']([0-9.]+)(pt|in|px)?[\"']", head)
        if found:
            scale = {b"pt": 96 / 72, b"in": 96.0}.get(found[2], 1.0)
            return "image/svg+xml", round(float(found[1]) * scale)
        return "image/svg+xml", 0
    raise ValueError(f"figure {picture.title!r}: neither PNG nor SVG")


_CSS = """
:root{color-scheme:light;--ink:#1b1f24;--soft:#57606a;--line:#d8dee4;--tint:#f6f8fa;--blue:#0072b2;--red:#b34700}
*{box-sizing:border-box}
html{-webkit-text-size-adjust:100%}
body{margin:0;background:#fff;color:var(--ink);font:16px/1.5 system-ui,-apple-system,"Segoe UI",Roboto,"Helvetica Neue",
Arial,sans-serif}
main{max-width:1020px;margin:0 auto;padding:28px 20px 60px}
header{border-bottom:1px solid var(--line);padding-bottom:22px}
.eyebrow{margin:0 0 6px;color:var(--soft)}
.soft{color:var(--soft)}
h1{font-size:clamp(1.35rem,1rem + 2vw,2.05rem);line-height:1.25;margin:0;padding-left:16px;
border-left:6px solid var(--blue);text-wrap:pretty;overflow-wrap:break-word}
h1.none{border-color:#009e73}
h2{font-size:1.3rem;margin:0 0 10px;line-height:1.3}
h3{font-size:1.08rem;margin:0 0 6px}
h4{font-size:1rem;margin:16px 0 6px}
section{margin-top:38px}
p,ul{margin:0 0 12px;max-width:46rem;overflow-wrap:break-word}
ul{padding-left:1.2em}
li{margin-bottom:6px}
.tiles{list-style:none;padding:0;margin:20px 0 0;max-width:none;display:grid;gap:12px;
grid-template-columns:repeat(auto-fit,minmax(230px,1fr))}
.tiles li{background:var(--tint);border-radius:8px;padding:12px 14px;margin:0;max-width:400px;
display:flex;flex-direction:column}
.tiles span{color:var(--soft);font-size:.9rem}
.tiles strong{font-size:1.25rem;font-variant-numeric:tabular-nums}
.cards{display:grid;gap:14px;grid-template-columns:repeat(auto-fit,minmax(min(100%,340px),1fr));margin-bottom:16px}
article{border:1px solid var(--line);border-top:4px solid var(--blue);border-radius:8px;padding:14px 16px;min-width:0}
article p{margin-bottom:10px}
.evidence{color:var(--soft);font-size:.93rem;margin:0}
.cards+.evidence{margin-bottom:20px}
.sure{color:var(--ink);font-weight:650}
dl{display:grid;grid-template-columns:minmax(8em,auto) 1fr;gap:2px 18px;margin:0 0 12px;max-width:46rem}
dt{color:var(--soft)}
dt i{font-size:.9em}
dd{margin:0;font-variant-numeric:tabular-nums;min-width:0;overflow-wrap:anywhere}
article dd{font-weight:600}
dd dl{margin:0}
.box{overflow-x:auto;margin:0 0 14px;max-width:100%}
.box:focus-visible{outline:2px solid var(--blue)}
table{border-collapse:collapse;font-variant-numeric:tabular-nums;font-size:.94rem}
th,td{padding:5px 10px;text-align:right;white-space:nowrap;border-bottom:1px solid var(--line);vertical-align:top}
thead th{color:var(--soft);font-weight:500;vertical-align:bottom}
tr>:first-child:not(.group){text-align:left;padding-left:2px}
tbody th{font-weight:500}
.group{border-left:1px solid var(--line);padding-left:16px}
thead .group[colspan]{text-align:center}
.ratio{color:var(--blue);font-weight:600}
.left td,.left th{text-align:left}
.words{white-space:normal;min-width:17rem}
.bad td:first-child{color:var(--red);font-weight:650}
.good td{color:var(--soft)}
.pair{display:grid;gap:0 28px;grid-template-columns:repeat(auto-fit,minmax(min(100%,320px),1fr))}
.pair>*{min-width:0}
figure{margin:0 0 26px;min-width:0}
figure .box{margin-bottom:6px}
img{display:block;width:100%;height:auto}
figcaption{color:var(--soft);font-size:.93rem;max-width:46rem}
figcaption b{color:var(--ink)}
details{border-top:1px solid var(--line);padding:10px 0}
details:last-child{border-bottom:1px solid var(--line)}
summary{cursor:pointer;font-weight:600;padding:2px 0}
details[open] summary{margin-bottom:10px}
@media(max-width:560px){main{padding:18px 14px 40px}section{margin-top:30px}h1{padding-left:12px;border-left-width:5px}
dl{grid-template-columns:minmax(0,auto) 1fr;gap:2px 12px}th,td{padding:5px 7px}}
@media print{main{max-width:none;padding:0}section{margin-top:22px}figure,article,tr{break-inside:avoid}
h2,h3,h4{break-after:avoid}.box{overflow:visible}img{min-width:0!important}body{font-size:11pt}}
"""
