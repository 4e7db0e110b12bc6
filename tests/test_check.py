"""The check before a fit: closed forms where there are any, and data sets that are bad in one known way."""

import re
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import file_rig, nnap, rig_of
from helpers import slide as slide_model

from nnap_em.errors import RigError
from nnap_em.estimate.em.build import build_system, measure_scales
from nnap_em.explain.check import Along, CheckResult, check, gramian, torques, undetermined
from nnap_em.explain.check import _motion as motion
from nnap_em.explain.check import _observability as observability
from nnap_em.explain.check import _sampling as sampling
from nnap_em.logs.dataset import Dataset
from nnap_em.logs.read import REPEAT, Logs, Masked
from nnap_em.machines.rig import Declared, Rig
from nnap_em.machines.systems.acrobot import table_i
from nnap_em.model.simulate import examples, sweep_experiment

ROWS, COUNT = 201, 6


def _rig(measured: tuple[str, ...] = ("x", "dx"), noise: dict[str, float] | None = None, dt: float = 0.01) -> Rig:
    declared = {"x": 1e-3, "dx": 5e-3} if noise is None else noise
    declared = {name: std for name, std in declared.items() if name in measured}
    return Rig("s", "slide", {"m": Declared(1.0, 0.0)}, True, ("u",), (1,), dt, "sequence", measured, declared, {})


@pytest.fixture(scope="module")
def slide() -> Logs:
    """Slides with both states read at the noise that `_rig` declares."""
    model, sweep = examples["slide"]()
    experiment = sweep_experiment(model, sweep, COUNT, ROWS - 1, key=jax.random.key(0))
    noise = np.random.default_rng(0).normal(size=experiment.x.shape) * [1e-3, 5e-3]
    data = Dataset(*(np.asarray(a) for a in experiment.data))
    return _logs(data._replace(y=np.asarray(experiment.x) + noise))


def _logs(data: Dataset) -> Logs:
    return Logs(tuple(f"{i:03d}.csv" for i in range(len(data.t))), data, ("u", "x", "dx"))


def _report(logs: Logs, rig: Rig | None = None, test: Logs | None = None) -> dict[str, list[tuple[str, str]]]:
    report: dict[str, list[tuple[str, str]]] = {}
    for mark, subject, text in check(rig or _rig(), logs, test, key=jax.random.key(0)):
        report.setdefault(subject, []).append((mark, text))
    return report


def test_a_good_data_set_is_all_ok(slide):
    report = _report(slide, test=slide)
    assert {mark for answers in report.values() for mark, _ in answers} == {"ok"}
    subjects = "length test missing rate sampling noise torque dynamics motion states"
    assert list(report) == subjects.split()
    assert f"{COUNT} training sequences, 12.1 s, {COUNT * ROWS} rows" in report["length"][0][1]
    assert "2 of 2 directions" in report["states"][0][1]


UPRIGHT = """
<mujoco>
  <worldbody><body name="column"><joint name="pan" axis="0 0 1"/>
    <inertial pos="0 0 0" mass="4" diaginertia=".02 .02 .02"/>
    <body name="roll" pos="0 0 .3"><joint name="shoulder" axis="0 1 0"/>
      <inertial pos="0 0 .1" mass="3" diaginertia=".02 .02 .02"/>
      <body name="upper" pos="0 0 .3"><joint name="twist" axis="0 0 1"/>
        <inertial pos="0 0 0" mass="2" diaginertia="1e-4 1e-4 1e-4"/>
        <body name="lower"><joint name="elbow" axis="0 1 0"/>
          <inertial pos="0 0 .4" mass="2" diaginertia="1e-4 1e-4 1e-4"/></body></body></body></body></worldbody>
  <actuator><motor name="tau" joint="twist"/></actuator>
</mujoco>
"""
"""Its joint `twist` bears nothing while the arm is upright; with shoulder and elbow at a quarter turn and half a turn
of its own between them, 2 kg act 0.4 m off its axis: 7.8 N m."""


