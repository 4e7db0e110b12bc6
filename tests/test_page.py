"""The page is sound HTML that fetches nothing, whatever of the report is there."""

import re
from html.parser import HTMLParser

import pytest

from nnap_em.diagnosis.keys import words
from nnap_em.diagnosis.statistics import FAILS
from nnap_em.effects import catalogue
from nnap_em.numerics.digits import counted, number, with_std
from nnap_em.report.page import MOST_PICTURES, Picture, page, write_page
from nnap_em.report.wording import label, reached

SVG = b'<?xml version="1.0"?>\n<svg width="360pt" height="200pt" xmlns="http://www.w3.org/2000/svg"></svg>'
VOID = {"meta", "img", "br", "link", "hr", "input"}

EFFECT = {
    "name": "torsional_spring",
    "joint": 2,
    "channel": None,
    "inputs": [],
    "parameters": {"k": {"value": 0.05995, "std": 0.00037, "unit": "N m/rad"}},
    "evidence": {"log_likelihood_gain": 1142.0, "held_out_gain": 1182.0, "p_value": 0.0},
    "equivalent": [{"name": "hard_stop", "joint": 1}],
    "description": "torsional spring at joint 2",
}
TEST = {"name": "whiteness", "channel": "theta1", "statistic": 50.0, "p_value": 1e-4, "size": 0.2, "meaning": "Errors."}
WHOLE = {
    "format": 1,
    "rig": "arm",
    "system": "acrobot",
    "verdict": "The model lacks a spring.",
    "effects": [EFFECT],
    "error": {
        "given_s": 1.0,
        "horizons_s": [0.5, 1.0],
        "before": {"theta1": [0.2, 0.807], "dtheta1": [1.0, None]},
        "after": {"theta1": [0.3, 0.0058], "dtheta1": [1.0, float("nan")]},
    },
    "units": {"theta1": "rad", "dtheta1": "rad/s"},
    "models": {"before": "before.npz", "after": "after.npz"},
    "friction_change": "Friction was bent.",
    "tests": {"before": [TEST, TEST | {"p_value": None}, TEST | {"slight": True}],
        "after": [TEST | {"p_value": FAILS}]},
    "parameters": {"before": {"m1": {"value": 1.0, "std": 0.1, "unit": "kg"}}, "after": {"m1": {"value": 1.1,
        "std": 0.1}}},
    "noise": {"before": {"theta1": {"value": 0.005, "unit": "rad"}}, "after": {"theta1": 0.005}},
    "rounds": [
        {"horizon_s": 1.0, "refitted": [], "accepted": "torsional spring at joint 2",
         "screened": [{"name": "cogging", "joint": 1, "channel": None, "inputs": [], "gain": 12.3}]},
        {"horizon_s": 5.0, "screened": None, "refitted": None, "accepted": None},
    ],
    "next": ["Unhook the cable."],
    "seconds": 172.0,
    "versions": {"jax": "0.10.2"},
}  # fmt: skip


class _Balance(HTMLParser):
    """Fails where a tag is not closed, or closed twice; keeps addresses, ids and text."""

    def __init__(self):
        super().__init__()
        self.open, self.addresses, self.text, self.tags = [], [], [], []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.addresses += [v for k, v in attrs if k in ("src", "href", "action", "data", "srcset")]
        assert not any(k.startswith("on") for k, _ in attrs)
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open and self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


def _parsed(html):
    parser = _Balance()
    parser.feed(html)
    parser.close()
    assert parser.open == []
    assert html.startswith("<!DOCTYPE html>")
    return parser


def _text(document, *pictures) -> str:
    """The words of the page of a document, without tags."""
    return " ".join("".join(_parsed(page(document, *pictures)).text).split())


FIGURES = (
    Picture("Errors", "A caption.", SVG),
    Picture("Learned", "", SVG, "found"),
    Picture("More", "", SVG, "details"),
)
FIT = {
    "rig": "arm",
    "verdict": "Fitted the friction of 1 joint.",
    "friction_law": [{"joint": 1, "parameters": {}, "text": "theta1: Coulomb 0.03 N m."}, {"text": "theta2: rough."}],
    "error": {"given_s": 1.0, "horizons_s": [1.0], "fit": {"theta1": [0.02]}},
    "units": {"theta1": "rad"},
    "parameters": {"m1": {"value": 1.0, "std": 0.1, "unit": "kg"}},
    "noise": {"measurement": {"theta1": {"std": 0.005, "unit": "rad", "estimated": True}}},
    "left_out": ["03.csv"],
    "model": "model.npz",
}
REPORTS = {
    "diagnosis": WHOLE,
    "without an effect": WHOLE | {"effects": [], "rounds": [], "friction_change": ""},
    "without a test": WHOLE | {"error": None, "tests": {"before": [], "after": []}},
    "fit": FIT,
    "fit without a test": FIT | {"error": None, "friction_law": None, "parameters": {}},
}


