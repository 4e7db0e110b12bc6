"""The page is sound HTML that fetches nothing, whatever of the report is there."""

import re
from html.parser import HTMLParser

import pytest
from helpers import begun
from rigs import slide_logs, slide_rig

from nnap_em.base.digits import counted, number, with_std
from nnap_em.explain.diagnosis.statistics import FAILS
from nnap_em.logs.read import logs_of_arrays
from nnap_em.model.effects import catalogue
from nnap_em.output.report.document import predictions
from nnap_em.output.report.html import Picture
from nnap_em.output.report.page import page
from nnap_em.output.report.wording import p_value, reached

SVG = b'<?xml version="1.0"?>\n<svg width="360pt" height="200pt" xmlns="http://www.w3.org/2000/svg"></svg>'
VOID = {"meta", "img", "input"}
EFFECT = {
    "name": "torsional_spring", "joint": 2, "channel": None, "inputs": [], "description": "torsional spring at joint 2",
    "law": "torsional spring at joint 2",
    "parameters": {"k": {"value": 0.05995, "std": 0.00037, "unit": "N m/rad"}},
    "evidence": {"log_likelihood_gain": 1142.0, "share_of_error": None, "p_value": 0.0},
    "equivalent": [{"name": "hard_stop", "joint": 1, "law": "hard stop at joint 1"}],
}  # fmt: skip
TEST = {"p_value": 1e-4}
PASSED = {"p_value": FAILS}
MASS = {"value": 1.0, "std": 0.1, "unit": "kg"}
NOISE = {
    "measurement": {"theta1": {"std": 0.005, "unit": "rad", "estimated": True}},
    "process_per_step": {"dtheta1": {"std": 0.02, "unit": "rad/s"}},
}
WHOLE = {
    "format": 1, "rig": "arm", "system": "acrobot", "verdict": "The model lacks a spring.", "effects": [EFFECT],
    "error": {
        "given_s": 1.0,
        "horizons_s": [0.5, 1.0],
        "before": {"theta1": [0.2, 0.807], "dtheta1": [1.0, None]},
        "after": {"theta1": [0.3, 0.0058], "dtheta1": [1.0, float("nan")]},
    },
    "units": {"theta1": "rad", "dtheta1": "rad/s"},
    "models": {"before": "before.npz", "after": "after.npz"},
    "tests": {"before": [TEST, TEST | {"p_value": None}, TEST | {"slight": True, "name": "level"}, PASSED],
              "after": [PASSED]},
    "parameters": {"before": {"m1": MASS}, "after": {"m1": MASS | {"value": 1.1}}},
    "noise": {"before": NOISE, "after": NOISE},
    "undetermined": ["m1 and I1 act together."],
    "next": ["Unhook the cable."],
    "masked": [{"part": "test", "file": "b.csv", "column": "theta1", "kind": "spike", "amount": 3, "time": 0.5}],
    "seconds": 172.0,
    "versions": {"jax": "0.10.2"},
}  # fmt: skip
FIT = {
    "rig": "arm",
    "verdict": "Fitted the friction of 1 joint.",
    "friction_law": [{"joint": 1, "parameters": {}, "text": "theta1: Coulomb 0.03 N m."}, {"text": "theta2: rough."}],
    "error": {"given_s": 1.0, "horizons_s": [1.0], "fit": {"theta1": [0.02]}},
    "units": {"theta1": "rad"},
    "parameters": {"m1": MASS},
    "noise": NOISE,
    "left_out": ["03.csv"],
    "model": "model.npz",
}
NOTHING = WHOLE | {"effects": []}
REPORTS = (
    WHOLE,
    NOTHING,
    WHOLE | {"error": None, "tests": {"before": [], "after": []}},
    FIT | {"error": None, "friction_law": None, "parameters": {}},
)
FIGURES = Picture("Errors", "A caption.", SVG, width=480.0), Picture("Learned", "", SVG, "found")


class _Balance(HTMLParser):
    """Fails where a tag is not closed, or closed twice; keeps addresses and text."""

    def __init__(self, html):
        super().__init__()
        self.open, self.addresses, self.tags, self.words = [], [], [], []
        self.feed(html)
        self.close()
        assert self.open == [] and html.startswith("<!DOCTYPE html>")
        self.text = " ".join("".join(self.words).split())

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.addresses += [v for k, v in attrs if k in ("src", "href", "action", "data", "srcset")]
        assert not any(k.startswith("on") for k, _ in attrs)
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open and self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)


def _text(document, *pictures) -> str:
    return _Balance(page(document, pictures)).text


def test_a_page_says_where_no_test_sequence_reaches_a_prediction():
    short = WHOLE["error"] | {"reach_s": -0.05}
    said = "Predictions start after 1.0 s, and no test sequence is longer: record some that are."
    assert said in _text(WHOLE | {"error": short}) and said not in _text(WHOLE)


def test_predictions_stand_in_the_order_of_their_models():
    """A figure has the first in vermilion, the last in blue."""
    rig, data = slide_rig(), slide_logs(0)
    fitted, logs = begun(rig, data), logs_of_arrays(data, rig)
    assert [*predictions({"before": fitted, "after": fitted}, logs, logs, 0)] == ["before", "after"]


def test_a_page_is_whole_and_fetches_nothing():
    for document in REPORTS:
        html = page(document, FIGURES)
        parsed = _Balance(html)
        assert "None" not in parsed.text and "nan" not in parsed.text and "script" not in parsed.tags
        assert not re.search(r"https?://|url\(|@import", html)
        assert all(a.startswith("data:image/svg+xml;base64,") for a in parsed.addresses)
        assert html.count("data:image/") == len(FIGURES) == html.count('<input type="checkbox"')  # enlarge by a click


