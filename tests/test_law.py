"""The Stribeck law as a description of a learned curve: what made the table is found, what it cannot show is said."""

import jax
import numpy as np
import pytest
from scipy.optimize import curve_fit

from nnap_em.model.law import CROSSED, PARAMETERS, LawFit, StribeckLaw, describe, fit_law, passed

TRUTH = (0.03, 0.05, 0.4, 0.007, 0.1)  # coulomb, breakaway, stribeck, viscous, smooth
OFFSET = 0.004


def _nodes(count: int = 61, top: float = 6.0):
    return (0.02 * np.sinh(np.linspace(-1, 1, count) * np.arcsinh(top / 0.02)))[None]


@jax.jit
def _forces(values, v):
    return jax.vmap(StribeckLaw(*values[:, None]))(v)


def _torque(v, values=TRUTH, offset=OFFSET):
    return np.asarray(_forces(np.asarray(values, float), v.T)).T + offset


def _kernel(v, std: float, length: float = 0.5):
    """Covariance of a curve that is smooth in asinh(v / 0.05), as a learned one."""
    s = np.arcsinh(v[0] / 0.05) / length
    return std**2 * np.exp(-0.5 * (s[:, None] - s[None, :]) ** 2)[None]


def test_law_limits_are_those_of_the_formula():
    values = np.asarray([2.0, 3.0, 0.1, 0.5, 1e-3])
    force = lambda v: float(_forces(values, np.asarray([[v]]))[0, 0])  # noqa: E731
    assert force(0.0) == 0.0
    assert force(10.0) == pytest.approx(-(2.0 + 0.5 * 10.0), rel=1e-12)
    assert force(0.005) == pytest.approx(-(3.0 + 0.5 * 0.005), rel=3e-3)  # exp(-0.0025) = 1 - 0.0025, of a third
    assert force(-0.3) == -force(0.3)
    v = np.linspace(-5.0, 5.0, 101)
    assert np.all(v * _forces(values, v[:, None])[:, 0] <= 0)  # friction never adds energy


def test_noise_free_table_returns_its_law():
    """Correlated errors, as of a learned curve, and independent ones give the same numbers."""
    v = _nodes()
    both = (fit_law(v, _torque(v), cov) for cov in (1e-6 * np.eye(v.shape[1])[None], _kernel(v, 1e-3)))
    for fit in both:
        # nothing but the weak prior moves it, by (std / width of the prior)^2 of the value or less: 1 % is ample
        np.testing.assert_allclose(fit.value[0], (*TRUTH, OFFSET), rtol=1e-2)
        np.testing.assert_array_less(fit.std[0][:4], np.asarray(TRUTH[:4]))
        assert not np.any(fit.departs)
    (text,) = describe(fit, ("theta1",), (True,))
    assert text.startswith(
        "theta1: Coulomb 0.03 ± 0.0008 N m, breakaway 0.05 ± 0.002 N m, Stribeck velocity 0.4 ± 0.03"
    )
    assert "viscous 0.007 ± 0.0002 N m s/rad" in text
    assert text.endswith("; the curve agrees with this law within 2 standard deviations.")


def test_agrees_with_scipy_curve_fit():
    v = _nodes()
    noise = np.random.default_rng(0).normal(size=v.shape[1]) * 5e-4
    scale = 0.5 + np.arange(v.shape[1]) / v.shape[1]  # uneven accuracy: the weights matter
    torque = _torque(v) + noise * scale
    variance = (5e-4 * scale) ** 2
    std = np.sqrt(1.01 * variance + (0.005 * np.abs(torque).max()) ** 2)  # with the nugget of fit_law
    curve = lambda v, *p: _torque(v[None], p[:5], p[5])[0]  # noqa: E731
    value, cov = curve_fit(curve, v[0], torque[0], p0=(*TRUTH, OFFSET), sigma=std, absolute_sigma=True)
    fit = fit_law(v, torque, np.diag(variance)[None])
    # equal but for the weak prior, which is worth a tenth of a standard deviation where the std is a third of the value
    np.testing.assert_allclose(fit.value[0], value, atol=0.1 * np.sqrt(np.diag(cov)).max(), rtol=0.02)
    np.testing.assert_allclose(fit.std[0], np.sqrt(np.diag(cov)), rtol=0.1)


