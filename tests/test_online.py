"""The observer in C: compiled, and compared with the one in Python; wild input under sanitizers."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from observer_c import SANITIZED, held, paper_rig, play, replay, rough, wild

from nnap_em.cli import main as cli
from nnap_em.errors import ExportError
from nnap_em.estimate.identify import begin
from nnap_em.estimate.observer import AMBIGUOUS, MISSING, OUTLIER, observer
from nnap_em.estimate.store import save
from nnap_em.logs.dataset import Dataset
from nnap_em.machines.rig import Declared, Rig
from nnap_em.model.effects import catalogue
from nnap_em.model.servo import Servo
from nnap_em.model.simulate import paper_experiment, paper_model
from nnap_em.model.state_space import with_effects
from nnap_em.output.export.online import write_observer

DT = 0.02
PENDULUM = Rig(
    "bench */", "pendulum",
    {"m": Declared(0.5, 0.05), "lc": Declared(0.2, 0.0), "I": Declared(0.002, 0.0), "g": Declared(9.81, 0.0)},
    True, ("u",), (1,), DT, "sequence", ("theta1", "dtheta1"), {"theta1": 0.01, "dtheta1": 0.05}, {},
)  # fmt: skip


def _log(rows=600, seed=0):
    t = DT * np.arange(rows)
    swing = np.stack([0.8 * np.sin(3 * t), 2.4 * np.cos(3 * t)], axis=1)
    y = swing + np.array([0.01, 0.05]) * np.random.default_rng(seed).normal(size=(rows, 2))
    return t, 0.3 * np.sin(4 * t)[:, None], rough(y, seed)


@pytest.fixture(scope="module")
def fit():
    """A pendulum with numbers that no fit made; friction as a learned one."""
    t, u, _ = _log(90)
    y = np.stack([0.8 * np.sin(3 * t), 2.4 * np.cos(3 * t)], axis=1)
    logs = Dataset(t[None], u[None], y[None], np.ones((1, 90), bool))
    fitted = begin(PENDULUM, logs, key=jax.random.key(0))
    rng = np.random.default_rng(0)
    stir = lambda a: a + 0.1 * jnp.asarray(rng.normal(size=a.shape)) if eqx.is_inexact_array(a) else a  # noqa: E731
    model = eqx.tree_at(lambda m: m.unknown.mlp, fitted.model, jax.tree.map(stir, fitted.model.unknown.mlp))
    return _with(fitted, model, log_q=jnp.asarray([-8.0, -2.0]))


def _with(fitted, model, **changes):
    return fitted._replace(state=fitted.state._replace(best=dataclasses.replace(model, **changes)))


@pytest.fixture(scope="module")
def plain(fit, tmp_path_factory):
    """The fit, its observer in C, a log and the states of the observer in Python along it."""
    source = tmp_path_factory.mktemp("plain") / "arm.c"
    write_observer(fit, source)
    return fit, source, _replayed(fit, *_log(1000))


SPRING, LATE = (
    catalogue["torsional_spring"].of(0.3, 0.02, 0.0, 0.0, joint=1),
    catalogue["input_delay"].of(0.05, joint=1),
)
LAG, LATE_SENSOR = catalogue["actuator_lag"].of(0.1, joint=1), catalogue["sensor_delay"].of(0.03, channel="theta1")
SERVO = Servo("u", "position", {k: jnp.asarray(v) for k, v in dict(kp=1.0, kd=0.02, delay=0.05, limit=0.3).items()})
LAWS = {
    "held: a servo with a delay, a late input, a lag, a spring": ((LATE, LAG, SPRING), (SERVO,), False),
    "smooth: a servo with a delay, a lag, a late sensor": ((LATE_SENSOR, LAG), (SERVO,), True),
}


def _replayed(fitted, t, u, y):
    u = u if fitted.model.smooth else held(u)
    return t, u, y, jax.tree.map(np.asarray, replay(observer(fitted), t, u, y))


def _compare(source, replayed, atol, kind=np.float64, *options):
    *log, states = replayed
    found = play(source, *log, states.mean.shape[1], kind, *options)
    std = np.sqrt(np.diagonal(states.cov, axis1=1, axis2=2))
    assert np.max(np.abs(found.mean - states.mean) / std) < atol
    assert np.max(np.abs(found.cov - states.cov) / (std[:, :, None] * std[:, None])) < 10 * atol
    np.testing.assert_array_equal(found.flags, states.flags)


def test_c_gives_the_numbers_of_python_over_rows_with_gaps(plain):
    _, source, replayed = plain
    _compare(source, replayed, 1e-9)
    states = replayed[-1]
    assert np.any(states.flags & MISSING) and np.any(states.flags & OUTLIER)
    assert np.ptp(states.mean[500:, 0]) > 1.0
    assert "friction1_rows" in source.read_text()  # as a table, not as its network


@pytest.mark.parametrize(("effects", "servos", "smooth"), LAWS.values(), ids=LAWS)
def test_c_has_laws_of_command_and_sensor(fit, effects, servos, smooth, tmp_path):
    fitted = _with(fit, with_effects(fit.model, effects), servos=servos, smooth=smooth)
    write_observer(fitted, tmp_path / "dressed.c")
    _compare(tmp_path / "dressed.c", _replayed(fitted, *_log()), 1e-9)


def test_the_command_writes_floats_within_a_hundredth_of_a_standard_deviation(plain, tmp_path, capsys):
    fitted, _, replayed = plain
    save(tmp_path / "fit/model.npz", fitted._replace(discrepancy=0.0))
    assert cli.main(["export", str(tmp_path / "fit"), "--observer", str(tmp_path / "arm.c"), "--float"]) == 0
    assert {path.name for path in tmp_path.iterdir()} == {"fit", "arm.c", "arm.h"}
    assert "typedef float arm_real;" in (tmp_path / "arm.h").read_text() and "wrote " in capsys.readouterr().err
    code = (tmp_path / "arm.c").read_text().replace("double time", "")
    assert "sqrtf" in code and "double" not in code
    _compare(tmp_path / "arm.c", replayed, 0.01, np.float32, "-Wdouble-promotion")


@pytest.fixture(scope="module")
def acrobot(tmp_path_factory):
    """The paper's acrobot with theta2 hidden, its friction that of the truth."""
    truth = paper_model()
    log = paper_experiment(truth, 1, 399, key=jax.random.key(3))
    fitted = begin(paper_rig(), log.data, key=jax.random.key(0))
    fitted = fitted._replace(state=fitted.state._replace(best=truth))
    source = tmp_path_factory.mktemp("acrobot") / "acrobot.c"
    write_observer(fitted, source)
    return fitted, source, _replayed(fitted, *(np.asarray(a[0]) for a in log.data[:3]))


