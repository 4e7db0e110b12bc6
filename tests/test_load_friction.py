"""Friction of a rod that grows with torques, in closed form."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import rod

from nnap_em.estimate.identify import begin
from nnap_em.model.effects import SearchScales, fields
from nnap_em.model.effects.base import a
from nnap_em.model.effects.friction import LoadFriction
from nnap_em.model.state_space import Inputs, StateSpaceModel

KNEE = 0.1
MOTOR = LoadFriction(a(0.2), a(KNEE), names=("u", "dhinge"), joint=1)
M3 = replace(MOTOR, whole=True)
M4 = replace(M3, stribeck=a(0.3), log_velocity=a(np.log(0.6)))
APART = replace(MOTOR, load=a(0.05))
M5 = replace(APART, stribeck=a(0.3), load_stribeck=a(0.1), log_velocity=a(np.log(0.6)))
M6 = replace(M5, square_motor=a(0.04), square_load=a(0.07))


def _dip(v):
    return np.exp(-((v / 0.6) ** 2))


def _square(u, c):
    """Quadratic part of the smaller torque while it is dragged along; none where both pull the same way."""
    return np.where(u * c > 0, np.where(np.abs(u) > np.abs(c), 0.07 * c**2, 0.04 * u**2), 0.0)


FORMS = {
    "motor": (MOTOR, lambda u, c, v: 0.2 * np.abs(u)),
    "M3": (M3, lambda u, c, v: 0.2 * np.abs(u + c)),
    "M4": (M4, lambda u, c, v: (0.2 + 0.3 * _dip(v)) * np.abs(u + c)),
    "apart": (APART, lambda u, c, v: np.abs(0.2 * u + 0.05 * c)),
    "M5": (M5, lambda u, c, v: np.abs(0.2 * u + 0.05 * c) + np.abs(0.3 * u + 0.1 * c) * _dip(v)),
    "M6": (
        M6,
        lambda u, c, v: np.abs(0.2 * u + 0.05 * c) + (np.abs(0.3 * u + 0.1 * c) + _square(u, c)) * _dip(v),
    ),
}
"""A law and its level [N m] as Duclusaud et al. have it, with their external torque as minus the weight."""


@pytest.fixture(scope="module")
def model(tmp_path_factory) -> StateSpaceModel:
    """The rod, which turns about level: its weight at an angle is known in closed form."""
    return begin(rod.rig(tmp_path_factory.mktemp("rod")), rod.logs(0), key=jax.random.key(0)).state.model


@eqx.filter_jit
def _forces(law: LoadFriction, model: StateSpaceModel, states):
    """Forces of a law [N m] at angles, rates and torques; one program for all laws of the same numbers."""

    def force(q, v, u):
        scene = model.scene(jnp.stack([q, v]), Inputs(u[None], u[None], a(0.0), a(0.0)))
        return law.force(scene, jnp.zeros(0))[0]

    return jax.vmap(force)(*states.T)


def _states(count: int = 100) -> np.ndarray:
    """Angles, rates and torques."""
    return np.random.default_rng(0).normal(size=(count, 3)) * [2.0, 1.0, 3.0]


@pytest.mark.parametrize(("law", "level"), FORMS.values(), ids=FORMS)
def test_a_form_is_that_of_the_paper(law, level, model):
    q, v, u = (states := _states()).T
    weight = rod.GRAVITY * rod.MASS * rod.LENGTH * np.sin(q)
    np.testing.assert_allclose(_forces(law, model, states), -level(u, weight, v) * np.tanh(v / KNEE), atol=1e-12)
    assert law.is_physical() and set(law.values()) <= set(law.units)


def test_forms_are_tried_in_one_order_from_from_plain_to_rich(model):
    """Every richer form begins as the one before it, has a number more, and the last has none behind it."""
    one = np.ones(1)
    around = SearchScales(
        model.system, one, 10 * one, 0 * one, -3 * one, 3 * one, one, ("hinge", "dhinge"), np.ones(2), rod.DT,
        (0.0, 3.0), 3.0, False, True, ("u",),
    )  # fmt: skip
    states, seen, ahead = _states(), [], [c.start for c in LoadFriction.candidates(around)]
    while ahead:
        law = ahead.pop()
        seen.append(law)
        for candidate in law.richer(around):
            assert len(fields(candidate.start)) > len(fields(law))
            assert jax.tree.structure(candidate.prior_std) == jax.tree.structure(candidate.start)
            np.testing.assert_allclose(_forces(candidate.start, model, states), _forces(law, model, states), atol=1e-14)
            for probe in candidate.probes:
                assert np.abs(_forces(probe, model, states) - _forces(law, model, states)).max() > 1e-4
            ahead.append(candidate.start)
    assert max(len(fields(law)) for law in seen) == len(fields(M6))
