"""A fit over the whole length goes on from friction that was fitted before, or from none where that is likelier."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import rod
from rigs import slide_logs

from nnap_em.diagnosis.context import SearchContext, extend
from nnap_em.diagnosis.hypothesis import Hypothesis
from nnap_em.diagnosis.losses import MultiStep
from nnap_em.fit.identify import friction_table, identify


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """Friction of a rod, and the logs."""
    data = rod.logs(0)
    return identify(rod.rig(tmp_path_factory.mktemp("rod"), pendulum=True), data, key=jax.random.key(0)), data


def _extended(before, data, model):
    """A fit that goes on from `model`, and what it logs."""
    lines = []
    context = SearchContext(before, {}, data, MultiStep(), lines.append)
    return extend(context, Hypothesis(model, before.m_step), data.t.shape[1]), lines


@pytest.mark.slow  # fast: test_friction_that_is_right_is_gone_on_from
def test_friction_too_steep_for_the_integration_is_left(fitted):
    """No step leads from 200 N m at 0.02 rad/s to a friction of 0.1 N m and 0.05 N m s/rad; a fit from the start does.

    It is that of `identify`: the same network, noise and schedule.
    """
    before, data = fitted
    weights = before.m_step.weights(before.model)
    w = weights.read(before.model)
    phi = weights.phi(before.model.unknown, w)
    steep = -200 * jnp.tanh(weights.nodes.ravel() / 0.02) - phi
    precise = 1e4 * jnp.eye(phi.size)
    model = weights.write(before.model, weights.fit(before.model.unknown, w, precise @ steep, precise, 500))
    assert abs(float(model.unknown(jnp.ones(1))[0])) > 100
    state, lines = _extended(before, data, eqx.tree_at(lambda m: m.log_q, model, model.log_q + 8))
    assert any("friction as declared is the likelier start" in line for line in lines)
    np.testing.assert_allclose(state.top, before.state.top, rtol=1e-9)
    v = np.array([[-4.0, -1.0, -0.3, 0.3, 1.0, 4.0]])
    table = friction_table(before._replace(state=state), jnp.asarray(v))
    np.testing.assert_allclose(table.torque, -0.05 * v - 0.1 * np.tanh(v / 0.1), atol=0.01)


def test_friction_that_is_right_is_gone_on_from(slide_fit):
    state, lines = _extended(slide_fit, slide_logs(0), slide_fit.model)
    assert len(lines) == 1
    assert np.nanmean(state.top) == pytest.approx(np.nanmean(slide_fit.state.top), abs=0.5)
