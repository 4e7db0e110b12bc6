"""The commands from end to end on a small slide: whole files, right rows, numbers that can be computed another way."""

import argparse
import json
import re
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from helpers import nnap
from shell import ROOT

from nnap_em.base.journal import Journal
from nnap_em.cli import identify as identify_command
from nnap_em.cli import main as cli
from nnap_em.estimate.smoother import AbstractSmoother
from nnap_em.estimate.smoother.start import StartBank
from nnap_em.estimate.store import load, read
from nnap_em.machines.rig import read_rig
from nnap_em.machines.systems import specs
from nnap_em.model.simulate import examples

STEPS = 150
SIMULATE = ("--system", "slide", "--sequences", 4, "--test", 4, "--steps", STEPS, "--seed", 3)
EPOCHS = 9
SHORT = 61
"""Rows of the one test sequence that is shorter than the others: it ends before the given time."""


def _read(path: Path) -> dict[str, np.ndarray]:
    table = np.genfromtxt(path, delimiter=",", names=True)
    return {name: table[name] for name in table.dtype.names}


def _slide_law(v: np.ndarray) -> np.ndarray:
    """The true friction of the simulated slide [N]."""
    return -((1.0 + 0.5 * np.exp(-((v / 0.05) ** 2))) * np.tanh(v / 0.02) + 2.0 * v)


