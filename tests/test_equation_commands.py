"""Commands on a rig that is written as equations: each works, or refuses with one sentence and writes nothing."""

import json
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import chain_rig, csv_text

from nnap_em.cli.main import main
from nnap_em.estimate.identify import begin
from nnap_em.estimate.store import fingerprint, save
from nnap_em.logs.read import read_logs
from nnap_em.machines.rig import read_rig
from nnap_em.machines.systems import specs
from nnap_em.model.effects import catalogue
from nnap_em.output.export.model import write_model

RIG = chain_rig('y = "b + 0.1*u"')
ROWS, GIVEN, SAMPLES = 60, 6.0, 8
LAWS = (
    catalogue["transfer"](strength=0.2, level=0.4, share=0.6, channel="a", reads=("a",), to="b"),
    catalogue["sensor_bend"](jnp.asarray(0.2), jnp.asarray(0.5), 4.0, channel="y"),
    catalogue["dead_zone"].of(0.1, channel="u"),
)


def _bench(folder: Path, seed: int, k: float = 1.0) -> Path:
    """A data set of Euler steps of a hundredth of a row."""
    rng, dt = np.random.default_rng(seed), 0.5
    for part in ("train", "test"):
        u = np.repeat(rng.uniform(0, 2, ROWS // 10), 10)
        a, b, y = 1.0, 1.0, []
        for one in u:
            y.append(b + 0.1 * one)
            for _ in range(100):
                a, b = a + dt / 100 * (k * one - a / 4), b + dt / 100 * (a - b) / 2
        columns = {"time": dt * np.arange(ROWS), "u": u, "y": np.array(y) + 0.01 * rng.standard_normal(ROWS)}
        (folder / part).mkdir(parents=True)
        (folder / part / "log.csv").write_text(csv_text(columns))
    (folder / "rig.toml").write_text(RIG)
    return folder


def _fit(bench: Path, laws=()):
    """The declared model before its first epoch, with a curvature."""
    rig = read_rig(bench / "rig.toml", specs)
    logs = read_logs(bench / "train", rig)
    fitted = begin(rig, logs.data, key=jax.random.key(0), effects=laws)
    size = fitted.state.hessian.shape[0]
    state = eqx.tree_at(lambda s: s.hessian, fitted.state, 400.0 * jnp.eye(size))
    return fitted._replace(state=state), logs


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """Two data sets, and a fit of each."""
    root = tmp_path_factory.mktemp("equations")
    for name, seed in (("monday", 0), ("friday", 1)):
        fitted, logs = _fit(_bench(root / f"{name}_logs", seed))
        notes = {"logs": [str(root / f"{name}_logs")]}
        (root / name).mkdir()
        save(root / name / "model.npz", fitted, fingerprint=fingerprint(logs.data), notes=notes)
    return root


REFUSED = {
    "mjcf": ("export", "monday", "--mjcf", "out.xml"),
    "design": ("design", "monday", "--out", "out"),
    "diagnose from": ("diagnose", "friday_logs", "--from", "monday", "--out", "out"),
}


@pytest.mark.parametrize("command", REFUSED.values(), ids=REFUSED)
def test_what_needs_joints_refuses_with_one_sentence_and_writes_nothing(place, command, monkeypatch, capsys):
    monkeypatch.chdir(place)
    before = sorted(place.rglob("*"))
    assert main(list(command)) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if "error" in line]
    assert len(lines) == 1 and "is written as equations" in lines[0] and "joints" in lines[0]
    assert sorted(place.rglob("*")) == before


def test_two_fits_are_compared_by_their_parameters(place, monkeypatch, capsys):
    """Parameters far apart in standard deviations."""
    monkeypatch.chdir(place)
    fitted, logs = _fit(place / "friday_logs")
    system = fitted.model.system.with_parameters({"k": jnp.asarray(1.6)})
    best = eqx.tree_at(lambda m: m.system, fitted.model, system)
    (place / "changed").mkdir()
    state = fitted.state._replace(best=best, model=best)
    save(place / "changed" / "model.npz", fitted._replace(state=state), fingerprint=fingerprint(logs.data))
    assert main(["compare", "monday", "changed", "--out", "beside"]) == 0
    printed = capsys.readouterr()
    assert printed.out.startswith("1 of 2 tested quantities changed between monday and changed beyond")
    document = json.loads((place / "beside" / "compare.json").read_text())
    assert document["changed"] == ["k"] and [each["name"] for each in document["quantities"]] == ["k", "ta"]


def test_numbers_are_exported_with_units(place, tmp_path):
    fitted, _ = _fit(place / "monday_logs", LAWS)
    write_model(fitted, tmp_path)
    document = json.loads((tmp_path / "parameters.json").read_text())
    assert document["inputs"] == [{"name": "u", "joint": None, "unit": "V"}]
    assert [effect["channel"] for effect in document["effects"]] == ["a", "y", "u"]
