"""The loop end to end on rigs of an independent simulator: what is there is found, where nothing is nothing is said."""

import csv
import json

import jax
import numpy as np
import plant
import pytest

from nnap_em import cli, close_the_loop, findings, load, read_logs, read_rig, specs
from nnap_em.loop import key_of

SLIDE = plant.Case(system="slide", sequences=8, tests=3, steps=250, seed=2, noise=(5e-4, 5e-3))
SPRING = {"name": "torsional_spring", "joint": 1, "k": 20.0, "theta0": 0.05}
DEAD = {"name": "dead_zone", "joint": 1, "width": 1.0}
DRAG = {"name": "air_drag", "joint": 1, "c": 0.8}


def _closed(case, folder):
    plant.write(case, folder)
    rig = read_rig(folder / "rig.toml", specs)
    data = read_logs(folder / "train", rig).data
    closed = close_the_loop(rig, data, key=jax.random.key(0))
    return closed, findings(closed, data)


def test_a_slide_that_lacks_nothing_is_left_alone(tmp_path):
    """A drag of the joint's own velocity is a static map: the learned friction holds it, and nothing is missing."""
    closed, found = _closed(SLIDE._replace(effects=(DRAG,)), tmp_path)
    assert not found
    assert closed.after is closed.before


@pytest.fixture(scope="module")
def diagnosed(tmp_path_factory):
    """A slide with an undeclared spring, dead zone and drag, through the command."""
    folder = tmp_path_factory.mktemp("slide")
    plant.write(SLIDE._replace(effects=(SPRING, DEAD, DRAG)), folder / "rig")
    assert cli.main(["diagnose", str(folder / "rig"), "--out", str(folder / "found"), "--quiet"]) == 0
    return folder, json.loads((folder / "found" / "report.json").read_text())


@pytest.mark.slow
def test_two_effects_of_a_slide_are_named_and_sized(diagnosed):
    _, report = diagnosed
    values = {e["name"]: e["parameters"] for e in report["effects"]}
    assert set(values) == {"torsional_spring", "dead_zone"}
    for name, parameter, truth in (("torsional_spring", "k", 20.0), ("dead_zone", "width", 1.0)):
        entry = values[name][parameter]
        assert entry["value"] == pytest.approx(truth, rel=0.05)
        assert abs(entry["value"] - truth) < 3 * entry["std"]
    assert values["torsional_spring"]["k"]["unit"] == "N/m"
    assert report["error"]["after"]["x"][3] < 0.3 * report["error"]["before"]["x"][3]


def test_report_is_exact_to_the_interface(diagnosed):
    folder, report = diagnosed
    assert report["format"] == 1
    for effect in report["effects"]:
        assert {"name", "joint", "channel", "inputs", "parameters", "evidence", "equivalent"} <= set(effect)
        assert {"log_likelihood_gain", "p_value"} <= set(effect["evidence"])
        assert 0 < effect["evidence"]["p_value"] < 1e-6
    error = report["error"]
    assert error["given_s"] == 1.0
    assert error["horizons_s"] == [0.1, 0.25, 0.5, 1.0, 2.0, 4.0]
    assert list(error["before"]) == list(error["after"]) == ["x"]
    assert len(error["before"]["x"]) == 6
    page = (folder / "found" / "report.html").read_text()
    assert report["verdict"] in page.replace("&#x27;", "'")
    assert "src=\"http" not in page and "<script" not in page  # fmt: skip


def test_reported_errors_are_those_of_predict(diagnosed):
    """Both models, through the command and its files."""
    folder, report = diagnosed
    for side in ("before", "after"):
        model, out = folder / "found" / report["models"][side], folder / side
        assert load(model).rig.name
        assert cli.main(["predict", str(model), str(folder / "rig" / "test"), "--given", "1.0", "--out", str(out)]) == 0
        square = []
        for path in sorted((folder / "rig" / "test").glob("*.csv")):
            told, read = _table(out / path.name), _table(path)
            ahead = (read["time"] > 1.0 + 1e-6) & (read["time"] <= 2.0 + 1e-6) & np.isfinite(read["x"])
            square.append((told["x"] - read["x"])[ahead] ** 2)
        rms = np.sqrt(np.mean(np.concatenate(square)))
        assert report["error"][side]["x"][3] == pytest.approx(rms, rel=1e-6)


def _table(path):
    with path.open() as file:
        rows = list(csv.DictReader(file))
    return {name: np.array([float(row[name] or "nan") for row in rows]) for name in rows[0]}


@pytest.mark.slow
def test_a_payload_is_found_though_joint_2_is_hidden(tmp_path):
    case = plant.Case(effects=plant.STRONG["payload"], sequences=8, tests=2, steps=200, seed=6)
    closed, found = _closed(case, tmp_path)
    assert [key_of(f.effect)[:2] for f in found] == [("payload", 2)]
    mass = found[0].parameters["mass"]
    assert mass.value == pytest.approx(0.04, rel=0.1)
    assert closed.after.model.effects[0].mass == pytest.approx(mass.value)


def test_the_same_seed_gives_the_same_numbers(tmp_path):
    short = SLIDE._replace(effects=(SPRING,), sequences=4, steps=120)
    first, second = (_closed(short, tmp_path)[0] for _ in range(2))
    for a, b in zip(jax.tree.leaves(first.after.model), jax.tree.leaves(second.after.model), strict=True):
        np.testing.assert_array_equal(a, b)
