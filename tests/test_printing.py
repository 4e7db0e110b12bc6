"""What the public objects say of themselves: in words, with units, in a few lines."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nnap_em.estimate.identify import begin
from nnap_em.logs.dataset import Dataset
from nnap_em.machines.rig import Declared, Rig
from nnap_em.model.effects import catalogue
from nnap_em.model.state_space import with_effects

RIG = Rig(
    "bench", "pendulum",
    {"m": Declared(0.5, 0.05), "lc": Declared(0.2, 0.0), "I": Declared(0.002, 0.0), "g": Declared(9.81, 0.0)},
    True, ("u",), (1,), 0.02, "sequence", ("theta1", "dtheta1"), {"theta1": 1e-3}, {"theta1": Declared(0.0, 0.1)},
)  # fmt: skip
ROWS = 50
Y = np.sin(np.arange(2.0 * ROWS)).reshape(1, ROWS, 2).repeat(3, axis=0)
Y[0, :15, 0] = np.nan
DATA = Dataset(np.tile(0.02 * np.arange(ROWS), (3, 1)), np.zeros((3, ROWS, 1)), Y, np.ones((3, ROWS), bool))
SYSTEM = "Pendulum: m = 0.5 kg, lc = 0.2 m, I = 0.002 kg m^2, g = 9.81 m/s^2; driven joints: 1"
SAID = {
    "rig": (RIG, "Rig 'bench': pendulum", "m = 0.5 +- 0.05 kg, lc = 0.2 m", "u on joint 1", "theta1 (noise 0.001 rad)"),
    "data": (DATA, "Dataset: 3 sequences, 150 rows, the longest 0.98 s; 1 inputs, 2 readings, 5 % missing"),
}


def _says(thing, *words: str) -> None:
    said = str(thing)
    for word in words:
        assert word in said
    assert said.count("\n") < 8
    assert max(map(len, said.splitlines())) < 160


@pytest.mark.parametrize("thing", SAID)
def test_an_object_says_what_it_is_with_units(thing):
    _says(*SAID[thing])


def test_a_fit_of_a_pendulum_has_torques_and_says_why_it_ended():
    offset = catalogue["torque_offset"](jnp.asarray(0.25), joint=1)
    fitted = begin(RIG, DATA, key=jax.random.key(0), effects=(offset,))
    _says(fitted.model.system, SYSTEM)
    _says(fitted.model, SYSTEM, "a row every 0.02 s", "theta1 (noise 0.001 rad)", "torque_offset at joint 1", "N m")
    _says(fitted, "Identified 'bench' after 0 epochs", "estimated: m = 0.5 +- ", " kg", SYSTEM)
    assert not fitted.converged and "nat" not in str(fitted)


def test_a_fit_of_a_slide_has_forces(slide_fit):
    spring = catalogue["torsional_spring"](*map(jnp.asarray, (20.0, 1.0, 0.0, 0.0)), joint=1)
    model = with_effects(slide_fit.model, (spring,))
    _says(model, "x (noise ", " m)", "torsional_spring at joint 1, k = 20 N/m, theta0 = 0.05 m")
