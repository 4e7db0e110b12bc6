"""Forecasts of the data-driven example against a linear system."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from blackbox import forecast

from nnap_em.base.gaussian import Gaussian


class _Oscillator(eqx.Module):
    """A damped oscillator under a sampled force, with the interface of a model."""

    log_q: jax.Array

    def transition(self, x, u):
        return jnp.asarray([[0.99, 0.1], [-0.1, 0.97]]) @ x + jnp.asarray([0.0, 0.1]) * u[0]


def test_forecast_of_a_linear_system_has_the_moments_of_the_kalman_prediction():
    truth, u, samples = _Oscillator(2 * jnp.log(jnp.asarray([0.02, 0.03]))), jnp.ones((20, 1)), 4000
    mean, cov = start = Gaussian(jnp.zeros(2), 0.16 * jnp.eye(2))
    paths = forecast(truth, start, u, samples=samples, key=jax.random.key(0))
    a = jax.jacfwd(lambda x: truth.transition(x, u[0]))(mean)
    for k in range(20):
        mean, cov = truth.transition(mean, u[k]), a @ cov @ a.T + jnp.diag(jnp.exp(truth.log_q))
    std = np.sqrt(np.diag(cov))
    np.testing.assert_allclose(np.mean(paths[:, -1], axis=0), mean, atol=4 * std.max() / np.sqrt(samples))
    np.testing.assert_allclose(np.std(paths[:, -1], axis=0), std, rtol=4 / np.sqrt(2 * samples))
