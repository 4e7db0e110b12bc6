"""Statistics against cases with a known answer, and the missing force against one that was put in."""

import math
import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import right_residual
from statsmodels.stats.diagnostic import acorr_ljungbox

from nnap_em.data.dataset import pad
from nnap_em.data.rig import Declared, Rig
from nnap_em.data.units import with_names
from nnap_em.diagnosis.residual import Names, names_of, residual
from nnap_em.diagnosis.statistics import FAILS, dependence, holm, spread, whiteness
from nnap_em.diagnosis.statistics import tests as run_tests
from nnap_em.effects.position import TorsionalSpring
from nnap_em.fit.identify import begin
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
    assert holm([]).size == 0


def test_one_sequence_gives_what_statsmodels_gives():
    e = _noise(0, (1, 400))
    q, p, _ = whiteness(e)
    table = acorr_ljungbox(e[0], lags=[20])
    # that takes every autocovariance over N, ours over the number of its pairs
    assert q == pytest.approx(float(table.lb_stat.iloc[0]), rel=0.1)
    assert p == pytest.approx(float(table.lb_pvalue.iloc[0]), abs=0.1)


@pytest.mark.parametrize("test", [whiteness, spread])
def test_white_noise_fails_as_often_as_stated(test):
    fails = np.mean([test(_noise(seed, (8, 120)))[1] < 0.05 for seed in range(400)])
    assert abs(fails - 0.05) < 4 * math.sqrt(0.05 * 0.95 / 400)


def test_unrelated_cause_fails_at_most_as_often_as_stated():
    def p(seed, sequences):
        rng = np.random.default_rng(seed)
        scale = rng.uniform(0.2, 3.0, size=(sequences, 1))
        cause = np.cumsum(rng.normal(size=(sequences, 150)), axis=1)
        return dependence(scale * rng.normal(size=(sequences, 150)), cause)[1]

    for sequences in (1, 6, 20):
        fails = np.mean([p(seed, sequences) < 0.05 for seed in range(300)])
        assert fails < 0.05 + 4 * math.sqrt(0.05 * 0.95 / 300)


def test_all_tests_together_seldom_accuse_a_right_model():
    accused = [any(t.p_value < FAILS for t in run_tests(_residual(seed), NAMES)) for seed in range(40)]
    assert np.mean(accused) < 0.05 + 4 * math.sqrt(0.05 * 0.95 / 40)


def test_autoregression_fails_and_its_coefficient_is_the_size():
    e = _noise(3, (10, 400))
    for k in range(1, 400):
        e[:, k] += 0.3 * e[:, k - 1]
    _, p, size = whiteness(e)
    assert p < 1e-9
    assert size == pytest.approx(0.3, abs=4 / math.sqrt(4000))
    np.testing.assert_allclose(whiteness(7.0 * e), whiteness(e), rtol=1e-9)  # whatever the unit


def test_gaps_and_padding_change_no_statistic():
    e = _noise(4, (5, 200))
    longer = np.concatenate([e, np.full((5, 40), np.nan)], axis=1)
    for test in (whiteness, spread):
        np.testing.assert_allclose(test(longer), test(e), rtol=1e-12)
    holes = np.where(_noise(5, e.shape) > 1, np.nan, e)
    assert whiteness(holes)[1] > 1e-3
    np.testing.assert_allclose(dependence(longer, np.ones_like(longer)), (0.0, 1.0, 0.0))


def test_a_wrong_spread_fails_and_its_excess_is_the_size():
    mean, p, size = spread(1.2 * _noise(7))
    assert p < 1e-9 and size == pytest.approx(0.2, abs=0.06) and mean == pytest.approx(1.44, abs=0.15)


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
    assert not by["dx", "correlation with u"].slight


@pytest.mark.parametrize(("size", "slight"), [(1.07, True), (3.4, False)])
def test_a_slight_but_certain_misfit_is_called_so(size, slight):
    """Errors more than twice as large are no percentage of what the model expects."""
    whole = _residual(14)
    e = whole.innovation.copy()
    e[..., 0] *= size
    test = next(t for t in run_tests(whole._replace(innovation=e), NAMES) if t[:2] == ("spread", "theta1"))
    assert test.p_value < FAILS and test.slight == slight and ("small" in test.meaning) == slight
    times = re.fullmatch(r"Errors in theta1 are ([\d.]+) times as large as the model expects.*", test.meaning)
    assert times and float(times[1]) == pytest.approx(size, rel=0.06)


def test_lost_sequences_take_no_part():
    whole = _residual(9)
    broken = whole.innovation.copy()
    broken[0] = 1e3
    used = np.arange(10) > 0
    results = run_tests(whole._replace(innovation=broken, used=used), NAMES)
    assert all(t.p_value > FAILS for t in results)
    assert run_tests(whole._replace(used=np.zeros(10, bool)), NAMES) == []


