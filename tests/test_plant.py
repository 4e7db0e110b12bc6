"""The simulator of the benchmarks where test_effects.py does not compare it: forms that the catalogue lacks, files, the
oracle.
"""

import json

import numpy as np
import plant
import pytest

from nnap_em import read_logs, read_rig

SMALL = plant.Case(sequences=3, tests=2, steps=40, seed=5)
FREE = {"Fc": 0.0, "Fs": 0.0, "vs": 0.3, "b": 0.0, "eps": 0.1}


def _run(case, *, substeps=None):
    """All states of a case without process noise."""
    p = plant.build(case)
    p = p if substeps is None else p._replace(substeps=substeps)
    return plant.simulate(p, plant.starts(case), plant.torques(case), plant.clocks(case))


def _acceleration(case, q, v, t=0.0):
    """Acceleration without friction and input."""
    p = plant.build(case)._replace(friction=(FREE,) * len(q))
    x = np.zeros((1, p.size))
    x[0, : p.dof], x[0, p.dof : 2 * p.dof] = q, v
    return plant.rates(p, x, np.zeros(1), np.array([t]))[0, p.dof : 2 * p.dof]


def _mass(q):
    """Mass matrix of the declared acrobot, from the kinetic energy of its two rods (numerically)."""
    p = plant.build(plant.Case())
    energy = lambda v: plant.energy(p, np.array([[*q, *v]]), 0.0)[0] - plant.energy(p, np.array([[*q, 0, 0]]), 0.0)[0]  # noqa: E731
    a, b, both = energy((1, 0)), energy((0, 1)), energy((1, 1))
    return np.array([[2 * a, both - a - b], [both - a - b, 2 * b]])


def test_every_name_of_the_vocabulary_is_simulated(shared):
    names = set(json.loads((shared / "vocabulary.json").read_text()))
    assert set(plant.STRONG) == set(plant.WEAK) == names - {"asymmetric_friction", "unknown_function"}


@pytest.mark.parametrize(
    ("effect", "force"),
    [
        ({"name": "air_drag", "joint": 2, "c": 0.01, "exponent": 1.8}, (0, 0.01 * 2**1.8)),
        ({"name": "hard_stop", "joint": 2, "upper": 0.6, "lower": -0.6}, (0, -(40 * 0.1 - 0.3 * 2))),
        ({"name": "unknown_function", "form": "coupling", "joint": 1, "amplitude": 0.1}, (0.1 * np.sin(1.5), 0)),
        (
            {"name": "unknown_function", "form": "bump", "joint": 2, "amplitude": 0.1, "center": 0.5, "width": 0.2},
            (0, 0.1 * np.exp(-1.0)),
        ),
        (
            {"name": "unknown_function", "form": "magnet", "joint": 2, "amplitude": 0.1, "center": 0.5, "width": 0.2},
            (0, 0.1 * 0.2 / 4),
        ),
    ],
    ids=lambda value: f"{value.get('form', value['name'])}-{value['joint']}" if isinstance(value, dict) else "",
)
def test_a_law_changes_the_force_by_its_formula(effect, force):
    q, v = (0.4, 0.7), (3.0, -2.0)
    change = _acceleration(plant.Case(effects=(effect,)), q, v) - _acceleration(plant.Case(), q, v)
    np.testing.assert_allclose(_mass(q) @ change, force, atol=1e-10)


def test_drag_at_the_tip_is_mapped_by_the_jacobian():
    q, v, h, exponent = np.array([0.4, 0.7]), np.array([3.0, -2.0]), 1e-6, 1.8
    down = lambda angle: np.array([np.sin(angle), -np.cos(angle)])  # noqa: E731
    place = lambda q: 0.275 * down(q[0]) + 0.285 * down(q.sum())  # noqa: E731
    jacobian = np.stack([(place(q + d) - place(q - d)) / (2 * h) for d in h * np.eye(2)], axis=1)
    drag = ({**plant.STRONG["air_drag"][0], "exponent": exponent},)
    change = _acceleration(plant.Case(effects=drag), q, v) - _acceleration(plant.Case(), q, v)
    force = -0.006 * np.linalg.norm(jacobian @ v) ** (exponent - 1) * (jacobian @ v)
    np.testing.assert_allclose(_mass(q) @ change, jacobian.T @ force, atol=1e-9)


def test_a_delay_of_half_a_sample_switches_in_the_middle():
    """The same as an input logged at twice the rate: half steps of the held values before and after."""
    effect = {"name": "input_delay", "joint": 2, "delay": 0.015}
    x, u = _run(SMALL._replace(effects=(effect,))), plant.torques(SMALL)
    p, t = plant.build(SMALL), np.zeros(len(u))
    for k in (5, 20):
        half = plant._runge_kutta(p, x[:, k], u[:, k - 2], t, 0.005)
        np.testing.assert_allclose(plant._runge_kutta(p, half, u[:, k - 1], t, 0.005), x[:, k + 1], atol=1e-12)


