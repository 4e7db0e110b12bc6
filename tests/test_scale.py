"""What a machine that nothing drives cannot tell: the scale of its masses and friction."""

import dataclasses
import math

import jax.numpy as jnp
import numpy as np
import plant
import pytest

from nnap_em.estimate.em.build import build_system, measure_scales
from nnap_em.estimate.identifiability import holding, not_identifiable
from nnap_em.explain.check import torques
from nnap_em.logs.dataset import Dataset
from nnap_em.machines.rig import Declared, Rig

BODY = {"m": Declared(1.3, 0.3), "lc": Declared(0.3, 0.0), "I": Declared(0.02, 0.01), "g": Declared(9.81, 0.0)}
SWING = Rig("swing", "pendulum", BODY, True, ("u",), (1,), 0.02, "sequence", ("theta1",), {"theta1": 0.002}, {})
ARM = {n: Declared(v, 0.1 * v if n[0] in "mI" else 0.0) for n, v in plant.SYSTEMS["acrobot"].parameters.items()}


def _swinging(rig: Rig) -> Dataset:
    """A pendulum of the declared body with viscous friction, that nothing drives."""
    system = build_system(rig)
    m, lc, inertia, g = (float(getattr(system, name)) for name in ("m", "lc", "I", "g"))
    rng, rows = np.random.default_rng(0), 150
    x = np.empty((4, rows, 2))
    for s in range(4):
        x[s, 0] = rng.uniform(0.6, 1.4), 0.0
        q, v = x[s, 0]
        for k in range(1, rows):
            for _ in range(20):
                v -= rig.dt / 20 * (0.02 * v + m * lc * g * math.sin(q)) / (m * lc**2 + inertia)
                q += rig.dt / 20 * v
            x[s, k] = q, v
    y = x[..., :1] + 0.002 * rng.normal(size=x[..., :1].shape)
    t = np.tile(rig.dt * np.arange(rows), (4, 1))
    return Dataset(*map(jnp.asarray, (t, 0 * t[..., None], y, np.ones(t.shape, bool))))


def test_the_most_closely_declared_mass_carries_the_scale():
    still = _swinging(SWING)
    assert not_identifiable(SWING, build_system(SWING), still) == ("m",)  # 23 % against 50 %
    assert not_identifiable(SWING, build_system(SWING), still._replace(u=still.u + 0.1)) == ()
    for known in ("m", "I"):  # what is trusted tells the scale
        held = holding(SWING, (known,))
        assert held.parameters[known] == Declared(BODY[known].mean, 0.0)
        assert not_identifiable(held, build_system(held), still) == ()
    # where a length is uncertain too, mass and length together scale what is left
    rig = dataclasses.replace(SWING, parameters={**BODY, "lc": Declared(0.3, 0.05)})
    names = not_identifiable(rig, build_system(rig), still)
    assert len(names) == 2 and "I" not in names[:1]


@pytest.mark.parametrize("joints", [(2,), ()])
def test_an_arm_with_an_idle_motor_or_none(joints):
    columns = ("u",) * len(joints)
    rig = Rig("arm", "acrobot", ARM, True, columns, joints, 0.02, "sequence", ("theta1", "theta2"), {}, {})
    still = Dataset(np.zeros((2, 9)), np.zeros((2, 9, len(columns))), np.zeros((2, 9, 2)), np.ones((2, 9), bool))
    system = build_system(rig)
    names = not_identifiable(rig, system, still)
    assert names and names[0][0] in "mI"
    remarks = [f for f in torques(rig, system, still, measure_scales(rig, system, still)) if f.subject == "scale"]
    assert len(remarks) == 1 and names[0] in remarks[0].text and "does not determine the scale" in remarks[0].text
