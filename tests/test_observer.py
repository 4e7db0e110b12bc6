"""The observer: the library's filter row by row, and what an online estimate meets beside."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import file_rig, rig_of, slide

from nnap_em.estimate import observer as observing
from nnap_em.estimate.identify import begin
from nnap_em.estimate.observer import AMBIGUOUS, MISSING, NO_INPUT, OUTLIER, RESTARTED, functions, restart_prior
from nnap_em.estimate.smoother.kalman import CUBATURE, ekf
from nnap_em.estimate.smoother.mixture import alone, mixture_filter
from nnap_em.logs.dataset import Dataset
from nnap_em.model.base import prepare
from nnap_em.model.effects import catalogue
from nnap_em.model.friction import FrictionNetwork
from nnap_em.model.servo import Servo
from nnap_em.model.simulate import paper_experiment, paper_model
from nnap_em.model.state_space import with_effects

NUMBER = lambda x: jnp.asarray(x, float)  # noqa: E731
ROWS = 120


def _log(model, rows=ROWS, columns=1, seed=0) -> Dataset:
    """A sweep with readings that miss at rates of their own."""
    rng = np.random.default_rng(seed)
    t = model.dt * np.arange(rows)
    u = 0.2 * np.stack([np.sin(3 * t + i) for i in range(columns)], axis=1)
    y = 0.2 * rng.normal(size=(rows, len(model.measured))).cumsum(axis=0) * model.dt**0.5
    y[rng.random(y.shape) < 0.2] = np.nan
    y[:, -1][np.arange(rows) % 3 != 0] = np.nan
    return jax.tree.map(jnp.asarray, Dataset(t, u, y, np.ones(rows, bool)))


def _states(start, step, data: Dataset, smooth=False):
    """All states; the inputs of a row are those that were held until it, or its own where they are smooth."""
    held = jnp.concatenate([jnp.full_like(data.u[:1], jnp.nan), data.u[:-1]])  # those before the first are not used

    def one(state, row):
        state = step(state, *row)
        return state, state

    return jax.lax.scan(one, start(0.0), (data.u if smooth else held, data.y))[1]


def _model(effects=(), servos=None, **changes):
    model = with_effects(slide()[0], effects)
    loose = jnp.full_like(model.log_q, -6.0)
    return dataclasses.replace(model, log_q=loose, log_r=jnp.full(2, -4.0), servos=servos, **changes)


LAW, NETWORK = catalogue, FrictionNetwork(NUMBER([2.0]), NUMBER([0.3]), key=jax.random.key(0))
LAWS = {
    "a late input, a spring, a biased, late sensor": (
        (
            LAW["input_delay"].of(0.12, joint=1), LAW["torsional_spring"].of(0.3, 0.02, 0.0, 0.0, joint=1),
            LAW["sensor_bias"].of(0.05, channel="x"), LAW["sensor_delay"].of(0.07, channel="x"),
        ),
        None, {},
    ),
    "a servo with delay, lag, a gain from a column, learned friction": (
        (LAW["actuator_lag"].of(0.2, joint=1), LAW["input_delay"].of(0.1, joint=1)),
        (Servo("goal", "position", {k: NUMBER(v) for k, v in dict(kp=8.0, kd=1.0, delay=0.08, limit=3.0).items()},
            (("kp", 0, 0.2),)),),
        {"unknown": NETWORK},
    ),
}  # fmt: skip


@pytest.mark.parametrize("laws", LAWS)
def test_the_same_numbers_as_the_filter(laws):
    """The observer gives the numbers of the filter, with held inputs and with smooth ones."""
    effects, servos, friction = LAWS[laws]
    held = _model(effects, servos, **friction)
    data = _log(held, rows=60, columns=2 if servos else 1)

    @jax.jit
    def both(data):
        out = []
        for smooth in (False, True):
            model = dataclasses.replace(held, smooth=smooth)
            ready = prepare(model, data)
            if smooth:  # an observer has only the second difference at the end of the row before
                second = jnp.pad(jnp.diff(ready.inputs.u, n=2, axis=0), ((1, 1), (0, 0)))
                ready = ready._replace(inputs=ready.inputs._replace(course=ready.inputs.course.at[:, 1].set(second)))
            rules = functions(model, (), restart_prior(model), 1)
            out.append((ekf(model, model.start, ready, CUBATURE), _states(*rules, data, smooth)))
        return out

    for filtered, states in both(data):
        np.testing.assert_allclose(states.mean, filtered.state.mean, rtol=1e-9, atol=1e-11)
        np.testing.assert_allclose(states.cov, filtered.state.cov, rtol=1e-9, atol=1e-13)
        np.testing.assert_allclose(states.innovation, filtered.innovation, rtol=1e-9, atol=1e-9)
        assert not np.any(states.flags & ~MISSING)
        np.testing.assert_array_equal(states.flags & MISSING > 0, np.isnan(data.y).any(axis=1))


@pytest.fixture(scope="module")
def plain():
    """A slide without laws, its log, and the states of a log as one program."""
    model = _model()
    rules = functions(model, (), restart_prior(model), 1)
    return model, _log(model), jax.jit(lambda data: _states(*rules, data))


@pytest.fixture(scope="module")
def acrobot():
    """The paper's acrobot, of which theta2 is not read and known to half a radian, and its filter in branches."""
    model = paper_model()
    experiment = paper_experiment(model, 2, 199, key=jax.random.key(3))
    start, step = functions(model, (0, 1), restart_prior(model), 8)
    one = jax.tree.map(lambda a: a[0], experiment.data)
    return model, experiment, jax.jit(lambda data: _states(start, step, data))(one)