def _files(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


@pytest.fixture(scope="module")
def bench(tmp_path_factory) -> Path:
    """A data set with a short test sequence and gaps in another; the noise of the readings is not declared."""
    folder = tmp_path_factory.mktemp("cli") / "bench"
    assert nnap("simulate", folder, *SIMULATE) == 0
    text = (folder / "rig.toml").read_text()
    (folder / "rig.toml").write_text(re.sub(r"\[measurement\.noise_std\]\n.*\n", "", text))
    lines = (folder / "test/001.csv").read_text().splitlines(keepends=True)
    (folder / "test/001.csv").write_text("".join(lines[: 1 + SHORT]))
    lines = (folder / "test/002.csv").read_text().splitlines()
    lines[130:136] = [line.rpartition(",")[0] + "," for line in lines[130:136]]
    (folder / "test/002.csv").write_text("\n".join(lines) + "\n")
    return folder


@pytest.fixture(scope="module")
def fit(bench) -> Path:
    out = bench.parent / "fit"
    assert nnap("identify", bench, "--out", out, "--epochs", EPOCHS, "--quiet") == 0
    return out


def test_help_shows_examples_and_loads_no_jax():
    code = """
import sys
from nnap_em.cli import main as cli
for command in ("", "simulate", "init", "check", "identify", "diagnose", "compare", "predict", "smooth", "export"):
    try:
        cli.main([command, "--help"] if command else ["--help"])
    except SystemExit as stop:
        assert stop.code == 0
assert not {"jax", "numpy", "equinox", "matplotlib"} & set(sys.modules)
"""
    process = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert process.returncode == 0, process.stderr
    assert process.stdout.count("example") >= 9
    for command in ("simulate bench", "identify bench --out fit", "predict fit bench/test", "smooth fit bench/test"):
        assert f"nnap-em {command}" in process.stdout


def test_command_line_offers_what_the_library_has():
    assert sorted(cli.SYSTEMS) == sorted(examples) == sorted(n for n, spec in specs.items() if not spec.declare)
    bank = StartBank((1, 1))
    for name in cli.SMOOTHERS:
        args = argparse.Namespace(smoother=name, particles=7 if name == "particle" else None)
        smoother = identify_command.smoother(args)(bank)
        assert isinstance(smoother, AbstractSmoother)
    assert smoother.num_particles == 7


def test_simulated_logs_are_the_truth_with_the_declared_noise(tmp_path):
    noise = ("--process-noise", 1e-4, 2e-3, "--measurement-noise", 0.002, 0.03)
    assert nnap("simulate", tmp_path / "a", *SIMULATE, "--measured", "dx", "x", *noise) == 0
    declared = read_rig(tmp_path / "a/rig.toml", specs)
    assert (declared.measured, declared.noise_std) == (("dx", "x"), {"dx": 0.03, "x": 0.002})
    groups = [f"{group}/{i:03d}.csv" for group in ("train", "test") for i in range(4)]
    wanted = ["rig.toml", "truth/friction.csv", *groups, *(f"truth/{name}" for name in groups)]
    assert _files(tmp_path / "a") == sorted(wanted)
    misfit = {"x": [], "dx": []}
    for name in groups:
        log, truth = _read(tmp_path / "a" / name), _read(tmp_path / "a/truth" / name)
        assert list(log) == ["time", "u", "dx", "x"]
        assert len(log["time"]) == STEPS + 1
        np.testing.assert_array_equal(log["u"], truth["u"])
        np.testing.assert_allclose(truth["time"], 0.01 * np.arange(STEPS + 1), atol=1e-12)
        for state in misfit:
            misfit[state].append(log[state] - truth[state])
    for state, std in (("x", 0.002), ("dx", 0.03)):
        values = np.concatenate(misfit[state])
        np.testing.assert_allclose(values.std(), std, rtol=4 / np.sqrt(2 * values.size))
    friction = _read(tmp_path / "a/truth/friction.csv")
    np.testing.assert_allclose(friction["torque"], _slide_law(friction["velocity"]), rtol=1e-9, atol=1e-9)
    assert nnap("simulate", tmp_path / "b", *SIMULATE) == 0
    assert (tmp_path / "b/train/000.csv").read_bytes() != (tmp_path / "a/train/000.csv").read_bytes()


def test_identify_writes_whole_results(bench, fit):
    assert _files(fit) == ["friction.csv", "friction.png", "model.npz", "report.html", "report.json"]
    assert (fit / "friction.png").read_bytes().startswith(b"\x89PNG")
    report = json.loads((fit / "report.json").read_text(), parse_constant=pytest.fail)
    assert report["format"] == 1
    assert list(report["fit"]) == ["given_s", "horizons_s", "x"]
    assert report["error"]["fit"] == {"x": report["fit"]["x"]}
    reading = report["noise"]["measurement"]["x"]
    assert (reading["estimated"], reading["unit"]) == (True, "m")
    np.testing.assert_allclose(reading["std"], 1e-3, rtol=0.2)
    assert report["versions"]["jax"] == jax.__version__
    rise = report["log_likelihood"][-1] - report["log_likelihood"][-3]
    assert report["verdict"] == f"Fitted the friction of 1 joint to 4 sequences; {report['stopped']}."
    assert f"stopped after {EPOCHS} epochs while the log-likelihood still rose by {rise:.2g}" in report["stopped"]
    assert report["friction_law"][0]["text"] in (fit / "report.html").read_text()
    stored = read(fit / "model.npz")
    assert report["log_likelihood"] == stored.fitted.state.loglik.tolist()
    assert stored.notes["settings"] == {"smoother": "cubature", "particles": None, "seed": 0}
    assert [epoch["epoch"] for epoch in stored.notes["epochs"]] == list(range(1, EPOCHS + 1))
    assert stored.fitted.rig == read_rig(bench / "rig.toml", specs)


def test_the_learned_friction_is_the_true_one(bench, fit):
    learned = _read(fit / "friction.csv")
    assert list(learned) == ["joint", "velocity", "torque", "torque_std"]
    assert (learned["joint"] == 1).all()
    assert len(learned["velocity"]) == 101
    assert (np.diff(learned["velocity"]) > 0).all()
    sliding = np.abs(learned["velocity"]) > 0.1  # at rest it takes more data than this
    exact = _slide_law(learned["velocity"])[sliding]
    miss = learned["torque"][sliding] - exact
    assert 0.1 < np.sqrt(np.mean((miss / learned["torque_std"][sliding]) ** 2)) < 3.0  # nor wider than ten times that
    assert np.sqrt(np.mean(miss**2) / np.mean(exact**2)) < 0.15


def test_reported_errors_are_those_of_the_predictions_which_contain_the_truth(bench, fit, tmp_path, capsys):
    """The true state, inputs after the given time included, is within the stated standard deviations."""
    assert nnap("predict", fit, bench / "test", "--given", 1, "--out", tmp_path) == 0
    assert "test: no row of 001.csv is later than --given 1 s: nothing is predicted" in capsys.readouterr().err
    assert _files(tmp_path) == [f"{i:03d}.csv" for i in range(4)]
    since, miss, z = [], [], []
    for name in _files(tmp_path):
        predicted, log = _read(tmp_path / name), _read(bench / "test" / name)
        truth = {state: values[: len(log["time"])] for state, values in _read(bench / "truth/test" / name).items()}
        assert list(predicted) == ["time", "x", "dx", "x_std", "dx_std"]
        np.testing.assert_array_equal(predicted["time"], log["time"])
        assert all(np.isfinite(values).all() for values in predicted.values())
        since.append(log["time"] - log["time"][0] - 1.0)
        miss.append(predicted["x"] - log["x"])
        ahead = since[-1] > 1e-6
        z += [(predicted[s] - truth[s])[ahead] / predicted[f"{s}_std"][ahead] for s in ("x", "dx")]
    assert 0.1 < np.sqrt(np.mean(np.square(np.concatenate(z)))) < 3.0  # an infinite std contains everything
    since, miss = np.concatenate(since), np.concatenate(miss)
    report = json.loads((fit / "report.json").read_text())["fit"]
    assert report["given_s"] == 1.0
    for horizon, reported in zip(report["horizons_s"], report["x"], strict=True):
        inside = (since > 1e-6) & (since < horizon + 1e-6) & np.isfinite(miss)
        np.testing.assert_allclose(reported, np.sqrt(np.mean(miss[inside] ** 2)), rtol=1e-6)


def test_smoothed_states_are_nearer_the_truth_than_the_readings(bench, fit, tmp_path):
    assert nnap("smooth", fit, bench / "test", "--out", tmp_path) == 0
    error, noise, z = [], [], []
    for name in _files(bench / "test"):
        smoothed, log, truth = _read(tmp_path / name), _read(bench / "test" / name), _read(bench / "truth/test" / name)
        assert list(smoothed) == ["time", "x", "dx", "x_std", "dx_std"]
        np.testing.assert_array_equal(smoothed["time"], log["time"])
        rows = slice(len(log["time"]))
        error.append(smoothed["x"] - truth["x"][rows])
        noise.append(log["x"] - truth["x"][rows])
        z += [(smoothed[s] - truth[s][rows]) / smoothed[f"{s}_std"] for s in ("x", "dx")]
    assert np.std(np.concatenate(error)) < 0.8 * np.nanstd(np.concatenate(noise))
    assert 0.5 < np.sqrt(np.mean(np.concatenate(z) ** 2)) < 2.0


def test_a_run_that_was_stopped_goes_on_to_the_same_numbers(bench, fit, tmp_path, monkeypatch, capsys):
    out = tmp_path / "stopped"
    argv, whole = ("identify", bench, "--out", out, "--epochs", EPOCHS), Journal.keep

    def keep(self, name, outcome):
        whole(self, name, outcome)
        if len(self.done) == 9:  # five of them tell how large the process noise is
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Journal, "keep", keep)
        assert nnap(*argv) == 130
    said = capsys.readouterr().err
    assert said.startswith("nnap-em: compiling for 4 sequences of 151 rows")
    assert re.search(r"epoch   2 of 9  horizon 0\.60 s  log-likelihood [\d.]+ nat .*  noise std x 0\.00", said)
    assert "stopped with 9 finished steps kept; the same command goes on" in said
    assert all(name.startswith("unfinished/em_step-") for name in _files(out))
    assert nnap(*argv) == 0
    assert f"9 finished steps in {out / 'unfinished'}: those" in capsys.readouterr().err
    assert _files(out) == _files(fit)
    assert (out / "friction.csv").read_bytes() == (fit / "friction.csv").read_bytes()
    whole, stopped = (json.loads((folder / "report.json").read_text()) for folder in (fit, out))
    for name in ("fit", "noise", "parameters", "friction_law", "log_likelihood", "left_out"):
        assert whole[name] == stopped[name]
    assert [e["epoch"] for e in stopped["epochs"]] == list(range(1, EPOCHS + 1))
    one, other = (load(folder / "model.npz") for folder in (fit, out))
    leaves = zip(jax.tree.leaves(one.model), jax.tree.leaves(other.model), strict=True)
    assert all(np.array_equal(a, b) for a, b in leaves if isinstance(a, jax.Array))


