"""The data-driven model against linear systems, whose noise floors are known."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from blackbox import GradientMStep, NetworkModel, build_network, forecast

from nnap_em.data.dataset import Dataset
from nnap_em.em.loop import Schedule, e_step, fit, start_state
from nnap_em.numerics.gaussian import Gaussian
from nnap_em.smoother.gaussian import ExtendedKalmanSmoother
from nnap_em.smoother.start import StartBank


class _Oscillator(eqx.Module):
    """A damped oscillator under a sampled force, with the interface of a model."""

    start: Gaussian
    log_q: jax.Array
    log_r: jax.Array
    measured: tuple[int, ...] = eqx.field(static=True, default=(0, 1))
    dt: float = eqx.field(static=True, default=0.05)

    def transition(self, x, u):
        return jnp.asarray([[0.99, 0.1], [-0.1, 0.97]]) @ x + jnp.asarray([0.0, 0.1]) * u[0]

    def emission(self, x, u=None):
        return x[jnp.asarray(self.measured)]


def _oscillator() -> _Oscillator:
    start = Gaussian(jnp.zeros(2), 0.16 * jnp.eye(2))
    return _Oscillator(start, 2 * jnp.log(jnp.asarray([0.02, 0.03])), 2 * jnp.log(jnp.asarray([0.03, 0.02])))


def _record(model, sequences, rows, *, key) -> tuple[Dataset, jax.Array]:
    """Logs of a linear model under smooth random forces, and its states."""
    key_u, key_x, key_r = jax.random.split(key, 3)
    phase = jax.random.uniform(key_u, (sequences, 1), maxval=6.0)
    count = jnp.arange(rows, dtype=float)[None]
    u = jnp.sin(0.11 * count * (1 + 0.2 * phase) + phase)[..., None]
    keys = jax.random.split(key_x, sequences)
    x = jax.vmap(lambda u, key: forecast(model, model.start, u[:-1], samples=1, key=key)[0])(u, keys)
    y = jax.vmap(jax.vmap(model.emission))(x)
    y = y + jnp.exp(0.5 * model.log_r)[None, None] * jax.random.normal(key_r, y.shape)
    t = jnp.broadcast_to(model.dt * count, u.shape[:2])
    return Dataset(t, u, y, jnp.ones(u.shape[:2], bool)), x


_smoother = ExtendedKalmanSmoother(StartBank((1, 1)))
_e_step = eqx.filter_jit(e_step)


@pytest.mark.slow  # fast: test_forecast_of_a_linear_system_has_the_moments_of_the_kalman_prediction
def test_a_fitted_network_predicts_as_the_system_itself():
    truth = _oscillator()
    data, _ = _record(truth, 24, 150, key=jax.random.key(0))
    model = build_network(data, (0, 1), 2, truth.dt, key=jax.random.key(1), width=16)
    rule = GradientMStep(jax.random.key(2), steps=200, batch=512)
    state = start_state(model, rule, key=jax.random.key(3))
    state = fit(state, data, _smoother, rule, epochs=12, schedule=Schedule(first=150))
    assert (
        state.loglik[-1] > state.loglik[0] and min(np.diff(state.loglik)) > -1.0
    )  # of some 600; the gradient is drawn
    model = state.model
    assert isinstance(model, NetworkModel)
    test, x = _record(truth, 40, 150, key=jax.random.key(7))
    learned, best = (_e_step(m, test, _smoother, key=jax.random.key(0)).loglik for m in (model, _as_model(truth)))
    # a nat in fifty readings: an excess of the one-step error of 2 % of its standard deviation
    assert np.mean(np.asarray(best - learned)) / (150 * 2) < 0.02
    each = jax.vmap(jax.vmap(lambda x, u: model.transition(x, u) - truth.transition(x, u)))(x, test.u)
    # adds less than 5 % to the variance of the process noise
    assert np.all(jnp.sqrt(jnp.mean(each**2, axis=(0, 1))) < np.sqrt(0.05) * np.exp(0.5 * truth.log_q))
    for log in ("log_r", "log_q"):
        np.testing.assert_allclose(np.exp(0.5 * (getattr(model, log) - getattr(truth, log))), 1.0, rtol=0.25)


def test_forecast_of_a_linear_system_has_the_moments_of_the_kalman_prediction():
    truth, u, samples = _oscillator(), jnp.ones((20, 1)), 4000
    paths = forecast(truth, truth.start, u, samples=samples, key=jax.random.key(0))
    mean, cov = truth.start
    for k in range(20):
        a = jax.jacfwd(lambda x: truth.transition(x, u[0]))(mean)
        mean, cov = truth.transition(mean, u[k]), a @ cov @ a.T + jnp.diag(jnp.exp(truth.log_q))
    std = np.sqrt(np.diag(cov))
    np.testing.assert_allclose(np.mean(paths[:, -1], axis=0), mean, atol=4 * std.max() / np.sqrt(samples))
    np.testing.assert_allclose(np.std(paths[:, -1], axis=0), std, rtol=4 / np.sqrt(2 * samples))


def _as_model(truth) -> NetworkModel:
    """The oscillator as a network without a hidden layer, which is exact for it."""
    a = jax.jacfwd(lambda x: truth.transition(x, jnp.zeros(1)))(jnp.zeros(2)) - jnp.eye(2)
    b = jax.jacfwd(lambda u: truth.transition(jnp.zeros(2), u))(jnp.zeros(1))
    mlp = eqx.nn.MLP(3, 2, 1, 0, key=jax.random.key(0))
    mlp = eqx.tree_at(
        lambda m: (m.layers[0].weight, m.layers[0].bias), mlp, (jnp.concatenate([a, b], axis=1), jnp.zeros(2))
    )
    return NetworkModel(
        mlp, jnp.zeros(3), jnp.ones(3), jnp.ones(2), truth.start, truth.log_q, truth.log_r, truth.measured, truth.dt
    )