@pytest.mark.slow  # fast: test_an_ambiguous_start_ends_in_one_branch_beside_the_truth
def test_branches_are_those_of_the_mixture(acrobot, monkeypatch):
    """Without pruning, the best branch is that of the mixture filter, also where two sequences are batched."""
    model, experiment, _ = acrobot
    every = jax.tree.map(lambda a: a[:, :100], experiment.data)
    data = jax.tree.map(lambda a: a[0], every)
    monkeypatch.setattr(observing, "BRANCH_END", 1e-300)
    monkeypatch.setattr(observing, "TWIN", 0.0)
    start, step = functions(model, (0, 1), restart_prior(model), 8)
    both = jax.jit(jax.vmap(lambda data: _states(start, step, data)))(every)
    states = jax.tree.map(lambda a: a[0], both)
    tree = jax.jit(lambda: mixture_filter(model, *alone(model.start, 8), prepare(model, data), CUBATURE, (0, 1)))()
    best = np.argmax(tree.rows.loglik, axis=1)
    np.testing.assert_allclose(states.mean, tree.rows.state.mean[np.arange(100), best], rtol=1e-7, atol=1e-8)
    assert np.isfinite(tree.rows.loglik[50]).sum() > 4 and states.weight.min() < 0.5  # all places were in use


def test_an_ambiguous_start_ends_in_one_branch_beside_the_truth(acrobot):
    """Hidden theta2 within four of its standard deviations, from two seconds on in every row of nearly all."""
    _, experiment, states = acrobot
    ambiguous = np.asarray(states.flags & AMBIGUOUS > 0)
    assert ambiguous[:20].any() and not ambiguous[-50:].any()
    error = np.asarray(states.mean - experiment.x[0])[100:, 1] / np.sqrt(np.asarray(states.cov)[100:, 1, 1])
    assert np.mean(np.abs(error) < 4) > 0.95
    np.testing.assert_allclose(states.weight[-50:], 1.0)


def test_outliers_are_gated_and_change_nothing(plain):
    _, data, replay = plain
    states, expected = (replay(data._replace(y=data.y.at[30, 0].set(value))) for value in (50.0, jnp.nan))
    np.testing.assert_array_equal(states.mean, expected.mean)
    assert states.flags[30] & OUTLIER and not np.any(states.flags & RESTARTED)


