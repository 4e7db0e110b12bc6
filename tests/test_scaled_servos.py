"""Numbers of servos that are proportional to columns of the logs: closed forms, invariances, mistakes with a hint."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import PENDULUM, rig_text, servo_model, written_again

from nnap_em.data.logs import OTHER_UNIT, DataError, read_logs
from nnap_em.data.rig import Declared, Rig, RigError, read_rig
from nnap_em.em.build import build_system
from nnap_em.em.servos import build_servos, steps_of_sample, torque_along
from nnap_em.fit.identifiability import identifiability
from nnap_em.fit.identify import begin
from nnap_em.fit.store import load, save
from nnap_em.systems import specs

KP = "kp = { mean = 3.0, std = 1.0, at = { gain = 200.0, supply = 7.4 } }"
LIMIT = "limit = { mean = 0.6, std = 0.0, at = { supply = 7.4 } }"
GAIN, SUPPLY = 400.0, 5.5


def _rig(path: Path, lines: str) -> Rig:
    servo = f'{PENDULUM}[input]\ncolumns = ["goal"]\njoints = [1]\nkind = "position"\n{lines}'
    (path / "rig.toml").write_text(rig_text(servo, ("theta1",)))
    return read_rig(path / "rig.toml", specs)


def _log(path: Path, gain: float | str = GAIN, supply: float | str = SUPPLY, rows: int = 40, at: int = 0) -> Path:
    """A folder with one log; `at` is the row in which the columns are as given, all others hold the defaults."""
    lines = ["time,goal,gain,supply,theta1"]
    for k in range(rows):
        row = (gain, supply) if k == at or at == 0 else (GAIN, SUPPLY)
        lines.append(f"{0.01 * k:.12g},{np.sin(0.3 * k):.9g},{row[0]},{row[1]},{0.4 * np.sin(0.3 * k - 0.5):.9g}")
    (path / "train").mkdir(exist_ok=True)
    (path / "train" / "a.csv").write_text("\n".join(lines) + "\n")
    return path / "train"


def _declared(path: Path, lines: str):
    rig = _rig(path, lines)
    return servo_model(rig), read_logs(_log(path), rig).data


def _first(data):
    return jax.tree.map(lambda a: jnp.asarray(a[0]), data)


def test_numbers_are_proportional_to_their_columns(tmp_path):
    model, data = _declared(tmp_path, f"{KP}\n{LIMIT}\nkd = 0.25")
    x = np.random.default_rng(0).uniform(-1.0, 1.0, (40, 2))
    kp, limit = 3.0 * GAIN / 200.0 * SUPPLY / 7.4, 0.6 * SUPPLY / 7.4
    drive = jax.jit(lambda x, seq: jax.vmap(lambda x, u: model.scene(x, u).drive[0])(x, model.inputs(seq)))
    torque = kp * (data.u[0, :, 0] - x[:, 0]) - 0.25 * x[:, 1]
    np.testing.assert_allclose(drive(x, _first(data)), np.clip(torque, -limit, limit), rtol=1e-12)
    assert 0 < np.sum(np.abs(torque) > limit) < 40


def test_declared_elsewhere_a_number_gives_the_same_motion(tmp_path):
    """Twice the number at twice the value is the same servo; so is a plain number where columns never change."""
    once = _declared(tmp_path, f"{KP}\n{LIMIT}")
    twice = _declared(tmp_path, KP.replace("3.0", "6.0").replace("200.0", "400.0") + f"\n{LIMIT}")
    plain = _declared(tmp_path, f"kp = {3.0 * GAIN / 200.0 * SUPPLY / 7.4!r}\nlimit = {0.6 * SUPPLY / 7.4!r}")
    x = jnp.asarray([0.2, -0.4])

    def moved(model, seq):
        u = jax.tree.map(lambda a: a[5], model.inputs(seq))
        along = model.driving((), x[None], jax.tree.map(lambda a: a[None], u))
        return model.transition(x, u), along[0], model.scene(x, u).drive

    every = jax.jit(lambda: [moved(model, _first(data)) for model, data in (once, twice, plain)])()
    ends, along, drives = zip(*every, strict=True)
    np.testing.assert_allclose(along, drives, rtol=1e-12)
    assert plain[1].u.shape[-1] == 1
    np.testing.assert_allclose(ends[1], ends[0], rtol=1e-12)
    np.testing.assert_allclose(ends[2], ends[0], rtol=1e-9)


def test_scales_of_the_fit_are_those_of_the_gains_in_the_logs(tmp_path):
    """The size of the torque and the step of integration, against those of plain numbers."""
    rig = _rig(tmp_path, KP)
    data = read_logs(_log(tmp_path), rig).data
    plain = _rig(tmp_path, f"kp = {3.0 * GAIN / 200.0 * SUPPLY / 7.4!r}")
    bare, system = data._replace(u=data.u[..., :1]), build_system(rig)
    steps = [steps_of_sample(system, build_servos(r), d, 0.01) for r, d in ((rig, data), (plain, bare))]
    np.testing.assert_allclose(*steps, rtol=1e-12)
    one, two = (
        torque_along(build_servos(r)[0], d.u[..., 0], d.y[..., 0], d.u[..., 1:], 0.01)
        for r, d in ((rig, data), (plain, bare))
    )
    np.testing.assert_allclose(one, two, rtol=1e-12)
    assert identifiability(rig, system, build_servos(rig)) == ((), (), ())


def test_a_declaration_is_written_and_stored_as_it_is(tmp_path):
    rig = _rig(tmp_path, f"{KP}\n{LIMIT}")
    fit = begin(rig, read_logs(_log(tmp_path), rig).data, key=jax.random.key(0))
    assert rig.input_scales == {"goal.kp": {"gain": 200.0, "supply": 7.4}, "goal.limit": {"supply": 7.4}}
    assert (rig.scale_columns, rig.logged_inputs) == (("gain", "supply"), ("goal", "gain", "supply"))
    assert rig.parameters["goal.kp"] == Declared(3.0, 1.0)
    assert "goal.kp by gain and supply" in str(rig)
    assert written_again(rig, tmp_path) == rig
    save(tmp_path / "model.npz", fit)
    again = load(tmp_path / "model.npz")
    assert again.rig == rig
    assert again.state.model.servos[0].scales == fit.state.model.servos[0].scales != ()


def test_numbers_of_one_column_stand_before_those_of_all(tmp_path):
    rig = _rig(tmp_path, f"{KP}\n[input.goal]\nkp = 2.0")
    assert (rig.input_scales, rig.parameters["goal.kp"]) == ({}, Declared(2.0, 0.0))
    assert rig == dataclasses.replace(rig, input_scales={})


BAD_LINES = {
    "no table": ("kp = { mean = 3.0, std = 1.0, at = 200.0 }", r"\[input.kp\] at: found 200.0; write at = { gain"),
    "no column": ("kp = { mean = 3.0, std = 1.0, at = {} }", r"\[input.kp\] at: found {}; write at = { gain"),
    "zero": (KP.replace("7.4", "0"), r"\[input.kp.at\] supply: found 0; write the value of that column at which kp"),
    "a state": (KP.replace("supply", "theta1"), "at: 'theta1' is the time, a state or an input; name a column"),
    "the input": (KP.replace("supply", "goal"), "at: 'goal' is the time, a state or an input; name a column"),
    "late": (f"{KP}\ndelay = {{ mean = 0.01, std = 0.0, at = {{ gain = 1.0 }} }}", "the same in all rows; take it out"),
    "misspelt": (KP.replace("at =", "att ="), r"\[input.kp\] att: unknown table or key; did you mean 'at'"),
}


@pytest.mark.parametrize("case", BAD_LINES)
def test_a_mistake_in_the_declaration_is_refused_with_its_mend(tmp_path, case):
    lines, message = BAD_LINES[case]
    with pytest.raises(RigError, match=message) as error:
        _rig(tmp_path, lines)
    assert str(tmp_path / "rig.toml") in str(error.value)


BAD_LOGS = {
    "negative": (
        {"gain": -1.0, "at": 6},
        r"line 8, column 'gain': found -1; goal.kp is proportional to it: write 0",
    ),
    "millivolts": ({"supply": 7400.0}, r"column 'supply': at most 7400, where rig.toml declares goal.kp at 7.4; write"),
    "empty": ({"supply": "", "at": 3}, r"line 5, column 'supply'"),
    "text": ({"gain": "high", "at": 3}, r"line 5, column 'gain'"),
}


@pytest.mark.parametrize("case", BAD_LOGS)
def test_a_mistake_in_a_log_is_refused_with_row_and_column(tmp_path, case):
    wrong, message = BAD_LOGS[case]
    rig = _rig(tmp_path, KP)
    with pytest.raises(DataError, match=message) as error:
        read_logs(_log(tmp_path, **wrong), rig)
    assert "a.csv" in str(error.value)


@pytest.mark.parametrize("ratio", [OTHER_UNIT, 1 / OTHER_UNIT])
def test_a_column_may_be_far_from_its_declared_value_but_not_in_another_unit(tmp_path, ratio):
    """One percent to either side of the largest and the smallest ratio."""
    rig, more = _rig(tmp_path, KP), 1.01 if ratio > 1 else 1 / 1.01
    assert read_logs(_log(tmp_path, supply=7.4 * ratio / more), rig).data.u.shape[-1] == 3
    with pytest.raises(DataError, match="write both in one unit"):
        read_logs(_log(tmp_path, supply=7.4 * ratio * more), rig)


def test_a_log_without_the_column_is_refused(tmp_path):
    rig = _rig(tmp_path, KP.replace("gain =", "firmware ="))
    with pytest.raises(DataError, match="'firmware'"):
        read_logs(_log(tmp_path), rig)