def test_torques_are_held_against_the_loads_along_the_log(tmp_path):
    """In the unit of the file all is well, a thousand times too large is not, and with loads at zero neither was."""
    (tmp_path / "arm.xml").write_text(UPRIGHT)
    rig = rig_of(tmp_path, file_rig("arm.xml", ("pan", "shoulder", "twist", "elbow"), dt=0.1))
    t = 0.1 * np.arange(ROWS)
    way = np.pi / 4 * (1 - np.cos(0.1 * np.pi * t))  # so slowly that inertia asks for nothing
    y, system = np.stack([0 * t, way, way, way], axis=1), build_system(rig)
    load = 2 * 9.81 * 0.4 * np.sin(way) ** 3

    def torque(factor: float) -> CheckResult:
        data = Dataset(t[None], factor * load[None, :, None], y[None], np.ones((1, ROWS), bool))
        return next(f for f in torques(rig, system, data, measure_scales(rig, system, data)) if f.subject == "torque")

    assert torque(1.0).mark == "ok"
    assert re.search(r"up to 7.8\d N m, gravity and inertia of joint 3 need 7.[89]", torque(1.0).text)
    assert [torque(1e3).mark, torque(1e-4).mark] == ["error", "error"]


def test_bodies_that_make_no_machine_are_bad_and_nothing_else_is_tried():
    """Acrobot with an inertia of link 2 below -m2 lc2^2: its mass matrix has a negative eigenvalue."""
    rig, logs = _acrobot()
    rig = replace(rig, parameters={**rig.parameters, "I2": Declared(-0.006, 0.0)})
    mark, text = _report(logs, rig)["bodies"][0]
    assert mark == "error" and "the declared masses and inertias make no machine" in text
    with pytest.raises(RigError, match="rig 'a': the declared masses and inertias make no machine"):
        build_system(rig)


def test_the_gramian_of_a_double_integrator():
    """Positions alone, read at k dt: sum [[1, k dt], [k dt, (k dt)^2]]."""
    dt, rows = 0.1, 7
    a = np.tile([[1.0, dt], [0.0, 1.0]], (rows, 1, 1))
    c = np.tile([[2.0, 0.0]], (rows, 1, 1))
    t = dt * np.arange(rows)
    wanted = 4 * np.array([[rows, t.sum()], [t.sum(), (t**2).sum()]])
    np.testing.assert_allclose(gramian(a, c, np.ones(2)), wanted, rtol=1e-12)
    np.testing.assert_allclose(gramian(a, c, np.array([3.0, 0.5])), wanted * np.outer([3, 0.5], [3, 0.5]), rtol=1e-12)


@pytest.mark.parametrize("size", [1.0, 1e20])
def test_a_sum_of_states_read_exactly_determines_neither(size):
    """A reading of their sum leaves the variance 1/2 of each; inverted as a matrix, the larger one is singular."""
    left = undetermined(size * np.ones((2, 2)))
    np.testing.assert_allclose(left, np.sqrt(0.5 + 0.5 / (1 + 2 * size)), rtol=1e-7)


def test_a_place_that_nothing_tells_is_named():
    """The rate of a slide does not depend on its position, so that the position is not determined."""
    turn = np.broadcast_to([[1.0, 0.01], [0.0, 1.0]], (1, 101, 2, 2))
    along = Along(
        np.random.default_rng(0).normal(size=(1, 101, 2)), turn, np.broadcast_to([[0.0, 1.0]], (1, 101, 1, 2))
    )
    model = replace(slide_model()[0], dt=0.01, measured=(1,), log_r=2 * jnp.log(jnp.full(1, 5e-3)))
    (finding,) = observability(model, along, np.ones((1, 101), bool))
    assert finding.mark == "warning"
    assert "1 of 2 directions" in finding.text and "not determined: x" in finding.text