@pytest.mark.parametrize("document", REPORTS.values(), ids=REPORTS)
def test_a_page_is_whole_and_fetches_nothing(document):
    html = page(document, FIGURES)
    parsed = _parsed(html)
    assert "None" not in "".join(parsed.text) and "nan" not in "".join(parsed.text)
    assert "script" not in parsed.tags
    assert not re.search(r"https?://|url\(|@import", html)
    assert all(a.startswith("data:image/svg+xml;base64,") for a in parsed.addresses)
    assert html.count("data:image/") == len(FIGURES)


def test_pictures_of_one_title_are_chosen_from_and_every_picture_is_enlarged_without_a_script():
    sequences = [Picture("One test sequence", name, SVG, "error", name) for name in ("a.csv", "b.csv", "c.csv")]
    html = page(WHOLE, [*sequences, Picture("Errors", "", SVG, "error")])
    _parsed(html)
    pattern = r'<input type="radio" name="(\S+)" id="(\S+?)"( checked)?><label for="(\S+?)">(\S+)</label>'
    radios = re.findall(pattern, html)
    assert [label for *_, label in radios] == ["a.csv", "b.csv", "c.csv"]
    assert len({name for name, *_ in radios}) == 1 and all(own == of for _, own, _, of, _ in radios)
    assert [bool(checked) for _, _, checked, _, _ in radios] == [True, False, False]
    assert len(re.findall(r'<input type="checkbox"', html)) == 4
    for place in range(1, MOST_PICTURES + 1):  # a picture that no rule shows would never be seen
        assert f".choose>input:nth-of-type({place}):checked~div:nth-of-type({place})" in html
    assert html.count("<figure") == 2


ORDER = {
    "diagnosis": (
        WHOLE,
        "The model lacks a spring. | 0.81 → 0.0058 rad | 139 × | What was found | 0.05995 ± 0.00037 N m/rad | "
        "Beyond doubt. It raises the log-likelihood of the training data by 1142 nat. | "
        "Before and after | 1.5 × larger | "
        "1 failed before and none fails after (not counting 1 and none | Friction was bent. | "
        "hard stop at joint 1 | Unhook the cable. | Details | ✗ fails | cogging at joint 1 | 172 s",
    ),
    "fit": (
        FIT,
        "Identification of arm | Fitted the friction of 1 joint. | 0.020 rad | What was learned | "
        "theta1: Coulomb 0.03 N m. | theta2: rough. | 1.00 ± 0.10 kg | Prediction error | the first 1.0 s | "
        "left out of the last epoch: 03.csv | 0.00500 rad (estimated)",
    ),
}


@pytest.mark.parametrize("kind", ORDER)
def test_a_page_says_what_was_found_in_order(kind):
    document, words = ORDER[kind]
    text = _text(document, FIGURES)
    places = {part: text.find(part) for part in words.split(" | ")}
    assert min(places.values()) >= 0, places
    assert list(places.values()) == sorted(places.values())
    for absent in ("What was found", "could not be told apart", "smaller by") if kind == "fit" else ("was learned",):
        assert absent not in text
    clean = _text(REPORTS["without an effect"])  # one column of errors and no effect
    assert (
        "No effect of the catalogue" in clean and "smaller by" not in clean and "could not be told apart" not in clean
    )


def test_tiles_show_what_changed_most_and_what_grows_is_no_success():
    """Three joints, of which the third falls most and the second grows."""
    before, after = ({n: [x] for n, x in zip("abc", each, strict=True)} for each in ((1, 1, 1), (0.9, 1.4, 0.2)))
    error = {"given_s": 1.0, "horizons_s": [1.0], "before": before, "after": after}
    html = page(WHOLE | {"error": error})
    tiles = re.findall("error of ([abc]), 1 s ahead", html)
    assert tiles == ["c", "b"]
    assert '<td class="worse">1.4 × larger</td>' in html and '<td class="ratio">5.0 ×</td>' in html


def test_evidence_by_many_steps_is_a_share_beside_chance():
    evidence = {"share_of_error": 0.42, "chance": 0.031, "parts": [4, 5], "p_value": None, "log_likelihood_gain": None}
    text = _text(WHOLE | {"effects": [EFFECT | {"evidence": evidence}]})
    assert "it removes 42 % of the error, on 4 of 5 parts of them. Columns shifted in time remove up to 3.1 %." in text
    assert "by luck" not in text and "log-likelihood of" not in text


