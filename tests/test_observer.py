"""The observer: the library's filter row by row, a closed form, and what an online estimate meets beside."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import file_rig, slide

from nnap_em.data.dataset import Dataset
from nnap_em.data.rig import Declared, Rig, read_rig
from nnap_em.effects import catalogue
from nnap_em.fit import observer as observing
from nnap_em.fit.identify import begin
from nnap_em.fit.observer import AMBIGUOUS, MISSING, NO_INPUT, OUTLIER, RESTARTED, functions, observer, restart_prior
from nnap_em.model import hooks
from nnap_em.model.base import prepare
from nnap_em.model.servo import Servo
from nnap_em.model.simulate import paper_experiment, paper_model
from nnap_em.model.state_space import with_effects
from nnap_em.numerics.gaussian import Gaussian
from nnap_em.smoother.kalman import CUBATURE, TANGENT, ekf
from nnap_em.smoother.mixture import mixture_filter
from nnap_em.systems import specs

NUMBER = lambda x: jnp.asarray(x, float)  # noqa: E731
ROWS = 60


def _log(model, rows=ROWS, columns=1, seed=0) -> Dataset:
    """A sweep with readings that miss at rates of their own."""
    rng = np.random.default_rng(seed)
    t = model.dt * np.arange(rows)
    u = 0.2 * np.stack([np.sin(3 * t + i) for i in range(columns)], axis=1)
    y = 0.2 * rng.normal(size=(rows, len(model.measured))).cumsum(axis=0) * model.dt**0.5
    y[rng.random(y.shape) < 0.2] = np.nan
    y[:, -1][np.arange(rows) % 3 != 0] = np.nan
    return jax.tree.map(jnp.asarray, Dataset(t, u, y, np.ones(rows, bool)))


def _replay(start, step, data: Dataset, time=0.0, smooth=False):
    """All states; the inputs of a row are those that were held until it, or its own where they are smooth."""
    held = jnp.concatenate([jnp.full_like(data.u[:1], jnp.nan), data.u[:-1]])  # those before the first are not used
    held = data.u if smooth else held

    def one(state, row):
        state = step(state, *row)
        return state, state

    return jax.jit(lambda: jax.lax.scan(one, start(time), (held, data.y))[1])()


def _model(effects=(), servos=None, **changes):
    model = with_effects(slide()[0], effects)
    loose = jnp.full_like(model.log_q, -6.0)
    return dataclasses.replace(model, log_q=loose, log_r=jnp.full(2, -4.0), servos=servos, **changes)


SPRING = catalogue["torsional_spring"].of(0.3, 0.02, 0.0, 0.0, joint=1)
LAWS = {
    "none": ((), None),
    "a spring, a biased sensor": ((SPRING, catalogue["sensor_bias"].of(0.05, channel="x")), None),
    "a late sensor": ((catalogue["sensor_delay"].of(0.07, channel="x"),), None),
    "a late input": ((catalogue["input_delay"].of(0.12, joint=1), SPRING), None),
    "a late input by whole rows": ((catalogue["input_delay"].of(0.1, joint=1),), None),
    "a lag, a gain": ((catalogue["actuator_lag"].of(0.2, joint=1), catalogue["motor_gain"].of(0.3, joint=1)), None),
    "a servo with delay and lag": (
        (catalogue["actuator_lag"].of(0.2, joint=1), catalogue["input_delay"].of(0.06, joint=1)),
        (Servo("goal", "position", {k: NUMBER(v) for k, v in dict(kp=8.0, kd=1.0, delay=0.08, limit=3.0).items()}),),
    ),
    "a torque of a late servo": ((), (Servo("f", "torque", {"delay": NUMBER(0.03)}),)),
    "a gain from a column": ((), (Servo("goal", "position", {"kp": NUMBER(8.0)}, (("kp", 0, 0.2),)),)),
    "a bristle": ((catalogue["presliding_friction"].of(0.0, 0.1, 0.0, 0.5, 0.5, 20.0, joint=1),), None),
}  # fmt: skip


@pytest.fixture(params=LAWS)
def dressed(request):
    effects, servos = LAWS[request.param]
    return _model(effects, servos), 2 if request.param == "a gain from a column" else 1


@pytest.mark.parametrize(
    "linearise, smooth", [(CUBATURE, False), (TANGENT, False), (TANGENT, True)], ids=["cubature", "tangent", "smooth"]
)
def test_the_same_numbers_as_the_filter(dressed, linearise, smooth):
    model, columns = dressed
    model = dataclasses.replace(model, smooth=smooth)
    data = _log(model, columns=columns)
    ready = prepare(model, data)
    if smooth:  # an observer has only the second difference at the end of the row before
        second = jnp.pad(jnp.diff(ready.inputs.u, n=2, axis=0), ((1, 1), (0, 0)))
        ready = ready._replace(inputs=ready.inputs._replace(course=ready.inputs.course.at[:, 1].set(second)))
    filtered = ekf(model, model.start, ready, linearise)
    states = _replay(*functions(model, (), restart_prior(model), 1, linearise), data, smooth=smooth)
    np.testing.assert_allclose(states.mean, filtered.state.mean, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(states.cov, filtered.state.cov, rtol=1e-9, atol=1e-13)
    np.testing.assert_allclose(states.innovation, filtered.innovation, rtol=1e-9, atol=1e-9)
    assert not np.any(states.flags & ~MISSING)
    np.testing.assert_array_equal(states.flags & MISSING > 0, np.isnan(data.y).any(axis=1))


def test_a_linear_machine_has_its_kalman_filter():
    """x' = v, v' = u / m: matrices by hand, Joseph's form of the update."""
    model = _model()
    data, m, dt = _log(model), float(model.system.m), model.dt
    states = _replay(*functions(model, (), restart_prior(model), 1, CUBATURE), data)
    a, b = np.array([[1.0, dt], [0.0, 1.0]]), np.array([dt**2 / 2, dt]) / m
    q, r = np.diag(np.exp(model.log_q)), np.exp(model.log_r)
    x, p = np.asarray(model.start.mean), np.asarray(model.start.cov)
    for k in range(ROWS):
        if k:
            x, p = a @ x + b * data.u[k - 1, 0], a @ p @ a.T + q
        for i in range(2):
            if np.isfinite(data.y[k, i]):
                gain = p[:, i] / (p[i, i] + r[i])
                keep = np.eye(2) - np.outer(gain, np.eye(2)[i])
                x, p = x + gain * (data.y[k, i] - x[i]), keep @ p @ keep.T + r[i] * np.outer(gain, gain)
        np.testing.assert_allclose(states.mean[k], x, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(states.cov[k], p, rtol=1e-9, atol=1e-14)


def test_a_law_of_the_command_without_a_form_for_one_row_is_named():
    late = catalogue["input_delay"].of(0.1, joint=1)
    with (
        pytest.MonkeyPatch.context() as patch,
        pytest.raises(ValueError, match="'input_delay' has no form for one row"),
    ):
        patch.setattr(type(late), "stream", lambda self, dt: None)
        hooks.command_stream((late,), None, slide()[0].system, hooks.Sampling(0.05))


@pytest.fixture(scope="module")
def acrobot():
    """The paper's acrobot, of which theta2 is not read and known to half a radian, and its filter in branches."""
    model = paper_model()
    experiment = paper_experiment(model, 2, 199, key=jax.random.key(3))
    start, step = functions(model, (0, 1), restart_prior(model), 8, CUBATURE)
    one = jax.tree.map(lambda a: a[0], experiment.data)
    return model, experiment, start, step, one, _replay(start, step, one)


def test_branches_are_those_of_the_mixture(acrobot, monkeypatch):
    """As long as none is so unlikely that the observer ends it."""
    model, _, start, step, data, _ = acrobot
    monkeypatch.setattr(observing, "BRANCH_END", 1e-300)
    monkeypatch.setattr(observing, "TWIN", 0.0)
    start, step = functions(model, (0, 1), restart_prior(model), 8, CUBATURE)
    states = _replay(start, step, data)
    begin = jax.tree.map(lambda a: jnp.broadcast_to(a, (8, *a.shape)), model.start)
    weight = jnp.where(jnp.arange(8) == 0, 0.0, -jnp.inf)
    tree = jax.jit(lambda: mixture_filter(model, begin, weight, prepare(model, data), CUBATURE, (0, 1)))()
    best = np.argmax(tree.rows.loglik, axis=1)
    np.testing.assert_allclose(
        states.mean[:100], tree.rows.state.mean[np.arange(100), best[:100]], rtol=1e-7, atol=1e-8
    )
    assert np.isfinite(tree.rows.loglik[50]).sum() > 4 and states.weight[:100].min() < 0.5  # all places were in use


def test_an_ambiguous_start_ends_in_one_branch_beside_the_truth(acrobot):
    """Hidden theta2 within four of its standard deviations, from two seconds on in every row of nearly all."""
    _, experiment, *_, states = acrobot
    ambiguous = np.asarray(states.flags & AMBIGUOUS > 0)
    assert ambiguous[:20].any() and not ambiguous[-50:].any()
    error = np.asarray(states.mean - experiment.x[0])[100:, 1] / np.sqrt(np.asarray(states.cov)[100:, 1, 1])
    assert np.mean(np.abs(error) < 4) > 0.95
    np.testing.assert_allclose(states.weight[-50:], 1.0)


def test_under_vmap_each_is_as_by_itself(acrobot):
    _, experiment, start, step, _, states = acrobot
    held = jnp.concatenate([jnp.zeros_like(experiment.data.u[:, :1]), experiment.data.u[:, :-1]], axis=1)
    both, every = jax.vmap(start)(jnp.zeros(2)), jax.vmap(step)
    for k in range(20):
        both = every(both, held[:, k], experiment.data.y[:, k])
    np.testing.assert_allclose(both.mean[0], states.mean[19], rtol=1e-9, atol=1e-11)


def test_outliers_are_gated_and_change_nothing():
    model = _model()
    data = _log(model)
    start, step = functions(model, (), restart_prior(model), 1, CUBATURE)
    spiked = data._replace(y=data.y.at[30, 0].set(50.0))
    missing = data._replace(y=data.y.at[30, 0].set(jnp.nan))
    states, expected = _replay(start, step, spiked), _replay(start, step, missing)
    np.testing.assert_array_equal(states.mean, expected.mean)
    assert states.flags[30] & OUTLIER and not np.any(states.flags & RESTARTED)


def test_an_input_that_is_no_number_is_the_one_before():
    model = _model()
    data = _log(model)
    start, step = functions(model, (), restart_prior(model), 1, CUBATURE)
    states = _replay(start, step, data._replace(u=data.u.at[30, 0].set(jnp.inf)))
    expected = _replay(start, step, data._replace(u=data.u.at[30, 0].set(data.u[29, 0])))
    np.testing.assert_array_equal(states.mean, expected.mean)
    np.testing.assert_array_equal(np.flatnonzero(states.flags & NO_INPUT), [31])


def test_a_diverged_estimate_starts_anew():
    """The machine is somewhere else: some rows beyond the gate, then the new place, within its covariance."""
    model = _model()
    data = _log(model, rows=120)
    start, step = functions(model, (), restart_prior(model), 1, CUBATURE)
    moved = data._replace(y=data.y.at[40:, 0].add(7.0))
    states, expected = _replay(start, step, moved), _replay(start, step, data)
    (row,) = np.flatnonzero(states.flags & RESTARTED)
    assert 50 < row < 100
    std = np.sqrt(np.asarray(states.cov[-1, 0, 0]))
    assert abs(float(states.mean[-1, 0] - expected.mean[-1, 0]) - 7.0) < 0.5 * std
    assert np.isfinite(states.mean).all() and np.isfinite(states.cov).all()


def test_nothing_makes_a_state_that_is_no_number():
    """Readings and inputs of any size in any order; readings of the machine are followed afterwards."""
    model = _model((SPRING,))
    data, rng = _log(model, rows=200), np.random.default_rng(0)
    wild = rng.choice([np.nan, np.inf, -np.inf, 1e300, -1e20, 0.0, 1e-300], size=(200, 3))
    wild = jnp.asarray(np.where(np.arange(200)[:, None] < 120, wild, np.concatenate([data.u, data.y], axis=1)))
    start, step = functions(model, (), restart_prior(model), 1, CUBATURE)
    states = _replay(start, step, data._replace(u=wild[:, :1], y=wild[:, 1:]))
    assert all(np.isfinite(a).all() for a in (states.mean, states.cov, states.innovation, states.misfit))
    assert states.flags[-1] & ~MISSING == 0 and abs(states.mean[-1, 0] - data.y[-1, 0]) < 1.0


def test_the_observer_of_a_fit_has_its_names():
    rig = Rig("b", "pendulum", {k: Declared(v, 0.0) for k, v in dict(m=0.5, lc=0.2, I=0.002, g=9.81).items()}, True,
              ("u",), (1,), 0.02, "sequence", ("theta1",), {"theta1": 1e-3}, {})  # fmt: skip
    t = 0.02 * np.arange(90)
    data = Dataset(t[None], np.sin(t)[None, :, None], np.sin(5 * t)[None, :, None], np.ones((1, 90), bool))
    fitted = begin(rig, data, key=jax.random.key(0))
    online = observer(fitted)
    assert (online.states, online.inputs, online.measured) == (("theta1", "dtheta1"), ("u",), ("theta1",))
    one = jax.tree.map(lambda a: jnp.asarray(a[0]), data)
    states = _replay(online.start, online.step, one)
    filtered = ekf(fitted.model, fitted.model.start, prepare(fitted.model, one))
    np.testing.assert_allclose(states.mean[-1], filtered.state.mean[-1], atol=1e-3)
    assert isinstance(restart_prior(fitted.model), Gaussian)


CART = """<mujoco><option gravity="0 0 0"/><worldbody><body name="cart">
<joint name="x" type="slide" axis="1 0 0" stiffness="20"/>
<geom type="box" size=".1 .1 .1" mass="1.2"/><site name="s"/></body></worldbody>
<actuator><motor name="push" joint="x"/></actuator><sensor><accelerometer name="acc" site="s"/></sensor></mujoco>"""
CART_RIG = file_rig("cart.xml", ("x", "acc.x"), friction="none", dt=0.05) + 'noise_std = { x = 0.05, "acc.x" = 0.1 }\n'


def test_an_acceleration_counts_when_its_input_is_known(tmp_path):
    """One row later: in rows without an acceleration the estimate is that of the filter again."""
    (tmp_path / "cart.xml").write_text(CART)
    (tmp_path / "rig.toml").write_text(CART_RIG)
    rig = read_rig(tmp_path / "rig.toml", specs)
    t = 0.05 * np.arange(ROWS)
    u, rng = np.sin(2 * t)[:, None], np.random.default_rng(0)
    y = np.stack([0.3 * np.sin(2 * t), np.sin(2 * t) / 1.2], axis=1) + 0.05 * rng.normal(size=(ROWS, 2))
    y[::2, 1] = np.nan
    one = jax.tree.map(jnp.asarray, Dataset(t, u, y, np.ones(ROWS, bool)))
    fitted = begin(rig, jax.tree.map(lambda a: a[None], one), key=jax.random.key(0))
    filtered = ekf(fitted.model, fitted.model.start, prepare(fitted.model, one), CUBATURE)
    online = observer(fitted)
    states = _replay(online.start, online.step, one)
    np.testing.assert_allclose(states.mean[::2], filtered.state.mean[::2], rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(states.cov[::2], filtered.state.cov[::2], rtol=1e-9, atol=1e-13)
    np.testing.assert_allclose(states.innovation[2::2, 1], filtered.innovation[1:-1:2, 1], rtol=1e-8, atol=1e-9)
    assert np.max(np.abs(states.mean[1::2] - filtered.state.mean[1::2])) > 1e-4
