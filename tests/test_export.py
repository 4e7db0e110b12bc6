"""A model that left the house: the same numbers."""

import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nnap_em.commands import cli
from nnap_em.data.dataset import Dataset
from nnap_em.data.rig import Declared, Rig
from nnap_em.effects import catalogue
from nnap_em.export.model import parameters, write_model
from nnap_em.fit.identify import Identified, begin, friction_table, parameter_table
from nnap_em.fit.store import save

DT, ROWS = 0.02, 90
RIG = Rig(
    "bench", "pendulum",
    {"m": Declared(0.5, 0.05), "lc": Declared(0.2, 0.0), "I": Declared(0.002, 0.0), "g": Declared(9.81, 0.0)},
    True, ("u",), (1,), DT, "sequence", ("theta1",), {"theta1": 1e-3}, {},
)  # fmt: skip
EFFECTS = (
    catalogue["torsional_spring"](*map(jnp.asarray, (0.3, 0.02, 0.0, 0.0)), joint=1),
    catalogue["sensor_bias"](jnp.asarray(0.05), channel="theta1"),
)


@pytest.fixture(scope="module")
def fitted() -> Identified:
    """A pendulum with numbers that no fit made, with a spring and a biased sensor."""
    t, rng = DT * np.arange(ROWS), np.random.default_rng(0)
    y, u = 0.8 * np.sin(5 * t) + 1e-3 * rng.normal(size=ROWS), 0.3 * np.sin(4 * t)
    data = Dataset(t[None], u[None, :, None], y[None, :, None], np.ones((1, ROWS), bool))
    fitted = begin(RIG, data, key=jax.random.key(0), effects=EFFECTS)
    stir = lambda a: a + 0.1 * jnp.asarray(rng.normal(size=a.shape)) if eqx.is_inexact_array(a) else a  # noqa: E731
    model = eqx.tree_at(lambda m: m.unknown.mlp, fitted.model, jax.tree.map(stir, fitted.model.unknown.mlp))
    hessian = 1e3 * jnp.eye(fitted.state.hessian.shape[0])
    return fitted._replace(state=fitted.state._replace(model=model, best=model, hessian=hessian))


def test_the_json_has_the_numbers_of_the_model(fitted, tmp_path):
    write_model(fitted, tmp_path)
    content = json.loads((tmp_path / "parameters.json").read_text(), parse_constant=pytest.fail)
    value, std = parameter_table(fitted)["m"]
    assert content["parameters"]["m"] == {"value": value, "std": std, "unit": "kg", "estimated": True}
    assert content["parameters"]["g"] == {"value": 9.81, "std": 0.0, "unit": "m/s^2", "estimated": False}
    assert content["noise"]["measurement_std"]["theta1"] == pytest.approx(1e-3)
    assert content["dt"] == {"value": DT, "unit": "s"}
    assert [effect["name"] for effect in content["effects"]] == [effect.name for effect in fitted.model.effects]
    (joint,) = content["friction"]["joints"]
    assert (joint["velocity_unit"], joint["torque_unit"]) == ("rad/s", "N m")
    velocity = jnp.asarray([joint["velocity"]])
    np.testing.assert_allclose(joint["torque"], friction_table(fitted, velocity).torque[0], rtol=1e-12)


def test_a_slide_is_exported_in_newtons_and_metres_and_without_friction():
    rig = Rig("s", "slide", {"m": Declared(1.0, 0.0)}, False, ("f",), (1,), DT, "sequence", ("x",), {"x": 1e-3}, {})
    swing = np.sin(5 * DT * np.arange(ROWS))[None, :, None]
    data = Dataset(DT * np.arange(ROWS)[None], swing, swing, np.ones((1, ROWS), bool))
    spring = catalogue["torsional_spring"].of(20.0, 1.0, 0.0, 0.0, joint=1)
    content = parameters(begin(rig, data, key=jax.random.key(0), effects=(spring,)))
    (effect,) = content["effects"]
    assert {n: p["unit"] for n, p in effect["parameters"].items()} == {"k": "N/m", "theta0": "m"}
    assert content["inputs"] == [{"name": "f", "joint": 1, "unit": "N"}] and content["friction"] is None


def test_the_command_writes_the_numbers(fitted, tmp_path, capsys):
    save(tmp_path / "fit/model.npz", fitted)
    assert cli.main(["export", str(tmp_path / "fit"), "--out", str(tmp_path / "out")]) == 0
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["parameters.json"]
    assert "wrote parameters.json to " in capsys.readouterr().err
    assert cli.main(["export", str(tmp_path / "nothing"), "--out", str(tmp_path / "other")]) == 2
    assert not (tmp_path / "other").exists()
