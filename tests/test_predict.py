"""Prediction: exact without noise, closed-form spread on a slide, errors as plain numpy counts them."""

import functools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from nnap_em.base.gaussian import Gaussian
from nnap_em.estimate.identify import Identified, begin, friction_table, phi_samples
from nnap_em.estimate.predict import Prediction, given_samples, horizon_errors, posterior_of, predict, smooth
from nnap_em.logs.dataset import Dataset
from nnap_em.machines.rig import Declared, Rig
from nnap_em.machines.systems.pendulum import Pendulum
from nnap_em.model.simulate import simulate
from nnap_em.model.state_space import Inputs, StateSpaceModel

DT, ROWS, SAMPLES = 0.02, 80, 400
GIVEN = 0.5
KEY = jax.random.key(1)
PHYSICS = {"m": 0.5, "lc": 0.2, "I": 0.002, "g": 9.81}


class _Case(NamedTuple):
    fitted: Identified
    data: Dataset
    x: jax.Array


@functools.cache
def _begun() -> Identified:
    blank = Dataset(*(jnp.zeros((1, 9, *s)) for s in ((), (1,), (1,))), jnp.ones((1, 9), bool))
    y = 0.3 * jnp.sin(jnp.arange(9.0))[None, :, None]
    numbers = {k: Declared(v, 0.05 * v if k == "m" else 0.0) for k, v in PHYSICS.items()}
    rig = Rig("p", "pendulum", numbers, True, ("u",), (1,), DT, "sequence", ("theta1",), {"theta1": 1e-3}, {})
    return begin(rig, blank._replace(y=y, u=0 * y + 0.2), key=jax.random.key(0))


@functools.cache
def _case(q: float, information: float) -> _Case:
    """A pendulum whose model is the truth, with rate kicks of std `q`; its mass is known, its friction as before any
    log, in units of that precision.
    """
    system = Pendulum(**{k: jnp.asarray(v) for k, v in PHYSICS.items()}, joints=(1,))
    start = Gaussian(jnp.zeros(2), jnp.diag(jnp.asarray([1.5, 3.0]) ** 2))
    noise = 2 * jnp.log(jnp.asarray([DT * q, q]))
    problem = _begun()
    unknown = eqx.tree_at(lambda f: (f.speed, f.knee), problem.model.unknown, (jnp.asarray([8.0]), jnp.asarray([0.1])))
    model = StateSpaceModel(system, unknown, start, noise, 2 * jnp.log(jnp.asarray([1e-3])), (0,), DT)
    x0 = jnp.asarray([[0.5, 1.0], [-1.0, 0.3], [2.0, -3.0]])
    u = 0.2 * jnp.sin(jnp.arange(float(ROWS)) * DT * 6)[None, :, None] * jnp.ones((3, 1, 1))
    data, x = simulate(model, x0, u, key=jax.random.key(2), substeps=model.substeps)
    hessian = (information * problem.m_step.weights(model).prior_precision(unknown)).at[-1, -1].set(1e20)
    return _Case(problem._replace(state=problem.state._replace(model=model, best=model, hessian=hessian)), data, x)


def test_without_noise_the_prediction_is_the_integral():
    case = _case(q=1e-7, information=1e20)
    prediction = predict(case.fitted, case.data, GIVEN, key=KEY, samples=SAMPLES)
    model, last, ahead = case.fitted.model, round(GIVEN / DT), np.asarray(prediction.ahead)
    np.testing.assert_array_equal(ahead, np.arange(ROWS)[None].repeat(3, 0) > last)
    x, path = prediction.mean[:, last], []
    step = jax.jit(jax.vmap(model.transition))
    for k in range(last, ROWS - 1):
        x = step(x, jax.vmap(Inputs.held)(case.data.u[:, k]))
        path.append(x)
    path = jnp.stack(path, axis=1)
    std = np.asarray(prediction.std[:, last + 1 :])
    # the mean of 400 draws about the smoothed state: four standard errors of what that is known to (rad: 1e-3 / sqrt n)
    assert np.all(np.abs(prediction.mean[:, last + 1 :] - path) < 4 * std / np.sqrt(SAMPLES) + 1e-5)
    assert np.all(np.abs(prediction.mean - case.x)[ahead] < 5 * np.asarray(prediction.std)[ahead])
    assert std.max() < 0.02


