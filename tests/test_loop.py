"""The loop end to end on rigs of an independent simulator: what is there is found, where nothing is nothing is said."""

import csv
import json

import jax
import jax.numpy as jnp
import numpy as np
import plant
import pytest

from nnap_em import diagnose, findings, load, read_logs, read_rig
from nnap_em.commands import cli
from nnap_em.diagnosis.findings import Estimate, Finding, verdict
from nnap_em.effects import catalogue
from nnap_em.effects.base import Curve
from nnap_em.effects.function import Axis
from nnap_em.numerics.profile import profiling

SLIDE = plant.Case(system="slide", sequences=8, tests=3, steps=95, seed=2, noise=(5e-4, 5e-3))
SPRING = {"name": "torsional_spring", "joint": 1, "k": 20.0, "theta0": 0.05}
DRAG = {"name": "air_drag", "joint": 1, "c": 0.8}


def _closed(case, folder):
    plant.write(case, folder)
    rig = read_rig(folder / "rig.toml")
    data = read_logs(folder / "train", rig).data
    diagnosis = diagnose(rig, data, key=jax.random.key(0))
    return diagnosis, findings(diagnosis)


def test_a_slide_that_lacks_nothing_is_left_alone_and_other_recordings_of_it_compile_nothing(tmp_path):
    """A drag of the joint's own velocity is a static map: the learned friction holds it, and nothing is missing.

    The programs of its search serve another data set, of two recordings more and three rows less.
    """
    case = SLIDE._replace(effects=(DRAG,))
    diagnosis, lacking = _closed(case, tmp_path / "first")
    assert not lacking
    assert diagnosis.after is diagnosis.before
    with profiling() as profile:
        _closed(case._replace(sequences=10, steps=92, seed=3), tmp_path / "second")
    assert {name: stages for name, stages in profile.spent.items() if stages["compile"]} == {}


@pytest.mark.slow  # fast: test_a_slide_that_lacks_nothing_is_left_alone_and_other_recordings_of_it_compile_nothing
def test_a_spring_of_a_slide_through_the_command(tmp_path):
    """Named and sized; the report exact to the interface; the reported errors those of `predict`."""
    plant.write(SLIDE._replace(steps=250, effects=(SPRING, DRAG)), tmp_path / "rig")
    out = tmp_path / "found"
    assert cli.main(["diagnose", str(tmp_path / "rig"), "--out", str(out), "--quiet"]) == 0
    report = json.loads((out / "report.json").read_text())
    _named_and_sized(report)
    _exact_to_the_interface(report, (out / "report.html").read_text())
    _ends_over_the_whole_length(report["rounds"])
    for side in ("before", "after"):
        _errors_of_predict(tmp_path, report, side)


def _named_and_sized(report):
    values = {e["name"]: e["parameters"] for e in report["effects"]}
    assert set(values) == {"torsional_spring"}
    estimate = values["torsional_spring"]["k"]
    assert estimate["value"] == pytest.approx(20.0, rel=0.05)
    assert abs(estimate["value"] - 20.0) < 3 * estimate["std"]
    assert values["torsional_spring"]["k"]["unit"] == "N/m"
    assert report["error"]["after"]["x"][3] < 0.3 * report["error"]["before"]["x"][3]


def _ends_over_the_whole_length(looks):
    """The first law may be found at a short horizon; every round after it is over the whole length."""
    assert len(looks) >= 2
    assert [look["horizon_s"] for look in looks[1:]] == pytest.approx([2.51] * len(looks[1:]))


def _exact_to_the_interface(report, page):
    assert report["format"] == 1
    for effect in report["effects"]:
        assert {"name", "joint", "channel", "inputs", "parameters", "evidence", "equivalent"} <= set(effect)
        evidence = effect["evidence"]
        fell, parts = evidence["parts"]
        assert 2 * evidence["chance"] <= evidence["share_of_error"] <= 1 and 0.75 * parts <= fell <= parts
        assert evidence["p_value"] is None and evidence["log_likelihood_gain"] is None
    error = report["error"]
    assert error["given_s"] == 1.0
    assert error["horizons_s"] == [0.1, 0.25, 0.5, 1.0, 2.0, 4.0]
    assert error["reach_s"] == pytest.approx(1.5)
    assert list(error["before"]) == list(error["after"]) == ["x"]
    assert len(error["before"]["x"]) == 6
    assert report["verdict"] in page
    assert 'src="http' not in page
    assert "<script" not in page


