"""How far smoothed states hang on what is uncertain of a model: against smoothing anew with another model or input."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import slide

from nnap_em.estimate.em import stated
from nnap_em.estimate.em.loop import e_step
from nnap_em.estimate.smoother.gaussian import ExtendedKalmanSmoother
from nnap_em.estimate.smoother.start import StartBank
from nnap_em.model.simulate import simulate

KEY = jax.random.key(3)


@pytest.fixture(scope="module")
def case():
    model, rule = slide()
    model = replace(model, log_q=jnp.full(2, -8.0), log_r=jnp.full(1, -6.0), measured=(0,))
    u = jnp.sin(jnp.arange(60.0) * 0.3)[None, :, None] * jnp.ones((2, 1, 1))
    data = simulate(model, jnp.asarray([[0.1, 0.0], [-0.2, 0.5]]), u, key=KEY).data
    return model, rule, data, _path(model, data)


def _path(model, data):
    return e_step(model, data, ExtendedKalmanSmoother(StartBank((1, 1))), key=KEY).state


def test_a_draw_of_a_parameter_moves_states_as_smoothing_with_it_does(case):
    model, rule, data, path = case
    small = 1e-3
    heavier = rule.prior.write(model, rule.prior.read(model) + small)
    moved = _path(heavier, data).mean - path.mean
    draw = jnp.zeros((1, rule.weights(model).nodes.size + 1)).at[0, -1].set(small)
    cov = stated.of_states(model, rule, path, data, draw, 0.0, key=KEY)
    np.testing.assert_allclose(cov, moved[..., :, None] * moved[..., None, :], atol=2e-3 * float(jnp.max(moved**2)))


def test_forces_unsaid_move_states_as_the_same_input_does(case):
    model, rule, data, path = case
    size = 0.4
    columns, kicks = jax.random.split(KEY)
    every = stated.discrepancy_columns(model, rule.weights(model), path, data, np.ones(2, bool), key=columns).force
    draw = size * jax.random.normal(kicks, (1, every.shape[1]))[0]
    pushed = data._replace(u=data.u + jnp.einsum("c,sctd->std", draw, every))
    moved = _path(model, pushed).mean - path.mean
    still = jnp.zeros((1, rule.weights(model).nodes.size + 1))
    cov = stated.of_states(model, rule, path, data, still, size, key=KEY)
    np.testing.assert_allclose(cov, moved[..., :, None] * moved[..., None, :], atol=1e-6 * float(jnp.max(moved**2)))
