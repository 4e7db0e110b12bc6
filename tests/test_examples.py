"""Examples: tanks, the tour."""

import re
from functools import partial
from pathlib import Path

import matplotlib
import numpy as np
import pytest
import tanks
from helpers import optimised

import nnap_em
from nnap_em.base.journal import Journal, keeping
from nnap_em.explain.design.search import Effort

TOUR = Path(__file__).resolve().parents[1] / "examples" / "tour.py"

NOISE = 0.016
"""Standard deviation of a reading of the simulated level [V]."""


def _tanks(rows: int = 256):
    """Euler steps of a tenth of a second of both tanks; the reading ends at 10 V."""
    rng, out = np.random.default_rng(0), {}
    for part in ("est", "test"):
        u = np.repeat(rng.uniform(1.0, 2.8, rows // 16), 16)
        x, y = np.array([4.0, 5.0]), []
        for one in u:
            y.append(min(x[1] + NOISE * rng.standard_normal(), 10.0))
            for _ in range(40):
                flow = 0.055 * np.sqrt(x[0])
                x = x + 0.1 * np.array([0.05 * one - flow, flow - 0.05 * np.sqrt(x[1])])
        out[part] = np.column_stack([4.0 * np.arange(rows), u, y])
    return out


@pytest.mark.slow  # fast: test_equation_commands.py
def test_the_tanks_run_from_the_recordings_to_the_figure(tmp_path, monkeypatch, capsys):
    """Nothing is missing in the simulated machine, and its levels are predicted to the noise of the readings."""
    out, parts = tmp_path / "out", _tanks()  # the sample interval stands in row 1 alone
    columns = zip(parts["est"][:, 1], parts["test"][:, 1], parts["est"][:, 2], parts["test"][:, 2], strict=True)
    rows = [",".join(f"{value:.10g}" for value in row) + (",," if i else ",4,") for i, row in enumerate(columns)]
    (tmp_path / tanks.PUBLISHED).write_text("\n".join(['"uEst","uVal","yEst","yVal","Ts",', *rows]) + "\n")
    monkeypatch.setattr("sys.argv", ["tanks.py", "--from", str(tmp_path), "--out", str(out)])
    with optimised():
        assert tanks.main() == 0
    printed = capsys.readouterr().out
    assert "\nNothing is missing that these data could show" in printed
    errors = [float(value) for value in re.findall(r": ([\d.]+) V", printed)]
    np.testing.assert_allclose(errors, [NOISE, NOISE], rtol=0.15)  # 100 rows
    assert (out / "tanks.png").stat().st_size > 10_000 and (out / "found" / "report.html").exists()


@pytest.mark.slow  # fast: test_public.py
def test_the_tour_runs_and_finds_the_cable(tmp_path, monkeypatch, capsys):
    """The truth is 30 N/m; the stated standard deviation holds it."""
    monkeypatch.chdir(tmp_path)
    small = Effort(pool=16, batch=16, rounds=2, tries=4)  # test_design.py tests the quality of a design
    monkeypatch.setattr(nnap_em, "design", partial(nnap_em.design, effort=small))
    matplotlib.use("agg")
    names = {"__name__": "tour"}
    with keeping(Journal(tmp_path / "steps")):  # the search begins with the fit of the cell before
        for cell in re.split(r"(?m)^# %%", TOUR.read_text())[1:]:
            if not cell.startswith(" [markdown]\n"):
                exec(compile(cell.partition("\n")[2], str(TOUR), "exec"), names)
    (finding,) = names["found"]
    number = finding.parameters["k"]
    assert finding.effect.name == "torsional_spring"
    assert abs(number.value - 30.0) < max(3 * number.std, 1.0)
    before, after = (names["error"][side]["x"] for side in ("before", "after"))
    assert after[-1] < 0.5 * before[-1]
    assert names["design"].u.shape[0] == 2
    assert "torsional spring" in capsys.readouterr().out
