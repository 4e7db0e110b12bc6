"""The tour, `examples/tour.py`: a notebook kept as text in cells of jupytext's percent format."""

import re
from functools import partial
from pathlib import Path

import matplotlib
import pytest

import nnap_em
from nnap_em.experiment.search import Effort
from nnap_em.storage.journal import Journal, keeping

TOUR = Path(__file__).resolve().parents[1] / "examples" / "tour.py"
SMALL = Effort(pool=16, batch=16, rounds=2, tries=4)
"""Small effort of the design search: `test_design.py` tests the quality of a design."""


def _cells():
    """Kind and text of every cell."""
    _, *parts = re.split(r"(?m)^# %%", TOUR.read_text())
    return [("markdown" if part.startswith(" [markdown]\n") else "code", part.partition("\n")[2]) for part in parts]


@pytest.mark.slow  # fast: test_docs.py, README.md
def test_it_runs_and_finds_the_cable(tmp_path, monkeypatch, capsys):
    """The truth is 30 N/m; the stated standard deviation holds it."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(nnap_em, "design", partial(nnap_em.design, effort=SMALL))
    matplotlib.use("agg")
    names = {"__name__": "tour"}
    with keeping(Journal(tmp_path / "steps")):  # the search begins with the fit of the cell before
        for kind, text in _cells():
            if kind == "code":
                exec(compile(text, str(TOUR), "exec"), names)
    (finding,) = names["found"]
    number = finding.parameters["k"]
    assert finding.effect.name == "torsional_spring"
    assert abs(number.value - 30.0) < max(3 * number.std, 1.0)
    before, after = (names["error"][side]["x"] for side in ("before", "after"))
    assert after[-1] < 0.5 * before[-1]
    assert names["design"].u.shape[0] == 2
    assert "torsional spring" in capsys.readouterr().out