def _errors_of_predict(folder, report, side):
    model, out = folder / "found" / report["models"][side], folder / side
    assert load(model).rig.name
    assert cli.main(["predict", str(model), str(folder / "rig" / "test"), "--given", "1.0", "--out", str(out)]) == 0
    square = []
    for path in sorted((folder / "rig" / "test").glob("*.csv")):
        predicted, read = _table(out / path.name), _table(path)
        ahead = (read["time"] > 1.0 + 1e-6) & (read["time"] <= 2.0 + 1e-6) & np.isfinite(read["x"])
        square.append((predicted["x"] - read["x"])[ahead] ** 2)
    rms = np.sqrt(np.mean(np.concatenate(square)))
    assert report["error"][side]["x"][3] == pytest.approx(rms, rel=1e-6)


def _table(path):
    with path.open() as file:
        rows = list(csv.DictReader(file))
    return {name: np.array([float(row[name] or "nan") for row in rows]) for name in rows[0]}


def test_the_verdict_claims_a_fall_only_where_there_is_one():
    """The same finding with a test error that falls, that rises, and that nobody knows."""
    effect = catalogue["payload"](jnp.zeros(()), joint=2)
    laws = [Finding(effect, {}, {}, (), "payload")]
    error = {"horizons_s": [1.0], "before": {"theta1": [0.2]}, "after": {"theta1": [0.1]}}
    assert "falls from 0.2 to 0.1" in verdict(laws, error)
    assert "the 1 s prediction error" in verdict(laws, error | {"reach_s": 3.0})
    assert "the 0.5 s prediction error" in verdict(laws, error | {"reach_s": 0.5})
    assert "do not trust" in verdict(laws, error | {"after": {"theta1": [0.3]}})
    mixed = {side: {"theta1": [x], "theta2": [y]} for side, x, y in (("before", 0.2, 0.3), ("after", 0.1, 0.4))}
    assert "falls from 0.2 to 0.1 and that of theta2 rises from 0.3 to 0.4 on" in verdict(laws, error | mixed)
    other = {side: {"theta1": [x], "theta2": [y]} for side, x, y in (("before", 0.2, 0.4), ("after", 0.21, 0.1))}
    assert "of theta2 falls from 0.4 to 0.1 and that of theta1 rises" in verdict(laws, error | other)
    worse = {side: {"theta1": [x], "theta2": [y]} for side, x, y in (("before", 0.2, 0.1), ("after", 0.19, 0.2))}
    assert "of theta2 does not fall with it (0.1 before, 0.2 after): do not trust" in verdict(laws, error | worse)
    assert verdict(laws, None) == "The model lacks a payload at joint 2."
    sized = laws[0]._replace(parameters={"mass": Estimate(0.4567, 0.0123, "kg"), "centre_x": Estimate(0.1, 0.2, "m")})
    assert verdict([sized], None) == "The model lacks a payload at joint 2 (mass = 0.457 ± 0.012 kg)."
    drawn = laws[0]._replace(
        effect=catalogue["air_drag"](jnp.zeros(())),
        curve=Curve("x", "rad", 1, "N m", False, *np.asarray([[0.0, 1.0], [-1.0, 2.0], [0.1, 0.1]])),
    )
    assert verdict([drawn], None) == "The model lacks air drag (3.0 N m from trough to peak)."
    axis = Axis(("theta2",), jnp.asarray(-1.0), jnp.asarray(1.0), False, 4)
    free = drawn._replace(effect=catalogue["unknown_function"](jnp.zeros(4), (axis,), joint=2))
    assert verdict([free], None) == (
        "The model lacks a torque at joint 2 that depends on theta2 (3.0 N m from trough to peak)."
    )
    rail = free._replace(curve=drawn.curve._replace(unit="N", mean=np.asarray([-3e3, 3.19e3])))
    assert "a force at joint 2 that depends on theta2 (6200 N from trough to peak)" in verdict([rail], None)
    several = [Finding(catalogue["payload"](jnp.zeros(()), joint=j), {}, {}, (), "") for j in (1, 2, 1)]
    assert verdict(several, error).startswith(
        "The model lacks a payload at joint 1, a payload at joint 2 and a payload at joint"
    )
    assert "with them" in verdict(several[:2], error)
