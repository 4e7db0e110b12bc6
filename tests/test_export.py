"""A model that left the house: the same predictions without JAX, the same step through StableHLO, the same numbers."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import csv_text, draws

from nnap_em.commands import cli
from nnap_em.data.dataset import Dataset
from nnap_em.data.rig import Declared, Rig
from nnap_em.effects import AbstractEffect, catalogue
from nnap_em.export import unroll
from nnap_em.export.model import ExportError, parameters, predictor, stablehlo, write_model
from nnap_em.fit.identify import Identified, begin, friction_table, parameter_table
from nnap_em.fit.predict import posterior_of, predict
from nnap_em.fit.store import save

DT, ROWS, GIVEN, SAMPLES = 0.02, 90, 0.6, 20
RIG = Rig(
    "bench", "pendulum",
    {"m": Declared(0.5, 0.05), "lc": Declared(0.2, 0.0), "I": Declared(0.002, 0.0), "g": Declared(9.81, 0.0)},
    True, ("u",), (1,), DT, "sequence", ("theta1",), {"theta1": 1e-3}, {},
)  # fmt: skip
EFFECTS: dict[str, tuple[AbstractEffect, ...]] = {
    "plain": (),
    "spring and bias": (
        catalogue["torsional_spring"](*map(jnp.asarray, (0.3, 0.02, 0.0, 0.0)), joint=1),
        catalogue["sensor_bias"](jnp.asarray(0.05), channel="theta1"),
    ),
}


class _Case(NamedTuple):
    fitted: Identified
    data: Dataset


def _case(effects: tuple[AbstractEffect, ...]) -> _Case:
    """A pendulum with numbers that no fit made, and a log with gaps."""
    t = DT * np.arange(ROWS)
    rng = np.random.default_rng(0)
    theta = 0.8 * np.sin(5 * t) + 1e-3 * rng.normal(size=ROWS)
    theta[20:24] = np.nan
    u = 0.3 * np.sin(4 * t)
    data = Dataset(t[None], u[None, :, None], theta[None, :, None], np.ones((1, ROWS), bool))
    fitted = begin(RIG, data, key=jax.random.key(0), effects=effects)
    stir = lambda a: a + 0.1 * jnp.asarray(rng.normal(size=a.shape)) if eqx.is_inexact_array(a) else a  # noqa: E731
    model = eqx.tree_at(lambda m: m.unknown.mlp, fitted.model, jax.tree.map(stir, fitted.model.unknown.mlp))
    model = eqx.tree_at(lambda m: m.log_q, model, jnp.log(jnp.asarray([1e-5, 1e-2])) * 2)
    hessian = 1e3 * jnp.eye(fitted.state.hessian.shape[0])
    return _Case(fitted._replace(state=fitted.state._replace(model=model, best=model, hessian=hessian)), data)


@pytest.fixture(scope="module", params=EFFECTS.values(), ids=EFFECTS)
def case(request) -> _Case:
    return _case(request.param)


def _alone(folder: Path, *argv: str) -> str:
    """Run Python where neither JAX nor this package can be imported."""
    for name in ("jax", "equinox", "nnap_em", "scipy"):
        (folder / f"{name}.py").write_text(f"raise ImportError('{name} is not to be used')\n")
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    done = subprocess.run(
        [sys.executable, *argv], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


CODE = """
import numpy as np, predictor, sys
log = np.load("log.npz")
found = predictor.predict(
    predictor.MODEL, log["t"], log["u"], log["y"], float(log["given"]),
    draws=(log["deviations"], log["start"], log["noise"]),
)
mean, cov = predictor.smooth(predictor.MODEL, log["t"], log["u"], log["y"])
np.savez("found.npz", mean=found.mean, std=found.std, ahead=found.ahead, smoothed=mean, cov=cov)
assert not {"jax", "nnap_em", "scipy"} & set(sys.modules)
"""


def test_the_predictor_agrees_with_predict_where_there_is_no_jax(case, tmp_path):
    """The same random numbers given, the same to 1e-6 of each state."""
    fitted, data = case
    key = jax.random.key(3)
    wanted = predict(fitted, data, GIVEN, key=key, samples=SAMPLES)
    np.savez(
        tmp_path / "log.npz",
        t=data.t[0], u=data.u[0], y=data.y[0], given=GIVEN,
        **dict(zip(("deviations", "start", "noise"), draws(fitted, SAMPLES, ROWS, key), strict=True)),
    )  # fmt: skip
    write_model(fitted, tmp_path)
    (tmp_path / "use.py").write_text(CODE)
    _alone(tmp_path, "use.py")
    with np.load(tmp_path / "found.npz") as stored:
        arrays = dict(stored)
    np.testing.assert_array_equal(arrays["ahead"], wanted.ahead[0])
    np.testing.assert_allclose(arrays["mean"], wanted.mean[0], rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(arrays["std"], wanted.std[0], rtol=1e-6, atol=1e-6)
    assert np.ptp(arrays["mean"][ROWS // 2 :, 0]) > 0.3  # it moves
    if not fitted.model.effects:
        state = posterior_of(fitted, data).state  # of the model as it is: `nnap-em smooth` widens it by the model's own
        np.testing.assert_allclose(arrays["smoothed"], state.mean[0], rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(arrays["cov"], state.cov[0], rtol=1e-6, atol=1e-9)


def test_the_predictor_is_a_program(case, tmp_path):
    """Its own random numbers: the mean within the error of as many draws."""
    fitted, data = case
    write_model(fitted, tmp_path)
    columns = {"time": data.t[0], "u": data.u[0, :, 0], "theta1": data.y[0, :, 0]}
    (tmp_path / "log.csv").write_text(csv_text(columns).replace("nan", ""))
    _alone(tmp_path, "predictor.py", "log.csv", "--given", str(GIVEN), "--out", "prediction.csv")
    table = np.genfromtxt(tmp_path / "prediction.csv", delimiter=",", names=True)
    assert table.dtype.names == ("time", "theta1", "dtheta1", "theta1_std", "dtheta1_std")
    wanted = predict(fitted, data, GIVEN, key=jax.random.key(0), samples=SAMPLES)
    ahead = np.asarray(wanted.ahead[0])
    for i, name in enumerate(("theta1", "dtheta1")):
        std = table[f"{name}_std"]
        assert np.all(np.abs(table[name] - wanted.mean[0, :, i])[ahead] < 6 * std[ahead] / np.sqrt(SAMPLES))
        np.testing.assert_allclose(table[name][~ahead], wanted.mean[0, ~ahead, i], rtol=1e-5, atol=1e-5)


def test_one_step_through_stablehlo(case):
    fitted, data = case
    step = jax.export.deserialize(bytearray(stablehlo(fitted.model)))
    x = jnp.asarray(np.random.default_rng(1).normal(size=(7, fitted.model.log_q.shape[0])))
    u = jax.tree.map(lambda a: a[:7], fitted.model.inputs(jax.tree.map(lambda a: jnp.asarray(a[0]), data)))
    clock = (u.time[:, None], u.before, u.age[:, None]) if fitted.model.effects else ()
    following, reading = step.call(x, jnp.concatenate([u.u, *clock], axis=1))
    np.testing.assert_allclose(following, jax.vmap(fitted.model.transition)(x, u), rtol=1e-12)
    np.testing.assert_allclose(reading, jax.vmap(fitted.model.emission)(x, u), rtol=1e-12)


def test_the_json_has_the_numbers_of_the_model(case, tmp_path):
    fitted, _ = case
    write_model(fitted, tmp_path)
    content = json.loads((tmp_path / "parameters.json").read_text(), parse_constant=pytest.fail)
    value, std = parameter_table(fitted)["m"]
    assert content["parameters"]["m"] == {"value": value, "std": std, "unit": "kg", "estimated": True}
    assert content["parameters"]["g"] == {"value": 9.81, "std": 0.0, "unit": "m/s^2", "estimated": False}
    assert content["noise"]["measurement_std"]["theta1"] == pytest.approx(1e-3)
    assert content["dt"] == {"value": DT, "unit": "s"}
    assert [effect["name"] for effect in content["effects"]] == [effect.name for effect in fitted.model.effects]
    (joint,) = content["friction"]["joints"]
    velocity = jnp.asarray([joint["velocity"]])
    np.testing.assert_allclose(joint["torque"], friction_table(fitted, velocity).torque[0], rtol=1e-12)
    network = content["friction"]["network"]  # by hand, from the JSON alone
    v, speed, knee, scale = 1.5, *(network[name][0] for name in ("speed", "knee", "scale"))
    h = np.array([v / speed, np.arcsinh(v / knee) / np.arcsinh(speed / knee)])
    *inner, last = network["layers"]
    for layer in inner:
        h = np.tanh(np.asarray(layer["weight"][0]) @ h + layer["bias"][0])
    torque = scale * (np.asarray(last["weight"][0]) @ h + last["bias"][0]).item()
    assert torque == pytest.approx(float(fitted.model.unknown(jnp.asarray([v]))[0]), rel=1e-12)


def test_a_slide_is_exported_in_newtons_and_metres():
    rig = Rig("s", "slide", {"m": Declared(1.0, 0.0)}, True, ("f",), (1,), DT, "sequence", ("x",), {"x": 1e-3}, {})
    t = DT * np.arange(ROWS)
    swing = np.sin(5 * t)[None, :, None]
    data = Dataset(t[None], swing, swing, np.ones((1, ROWS), bool))
    spring = catalogue["torsional_spring"](*map(jnp.asarray, (20.0, 1.0, 0.0, 0.0)), joint=1)
    fitted = begin(rig, data, key=jax.random.key(0), effects=(spring,))
    fitted = fitted._replace(state=fitted.state._replace(hessian=jnp.eye(fitted.state.hessian.shape[0])))
    content = parameters(fitted)
    (effect,), (joint,) = content["effects"], content["friction"]["joints"]
    assert {n: p["unit"] for n, p in effect["parameters"].items()} == {"k": "N/m", "theta0": "m"}
    assert (joint["velocity_unit"], joint["torque_unit"]) == ("m/s", "N")
    assert content["inputs"] == [{"name": "f", "joint": 1, "unit": "N"}]
    assert "Inputs: f [N]." in predictor(fitted)


def test_a_model_that_numpy_cannot_follow_has_no_predictor_and_says_why(tmp_path):
    """A predictor of another fit does not stay beside it."""
    out = tmp_path / "out"
    assert write_model(_case(()).fitted, out) == "" and (out / "predictor.py").exists()
    gain = catalogue["motor_gain"](jnp.asarray(0.1), joint=1)
    assert "'motor_gain' acts on the command; use model.stablehlo" in write_model(_case((gain,)).fitted, out)
    assert sorted(path.name for path in out.iterdir()) == ["model.stablehlo", "parameters.json"]
    assert json.loads((out / "parameters.json").read_text())["effects"][0]["name"] == "motor_gain"


def test_a_form_with_other_numbers_is_not_exported(monkeypatch):
    monkeypatch.setitem(unroll._ELEMENTWISE, "abs", "{}")
    with pytest.raises(ExportError, match="the NumPy form of 'rate' gives other numbers than JAX"):
        predictor(_case(()).fitted)


def test_a_declared_frictionless_slide_is_exported_too(tmp_path):
    t = DT * np.arange(ROWS)
    rig = Rig("s", "slide", {"m": Declared(1.0, 0.0)}, False, (), (), DT, "sequence", ("x",), {"x": 1e-3}, {})
    data = Dataset(t[None], np.zeros((1, ROWS, 0)), (0.5 * t)[None, :, None], np.ones((1, ROWS), bool))
    fitted = begin(rig, data, key=jax.random.key(0))
    assert parameters(fitted)["friction"] is None
    (tmp_path / "predictor.py").write_text(predictor(fitted))
    code = "import numpy as np, predictor as p; print(*p.transition(p.MODEL, np.array([0.1, 2.0]), np.zeros(0)))"
    x, v = map(float, _alone(tmp_path, "-c", code).split())
    assert (x, v) == pytest.approx((0.1 + 2.0 * DT, 2.0), rel=1e-12)  # free motion


def test_the_command_writes_three_files(tmp_path, capsys):
    fitted, _ = _case(())
    save(tmp_path / "fit/model.npz", fitted)
    assert cli.main(["export", str(tmp_path / "fit"), "--out", str(tmp_path / "out")]) == 0
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "model.stablehlo",
        "parameters.json",
        "predictor.py",
    ]
    assert "wrote predictor.py to " in capsys.readouterr().err
    assert cli.main(["export", str(tmp_path / "nothing"), "--out", str(tmp_path / "other")]) == 2
    assert not (tmp_path / "other").exists()