def test_branches_in_c_are_those_of_python(acrobot):
    _, source, replayed = acrobot
    _compare(source, replayed, 1e-9)
    ambiguous = replayed[-1].flags & AMBIGUOUS > 0
    assert ambiguous[:20].any() and not ambiguous[-50:].any()


@pytest.mark.parametrize(
    "which, single",
    [("plain", True), pytest.param("acrobot", False, marks=pytest.mark.slow)],  # fast: plain, and test_branches_...
)
def test_wild_input_leaves_numbers_and_no_fault(which, single, request, tmp_path):
    """NaN, infinity, huge values, starts: under the address and undefined behaviour sanitizers.

    Some faults take longer than a tenth of 30,000 steps to meet, as branches of which one is impossible.
    """
    write_observer(request.getfixturevalue(which)[0], tmp_path / "wild.c", single=single)
    assert all(wild(tmp_path / "wild.c", 30_000, *SANITIZED, "-O1")[k] > 0 for k in (0, 2))


def test_nothing_is_written_where_a_law_has_no_c_form(fit, tmp_path):
    with pytest.raises(ExportError, match="a file that ends in"):
        write_observer(fit, tmp_path / "arm.h")
    with pytest.raises(ExportError, match="'erf' has no plain C form"):
        write_observer(_with(fit, fit.model, unknown=jax.scipy.special.erf), tmp_path / "arm.c")
    assert not list(tmp_path.iterdir())
