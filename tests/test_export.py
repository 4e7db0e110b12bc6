"""A model that left the house: the same numbers."""

import json

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import nnap

from nnap_em.estimate.identify import friction_table, parameter_table
from nnap_em.estimate.store import save
from nnap_em.model.effects import catalogue
from nnap_em.model.state_space import with_effects
from nnap_em.output.export.model import parameters


def test_the_command_writes_the_numbers_of_the_model(slide_fit, tmp_path, capsys):
    save(tmp_path / "fit/model.npz", slide_fit)
    assert nnap("export", tmp_path / "fit", "--out", tmp_path / "out") == 0
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["parameters.json"]
    assert "wrote parameters.json to " in capsys.readouterr().err
    content = json.loads((tmp_path / "out/parameters.json").read_text(), parse_constant=pytest.fail)
    value, std = parameter_table(slide_fit)["m"]
    assert content["parameters"]["m"] == {"value": value, "std": std, "unit": "kg", "estimated": True}
    std = np.exp(0.5 * float(slide_fit.model.log_r[0]))
    assert content["noise"]["measurement_std"]["x"] == pytest.approx(std)
    assert content["dt"] == {"value": slide_fit.rig.dt, "unit": "s"}
    assert content["inputs"] == [{"name": "u", "joint": 1, "unit": "N"}]
    (joint,) = content["friction"]["joints"]
    assert (joint["velocity_unit"], joint["torque_unit"]) == ("m/s", "N")
    table = friction_table(slide_fit, jnp.asarray([joint["velocity"]]))
    np.testing.assert_allclose(joint["torque"], table.torque[0], rtol=1e-12)


def test_laws_are_exported_in_newtons_and_metres(slide_fit):
    spring = catalogue["torsional_spring"].of(20.0, 1.0, 0.0, 0.0, joint=1)
    model = with_effects(slide_fit.model, (spring,))
    (effect,) = parameters(slide_fit._replace(state=slide_fit.state._replace(best=model)))["effects"]
    assert {n: p["unit"] for n, p in effect["parameters"].items()} == {"k": "N/m", "theta0": "m"}