ROW = np.arange(ROWS)
CASES = {  # the words of the check: the change of the readings, of another part of the logs, or of the rig
    "length | error | too few": {"valid": lambda v: v & (ROW < 15)},
    "length | warning | 0.5 s": {"valid": lambda v: v & (ROW < 50)},
    "missing | warning | x: 67 %": {"y": lambda y: np.where((ROW % 3 > 0)[None, :, None], np.nan, y)},
    "missing | error | x: 80 %": {"y": lambda y: np.where((ROW % 20 > 3)[None, :, None], np.nan, y)},
    "torque | error | look at its unit (N)": {"u": lambda u: 1000 * u},
    "motion | warning | one direction only": {"y": lambda y: np.stack([y[..., 0], np.abs(y[..., 1])], -1)},
    "motion | error | hardly moves": {"y": lambda y: y * [1.0, 0.01]},
    "motion | warning | it rests most": {"y": lambda y: y * np.where(ROW < 20, 1.0, 1e-3)[None, :, None]},
    "noise | warning | declare more": {"y": lambda y: y + 0.01 * np.random.default_rng(1).normal(size=y.shape)},
    "noise | warning | was filtered": {"rig": _rig(noise={"x": 1e-3, "dx": 0.1})},
    "noise | error | the motion hardly rises above it": {"rig": _rig(noise={"x": 50.0, "dx": 50.0})},
    "states | error | 0 of 2": {"rig": _rig(noise={"x": 50.0, "dx": 50.0})},  # which tell no velocity
}


def test_what_is_bad_is_found(slide):
    for words, change in CASES.items():
        subject, mark, text = words.split(" | ")
        parts = {name: how(getattr(slide.data, name)) for name, how in change.items() if name != "rig"}
        answers = _report(_logs(slide.data._replace(**parts)), change.get("rig"))[subject]
        assert any(actual == mark and text in said for actual, said in answers), answers
    report = _report(_logs(Dataset(*(part[:, :2] for part in slide.data))))
    assert list(report) == ["length", "test", "missing"] and report["length"][0][0] == "error"


def test_slow_sampling_is_noticed(slide):
    """Every 10th row: half a second of a sweep is five rows."""
    rig, slow = _rig(dt=0.1), Dataset(*(part[:, ::10] for part in slide.data))
    still = Along(*(np.zeros((1, 11, *shape)) for shape in ((2,), (2, 2), (2, 2), (2, 2))))
    (finding,) = sampling(rig, still, measure_scales(rig, build_system(rig), slow))
    assert finding.mark == "warning" and "sample faster" in finding.text


def test_a_slow_machine_is_judged_as_a_quick_one(slide, slower=6000.0):
    """The same motion in so many times as long a unit of time, 60 s a sample."""
    data, rigs = slide.data, (_rig(), _rig(dt=0.01 * slower))
    slow = data._replace(t=slower * data.t, u=data.u / slower**2, y=data.y / [1.0, slower])
    quick, scales = (measure_scales(r, build_system(r), d) for r, d in zip(rigs, (data, slow), strict=True))
    np.testing.assert_allclose(scales.speed, quick.speed / slower, rtol=1e-9)
    np.testing.assert_allclose(scales.acceleration, quick.acceleration / slower**2, rtol=1e-9)


def test_a_machine_at_one_speed_has_come_to_it_within_a_sequence(slide):
    """Its acceleration is not that which noise shows, nor its speed per second."""
    y = np.full((*slide.data.t.shape, 1), 3.0)
    scales = measure_scales(_rig(("dx",)), build_system(_rig()), slide.data._replace(y=y))
    np.testing.assert_allclose(scales.acceleration, 3.0 / (ROWS * 0.01))


