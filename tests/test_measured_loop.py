"""Files that `examples/measured_loop.py` writes from raw recordings, and its table."""

import measured_loop
import numpy as np
import pytest
import recordings
from measured_figures import MissingTorque, errors_figure, finding_figure

from nnap_em import read_logs, read_rig
from nnap_em.commands.cli import main as nnap_em

LAWS = {
    "torsional_spring": lambda q, v: -0.6 * (q - 0.2),
    "cogging": lambda q, v: 0.4 * np.sin(3 * q + 0.5),
    "eddy_brake": lambda q, v: -0.05 * np.cos(q - 0.5) ** 2 * v,
}
"""The laws of the page, written once more."""


def _columns(path):
    return np.genfromtxt(path, delimiter=",", names=True)


@pytest.fixture(scope="module")
def source(shared):
    return recordings.recordings(shared / "data/raw/dfki_c1_pert")[:2]


@pytest.mark.parametrize("law", measured_loop.LAWS)
def test_a_law_is_taken_out_of_the_torque_of_its_joint_alone(law, source, tmp_path):
    (written,) = measured_loop.write_logs(source[:1], tmp_path / "logs", law)
    log, real = _columns(written), _columns(source[0])[: len(_columns(written))]
    assert 4.99 < log["time"][-1] <= 5.0
    q, v = real["pos_meas2"], real["vel_meas2"]
    np.testing.assert_allclose(log["tau_meas2"], real["tau_meas2"] - LAWS[law](q, v), atol=1e-7)
    for name in set(log.dtype.names) - {"tau_meas2"}:
        np.testing.assert_allclose(log[name], real[name], rtol=1e-8, atol=1e-8)


def test_the_import_keeps_the_law_as_its_mean_over_each_step(source, tmp_path):
    """Against the exact mean of the spring at the raw rows, each held until the next."""
    data = {}
    for name, law in (("recorded", None), ("planted", "torsional_spring")):
        logs = map(str, measured_loop.write_logs(source, tmp_path / name / "logs", law))
        out = tmp_path / name / "data"
        assert nnap_em(["import", *logs, "--rig", str(measured_loop.RIG), "--out", str(out), "--test", "1"]) == 0
        rig = read_rig(out / "rig.toml")
        data[name] = read_logs(out / "train", rig).data
    np.testing.assert_array_equal(data["planted"].y, data["recorded"].y)
    change = np.asarray(data["planted"].u - data["recorded"].u)[0]
    raw = _columns(source[0])
    whole = np.concatenate([[0.0], np.cumsum(0.6 * (raw["pos_meas2"][:-1] - 0.2) * np.diff(raw["time"]))])
    expected = np.diff(np.interp(0.01 * np.arange(len(change)), raw["time"], whole)) / 0.01
    np.testing.assert_allclose(change[:-1, 1], expected, atol=1e-6)
    np.testing.assert_array_equal(change[:, 0], 0.0)
    assert data["recorded"].y.shape == (1, 500, 2)


def _diagnosed(folder, effects):
    for part, count in (("train", 6), ("test", 2)):
        (folder / part).mkdir(parents=True, exist_ok=True)
        for i in range(count):
            (folder / part / f"{i}.csv").touch()
    return measured_loop.Diagnosis(folder, {"effects": effects}, None, None)  # type: ignore[arg-type]


def test_the_table_says_what_was_found(tmp_path):
    number = {"value": 0.6012, "std": 0.0123, "unit": "N m/rad"}
    spring = {"name": "torsional_spring", "joint": 2, "parameters": {"k": number}, "description": "spring at 2: k"}
    spring["evidence"] = {"share_of_error": 0.7}
    recorded, planted = (_diagnosed(tmp_path, effects) for effects in ([], [spring]))
    off = {"before": 0.5, "after": 0.25, "recorded": 0.24}
    lines = dict(measured_loop.lines(recorded, planted, "torsional_spring", off))
    assert list(lines.values())[:2] == ["6 to fit, 2 to test", "nothing"]
    assert "0.6 N m/rad" in lines.values() and "0.601 ± 0.01 N m/rad" in lines.values()
    assert [value for value in lines.values() if value.endswith(" rad")] == ["0.500 rad", "0.250 rad", "0.240 rad"]
    missed = dict(measured_loop.lines(recorded, recorded, "torsional_spring", off))
    assert "not found" in missed.values()


def test_the_law_through_the_samples_is_drawn_where_it_is():
    """Means over bins of a line are on the line."""
    q = np.random.default_rng(0).uniform(-2, 2, 4000)
    panel = MissingTorque("", q, -0.3 * q + np.random.default_rng(1).normal(0, 0.1, 4000), -0.3 * q, -0.3 * q)
    figure = finding_figure([panel, panel], 2)
    for line in figure.axes[0].lines[3:5]:
        x, y = (np.asarray(a) for a in line.get_data())
        np.testing.assert_allclose(y, -0.3 * (x - q.mean()), atol=1e-9)
        assert len(x) > 20
    errors = {name: {"theta1": [0.1, 0.2], "theta2": [0.1, 0.3]} for name in ("a", "b", "c")}
    titles = [ax.get_title(loc="left") for ax in errors_figure((0.1, 0.5), errors).axes]
    assert titles == ["joint 1", "joint 2"]


def test_a_folder_without_the_files_is_refused_in_one_sentence(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["measured_loop.py", "--from", str(tmp_path)])
    assert measured_loop.main() == 1
    said = capsys.readouterr().err
    assert said.startswith("error: ") and "experiment01.csv: not there" in said and said.count("\n") == 1