ORDER = {
    "diagnosis": (
        WHOLE,
        "The model lacks a spring. | What was found | stiffness (k) | 0.05995 ± 0.00037 N m/rad | Beyond doubt. It "
        "raises the log-likelihood of the training data by 1142 nat. | Before and after | the first 1.0 s | "
        "0.200 → 0.300 (1.5 × larger) | 0.807 → 0.00580 (139 ×) | Of 4 tests | 1 before and none after fail | "
        "hard stop at joint 1 | spike | Unhook the cable. | Details | 1.00 ± 0.10 kg | act together | "
        "0.00500 rad (estimated) | seconds | 172",
    ),
    "fit": (
        FIT,
        "Identification of arm | Fitted the friction of 1 joint. | What was learned | theta1: Coulomb 0.03 N m. | "
        "theta2: rough. | 1.00 ± 0.10 kg | Prediction error | the first 1.0 s | 0.0200 | "
        "left out of the last epoch: 03.csv | 0.00500 rad (estimated) | model.npz",
    ),
}


@pytest.mark.parametrize("kind", ORDER)
def test_a_page_says_what_was_found_in_order(kind):
    document, parts = ORDER[kind]
    text = _text(document, *FIGURES)
    places = {part: text.find(part) for part in parts.split(" | ")}
    assert min(places.values()) >= 0, places
    assert list(places.values()) == sorted(places.values())


def test_a_page_without_an_effect_says_so():
    text = _text(NOTHING)
    assert "No effect of the catalogue" in text and "→" not in text and "could not be told apart" not in text


def test_evidence_by_many_steps_is_a_share_beside_chance():
    evidence = {"share_of_error": 0.42, "chance": 0.031, "parts": [4, 5], "p_value": None, "log_likelihood_gain": None}
    text = _text(WHOLE | {"effects": [EFFECT | {"evidence": evidence}]})
    assert "Sure. On recordings left out of its fit it removes 42 % of the error, on 4 of 5 parts of them." in text
    assert "Columns shifted in time remove up to 3.1 %." in text and "log-likelihood of" not in text


def test_what_the_test_sequences_do_not_bear_out_is_doubted():
    """In the geometric mean of the columns: what one loses, another may more than gain."""
    for after, doubted in (({"x": [1.1], "dx": [0.5]}, False), ({"x": [2.1], "dx": [0.5]}, True)):
        error = {"horizons_s": [1.0], "before": {"x": [1.0], "dx": [1.0]}, "after": after}
        assert ("Doubtful" in _text(WHOLE | {"error": error})) is doubted


def test_all_text_is_escaped():
    evil = '<script>alert("1")</script>&'

    def spoil(value):
        if isinstance(value, dict):
            return {evil + k if k in ("theta1", "k", "m1", "jax") else k: spoil(v) for k, v in value.items()}
        if isinstance(value, list):
            return [spoil(v) for v in value]
        return evil if isinstance(value, str) else value

    html = page(spoil(WHOLE), [Picture(evil, evil, SVG)])
    assert "<script" not in html and evil not in html and evil in "".join(_Balance(html).words)


def test_numbers_as_a_reader_writes_them():
    texts = ["0.00585", "1234", "−2.00", "0", "–", "–", "1.50 × 10⁻⁹"]
    assert [number(v) for v in (0.00585, 1234.5, -2.0, 0, None, float("nan"), 1.5e-9)] == texts
    pairs = ((0.059951, 0.00037), (12.3456, 3.21), (1.5e-6, 2e-7), (3.0, None))
    texts = ["0.05995 ± 0.00037", "12.3 ± 3.2", "(1.50 ± 0.20) × 10⁻⁶", "3.000"]
    assert [with_std(*pair) for pair in pairs] == texts
    assert [p_value(p) for p in (1.01e-6, 0.99e-6, 0.0)] == ["1.0 × 10⁻⁶", "< 10⁻⁶", "< 10⁻⁶"]
    assert [counted(n, "quantity", "quantities") for n in (0, 1, 2)] == ["0 quantities", "1 quantity", "2 quantities"]


def test_short_test_sequences_have_no_errors_beyond_their_end():
    """The last horizon is the time that they last; without it, or beyond it, horizons are as they are."""
    error = WHOLE["error"] | {"horizons_s": [0.25, 1.0, 2.0], "reach_s": 0.5}
    assert reached(error) == [0.25, 0.5]
    assert reached(error | {"reach_s": 1.0}) == [0.25, 1.0]
    assert reached(error | {"reach_s": 9.0}) == [0.25, 1.0, 2.0]
    assert reached(error | {"reach_s": -0.1}) == reached({}) == []
    text = _text(WHOLE | {"error": error})
    assert "0.50 s" in text and "2.0 s" not in text


def test_every_effect_is_explained(monkeypatch):
    """Under the name in the report, with words for no parameter that it lacks; a law of a user as far as it says."""
    for kind in catalogue.values():
        assert kind.meaning and set(kind.words) <= set(kind.units), kind
    text = _text(WHOLE | {"effects": [EFFECT | {"law": "one sided loss of tau1", "meaning": "Less one way."}]})
    assert "One sided loss of tau1" in text and "Less one way." in text
    own = type("Wind", (), {"words": {"k": "push"}})
    monkeypatch.setitem(catalogue, "wind", own)
    html = page(WHOLE | {"effects": [EFFECT | {"name": "wind", "law": "wind", "description": "a wind"}]})
    assert "push (k)" in html and "<p>A wind.</p>" in html and "<p></p>" not in html
