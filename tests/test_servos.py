"""Servos as inputs: their torque is that of MuJoCo's actuators, what is declared comes back, mistakes have a hint."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from helpers import PENDULUM, rig_of, rig_text, servo_model, written_again

from nnap_em.errors import DataError, ExportError, RigError
from nnap_em.estimate.em.build import build, build_system
from nnap_em.estimate.em.servos import build_servos
from nnap_em.estimate.identifiability import identifiability, sentences
from nnap_em.estimate.identify import begin
from nnap_em.estimate.store import load, save
from nnap_em.logs.dataset import Dataset
from nnap_em.logs.read import read_logs
from nnap_em.machines.rig import Declared, Rig
from nnap_em.machines.servo import KINDS
from nnap_em.model.effects.actuator import InputDelay
from nnap_em.model.servo import LAWS
from nnap_em.output.export.model import write_model

BODY = '<inertial pos="0 0 -.2" mass=".5" diaginertia=".002 .002 .002"/>'
TWO = f"""<mujoco><worldbody><body name="b"><joint name="a" axis="0 1 0"/>{BODY}
  <body name="c" pos="0 0 -.4"><joint name="rail" type="slide" axis="1 0 0"/>{BODY}</body></body></worldbody>
  <actuator>%s</actuator></mujoco>"""
ACTUATORS = {
    "position": '<position name="goal" joint="a" kp="12" kv=".3"/>',
    "velocity": '<velocity name="goal" joint="a" kv=".7"/>',
    "damper": '<damper name="goal" joint="a" kv=".7" ctrlrange="0 5"/>',
    "affine": '<general name="goal" joint="a" gainprm="3" biastype="affine" biasprm=".2 -5 -.1"/>',
    "position on a slide": '<position name="goal" joint="rail" kp="12" kv=".3"/>',
    "behind a gear": '<position name="goal" joint="a" kp="12" kv=".3" gear="3"/>',
    "limited": '<position name="goal" joint="a" kp="12" kv=".3" gear="-3" forcerange="-30 30"/>',
    "limited at its joint": '<velocity name="goal" joint="a" kv="9" gear="2"/>',
    "general as a servo": '<general name="goal" joint="a" gainprm="9" biastype="affine" biasprm="0 -9 -1"/>',
    "offset": '<general name="goal" joint="a" gainprm="9" biastype="affine" biasprm=".5 -9 -1"/>',
}

SLIDE = 'type = "slide"\nm = 1.0\nfriction = "unknown"\n'
ACROBOT = """type = "acrobot"\nm1 = 0.3\nm2 = 0.25\nl1 = 0.2\nl2 = 0.2\nlc1 = 0.1\nlc2 = 0.1\nI1 = 0.001\nI2 = 0.001
g = 9.81\nfriction = "unknown"
"""


SERVO = 'kind = "position"\n'


def _rig(path: Path, text: str, *, model: str = PENDULUM, read: tuple[str, ...] = ("theta1",)) -> Rig:
    return rig_of(path, rig_text(model + text, read))


def _servo(path: Path, lines: str, **model) -> Rig:
    return _rig(path, f'[input]\ncolumns = ["goal"]\njoints = [1]\n{lines}', **model)


def _of_file(path: Path, actuators: str, text: str = "", more: str = "") -> Rig:
    (path / "machine.xml").write_text((TWO % actuators).replace('axis="0 1 0"', f'axis="0 1 0" {more}'))
    model = 'type = "mjcf"\nfile = "machine.xml"\nfriction = "unknown"\n'
    return _rig(path, text, model=model, read=("a", "rail"))


def _logs(u: np.ndarray, y: np.ndarray | None = None, dt: float = 0.01) -> Dataset:
    """Sequences of the commands u, batched; readings 0 where there are none."""
    t = np.broadcast_to(dt * np.arange(u.shape[1]), u.shape[:2])
    return Dataset(t, u, np.zeros((*u.shape[:2], 1)) if y is None else y, np.ones(u.shape[:2], bool))


def _drives(models, x, u) -> list[np.ndarray]:
    """Generalised forces of some models at states under commands that stand still, a row each, in one program."""

    def of(model, x, u):
        rows = Dataset(0.01 * jnp.arange(4.0), jnp.tile(u, (4, 1)), jnp.zeros((4, 1)), jnp.ones(4, bool))
        return model.scene(x, jax.tree.map(lambda a: a[-1], model.inputs(rows))).drive

    each = [jax.vmap(lambda x, u, model=model: of(model, x, u)) for model in models]
    return jax.jit(lambda x, u: [one(x, u) for one in each])(jnp.asarray(x), jnp.asarray(u))


def test_servos_of_files_give_the_force_of_mujoco(tmp_path):
    rng, rigs, truths = np.random.default_rng(0), [], []
    x, u = rng.uniform(-2.0, 2.0, (12, 4)), rng.uniform(0.0, 3.0, (12, 1))
    for name, actuator in ACTUATORS.items():
        more = 'actuatorfrcrange="-15 15"' if name == "limited at its joint" else ""
        rigs.append(_of_file(tmp_path, actuator, more=more))
        compiled, truth = mujoco.MjModel.from_xml_path(str(tmp_path / "machine.xml")), []
        data = mujoco.MjData(compiled)
        for state, push in zip(x, u, strict=True):
            data.qpos[:], data.qvel[:] = np.split(state, 2)
            data.ctrl[:] = push
            mujoco.mj_forward(compiled, data)
            truth.append(data.qfrc_actuator.copy())
        truths.append(truth)
    for name, own, truth in zip(ACTUATORS, _drives([servo_model(rig) for rig in rigs], x, u), truths, strict=True):
        np.testing.assert_allclose(own, truth, atol=1e-10, err_msg=name)
        assert len(set(np.round(np.abs(truth).max(axis=1), 9))) > 1
    kinds = [rig.input_kinds[0] for rig in rigs]
    assert kinds == [*KINDS][1:3] + ["damper", "affine"] + 3 * ["position"] + ["velocity", "position", "position"]
    assert set(LAWS) == set(KINDS)


def test_a_slide_on_a_servo_swings_as_its_closed_form(tmp_path):
    """m x'' = kp (u - x): x = u (1 - cos(w t)) from rest at 0, at 4 rad per sample, by as many steps as that asks for.

    Tolerance: the fourth-order method at STIFF = 0.5 loses (w h)^5 / 120 of the phase in a step.
    """
    rig = _servo(tmp_path, 'kind = "position"\nkp = 160000.0', model=SLIDE, read=("x",))
    w, rows = 400.0, 12
    logs = _logs(np.full((1, 40, 1), 0.5), 0.1 * np.sin(np.arange(40.0))[None, :, None])
    model = build(dataclasses.replace(rig, friction=False), logs, key=jax.random.key(0)).model
    row = jax.tree.map(lambda a: a[-1], model.inputs(jax.tree.map(lambda a: jnp.asarray(a[0]), logs)))
    step = lambda x, _: (model.transition(x, row), x[0])  # noqa: E731
    _, positions = jax.jit(lambda: jax.lax.scan(step, jnp.zeros(2), length=rows))()
    assert model.steps == 9
    np.testing.assert_allclose(positions, 0.5 * (1 - np.cos(w * 0.01 * np.arange(rows))), atol=0.02)


def test_a_late_command_is_that_of_earlier_rows_and_stood_before_the_first(tmp_path):
    u = np.cumsum(np.random.default_rng(0).normal(size=(1, 20, 1)), axis=1)
    seq = jax.tree.map(lambda a: jnp.asarray(a[0]), _logs(u))
    declared = servo_model(_servo(tmp_path, 'kind = "position"\nkp = 3.0\ndelay = 0.03'))
    lacking = servo_model(_servo(tmp_path, 'kind = "position"\nkp = 3.0'), (InputDelay.of(0.03, joint=1),))
    late, other = jax.jit(lambda seq: (declared.inputs(seq), lacking.inputs(seq)))(seq)
    np.testing.assert_allclose(late.u, 3.0 * np.concatenate([np.repeat(seq.u[:1], 3, axis=0), seq.u[:-3]]), rtol=1e-12)
    np.testing.assert_allclose(late.before[1:], late.u[:-1])
    np.testing.assert_allclose(other.u, late.u, rtol=1e-12)


def test_a_voltage_is_a_velocity_servo_of_its_own_gain(tmp_path):
    k, r = 0.3, 2.0
    driven = servo_model(_servo(tmp_path, f'kind = "voltage"\nk = {k}\nR = {r}\nlimit = 0.4\nbias = 0.01'))
    servo = servo_model(_servo(tmp_path, f'kind = "velocity"\nkv = {k * k / r}\nlimit = 0.4\nbias = 0.01'))
    x, u = [[0.1, 1.0], [0.1, 2.0], [0.1, -4.0]], np.array([[3.0], [-0.2], [9.0]])
    np.testing.assert_allclose(_drives([driven], x, u)[0], _drives([servo], x, u / k)[0], rtol=1e-12)


# --- what is declared


def test_numbers_of_a_column_stand_before_those_of_all(tmp_path):
    text = """[input]
