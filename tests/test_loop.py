"""The loop end to end: what is there is found and sized, where nothing is nothing is said."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import plant
import pytest
from helpers import compiled, nnap
from rigs import slide_logs, slide_rig

from nnap_em import diagnose, findings
from nnap_em.explain.diagnosis.findings import Finding, verdict
from nnap_em.model.effects import catalogue
from nnap_em.model.effects.position import TorsionalSpring

SPRING = TorsionalSpring.of(20.0, 1.0, 0.0, 0.0, joint=1)
HELD = {"name": "torsional_spring", "joint": 1, "k": 20.0, "theta0": 0.05}
DRAG = catalogue["air_drag"](jnp.asarray(0.8), joint=1)


def test_a_spring_is_named_and_sized_and_other_recordings_compile_nothing():
    """The drag of the joint's own velocity is a static map: the learned friction holds it, and it is not missing."""
    diagnosis = diagnose(slide_rig(), slide_logs(0, laws=(SPRING, DRAG), sequences=6), key=jax.random.key(0))
    found = findings(diagnosis)
    assert [finding.effect.name for finding in found] == ["torsional_spring"] and not diagnosis.interventions
    k = found[0].parameters["k"]
    assert k.unit == "N/m" and k.value == pytest.approx(20.0, rel=0.05) and abs(k.value - 20.0) < 3 * k.std
    assert diagnosis.complete and [step.accepted is None for step in diagnosis.steps] == [False, True]
    other = slide_logs(1, laws=(DRAG,), sequences=3, steps=92)
    with compiled() as programs:
        diagnosis = diagnose(slide_rig(), other, key=jax.random.key(0))
    assert not findings(diagnosis) and diagnosis.after is diagnosis.before
    assert programs == ["jit(each_left)"]  # of touches, which are sought by the last model: here without a law


@pytest.mark.slow  # fast: test_a_spring_is_named_and_sized_and_other_recordings_compile_nothing
def test_the_report_of_the_command_has_the_errors_of_predict(tmp_path):
    """Root mean squares over the second after the first, of the models before and after."""
    case = plant.Case(system="slide", sequences=8, tests=3, steps=250, seed=2, noise=(5e-4, 5e-3), effects=(HELD,))
    plant.write(case, tmp_path / "rig")
    assert nnap("diagnose", tmp_path / "rig", "--out", tmp_path / "found", "--quiet") == 0
    report = json.loads((tmp_path / "found" / "report.json").read_text())
    assert [effect["name"] for effect in report["effects"]] == ["torsional_spring"]
    assert report["verdict"] in (tmp_path / "found" / "report.html").read_text()
    error = report["error"]
    assert error["after"]["x"][3] < 0.3 * error["before"]["x"][3]
    for side, model in report["models"].items():
        out, square = tmp_path / side, []
        options = ("--given", error["given_s"], "--out", out)
        assert nnap("predict", tmp_path / "found" / model, tmp_path / "rig" / "test", *options) == 0
        for path in sorted((tmp_path / "rig" / "test").glob("*.csv")):
            predicted, read = (np.genfromtxt(file, delimiter=",", names=True) for file in (out / path.name, path))
            ahead = (read["time"] > 1.0 + 1e-6) & (read["time"] <= 2.0 + 1e-6) & np.isfinite(read["x"])
            square.append((predicted["x"] - read["x"])[ahead] ** 2)
        assert error[side]["x"][3] == pytest.approx(np.sqrt(np.mean(np.concatenate(square))), rel=1e-6)


CLAIMS = {  # errors before and after by channel, and what is said of them
    "do not trust": {"theta1": (0.2, 0.3)},
    "falls from 0.2 to 0.1 and that of theta2 rises from 0.3 to 0.4": {"theta1": (0.2, 0.1), "theta2": (0.3, 0.4)},
    "of theta2 does not fall with it (0.1 before, 0.2 after)": {"theta1": (0.2, 0.19), "theta2": (0.1, 0.2)},
}


@pytest.mark.parametrize("claim", CLAIMS)
def test_the_verdict_claims_a_fall_only_where_there_is_one(claim):
    laws = [Finding(catalogue["payload"](jnp.zeros(()), joint=2), {}, {}, (), "payload")]
    before, after = ({name: [pair[side]] for name, pair in CLAIMS[claim].items()} for side in (0, 1))
    error = {"horizons_s": [1.0], "before": before, "after": after}
    assert claim in verdict(laws, error) and "0.5 s prediction error" in verdict(laws, error | {"reach_s": 0.5})
