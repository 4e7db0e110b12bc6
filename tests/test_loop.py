"""The loop end to end: what is there is found, where nothing is nothing is said; most of it by another simulator."""

import csv
import json

import jax
import jax.numpy as jnp
import numpy as np
import plant
import pytest
from helpers import nnap
from rigs import slide_logs, slide_rig

from nnap_em import diagnose, findings, load, read_logs, read_rig
from nnap_em.diagnosis import search
from nnap_em.diagnosis.findings import Finding, verdict
from nnap_em.effects import catalogue
from nnap_em.effects.position import TorsionalSpring
from nnap_em.numerics.profile import profiling

SLIDE = plant.Case(system="slide", sequences=8, tests=3, steps=95, seed=2, noise=(5e-4, 5e-3))
SPRING = {"name": "torsional_spring", "joint": 1, "k": 20.0, "theta0": 0.05}
DRAG = {"name": "air_drag", "joint": 1, "c": 0.8}


def test_a_spring_is_named_and_sized(monkeypatch):
    """The drag of the joint's own velocity is a static map: the learned friction holds it, and it is not missing."""
    sought = []
    monkeypatch.setattr(search, "interventions", lambda *_: sought.append(True) or ())
    laws = TorsionalSpring.of(20.0, 1.0, 0.0, 0.0, joint=1), catalogue["air_drag"](jnp.asarray(0.8), joint=1)
    diagnosis = diagnose(slide_rig(), slide_logs(0, laws=laws), key=jax.random.key(0))
    found = findings(diagnosis)
    assert [finding.effect.name for finding in found] == ["torsional_spring"] and not sought  # in white noise
    (spring,) = found
    assert spring.parameters["k"].unit == "N/m"
    assert spring.parameters["k"].value == pytest.approx(20.0, rel=0.05)
    assert abs(spring.parameters["k"].value - 20.0) < 3 * spring.parameters["k"].std
    assert diagnosis.complete and [step.accepted is None for step in diagnosis.steps] == [False, True]


@pytest.mark.slow  # fast: the test above; test_a_machine_that_did_not_change_is_said_to_be_the_same
def test_a_slide_that_lacks_nothing_is_left_alone_and_other_recordings_of_it_compile_nothing(tmp_path):
    """The programs of a search serve another data set, of two recordings more and three rows less."""
    for seed, sequences, steps in ((2, 8, 95), (3, 10, 92)):
        folder = tmp_path / str(seed)
        plant.write(SLIDE._replace(effects=(DRAG,), sequences=sequences, steps=steps, seed=seed), folder)
        rig = read_rig(folder / "rig.toml")
        with profiling() as profile:
            diagnosis = diagnose(rig, read_logs(folder / "train", rig), key=jax.random.key(0))
        assert not findings(diagnosis) and diagnosis.after is diagnosis.before
    assert {name: stages for name, stages in profile.spent.items() if stages["compile"]} == {}


@pytest.mark.slow  # fast: test_a_spring_is_named_and_sized; test_findings.py
def test_the_report_of_the_command_is_exact_and_its_errors_are_those_of_predict(tmp_path):
    plant.write(SLIDE._replace(steps=250, effects=(SPRING, DRAG)), tmp_path / "rig")
    assert nnap("diagnose", tmp_path / "rig", "--out", tmp_path / "found", "--quiet") == 0
    report, page = json.loads((tmp_path / "found" / "report.json").read_text()), tmp_path / "found" / "report.html"
    (effect,) = report["effects"]
    assert {"name", "joint", "channel", "inputs", "parameters", "evidence", "equivalent"} <= set(effect)
    evidence = effect["evidence"]
    fell, parts = evidence["parts"]
    assert 2 * evidence["chance"] <= evidence["share_of_error"] <= 1 and 0.75 * parts <= fell <= parts
    assert evidence["p_value"] is None and evidence["log_likelihood_gain"] is None
    assert report["verdict"] in page.read_text()
    # the first law may be found at a short horizon; every round after it is over the whole length
    assert [look["horizon_s"] for look in report["rounds"][1:]] == pytest.approx([2.51] * (len(report["rounds"]) - 1))
    error = report["error"]
    assert (error["given_s"], error["horizons_s"]) == (1.0, [0.1, 0.25, 0.5, 1.0, 2.0, 4.0])
    assert error["after"]["x"][3] < 0.3 * error["before"]["x"][3]
    for side in ("before", "after"):
        assert error[side]["x"][3] == pytest.approx(_error_of_predict(tmp_path, report["models"][side]), rel=1e-6)


def _error_of_predict(folder, model):
    """Root mean square error within a second by `predict`."""
    assert load(folder / "found" / model).rig.name
    out, square = folder / model.replace(".", "_"), []
    assert nnap("predict", folder / "found" / model, folder / "rig" / "test", "--given", 1.0, "--out", out) == 0
    for path in sorted((folder / "rig" / "test").glob("*.csv")):
        predicted, read = _table(out / path.name), _table(path)
        ahead = (read["time"] > 1.0 + 1e-6) & (read["time"] <= 2.0 + 1e-6) & np.isfinite(read["x"])
        square.append((predicted["x"] - read["x"])[ahead] ** 2)
    return np.sqrt(np.mean(np.concatenate(square)))


def _table(path):
    with path.open() as file:
        rows = list(csv.DictReader(file))
    return {name: np.array([float(row[name] or "nan") for row in rows]) for name in rows[0]}


CLAIMS = {  # errors before and after by channel, and what is said of them
    "it falls": ({"theta1": (0.2, 0.1)}, "falls from 0.2 to 0.1"),
    "it rises": ({"theta1": (0.2, 0.3)}, "do not trust"),
    "one falls, one rises": (
        {"theta1": (0.2, 0.1), "theta2": (0.3, 0.4)}, "falls from 0.2 to 0.1 and that of theta2 rises from 0.3 to 0.4"),
    "the other falls": (
        {"theta1": (0.2, 0.21), "theta2": (0.4, 0.1)}, "of theta2 falls from 0.4 to 0.1 and that of theta1 rises"),
    "one hardly falls": (
        {"theta1": (0.2, 0.19), "theta2": (0.1, 0.2)}, "of theta2 does not fall with it (0.1 before, 0.2 after)"),
}  # fmt: skip


@pytest.mark.parametrize(("errors", "claim"), CLAIMS.values(), ids=CLAIMS)
def test_the_verdict_claims_a_fall_only_where_there_is_one(errors, claim):
    laws = [Finding(catalogue["payload"](jnp.zeros(()), joint=2), {}, {}, (), "payload")]
    before, after = ({name: [pair[side]] for name, pair in errors.items()} for side in (0, 1))
    error = {"horizons_s": [1.0], "before": before, "after": after}
    assert claim in verdict(laws, error)
    assert "the 0.5 s prediction error" in verdict(laws, error | {"reach_s": 0.5})
    assert verdict(laws, None) == "The model lacks a payload at joint 2."