def test_an_input_that_is_no_number_is_the_one_before(plain):
    _, data, replay = plain
    states, expected = (replay(data._replace(u=data.u.at[30, 0].set(value))) for value in (jnp.inf, data.u[29, 0]))
    np.testing.assert_array_equal(states.mean, expected.mean)
    np.testing.assert_array_equal(np.flatnonzero(states.flags & NO_INPUT), [31])


def test_a_diverged_estimate_starts_anew(plain):
    """The machine is somewhere else: some rows beyond the gate, then the new place, within its covariance."""
    _, data, replay = plain
    states, expected = replay(data._replace(y=data.y.at[40:, 0].add(7.0))), replay(data)
    (row,) = np.flatnonzero(states.flags & RESTARTED)
    assert 50 < row < 100
    std = np.sqrt(np.asarray(states.cov[-1, 0, 0]))
    assert abs(float(states.mean[-1, 0] - expected.mean[-1, 0]) - 7.0) < 0.5 * std
    assert np.isfinite(states.mean).all() and np.isfinite(states.cov).all()


def test_nothing_makes_a_state_that_is_no_number(plain):
    """Readings and inputs of any size in any order; readings of the machine are followed afterwards."""
    _, data, replay = plain
    wild = np.random.default_rng(0).choice([np.nan, np.inf, -np.inf, 1e300, -1e20, 0.0, 1e-300], size=(ROWS, 3))
    sound = np.arange(ROWS)[:, None] >= 60
    wild = jnp.asarray(np.where(sound, np.concatenate([data.u, data.y], axis=1), wild))
    states = replay(data._replace(u=wild[:, :1], y=wild[:, 1:]))
    assert all(np.isfinite(a).all() for a in (states.mean, states.cov, states.innovation, states.misfit))
    assert states.flags[-1] & ~MISSING == 0 and abs(states.mean[-1, 0] - data.y[-1, 0]) < 1.0


CART = """<mujoco><option gravity="0 0 0"/><worldbody><body name="cart">
<joint name="x" type="slide" axis="1 0 0" stiffness="20"/>
<geom type="box" size=".1 .1 .1" mass="1.2"/><site name="s"/></body></worldbody>
<actuator><motor name="push" joint="x"/></actuator><sensor><accelerometer name="acc" site="s"/></sensor></mujoco>"""
CART_RIG = file_rig("cart.xml", ("x", "acc.x"), friction="none", dt=0.05) + 'noise_std = { x = 0.05, "acc.x" = 0.1 }\n'


def test_an_acceleration_counts_when_its_input_is_known(tmp_path):
    """One row later: in rows without an acceleration the estimate is that of the filter again.  Names are the fit's."""
    (tmp_path / "cart.xml").write_text(CART)
    rig, t = rig_of(tmp_path, CART_RIG), 0.05 * np.arange(60)
    u, rng = np.sin(2 * t)[:, None], np.random.default_rng(0)
    y = np.stack([0.3 * np.sin(2 * t), np.sin(2 * t) / 1.2], axis=1) + 0.05 * rng.normal(size=(60, 2))
    y[::2, 1] = np.nan
    one = jax.tree.map(jnp.asarray, Dataset(t, u, y, np.ones(60, bool)))
    fitted = begin(rig, jax.tree.map(lambda a: a[None], one), key=jax.random.key(0))
    model, online = fitted.model, observing.observer(fitted)
    assert (online.states, online.inputs, online.measured) == (("x", "dx"), ("push",), ("x", "acc.x"))
    filtered, states = jax.jit(
        lambda data: (
            ekf(model, model.start, prepare(model, data), CUBATURE),
            _states(online.start, online.step, data),
        )
    )(one)
    np.testing.assert_allclose(states.mean[::2], filtered.state.mean[::2], rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(states.cov[::2], filtered.state.cov[::2], rtol=1e-9, atol=1e-13)
    np.testing.assert_allclose(states.innovation[2::2, 1], filtered.innovation[1:-1:2, 1], rtol=1e-8, atol=1e-9)
    assert np.max(np.abs(states.mean[1::2] - filtered.state.mean[1::2])) > 1e-4