def test_a_coarse_encoder_reads_multiples_of_its_step():
    effect = plant.STRONG["sensor_quantization"][0]
    case = SMALL._replace(effects=(effect,))
    y = plant.readings(plant.build(case), _run(case))[..., 0]
    np.testing.assert_allclose(y / effect["step"], np.round(y / effect["step"]), atol=1e-9)


SLOW = [pytest.param(n, marks=pytest.mark.slow) for n in ("presliding_friction", "hard_stop", "joint_flexibility")]


@pytest.mark.parametrize("name", ["backlash", *SLOW])  # fast: backlash
def test_stiff_effects_are_integrated_finely_enough(name):
    """With one substep they are off by 6e-3 and more [rad], thrice what is allowed."""
    case = SMALL._replace(effects=plant.STRONG[name])
    np.testing.assert_allclose(_run(case)[..., :2], _run(case, substeps=60)[..., :2], atol=2e-3)


@pytest.mark.parametrize(
    "case",
    [
        SMALL,
        SMALL._replace(clock="session", missing=0.1, hidden=False, declare_noise=False),
        SMALL._replace(system="pendulum"),
        SMALL._replace(system="slide", noise=(0.001, 0.01)),
    ],
    ids=["acrobot", "session", "pendulum", "slide"],
)
def test_the_library_reads_the_folder(case, tmp_path):
    """Without a warning: pytest turns them into errors."""
    plant.write(case, tmp_path)
    rig = read_rig(tmp_path / "rig.toml")
    assert rig.system == case.system and rig.clock == case.clock
    assert bool(rig.noise_std) == case.declare_noise
    assert ("theta2" in rig.start) == (case.system == "acrobot" and case.hidden)
    for name, number in (("train", 3), ("test", 2)):
        data = read_logs(tmp_path / name, rig).data
        assert data.y.shape == (number, 41, len(plant.measured(case)))
        assert np.isnan(np.asarray(data.y)).mean() == pytest.approx(case.missing, abs=0.06)
    truth = json.loads((tmp_path / "truth" / "truth.json").read_text())
    assert truth["effects"] == [] and len(truth["friction"]) == len(plant.SYSTEMS[case.system].friction)
    assert len(list((tmp_path / "truth" / "test").glob("*.csv"))) == 2


def test_the_clock_of_a_session_runs_on(tmp_path):
    plant.write(SMALL._replace(clock="session"), tmp_path)
    first = [plant.read(tmp_path / name)[0][:, 0] for name in ("train", "test")]
    np.testing.assert_allclose(np.concatenate(first), 2.4 * np.arange(5), atol=1e-9)


def test_a_step_of_the_payload_waits_for_its_time():
    step = ({"name": "payload_step", "joint": 2, "mass": 0.05, "time": 5.0},)
    case = SMALL._replace(clock="session", effects=step)
    x, none = _run(case), _run(case._replace(effects=()))
    loaded = _run(case._replace(effects=({"name": "payload", "joint": 2, "mass": 0.05},)))
    np.testing.assert_array_equal(x[:2], none[:2])
    np.testing.assert_allclose(x[3:], loaded[3:], atol=1e-10)
    np.testing.assert_array_equal(x[2, :20], none[2, :20])
    assert np.abs(x[2, -1] - none[2, -1]).max() > 0.01


def test_a_case_writes_the_same_files_again(tmp_path):
    case = SMALL._replace(effects=plant.STRONG["payload"], steps=20)
    for name in ("a", "b"):
        plant.write(case, tmp_path / name)
    plant.write(case._replace(seed=6), tmp_path / "c")
    files = lambda name: {p.relative_to(tmp_path / name): p.read_bytes() for p in (tmp_path / name).rglob("*.*")}  # noqa: E731
    assert files("a") == files("b")
    assert len(files("a")) == 9
    assert files("a") != files("c")


@pytest.mark.parametrize(
    "effects", [(), plant.STRONG["sensor_delay"] + plant.STRONG["actuator_lag"]], ids=["none", "late sensor and lag"]
)
def test_the_oracle_foretells_the_next_tenth_to_the_noise(effects, tmp_path):
    """Noise 0.005 rad and 0.05 rad/s; 5 x 10 readings give the RMS to 1 / sqrt(100) = 10 %, so 1.5 is 5 deviations."""
    case = plant.Case(effects=effects, sequences=1, tests=5, steps=75, seed=2, missing=0.02)
    plant.write(case, tmp_path)
    error = plant.oracle_errors(case, tmp_path, given=0.6, horizons=(0.1,))
    assert 0.0035 < error["theta1"][0] < 0.0075
    assert 0.035 < error["dtheta1"][0] < 0.075
    if effects:
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
