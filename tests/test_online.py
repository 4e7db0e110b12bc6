"""The observer in C: compiled, and compared with the one in Python; wild input under sanitizers."""

import dataclasses
import subprocess

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from observer_c import SANITIZED, held, paper_rig, play, replay, rough, wild

from nnap_em.commands import cli
from nnap_em.data.dataset import Dataset
from nnap_em.data.rig import Declared, Rig
from nnap_em.effects import catalogue
from nnap_em.export import online
from nnap_em.export.model import ExportError
from nnap_em.export.online import numbers, table, write_observer
from nnap_em.fit.identify import begin
from nnap_em.fit.observer import AMBIGUOUS, MISSING, OUTLIER, RESTARTED, observer
from nnap_em.fit.store import save
from nnap_em.model.servo import Servo
from nnap_em.model.simulate import paper_experiment, paper_model

DT, JUMP = 0.02, 32
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


def _fit(effects=(), servos=None):
    """A pendulum with numbers that no fit made; friction as a learned one."""
    t, u, _ = _log(90)
    y = np.stack([0.8 * np.sin(3 * t), 2.4 * np.cos(3 * t)], axis=1)
    fitted = begin(
        PENDULUM, Dataset(t[None], u[None], y[None], np.ones((1, 90), bool)), key=jax.random.key(0), effects=effects
    )
    rng = np.random.default_rng(0)
    stir = lambda a: a + 0.1 * jnp.asarray(rng.normal(size=a.shape)) if eqx.is_inexact_array(a) else a  # noqa: E731
    model = eqx.tree_at(lambda m: m.unknown.mlp, fitted.model, jax.tree.map(stir, fitted.model.unknown.mlp))
    loose = jnp.concatenate([jnp.asarray([-8.0, -2.0]), model.log_q[2:]])
    model = dataclasses.replace(model, log_q=loose, servos=servos)
    return fitted._replace(state=fitted.state._replace(best=model))


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    fitted, folder = _fit(), tmp_path_factory.mktemp("plain")
    write_observer(fitted, folder / "arm.c")
    return fitted, folder / "arm.c"


LAWS = {
    "a spring, a late input": (
        (catalogue["torsional_spring"].of(0.3, 0.02, 0.0, 0.0, joint=1), catalogue["input_delay"].of(0.05, joint=1)),
        None,
    ),
    "a late sensor": ((catalogue["sensor_delay"].of(0.03, channel="theta1"),), None),
    "a servo with a delay, a lag": (
        (catalogue["actuator_lag"].of(0.1, joint=1),),
        (Servo("u", "position", {k: jnp.asarray(v) for k, v in dict(kp=1.0, kd=0.02, delay=0.05, limit=0.3).items()}),),
    ),
}  # fmt: skip


def _compare(source, fitted, t, u, y, atol, kind=np.float64):
    u = u if fitted.model.smooth else held(u)
    found, states = play(source, t, u, y, fitted.model.log_q.shape[0], kind), replay(observer(fitted), t, u, y)
    states = jax.tree.map(np.asarray, states)
    std = np.sqrt(np.diagonal(states.cov, axis1=1, axis2=2))
    assert np.max(np.abs(found.mean - states.mean) / std) < atol
    assert np.max(np.abs(found.cov - states.cov) / (std[:, :, None] * std[:, None])) < 10 * atol
    np.testing.assert_array_equal(found.flags, states.flags)
    return states


def test_c_gives_the_numbers_of_python_over_10000_rows_with_gaps(plain):
    fitted, source = plain
    states = _compare(source, fitted, *_log(10_000), 1e-9)
    flags = np.asarray(states.flags)
    assert np.any(flags & MISSING) and np.any(flags & OUTLIER)
    assert np.ptp(states.mean[5000:, 0]) > 1.0
    assert "friction1_rows" in source.read_text()  # as a table, not as its network


@pytest.mark.parametrize("laws", LAWS)
@pytest.mark.parametrize("smooth", [False, True], ids=["held", "smooth"])
def test_c_has_laws_of_command_and_sensor(laws, smooth, tmp_path):
    fitted = _fit(*LAWS[laws])
    fitted = fitted._replace(state=fitted.state._replace(best=dataclasses.replace(fitted.model, smooth=smooth)))
    write_observer(fitted, tmp_path / "dressed.c")
    _compare(tmp_path / "dressed.c", fitted, *_log(), 1e-9)


def test_float_is_within_a_hundredth_of_a_standard_deviation(plain, tmp_path):
    write_observer(plain[0], tmp_path / "arm.c", single=True)
    _compare(tmp_path / "arm.c", plain[0], *_log(3000), 0.01, np.float32)
    code = (tmp_path / "arm.c").read_text()
    assert "sqrtf" in code and "double" not in code.replace("double time", "").replace("double rows", "").replace(
        "whole(double x)", ""
    )


@pytest.fixture(scope="module")
def acrobot(tmp_path_factory):
    """The paper's acrobot with theta2 hidden, its friction that of the truth."""
    truth = paper_model()
    log = paper_experiment(truth, 1, 399, key=jax.random.key(3))
    fitted = begin(paper_rig(), log.data, key=jax.random.key(0))
    fitted = fitted._replace(state=fitted.state._replace(best=truth))
    source = tmp_path_factory.mktemp("acrobot") / "acrobot.c"
    write_observer(fitted, source)
    return fitted, source, log.data