def test_of_many_tests_all_that_fail_are_listed_and_of_the_others_a_part():
    bad, good = TEST | {"meaning": "It fails."}, TEST | {"p_value": 0.9, "meaning": "It holds."}
    text = _text(WHOLE | {"tests": {"before": 50 * [good, bad], "after": 60 * [good]}})
    assert (text.count("It fails."), text.count("It holds.")) == (50, 40)
    assert "50 more pass" in text and "20 more pass" in text


def test_all_text_is_escaped():
    evil = '<script>alert("1")</script>&'

    def spoil(value):
        if isinstance(value, dict):
            return {evil + k if k in ("theta1", "k", "m1", "jax") else k: spoil(v) for k, v in value.items()}
        if isinstance(value, list):
            return [spoil(v) for v in value]
        return evil if isinstance(value, str) else value

    html = page(spoil(WHOLE), [Picture(evil, evil, SVG)])
    assert "<script" not in html and evil not in html
    assert evil in "".join(_parsed(html).text)


KEYS = {
    "torsional spring at joint 1": ("torsional_spring", 1, None, ()),
    "unknown function of theta1 and u at joint 2": ("unknown_function", 2, None, ("theta1", "u")),
    "sensor delay on all sensors": ("sensor_delay", None, "all", ()),
    "sensor bias on x": ("sensor_bias", None, "x", ()),
}


def test_a_report_calls_an_effect_as_the_search_does():
    for text, key in KEYS.items():
        assert words(key) == label(dict(zip(("name", "joint", "channel", "inputs"), key, strict=True))) == text
    assert label({}) == "unnamed"


def test_numbers_as_a_reader_writes_them():
    texts = ["0.00585", "1234", "−2.00", "0", "–", "–", "1.50 × 10⁻⁹"]
    assert [number(v) for v in (0.00585, 1234.5, -2.0, 0, None, float("nan"), 1.5e-9)] == texts
    assert with_std(0.059951, 0.00037) == "0.05995 ± 0.00037"
    assert with_std(12.3456, 3.21) == "12.3 ± 3.2"
    assert with_std(1.5e-6, 2e-7) == "(1.50 ± 0.20) × 10⁻⁶"
    assert with_std(3.0, None) == "3.000"
    assert [counted(n, "row") for n in (0, 1, 2)] == ["0 rows", "1 row", "2 rows"]
    assert [counted(n, "quantity", "quantities") for n in (1, 2)] == ["1 quantity", "2 quantities"]


def test_short_test_sequences_have_no_errors_beyond_their_end():
    """The last horizon is the time that they last; without it, or beyond it, horizons are as they are."""
    error = WHOLE["error"] | {"horizons_s": [0.25, 1.0, 2.0], "reach_s": 0.5}
    assert reached(error) == [0.25, 0.5]
    assert reached(error | {"reach_s": 1.0}) == [0.25, 1.0]
    assert reached(error | {"reach_s": 9.0}) == [0.25, 1.0, 2.0]
    assert reached(error | {"reach_s": -0.1}) == reached({}) == []
    text = _text(WHOLE | {"error": error}, FIGURES)
    assert "error of theta1, 0.5 s ahead" in text
    assert "2.0 s" not in text


def test_every_effect_is_explained(monkeypatch):
    """Under the name in the report, with words for no parameter that it lacks; a law of a user as far as it says."""
    for kind in catalogue.values():
        assert catalogue[kind.key()].meaning
        assert set(kind.words) <= set(kind.units)
    assert catalogue["torsional_spring"].meaning in page(WHOLE) and "stiffness <i>k</i>" in page(WHOLE)
    own = type("Wind", (), {"meaning": "", "words": {"k": "push"}})
    monkeypatch.setitem(catalogue, "wind", own)
    html = page(WHOLE | {"effects": [EFFECT | {"name": "wind", "description": "a wind"}]})
    assert "push <i>k</i>" in html and "<p>A wind.</p>" in html and "<p></p>" not in html


def test_what_the_test_sequences_do_not_bear_out_is_doubted():
    error = WHOLE["error"] | {"after": {"theta1": [0.3, 0.9], "dtheta1": [1.0, None]}}
    assert "Doubtful" in page(WHOLE | {"error": error})
    error = {"horizons_s": [1.0], "before": {"x": [1.0], "dx": [1.0]}, "after": {"x": [1.1], "dx": [0.5]}}
    assert "Doubtful" not in page(WHOLE | {"error": error})  # what one column loses, another one more than gains
    assert "Doubtful" not in page(WHOLE)
    assert "Beyond doubt" in page(WHOLE)


def test_names_on_a_written_page_are_those_of_the_user(tmp_path):
    write_page(tmp_path, {"rig": "bench"}, FIGURES, lambda text: text.replace("Learned", "Found"))
    html = (tmp_path / "report.html").read_text()
    assert "Found" in html and "Learned" not in html
