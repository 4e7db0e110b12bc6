"""Statistics against cases with a known answer, and the missing force against one that was put in."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from helpers import right_residual

from nnap_em.estimate.identify import begin
from nnap_em.explain.diagnosis.residual import Names, names_of, residual
from nnap_em.explain.diagnosis.statistics import FAILS, dependence, holm, spread, whiteness
from nnap_em.explain.diagnosis.statistics import tests as run_tests
from nnap_em.logs.dataset import pad
from nnap_em.machines.rig import Declared, Rig
from nnap_em.machines.units import with_names
from nnap_em.model.effects.position import TorsionalSpring
from nnap_em.model.state_space import with_effects

DT = 0.01
NAMES = Names(("theta1", "x"), ("dtheta1", "dx"), (True, False), ("u",), (1,), ("theta1", "dx"))


def _noise(seed, shape=(10, 300)):
    return np.random.default_rng(seed).normal(size=shape)


def _residual(seed, **changes):
    return right_residual(1000 + seed, (10, 300), 2, 2, **changes)


def test_holm_by_hand():
    # sorted 0.005 0.01 0.03 0.04, times 4 3 2 1, then never falling: 0.02 0.03 0.06 0.06
    np.testing.assert_allclose(holm([0.01, 0.04, 0.03, 0.005]), [0.03, 0.06, 0.06, 0.02], rtol=1e-12)
    np.testing.assert_allclose(holm([0.6, 0.9]), [1.0, 1.0])


def test_whiteness_is_the_portmanteau_test_of_ljung_and_box():
    """Q = n (n + 2) sum_k r_k^2 / (n - k), r_k the sum of products k apart over that of squares [Ljung & Box 1978]."""
    e, n, total = list(_noise(0, (1, 400))[0]), 400, 0.0
    mean = sum(e) / n
    square = sum((value - mean) ** 2 for value in e)
    for k in range(1, 21):
        r = sum((e[t] - mean) * (e[t - k] - mean) for t in range(k, n)) / square
        total += n * (n + 2) * r**2 / (n - k)
    q, p, _ = whiteness(np.asarray([e]))
    assert q == pytest.approx(total, rel=1e-9)
    assert p == pytest.approx(scipy.stats.chi2.sf(total, 20), rel=1e-9)


@pytest.mark.parametrize("test", [whiteness, spread])
def test_white_noise_fails_as_often_as_stated(test):
    fails = np.mean([test(_noise(seed, (8, 120)))[1] < 0.05 for seed in range(200)])
    assert abs(fails - 0.05) < 4 * math.sqrt(0.05 * 0.95 / 200)


def test_unrelated_cause_fails_at_most_as_often_as_stated():
    def p(seed, sequences):
        rng = np.random.default_rng(seed)
        scale = rng.uniform(0.2, 3.0, size=(sequences, 1))
        cause = np.cumsum(rng.normal(size=(sequences, 150)), axis=1)
        return dependence(scale * rng.normal(size=(sequences, 150)), cause)[1]

    for sequences in (1, 20):
        fails = np.mean([p(seed, sequences) < 0.05 for seed in range(200)])
        assert fails < 0.05 + 4 * math.sqrt(0.05 * 0.95 / 200)


def test_all_tests_together_seldom_accuse_a_right_model():
    accused = [any(t.p_value < FAILS for t in run_tests(_residual(seed), NAMES)) for seed in range(20)]
    assert np.mean(accused) < 0.05 + 4 * math.sqrt(0.05 * 0.95 / 20)


def test_autoregression_fails_and_its_coefficient_is_the_size():
    e = _noise(3, (10, 400))
    for k in range(1, 400):
        e[:, k] += 0.3 * e[:, k - 1]
    _, p, size = whiteness(7.0 * e)  # whatever the unit
    assert p < 1e-9
    assert size == pytest.approx(0.3, abs=4 / math.sqrt(4000))


def test_padding_changes_no_statistic():
    e = _noise(4, (5, 200))
    longer = np.concatenate([e, np.full((5, 40), np.nan)], axis=1)
    for test in (whiteness, spread):
        np.testing.assert_allclose(test(longer), test(e), rtol=1e-12)
    np.testing.assert_allclose(dependence(longer, np.ones_like(longer)), (0.0, 1.0, 0.0))


def test_a_dependence_is_found_and_placed():
    whole = _residual(8)
    e = whole.innovation.copy()
    e[..., 0] += 0.5 * np.cos(whole.predicted[..., 0])
    e[:, 1:, 1] += 0.5 * whole.u[:, :-1, 0]
    results = run_tests(whole._replace(innovation=e), NAMES)
    by = {(t.channel, t.name): t for t in results}
    assert by["theta1", "correlation with cos(theta1)"].p_value < FAILS
    assert by["dx", "correlation with u"].p_value < FAILS
    assert by["dx", "correlation with cos(theta1)"].p_value > FAILS
    assert "no link" in by["dx", "correlation with cos(theta1)"].meaning
    assert 0.1 < by["dx", "correlation with u"].size < 0.6


@pytest.mark.parametrize(("size", "slight"), [(1.07, True), (3.4, False)])
def test_a_wrong_spread_fails_with_its_size_and_is_called_small_where_it_is(size, slight):
    whole = _residual(14)
    e = whole.innovation.copy()
    e[..., 0] *= size
    test = next(t for t in run_tests(whole._replace(innovation=e), NAMES) if t[:2] == ("spread", "theta1"))
    assert test.p_value < FAILS and test.slight == slight and ("small" in test.meaning) == slight
    assert 1 + test.size == pytest.approx(size, rel=0.06) and f"{1 + test.size:.3g} times as large" in test.meaning


def test_lost_sequences_take_no_part():
    whole = _residual(9)
    broken = np.where(np.arange(10)[:, None, None] > 0, whole.innovation, 1e3)
    results = run_tests(whole._replace(innovation=broken, used=np.arange(10) > 0), NAMES)
    assert all(t.p_value > FAILS for t in results)
    assert run_tests(whole._replace(used=np.zeros(10, bool)), NAMES) == []


@pytest.fixture(scope="module")
def forced():
    """A fit of a slide with both states read and a spring, whose process noise is as large as the force of time that it
    does not know; logs, and the sum of both forces.
    """
    mass, noise, rows = 2.0, (1e-3, 1e-4), round(3.0 / DT) + 1
    read = {"x": noise[0], "dx": noise[1]}
    rig = Rig("slide", "slide", {"m": Declared(mass, 0.0)}, False, ("u",), (1,), DT, "sequence", tuple(read), read, {})
    rng, t = np.random.default_rng(0), DT * np.arange(rows)
    u = np.sin(rng.uniform(1, 4, (6, 1)) * t + rng.uniform(0, 6, (6, 1)))
    x, v = rng.normal(size=(2, 6))
    path, truth = np.zeros((6, rows, 2)), np.zeros((6, rows))
    for k in range(rows):
        path[:, k, 0], path[:, k, 1] = x, v
        for _ in range(50):  # of semi-implicit Euler
            f = 1.5 * math.sin(2 * t[k]) - 0.8 * x
            truth[:, k] += f / 50
            v = v + (u[:, k] + f) / mass * DT / 50
            x = x + v * DT / 50
    y = path + np.asarray(noise) * rng.normal(size=path.shape)
    data = pad([(t, u[i, :, None], y[i]) for i in range(6)])
    fitted = begin(rig, data, key=jax.random.key(0))
    # of the rate as said; of the position what a force does to it within a sample
    log_q = 2 * jnp.log(jnp.asarray([3e-5, np.std(truth) * DT / mass]))
    spring = TorsionalSpring(*map(jnp.asarray, (0.8, 0.0, 0.0, 0.0)), joint=1)
    state = eqx.tree_at(lambda s: s.best.log_q, fitted.state, log_q)
    return fitted._replace(state=state._replace(best=with_effects(state.best, (spring,)))), data, truth


def test_a_known_force_comes_back_within_its_standard_deviation_with_that_of_an_effect_and_without(forced):
    """A spring in the model takes its force out of the residual; what is left is the force of time."""
    fitted, data, truth = forced
    left = residual(fitted, data)
    whole = left.without_effects()
    of_spring = -0.8 * (left.state[:, :-1, 0] + left.state[:, 1:, 0]) / 2
    np.testing.assert_allclose((whole.force - left.force)[:, :-1, 0], of_spring, atol=0.01 * np.abs(of_spring).max())
    for force, expected in ((whole.force, truth[:, :-1]), (left.force, truth[:, :-1] - of_spring)):
        missed = force[:, :-1, 0] - expected
        assert np.sqrt(np.mean((missed / whole.force_std[:, :-1, 0]) ** 2)) < 1.1
        smooth = np.mean(missed.reshape(6, 15, 20), axis=-1)
        assert np.sqrt(np.mean(smooth**2)) < 0.02 * np.std(truth)
    assert left.used.all() and np.isnan(left.force[:, -1]).all()
    np.testing.assert_allclose(left.state, data.y, atol=5e-3)
    np.testing.assert_allclose(left.u, data.u)


def test_there_is_an_innovation_where_there_is_a_reading(forced):
    fitted, data, _ = forced
    y = np.where(_noise(15, data.y.shape) > 1, np.nan, data.y)
    left = residual(fitted, data._replace(y=y))
    assert np.isnan(y).any()
    np.testing.assert_array_equal(np.isfinite(left.innovation), np.isfinite(y))


def test_names_carry_units_and_the_name_of_a_joint_of_its_own(forced):
    """Joints count from 1, as those of a system."""
    assert [NAMES.force_unit(1), NAMES.force_unit(2), NAMES.unit("u")] == ["N m", "N", "N m"]
    slide = names_of(forced[0])
    assert [slide.unit(n) for n in ("x", "dx", "u", "time")] == ["m", "m/s", "N", "s"]
    names = NAMES._replace(coordinates=("theta1", "elbow", "x3"), rates=("dtheta1", "delbow", "dx3"))
    assert [names.joint(j) for j in (1, 2, 3)] == ["joint 1", "joint 2 (elbow)", "joint 3"]
    text = "motor gain at joint 2: joints 1 and 2, joint 22, joint 2 (elbow)"
    assert with_names(text, names.coordinates) == text.replace("at joint 2:", "at joint 2 (elbow):")