def test_branches_in_c_are_those_of_python(acrobot):
    fitted, source, data = acrobot
    states = _compare(source, fitted, np.asarray(data.t[0]), np.asarray(data.u[0]), np.asarray(data.y[0]), 1e-9)
    ambiguous = np.asarray(states.flags) & AMBIGUOUS > 0
    assert ambiguous[:20].any() and not ambiguous[-50:].any()


@pytest.mark.parametrize("which", ["plain", "acrobot"])
def test_wild_input_leaves_numbers_and_no_fault(which, request, tmp_path):
    """NaN, infinity, huge values, jumps, starts: under the address and undefined behaviour sanitizers."""
    fitted = request.getfixturevalue(which)[0]
    for single in (False, True):
        source = tmp_path / f"wild{single}.c"
        write_observer(fitted, source, single=single)
        assert all(wild(source, 3_000, *SANITIZED)[k] > 0 for k in (0, 2, 3))
        assert wild(source, 30_000)  # some faults take longer to meet, as branches of which one is impossible


def test_stamps_say_which_rows_are_missing(plain):
    """Two rows that never came are as two without readings; one stamp that is wrong is a row without readings."""
    _, source = plain
    t, u, y = _log(100, seed=1)
    y[:] = np.where(np.isnan(y), 0.0, y)
    gone = np.delete(np.arange(100), [50, 51])
    without = y.copy()
    without[50:52] = np.nan
    whole = play(source, t, held(u), without, 2)
    u_gone = held(u)[gone]
    u_gone[50] = held(u)[50]
    held_on = held(u)
    held_on[50:53] = held(u)[50]
    whole = play(source, t, held_on, without, 2)
    found = play(source, t[gone], u_gone, y[gone], 2)
    np.testing.assert_allclose(found.mean[50:], whole.mean[52:], rtol=1e-12)
    assert found.flags[50] == JUMP and not found.flags[51]
    odd, blank = t.copy(), y.copy()
    odd[60], blank[60] = 1e7, np.nan
    np.testing.assert_array_equal(play(source, odd, held(u), y, 2).mean, play(source, t, held(u), blank, 2).mean)
    twice = np.insert(np.arange(100), 70, 70)  # a row that comes twice counts once
    found = play(source, t[twice], held(u)[twice], y[twice], 2)
    np.testing.assert_array_equal(found.mean[71:], play(source, t, held(u), y, 2).mean[70:])
    assert found.flags[71] == JUMP
    other = np.where(np.arange(100) < 60, t, t + 1e6)  # another clock: one row is not read, then a new start
    flags = play(source, other, held(u), y, 2).flags
    assert flags[60] & JUMP and flags[61] & RESTARTED and not flags[62:].any()


def test_smooth_inputs_go_straight_over_rows_that_never_came(plain, tmp_path):
    fitted = plain[0]._replace(state=plain[0].state._replace(best=dataclasses.replace(plain[0].model, smooth=True)))
    write_observer(fitted, tmp_path / "smooth.c")
    t, u, y = _log(100, seed=1)
    y = np.where(np.isnan(y), 0.0, y)
    gone, without, straight = np.delete(np.arange(100), [50, 51]), y.copy(), u.copy()
    without[50:52] = np.nan
    straight[50:52] = u[49] + (u[52] - u[49]) * np.array([[1.0], [2.0]]) / 3
    whole = play(tmp_path / "smooth.c", t, straight, without, 2)
    np.testing.assert_allclose(
        play(tmp_path / "smooth.c", t[gone], u[gone], y[gone], 2).mean[50:], whole.mean[52:], rtol=1e-12
    )


def test_a_table_is_as_exact_as_it_says():
    curve = lambda v: jnp.tanh(3 * v) + 0.1 * v  # noqa: E731
    found = table(curve, "f", 2.0, 0.01, 1e-11)
    assert found is not None
    v = np.concatenate([np.linspace(-11.9, 11.9, 5001), np.linspace(-0.03, 0.03, 1001)])  # to six times the rate
    np.testing.assert_allclose(found(v), curve(jnp.asarray(v)), rtol=0, atol=3e-11)
    assert table(lambda v: jnp.sign(v - 0.1), "f", 2.0, 0.01, 1e-11) is None


def test_nothing_is_written_where_a_law_has_no_c_form(tmp_path, monkeypatch):
    def refused(*args, **names):
        raise ExportError("no form")

    with pytest.raises(ExportError, match="a file that ends in"):
        write_observer(_fit(), tmp_path / "arm.h")
    monkeypatch.setattr(online, "unrolled", refused)
    with pytest.raises(ExportError):
        write_observer(_fit(), tmp_path / "arm.c")
    assert not list(tmp_path.iterdir())


def test_numbers_that_a_program_may_change(plain):
    """The mass and both noises, by name."""
    fitted, _ = plain
    own = numbers(fitted)
    assert own.names == ("m", "noise.theta1", "noise.dtheta1", "kick.theta1", "kick.dtheta1")
    assert own.values[:2] == pytest.approx((0.5, 0.01))


def test_the_command_writes_c(tmp_path, capsys):
    save(tmp_path / "fit/model.npz", _fit()._replace(discrepancy=0.0))
    words = ["export", str(tmp_path / "fit"), "--observer", str(tmp_path / "arm.c")]
    assert cli.main([*words, "--float"]) == 0
    assert {path.name for path in tmp_path.iterdir()} == {"fit", "arm.c", "arm.h"}
    assert "typedef float arm_real;" in (tmp_path / "arm.h").read_text()
    assert "wrote " in capsys.readouterr().err
    strict = ["gcc", "-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-Wdouble-promotion", "-c", "arm.c"]
    subprocess.run(strict, cwd=tmp_path, check=True)