BAD = {
    "identify bench --out bench/rig.toml": r"rig\.toml: File exists",
    "simulate bench --system slide": "is there already; give a new folder",
    "smooth bench bench/test --out out": "model.npz: cannot be read",
    "predict fit nothing --given 1 --out out": "nothing: is no folder",
    "simulate out --system slide --measured y": "--measured y: no state of this system; possible here: x, dx",
}


@pytest.mark.parametrize("line", BAD)
def test_a_mistake_gives_one_line_and_writes_nothing(bench, fit, monkeypatch, capsys, line):
    monkeypatch.chdir(bench.parent)
    before = _files(bench.parent)
    assert cli.main(line.split()) == 2
    said = capsys.readouterr()
    assert re.fullmatch(rf"nnap-em: error: .*{BAD[line]}.*\n", said.err)
    assert said.out == ""
    assert _files(bench.parent) == before


USAGE = {
    "": "required",
    "identify bench": "--out",
    "identify bench --out x --epochs 0": "found '0'; give a whole number of 1 or more",
    "identify bench --out x --particles 9": "--particles goes with --smoother particle",
    "identify bench --out x --smoother ukf": "invalid choice: 'ukf'",
    "predict m t --out x --given -1": "found '-1'; give seconds, 0 or more",
    "simulate x --process-noise 0 1": "found '0'; give a number above 0",
}


@pytest.mark.parametrize("line", USAGE)
def test_wrong_usage_is_refused(capsys, line):
    with pytest.raises(SystemExit, match="2"):
        cli.main(line.split())
    assert USAGE[line] in capsys.readouterr().err