@pytest.fixture(scope="module")
def forced():
    """A fit of a slide with both states read, whose process noise is as large as the force that it does not know."""
    mass, noise, rows = 2.0, (1e-3, 1e-4), round(3.0 / DT) + 1
    read = {"x": noise[0], "dx": noise[1]}
    rig = Rig("slide", "slide", {"m": Declared(mass, 0.0)}, False, ("u",), (1,), DT, "sequence", tuple(read), read, {})
    rng, t = np.random.default_rng(0), DT * np.arange(rows)
    logs, truth = [], []
    for _ in range(6):
        u = np.sin(rng.uniform(1, 4) * t + rng.uniform(0, 6))
        x, v = rng.normal(), rng.normal()
        path, forces = [], []
        for k in range(rows):
            path.append((x, v))
            total = 0.0
            for _ in range(50):  # of semi-implicit Euler
                f = 1.5 * math.sin(2 * t[k]) - 0.8 * x
                total += f / 50
                v += (u[k] + f) / mass * DT / 50
                x += v * DT / 50
            forces.append(total)
        logs.append((t, u[:, None], np.asarray(path) + np.asarray(noise) * rng.normal(size=(rows, 2))))
        truth.append(forces)
    data, truth = pad(logs), np.asarray(truth)
    fitted = begin(rig, data, key=jax.random.key(0))
    # of the rate as said; of the position what a force does to it within a sample
    log_q = 2 * jnp.log(jnp.asarray([3e-5, np.std(truth) * DT / mass]))
    return fitted._replace(state=eqx.tree_at(lambda s: s.best.log_q, fitted.state, log_q)), data, truth


def test_a_known_force_comes_back_within_its_standard_deviation(forced):
    fitted, data, truth = forced
    left = residual(fitted, data)
    assert left.used.all()
    error = (left.force[:, :-1, 0] - truth[:, :-1]) / left.force_std[:, :-1, 0]
    assert np.sqrt(np.mean(error**2)) < 1.1
    assert np.isnan(left.force[:, -1]).all()
    smooth = np.mean((left.force[:, :-1, 0] - truth[:, :-1]).reshape(6, 15, 20), axis=-1)
    assert np.sqrt(np.mean(smooth**2)) < 0.02 * np.std(truth)
    np.testing.assert_allclose(left.state, data.y, atol=5e-3)
    np.testing.assert_allclose(left.u, data.u)


def test_adding_an_effect_back_gives_its_force(forced):
    """A spring in the model takes its force out of the residual; what is left is the force of time."""
    fitted, data, truth = forced
    spring = TorsionalSpring(*map(jnp.asarray, (0.8, 0.0, 0.0, 0.0)), joint=1)
    state = fitted.state._replace(best=with_effects(fitted.model, (spring,)))
    left = residual(fitted._replace(state=state), data)
    whole = left.without_effects()
    of_spring = -0.8 * (left.state[:, :-1, 0] + left.state[:, 1:, 0]) / 2
    np.testing.assert_allclose((whole.force - left.force)[:, :-1, 0], of_spring, atol=0.01 * np.abs(of_spring).max())
    for force, expected in ((whole.force, truth), (left.force, truth[:, :-1] - of_spring)):
        error = (force[:, :-1, 0] - expected[:, : of_spring.shape[1]]) / whole.force_std[:, :-1, 0]
        assert np.sqrt(np.mean(error**2)) < 1.1


def test_there_is_an_innovation_where_there_is_a_reading(forced):
    fitted, data, _ = forced
    y = np.where(_noise(15, data.y.shape) > 1, np.nan, data.y)
    left = residual(fitted, data._replace(y=y))
    assert np.isnan(y).any()
    np.testing.assert_array_equal(np.isfinite(left.innovation), np.isfinite(y))


def test_names_carry_units_and_the_name_of_a_joint_of_its_own(forced):
    """Joints count from 1, as those of a system."""
    assert [NAMES.force_unit(1), NAMES.force_unit(2), NAMES.unit("u")] == ["N m", "N", "N m"]
    assert [NAMES.unit(name) for name in ("theta1", "dtheta1", "dx", "time")] == ["rad", "rad/s", "m/s", "s"]
    slide = names_of(forced[0])
    assert [slide.unit(n) for n in ("x", "dx", "u", "time")] == ["m", "m/s", "N", "s"]
    names = NAMES._replace(coordinates=("theta1", "elbow", "x3"), rates=("dtheta1", "delbow", "dx3"))
    assert [names.joint(j) for j in (1, 2, 3)] == ["joint 1", "joint 2 (elbow)", "joint 3"]
    text = "motor gain at joint 2: joints 1 and 2, joint 1, joint 22, joint 2 (elbow)"
    expected = "motor gain at joint 2 (elbow): joints 1 and 2, joint 1, joint 22, joint 2 (elbow)"
    assert with_names(text, names.coordinates) == expected