def test_what_the_curve_does_not_show_has_a_large_std():
    v = _nodes()
    index = {name: i for i, name in enumerate(PARAMETERS)}
    no_stribeck = fit_law(v, _torque(v, (0.03, 0.03, 0.4, 0.007, 0.1)), _kernel(v, 1e-3))
    assert no_stribeck.std[0, index["stribeck"]] > no_stribeck.value[0, index["stribeck"]]
    assert no_stribeck.value[0, index["coulomb"]] == pytest.approx(0.03, abs=3 * float(no_stribeck.std[0, 0]))
    assert "Stribeck velocity not determined" in describe(no_stribeck, ("theta1",), (True,))[0]
    viscous = fit_law(v, -0.01 * v, 1e-8 * np.eye(v.shape[1])[None])
    assert viscous.value[0, index["viscous"]] == pytest.approx(0.01, rel=0.02)
    assert viscous.std[0, index["smooth"]] > viscous.value[0, index["smooth"]]
    nothing = fit_law(v, 0.0 * v, np.zeros((1, v.shape[1], v.shape[1])))
    assert np.all(np.isfinite(nothing.value)) and np.all(np.isfinite(nothing.std))


def test_departure_is_found_where_it_is():
    v = _nodes()
    bump = 0.02 * np.exp(-0.5 * ((v - 2.0) / 0.3) ** 2)
    fit = fit_law(v, _torque(v) + bump, _kernel(v, 1e-3) * 0.04)
    peak = np.argmin(np.abs(v[0] - 2.0))
    assert fit.departs[0, peak] and fit.difference[0, peak] > 0.005
    text = describe(fit, ("x",), (False,))[0]
    assert "departs" in text and text.startswith("x: Coulomb") and "N s/m" in text and "rad" not in text


def test_a_departure_is_said_where_it_begins_and_ends():
    v, number = np.linspace(-2.1, 2.1, 15)[None], np.ones((1, len(PARAMETERS)))
    departs = 3.0 * np.isin(np.arange(15), [3, 4, 9])[None]
    fit = LawFit(number, 0.1 * number, v, departs, np.ones((1, 15)), np.zeros(1))
    text = describe(fit, ("theta1",), (True,))[0]
    assert text.endswith("departs from this law at -1.2 to -0.9, 0.6 rad/s.")


@pytest.mark.parametrize(("step", "speed", "rest"), [(0.02, 0.0, 0), (0.3, 0.25, 500)])
def test_a_speed_is_less_than_a_row_from_rest_where_most_rows_change_the_velocity_by_more(step, speed, rest):
    """To and fro at a constant acceleration; at rest a smoother leaves some dither."""
    there = np.arange(-2.0, 2.0, step)
    moving = np.concatenate([1e-3 * np.sin(np.arange(rest)), np.tile(np.concatenate([there, there[::-1]]), 20)])
    nodes = np.tile(np.linspace(-1.0, 1.0, 9), (2, 1))
    np.testing.assert_array_equal(passed(np.stack([moving, 0.0 * moving], axis=1), nodes), [speed, 0.0])


def test_breakaway_and_stribeck_velocity_are_stated_where_no_row_crosses_the_whole_dip():
    v, index = _nodes(), [PARAMETERS.index(name) for name in ("breakaway", "stribeck")]
    table = v, _torque(v, (0.03, 0.05, 0.4, 0.007, 0.39)), 1e-8 * np.eye(v.shape[1])[None]
    rows = CROSSED * 0.4 * np.array([0.0, 0.9, 1.1])
    fit = fit_law(*(np.concatenate(3 * [part]) for part in table), rows)
    np.testing.assert_array_equal(np.isfinite(fit.value[:, index]).all(axis=1), [True, True, False])
    np.testing.assert_array_equal(fit.value[1:, [0, 3, 5]], fit.value[[0, 0]][:, [0, 3, 5]])
    stated, text = describe(fit, ("theta1", "theta2", "theta3"), (True, True, True))[1:]
    assert "not determined" not in stated
    assert "breakaway not determined, Stribeck velocity not determined" in text
    assert f"; {rows[2]:.2g} rad/s is less than a row from rest, so that its shape there is not seen; " in text