columns = ["goal1", "goal2"]
joints = [1, 2]
kind = "position"
kp = { mean = 8.0, std = 2.0 }
delay = 0.02
goal2 = { kind = "velocity", kv = 0.4, delay = { mean = 0.01, std = 0.005 } }
"""
    rig = _rig(tmp_path, text, model=ACROBOT)
    assert rig.kinds == {"goal1": "position", "goal2": "velocity"}
    numbers = {name: (x.mean, x.std) for name, x in rig.parameters.items() if name not in rig.bodies}
    assert numbers == {
        "goal1.kp": (8.0, 2.0), "goal1.delay": (0.02, 0.0), "goal2.kv": (0.4, 0.0), "goal2.delay": (0.01, 0.005),
    }  # fmt: skip
    assert (rig.unit("goal1.kp"), rig.unit("goal2.kv"), rig.unit("goal2.delay")) == ("N m/rad", "N m s/rad", "s")
    assert "goal1 (position) on joint 1, goal2 (velocity) on joint 2" in str(rig)
    assert written_again(rig, tmp_path) == rig


def test_a_file_gives_what_rig_toml_leaves_out(tmp_path):
    rig = _of_file(tmp_path, ACTUATORS["limited"], "[input]\nkp = { mean = 10.0, std = 3.0 }")
    numbers = {"goal.kp": Declared(10.0, 3.0), "goal.kd": Declared(0.3, 0.0), "goal.limit": Declared(30.0, 0.0)}
    assert (rig.kinds, rig.parameters, build_system(rig).gears) == ({"goal": "position"}, numbers, (-3.0,))
    assert written_again(rig, tmp_path) == rig
    late = _of_file(tmp_path, '<position name="goal" joint="a" kp="12" delay=".02" nsample="3"/>')
    assert late.parameters["goal.delay"] == Declared(0.02, 0.0)
    assert _of_file(tmp_path, ACTUATORS["position on a slide"]).unit("goal.kp") == "N/m"
    motor = '<motor name="goal" joint="a" gear="50"/>'  # it may be declared a servo of its joint
    rig = _of_file(tmp_path, motor, '[input]\nkind = "position"\nkp = 5.0')
    assert (rig.kinds, build_system(rig).gears) == ({"goal": "position"}, (1.0,))
    assert build_system(_of_file(tmp_path, motor)).gears == (50.0,)


KP = "kp = { mean = 3.0, std = 1.0, at = { gain = 200.0, supply = 7.4 } }"
LIMIT = "limit = { mean = 0.6, std = 0.0, at = { supply = 7.4 } }"
BAD_LINES = {
    "no gain": (SERVO, r"\[input\] kp: missing: the input 'goal' of kind 'position' needs its kp; write"),
    "no kind": ("kp = 3.0", r"\[input\] kp: no input has a kp \(kinds: torque\); write kind = \"position\""),
    "negative gain": (f"{SERVO}kp = -3.0", r"found -3; write a number above 0 \[N m/rad\]"),
    "of another kind": (
        '[input.goal]\nkind = "velocity"\nkp = 3.0',
        r"\[input.goal\] kp: an input of kind 'velocity' has no kp; possible are kv, bias",
    ),
    "at zero": (SERVO + KP.replace("7.4", "0"), r"\[input.kp.at\] supply: found 0; write a number above 0"),
    "at a state": (SERVO + KP.replace("supply", "theta1"), "at: 'theta1' is the time, a state or an input; name a col"),
    "late by a column": (
        f"{SERVO}{KP}\ndelay = {{ mean = 0.01, std = 0.0, at = {{ gain = 1.0 }} }}", "the same in all rows; take it",
    ),
    "muscle": ("<muscle name='goal' joint='a' lengthrange='0 1'/>",
        "actuator 'goal' is no motor, .*gain: muscle.*; log the torque"),
    "gain by position": ("<general name='goal' joint='a' gaintype='affine' gainprm='1 2 0'/>",
        r"actuator 'goal' is no motor, servo or damper"),
    "one-sided": ("<position name='goal' joint='a' kp='3' forcerange='-1 2'/>",
        r"limited to -1 \.\.\. 2; make it symmetric about 0"),
}  # fmt: skip


@pytest.mark.parametrize("lines, message", BAD_LINES.values(), ids=BAD_LINES)
def test_a_mistake_is_refused_with_its_mend(tmp_path, lines, message):
    with pytest.raises(RigError, match=message) as error:
        (_of_file if lines.startswith("<") else _servo)(tmp_path, lines)
    assert lines.startswith("<") or str(tmp_path / "rig.toml") in str(error.value)


# --- what cannot be told


def test_what_scales_with_the_gain_and_what_friction_does_is_said(tmp_path):
    free = PENDULUM.replace("m = 0.5", "m = { mean = 0.5, std = 0.1 }")
    free = free.replace("I = 0.002", "I = { mean = 0.002, std = 0.001 }")
    lines = 'kind = "position"\nkp = { mean = 9.0, std = 3.0 }\nkd = { mean = 0.2, std = 0.1 }\n'
    rig = _servo(tmp_path, lines + "delay = { mean = 0.01, std = 0.01 }\nlimit = { mean = 3.0, std = 1.0 }", model=free)
    result = identifiability(rig, build_system(rig), build_servos(rig))
    rubbed = ("goal.kd", "the learned friction of joint 1")
    assert [set(group) for group in result.together] == [{"m", "I", "goal.kp", *rubbed}]
    assert "goal.kd, the learned friction of joint 1 only in combination" in sentences(result)[0]


# --- numbers that are proportional to columns of the logs

GAIN, SUPPLY = 400.0, 5.5


def _log(path: Path, supply: float = SUPPLY) -> Path:
    """A folder with one log."""
    lines = ["time,goal,gain,supply,theta1"]
    for k in range(40):
        lines.append(f"{0.01 * k:.12g},{np.sin(0.3 * k):.9g},{GAIN},{supply},{0.4 * np.sin(0.3 * k - 0.5):.9g}")
    (path / "train").mkdir(exist_ok=True)
    (path / "train" / "a.csv").write_text("\n".join(lines) + "\n")
    return path / "train"


def _declared(path: Path, lines: str):
    rig = _servo(path, SERVO + lines)
    return servo_model(rig), read_logs(_log(path), rig).data


def test_numbers_are_proportional_to_their_columns(tmp_path):
    """Twice the number at twice the value is the same servo, along states and at each."""
    once = _declared(tmp_path, f"{KP}\n{LIMIT}\nkd = 0.25")
    twice = _declared(tmp_path, KP.replace("3.0", "6.0").replace("200.0", "400.0") + f"\n{LIMIT}\nkd = 0.25")
    x = np.random.default_rng(0).uniform(-1.0, 1.0, (40, 2))
    kp, limit = 3.0 * GAIN / 200.0 * SUPPLY / 7.4, 0.6 * SUPPLY / 7.4
    torque = kp * (once[1].u[0, :, 0] - x[:, 0]) - 0.25 * x[:, 1]

    def drives(model, data):
        u = model.inputs(jax.tree.map(lambda a: jnp.asarray(a[0]), data))
        return jax.vmap(lambda x, u: model.scene(x, u).drive)(x, u), model.driving((), x, u)

    for drive in jax.tree.leaves(jax.jit(lambda x: [drives(*one) for one in (once, twice)])(x)):
        np.testing.assert_allclose(drive[:, 0], np.clip(torque, -limit, limit), rtol=1e-12)
    assert 0 < np.sum(np.abs(torque) > limit) < 40


def test_a_declaration_is_written_and_stored_as_it_is(tmp_path):
    rig = _servo(tmp_path, SERVO + f"{KP}\n{LIMIT}")
    fit = begin(rig, read_logs(_log(tmp_path), rig).data, key=jax.random.key(0))
    assert rig.input_scales == {"goal.kp": {"gain": 200.0, "supply": 7.4}, "goal.limit": {"supply": 7.4}}
    assert (rig.scale_columns, rig.logged_inputs) == (("gain", "supply"), ("goal", "gain", "supply"))
    assert rig.parameters["goal.kp"] == Declared(3.0, 1.0)
    assert "goal.kp by gain and supply" in str(rig)
    assert written_again(rig, tmp_path) == rig
    own = _servo(tmp_path, f"{SERVO}{KP}\n[input.goal]\nkp = 2.0")
    assert (own.input_scales, own.parameters["goal.kp"]) == ({}, Declared(2.0, 0.0))
    save(tmp_path / "model.npz", fit)
    again = load(tmp_path / "model.npz")
    assert again.rig == rig
    assert again.state.model.servos[0].scales == fit.state.model.servos[0].scales != ()
    with pytest.raises(ExportError, match="its inputs are commands of servos"):
        write_model(again, tmp_path / "out")


def test_millivolts_in_a_log_are_refused_with_file_and_column(tmp_path):
    rig = _servo(tmp_path, SERVO + KP)
    said = r"column 'supply': at most 7400, where rig.toml declares goal.kp at 7.4; write"
    with pytest.raises(DataError, match=said) as error:
        read_logs(_log(tmp_path, supply=7400.0), rig)
    assert "a.csv" in str(error.value)
