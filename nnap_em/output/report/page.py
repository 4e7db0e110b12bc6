"""Page of a fit or a diagnosis: what report.json beside it holds, in sentences, tables and figures."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from ...base.digits import finite, number, with_std
from ...explain.diagnosis.findings import growth
from ...explain.diagnosis.statistics import FAILS
from ...model.effects import catalogue
from .html import Part, Picture, Section, Table, rendered, section
from .wording import duration, quantity, ratio, reached, sentence, share

_NATS = ((100, "Beyond doubt"), (30, "Very sure"), (10, "Sure"), (3, "Likely"))
_SHARES = ((0.6, "Very sure"), (0.3, "Sure"), (0.15, "Likely"))
"""Thresholds of words for a log-likelihood [nat], and for a share of the error on recordings left out."""

_Entry = Mapping[str, Any]


def page(document: Mapping[str, Any], pictures: Sequence[Picture] = ()) -> str:
    """Page of a fit or a diagnosis, whose document has no key `effects` or has one."""
    diagnosed, effects = "effects" in document, document.get("effects") or []
    shown = {place: [one for one in pictures if one.place == place] for place in ("found", "error", "residual")}
    numbers = _parameter_table(document)
    learned = [[law["text"] for law in document.get("friction_law") or []], numbers]
    title = "What was found, and how sure" if diagnosed else "What was learned"
    sections = [
        section(title, *(_found(document) if diagnosed else learned), *shown["found"]),
        section("Before and after" if effects else "Prediction error", *_errors(document), *shown["error"]),
        section("What the declared model leaves unexplained", *shown["residual"]),
        section("External disturbances", *_disturbances(document.get("interventions"))),
        section("What could not be told apart", *_equivalents(effects)),
        section("What was not used of the logs", *_unused(document)),
        section("Suspects", *_suspects(document.get("suspects"))),
        section("What to measure next", document.get("next")),
    ]
    details = [
        section("Estimated parameters", *[numbers, document.get("undetermined")] * diagnosed, folded=True),
        section("Noise", _noise_table(document.get("noise") or {}), folded=True),
    ]
    return rendered("Diagnosis of" if diagnosed else "Identification of", document, sections, details)


# --- what was found


def _found(document: _Entry) -> list[Part | None]:
    effects = document["effects"] or []
    if effects:
        grows = growth(document.get("error") or {})
        doubted = bool(grows) and sum(grows.values()) >= 0  # in the geometric mean of the columns
        return [*(_effect(effect, doubted) for effect in effects), "±: one standard deviation."]
    if document.get("suspects"):
        return ["No effect is added to the model. Some laws are suspected."]
    if document.get("complete") is False:
        return ["No effect is added to the model so far: the search was not finished."]
    return [
        "No effect of the catalogue, and no unknown force, improves the model by more than chance would. "
        "Weaker effects than these data can show are not excluded."
    ]


def _effect(effect: _Entry, doubted: bool) -> Section | None:
    law, text = catalogue.get(effect.get("name") or ""), effect.get("description") or ""
    meaning, words = effect.get("meaning") or "", law.words if law else {}
    if "±" in text and meaning and not effect.get("shape"):
        text = ""  # numbers that the table has
    rows = [
        [f"{words[key]} ({key})" if words.get(key, key) != key else key, quantity(entry)]
        for key, entry in (effect.get("parameters") or {}).items()
    ]
    evidence = " ".join(_evidence(effect.get("evidence") or {}, doubted))
    return section(sentence(effect["law"])[:-1], meaning, sentence(text), Table([], rows), evidence)


def _evidence(evidence: _Entry, doubted: bool) -> Iterable[str]:
    """Certainty in words, by the share of the error where it is known, for nats are worth little where noise is not
    that of the model; then the numbers.
    """
    gain, removed, chance = (evidence.get(name) for name in ("log_likelihood_gain", "share_of_error", "chance"))
    for value, scale in ((removed, _SHARES), (gain, _NATS)):
        if finite(value):
            word = next((word for least, word in scale if value >= least), "A hint only")  # type: ignore[operator]
            yield "Doubtful: the test sequences are predicted no better with it." if doubted else f"{word}."
            break
    if finite(gain):
        yield f"It raises the log-likelihood of the training data by {number(gain)} nat."
    if finite(removed):
        parts = evidence.get("parts")
        where = f", on {parts[0]} of {parts[1]} parts of them" if parts else ""
        yield f"On recordings left out of its fit it removes {share(removed)}{where}."  # type: ignore[arg-type]
    if finite(chance):
        least = f"up to {number(100 * chance, 2)} %" if chance >= 0.005 else "less than 1 %"  # type: ignore[operator]
        yield f"Columns shifted in time remove {least}."


def _equivalents(effects: Sequence[_Entry]) -> list[Part]:
    same = [
        f"{sentence(effect['law'])[:-1]}: the data cannot tell it from {' or '.join(e['law'] for e in others)}."
        for effect in effects
        if (others := effect.get("equivalent"))
    ]
    return [same or "Nothing: no other effect that was tried explains these data nearly as well."] if effects else []


def _suspects(suspects: Sequence[_Entry] | None) -> list[Part]:
    text = (
        "These laws remove more of the prediction error than chance does on these recordings. They were not accepted "
        "and are not in the model. Chance is measured on the same laws with their columns shifted in time."
    )
    return [text, [each["description"] for each in suspects]] if suspects else []


# --- errors


def _errors(document: _Entry) -> list[Part]:
    """Errors of the predictions by horizon and column, and how many tests of the one-step errors fail."""
    error, units = document.get("error") or {}, document.get("units") or {}
    before, after = error.get("before") or error.get("fit") or {}, error.get("after") or {}
    both, horizons, out = bool(document.get("effects")), reached(error), []
    if before and horizons:
        given = f"the first {duration(error, error['given_s'])}" if finite(error.get("given_s")) else "the start"
        what = ": before → after, and how many times smaller it is" * both
        out.append(
            f"Each test sequence is predicted from {given} of its readings, without looking at the rest. The error is "
            f"the root mean square of prediction minus reading, up to the time ahead{what}. Test sequences had no part "
            "in any choice."
        )
        head = ["time ahead", *(f"{column} [{units[column]}]" if units.get(column) else column for column in before)]
        rows = [
            [duration(error, horizon), *(_change(before[c][i], after[c][i] if both else None) for c in before)]
            for i, horizon in enumerate(horizons)
        ]
        out.append(Table(head, rows))
    elif before and finite(error.get("given_s")):
        given = duration(error, error["given_s"])
        out.append(f"Predictions start after {given}, and no test sequence is longer: record some that are.")
    tests = document.get("tests") or {}
    if tests.get("before"):
        out.append(_failures(tests["before"], tests.get("after")))
    return out


def _change(before: Any, after: Any) -> str:
    if after is None or not finite(before):
        return number(before)
    return f"{number(before)} → {number(after)} ({ratio(before, after)})"


def _failures(before: Sequence[_Entry], after: Sequence[_Entry] | None) -> str:
    sides = {"before": before, "after": after} if after else {"": before}
    counts = {
        side: sum(finite(t["p_value"]) and t["p_value"] < FAILS and not t.get("slight") for t in tests)
        for side, tests in sides.items()
    }
    texts = " and ".join(f"{count or 'none'} {side}".strip() for side, count in counts.items())
    pure = f"Of {len(before)} tests that the errors from one sample to the next are pure noise"
    return f"{pure}, {texts} fail by more than a little."


# --- the logs and the search


def _disturbances(entries: Sequence[_Entry] | None) -> list[Part]:
    text = (
        "At these moments something pushed that no law explains: a hand, a collision, a cable that caught, or a "
        "disturbance that is not in the log. No other recording shows such a force in the same state. What the machine "
        "does by itself should not stand here; record such a motion twice, and it will not."
    )
    rows = [
        [f"train/{e['file']}", str(e["joint"]), f"{number(e['from'], 4)} s", f"{number(e['to'], 4)} s",
         f"{with_std(e['size'], e['std'])} {e['unit']}"]
        for e in entries or ()
    ]  # fmt: skip
    return [text, Table(["file", "joint", "from", "to", "size"], rows, "left")] if rows else []


def _unused(document: _Entry) -> list[Part]:
    out: list[Part] = []
    if document.get("left_out"):
        out.append(f"Diverged, and left out of the last epoch: {', '.join(document['left_out'])}.")
    if masked := document.get("masked"):
        unit = (document.get("units") or {}).get("time", "s")
        first = [f"{number(e['time'], 4)} {unit}" for e in masked]
        rows = [
            [f"{e['part']}/{e['file']}", e["column"] or "all", e["kind"], str(e["amount"]), at]
            for e, at in zip(masked, first, strict=True)
        ]
        text = (
            "These readings were taken as missing: they are far from what the rows around them say, or their sensor "
            "stood still while the machine moved. gap: rows that the log lost; cut: rows after a gap that nothing "
            "could bridge. Errors of prediction are against all readings of the test files. --trust-readings uses the "
            "readings as they are."
        )
        out += [text, Table(["file", "column", "what", "how many", "first at"], rows, "left")]
    return out


# --- numbers


def _parameter_table(document: _Entry) -> Table:
    sides = _sides(document.get("parameters") or {})
    names = dict.fromkeys(name for side in sides.values() for name in side)
    rows = [[n, *(quantity(side[n]) if n in side else "–" for side in sides.values())] for n in names]
    return Table(["parameter", *sides], rows)


def _noise_table(noise: _Entry) -> Table:
    sides = _sides(noise)
    rows = [
        [f"{title} {name}", *(_std(side[kind][name]) if name in side[kind] else "–" for side in sides.values())]
        for kind, title in (("measurement", "reading"), ("process_per_step", "process per step,"))
        for name in next(iter(sides.values()), {}).get(kind, {})
    ]
    return Table(["standard deviation", *sides], rows)


def _std(entry: _Entry) -> str:
    return f"{number(entry['std'])} {entry['unit']}" + " (estimated)" * bool(entry.get("estimated"))


def _sides(entries: _Entry) -> _Entry:
    return entries if "before" in entries else {"fitted": entries} if entries else {}
