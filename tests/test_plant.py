"""The simulator of the benchmarks where test_effects.py does not compare it: other forms, files, the oracle."""

import json

import numpy as np
import plant
import pytest

from nnap_em import read_logs, read_rig

SMALL = plant.Case(sequences=3, tests=2, steps=40, seed=5)
FREE = {"Fc": 0.0, "Fs": 0.0, "vs": 0.3, "b": 0.0, "eps": 0.1}


def _acceleration(case, q, v):
    """Acceleration without friction and input."""
    p = plant.build(case)._replace(friction=(FREE,) * len(q))
    x = np.zeros((1, p.size))
    x[0, : p.dof], x[0, p.dof : 2 * p.dof] = q, v
    return plant.rates(p, x, np.zeros(1), np.zeros(1))[0, p.dof : 2 * p.dof]


def _mass(q):
    """Mass matrix of the declared acrobot, from the kinetic energy of its two rods (numerically)."""
    p = plant.build(plant.Case())
    energy = lambda v: plant.energy(p, np.array([[*q, *v]]), 0.0)[0] - plant.energy(p, np.array([[*q, 0, 0]]), 0.0)[0]  # noqa: E731
    a, b, both = energy((1, 0)), energy((0, 1)), energy((1, 1))
    return np.array([[2 * a, both - a - b], [both - a - b, 2 * b]])


FORM = {"name": "unknown_function", "amplitude": 0.1}
NEAR = {"joint": 2, "center": 0.5, "width": 0.2}
FORCES = (  # at the state below
    ({"name": "air_drag", "joint": 2, "c": 0.01, "exponent": 1.8}, (0, 0.01 * 2**1.8)),
    ({"name": "hard_stop", "joint": 2, "upper": 0.6, "lower": -0.6}, (0, -(40 * 0.1 - 0.3 * 2))),
    (FORM | {"form": "coupling", "joint": 1}, (0.1 * np.sin(1.5), 0)),
    (FORM | {"form": "bump"} | NEAR, (0, 0.1 * np.exp(-1.0))),
    (FORM | {"form": "magnet"} | NEAR, (0, 0.1 * 0.2 / 4)),
)


def test_a_law_changes_the_force_by_its_formula():
    q, v = (0.4, 0.7), (3.0, -2.0)
    for effect, force in FORCES:
        change = _acceleration(plant.Case(effects=(effect,)), q, v) - _acceleration(plant.Case(), q, v)
        np.testing.assert_allclose(_mass(q) @ change, force, atol=1e-10, err_msg=str(effect))


@pytest.mark.parametrize(
    "case",
    [
        SMALL._replace(clock="session", missing=0.1, hidden=False, declare_noise=False),
        SMALL._replace(system="slide", noise=(0.001, 0.01)),
    ],
    ids=["session", "slide"],
)
def test_the_library_reads_the_folder(case, tmp_path):
    """Without a warning: pytest turns them into errors.  The clock of a session runs on."""
    plant.write(case, tmp_path)
    rig = read_rig(tmp_path / "rig.toml")
    assert rig.system == case.system and rig.clock == case.clock
    assert bool(rig.noise_std) == case.declare_noise
    for name, number in (("train", 3), ("test", 2)):
        data = read_logs(tmp_path / name, rig).data
        assert data.y.shape == (number, 41, len(plant.measured(case)))
        assert np.isnan(np.asarray(data.y)).mean() == pytest.approx(case.missing, abs=0.06)
    truth = json.loads((tmp_path / "truth" / "truth.json").read_text())
    assert truth["effects"] == [] and len(truth["friction"]) == len(plant.SYSTEMS[case.system].friction)
    first = np.concatenate([plant.read(tmp_path / name)[0][:, 0] for name in ("train", "test")])
    np.testing.assert_allclose(first, (2.4 if case.clock == "session" else 0.0) * np.arange(5), atol=1e-9)


def test_the_oracle_foretells_the_next_tenth_to_the_noise(tmp_path):
    """Noise 0.005 rad and 0.05 rad/s; 5 x 10 readings give the RMS to 1 / sqrt(100) = 10 %, so 1.5 is 5 deviations."""
    effects = plant.STRONG["sensor_delay"] + plant.STRONG["actuator_lag"]
    case = plant.Case(effects=effects, sequences=1, tests=5, steps=75, seed=2, missing=0.02)
    plant.write(case, tmp_path)
    error = plant.oracle_errors(case, tmp_path, given=0.6, horizons=(0.1,))
    assert 0.0035 < error["theta1"][0] < 0.0075
    assert 0.035 < error["dtheta1"][0] < 0.075
    naive = plant.oracle_errors(case._replace(effects=()), tmp_path, given=0.6, horizons=(0.1,))
    assert naive["theta1"][0] > 2 * error["theta1"][0]


def test_the_filter_is_kalmans_on_a_slide():
    """Without friction the slide is linear: mean and likelihood against the textbook's matrices."""
    sensor = (
        {"name": "sensor_scale", "channel": "x", "scale": 1.5},
        {"name": "sensor_bias", "channel": "x", "bias": 0.2},
    )
    case = plant.Case(system="slide", effects=sensor, noise=(0.01, 0.1), process=0.05, seed=3)
    p = plant.build(case)._replace(friction=(FREE,))
    u, y = plant.torques(case)[:1, :30], np.random.default_rng(0).normal(0, 0.1, (1, 30, 1))
    a, b, q = np.array([[1, 0.01], [0, 1]]), np.array([0.01**2 / 2, 0.01]), np.diag([1e-10, 1e-10 + 0.05**2])
    m, c, total = np.zeros(2), np.diag([0.04, 0.01]), 0.0
    mean, likelihood = plant.filtered(p, m[None], c[None], u, y, np.zeros(1))
    for k in range(30):
        if k:
            m, c = a @ m + b * u[0, k - 1], a @ c @ a.T + q
        s, e = 1.5**2 * c[0, 0] + 1e-4, y[0, k, 0] - 1.5 * m[0] - 0.2
        total -= (e**2 / s + np.log(2 * np.pi * s)) / 2
        m, c = m + 1.5 * c[:, 0] * e / s, c - 1.5**2 * np.outer(c[:, 0], c[0]) / s
    np.testing.assert_allclose(mean[0], m, atol=1e-9)
    assert likelihood[0] == pytest.approx(total, rel=1e-9)