def test_std_grows_as_the_kicks_add_up():
    """Near rest the pendulum is linear: the covariance obeys P' = F P F' + Q, here against draws."""
    case = _case(q=1e-2, information=1e20)
    quiet = case.data._replace(y=0.001 * case.data.y, u=0.0 * case.data.u)
    prediction = predict(case.fitted, quiet, GIVEN, key=KEY, samples=SAMPLES)
    model = case.fitted.model
    last = int(np.sum(given_samples(quiet, GIVEN)[0])) - 1
    f = np.asarray(jax.jit(jax.jacfwd(model.transition))(jnp.zeros(2), Inputs.held(jnp.zeros(1))))
    # steady state of the filter at the last known row, then open loop
    p, r, q = np.asarray(model.start.cov), 1e-6, np.diag(np.exp(np.asarray(model.log_q)))
    for k in range(last + 1):
        p = (f @ p @ f.T + q) if k else p
        p = p - np.outer(p[:, 0], p[0]) / (p[0, 0] + r)
    stds = []
    for _ in range(last + 1, ROWS):
        p = f @ p @ f.T + q
        stds.append(np.sqrt(np.diag(p)))
    # a standard deviation of n draws errs by 1 / sqrt(2 n); 330 of them: 4.5 of these
    np.testing.assert_allclose(prediction.std[0, last + 1 :], np.asarray(stds), rtol=4.5 / np.sqrt(2 * SAMPLES))
    total = np.asarray(prediction.std[0, :, 0])
    assert total[-1] > 3 * total[last + 1] > 3 * total[last]


def test_uncertain_friction_widens_what_is_predicted_and_what_is_smoothed_where_nothing_is_read():
    cases = [_case(q=1e-5, information=information) for information in (1e20, 1.0)]
    ahead = [predict(c.fitted, c.data, GIVEN, key=KEY, samples=SAMPLES).std[:, -1, 0] for c in cases]
    assert np.all(np.asarray(ahead[1]) > 1.5 * np.asarray(ahead[0]))
    blind = cases[0].data._replace(y=cases[0].data.y.at[:, 20:].set(jnp.nan))
    certain = posterior_of(cases[0].fitted, blind).state.cov
    known, wide = (smooth(case.fitted, blind).cov for case in cases)
    np.testing.assert_allclose(known, certain, rtol=1e-6)
    last, first = (np.asarray(wide / certain)[:, row, 0, 0] for row in (-1, 5))
    assert np.all(last > 100 * first)


def test_posterior_samples_have_the_moments_of_the_table():
    case = _case(q=1e-2, information=1.0)
    rng = np.random.default_rng(0)
    root = rng.normal(size=case.fitted.state.hessian.shape)
    hessian = jnp.asarray(root @ root.T / len(root) + np.eye(len(root)))  # correlated weights
    fitted = case.fitted._replace(state=case.fitted.state._replace(hessian=hessian))
    nodes = fitted.m_step.weights(fitted.model).nodes
    n = 4000
    draws = np.asarray(phi_samples(fitted, n, key=jax.random.key(3)))[:, : nodes.shape[1]]
    table = friction_table(fitted, nodes)
    cov = np.asarray(table.cov[0])
    std = np.sqrt(np.diag(cov))
    assert np.all(np.abs(draws.mean(0)) < 4.5 * std / np.sqrt(n))
    error = np.sqrt((cov**2 + np.outer(np.diag(cov), np.diag(cov))) / n)  # of a sample covariance
    assert np.all(np.abs(np.cov(draws.T) - cov) < 5 * error)
    np.testing.assert_allclose(table.torque[0], jax.jit(jax.vmap(fitted.model.unknown))(nodes.T)[:, 0], rtol=1e-12)
    np.testing.assert_allclose(table.std[0], std, rtol=1e-12)


def test_horizon_errors_are_plain_arithmetic():
    case = _case(q=1e-2, information=1.0)
    rng = np.random.default_rng(0)
    y = np.array(case.data.y)
    y[rng.uniform(size=y.shape) < 0.2] = np.nan
    valid = np.ones((3, ROWS), bool)
    valid[1, 50:] = False  # given 25 steps: 24 rows ahead
    data = case.data._replace(y=jnp.asarray(y), valid=jnp.asarray(valid))
    mean = np.asarray(case.x) + rng.normal(size=case.x.shape)
    mean[2, :, 0] += 2 * np.pi  # a whole turn is no error
    known = given_samples(data, GIVEN)
    prediction = Prediction(jnp.asarray(mean), jnp.ones(mean.shape), jnp.asarray(valid & ~known))
    horizons = (0.1, 0.4, 1.0, 4.0, 0.001)
    errors = horizon_errors(prediction, case.fitted, data, GIVEN, horizons)
    assert list(errors) == ["theta1"]
    for horizon, rms in zip(horizons, errors["theta1"], strict=True):
        squares = [
            ((mean[s, k, 0] - y[s, k, 0] + np.pi) % (2 * np.pi) - np.pi) ** 2
            for s in range(3)
            for k in range(ROWS)
            if valid[s, k] and not np.isnan(y[s, k, 0]) and round(GIVEN / DT) < k <= round((GIVEN + horizon) / DT)
        ]
        np.testing.assert_allclose(rms, np.sqrt(np.mean(squares)) if squares else np.nan, rtol=1e-12)