def test_a_held_reading_is_said_and_its_repeats_are_no_lost_samples(slide):
    """Each stands in 10 rows; 90 % of the samples missing would be an error."""
    data = slide.data._replace(y=np.where((ROW % 10 == 0)[None, :, None], slide.data.y, np.nan))
    masked = tuple(Masked(file, REPEAT, name, 2, 0.01, ROWS - 21) for file in slide.files for name in ("x", "dx"))
    report = _report(replace(slide, data=data, masked=masked))
    assert report["missing"] == [("ok", f"{name}: 0 % of the samples are missing") for name in ("x", "dx")]
    assert [mark for mark, _ in report["held"]] == ["warning", "warning"] and "rough" not in report
    assert report["held"][0][1].startswith(
        f"x: held: 1080 in {COUNT} of {COUNT} files, most in 000.csv; each reading stands in 9.57 rows"
    )


def test_the_command_prints_a_line_per_question_and_fails_where_one_is_bad(tmp_path, capsys):
    folder = tmp_path / "bench"
    size = "--sequences", COUNT, "--test", 1, "--steps", ROWS - 1
    assert nnap("simulate", folder, "--system", "slide", "--measured", "x", "dx", *size) == 0
    before = sorted(tmp_path.rglob("*"))
    capsys.readouterr()
    assert nnap("check", folder) == 0
    good = capsys.readouterr()
    assert "the logs allow a fit" in good.err
    assert all(re.match(r"(ok|warning)  *[a-z]+ +\S", line) for line in good.out.splitlines())
    rig = (folder / "rig.toml").read_text()
    (folder / "rig.toml").write_text(rig.replace("m = 1.0 ", "m = 1e6 "))  # in mg
    assert nnap("check", folder) == 1
    bad = capsys.readouterr()
    assert "nnap-em: 2 errors" in bad.err
    found = re.search(r"(?m)^error    dynamics    u is in another unit: multiply it by (\S+) ", bad.out)
    assert found and float(found[1]) == pytest.approx(1e6, rel=0.02)  # derivatives of noisy positions: 1 % here
    assert sorted(tmp_path.rglob("*")) == before


def _acrobot() -> tuple[Rig, Logs]:
    """The paper's experiment, of which joint 1 is read."""
    model, sweep = examples["acrobot"]()
    data = sweep_experiment(model, sweep, 4, 150, key=jax.random.key(0)).data
    parameters = {name: Declared(value, 0.0) for name, value in table_i.items()}
    measured = tuple(("theta1", "theta2", "dtheta1", "dtheta2")[i] for i in model.measured)
    rig = Rig("a", "acrobot", parameters, True, ("u",), (2,), 0.01, "sequence", measured, {}, {})
    return rig, Logs(tuple("abcd"), Dataset(*(np.asarray(part) for part in data)), ("u", *measured))


def test_logs_that_the_model_cannot_follow_are_an_error():
    """Joint 2 of an arm is not read, and its smoothed states are no numbers."""
    (rig, logs), model = _acrobot(), examples["acrobot"]().model
    along = Along(*(np.full((4, 101, *shape), np.nan) for shape in ((4,), (4, 4), (len(rig.measured), 4))))
    (states,) = observability(model, along, np.ones((4, 101), bool))
    assert states.mark == "error" and "the declared model cannot follow the logs" in states.text
    first, second = motion(rig, model, logs.data, along)
    assert first.text.startswith("joint 1: ")
    assert second.mark == "error" and "joint 2 (never seen, by the declared model): no velocity" in second.text


@pytest.mark.slow  # fast: test_the_gramian_of_a_double_integrator, test_a_good_data_set_is_all_ok
def test_the_acrobot_with_a_hidden_joint_passes():
    """Joint 1 tells all four states."""
    rig, logs = _acrobot()
    report = _report(logs, rig)
    assert "error" not in {mark for answers in report.values() for mark, _ in answers}
    assert "4 of 4 directions" in report["states"][0][1]
    assert any("joint 2 (never seen, by the declared model)" in text for _, text in report["motion"])
