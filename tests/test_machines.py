"""Machines from files: the physics against MuJoCo's own, names and numbers as the file has them, bad files refused."""

import dataclasses
import re
import sys
from pathlib import Path
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from helpers import file_rig, written_again
from machines import arm, tree

from nnap_em.data.dataset import Dataset
from nnap_em.data.machine import packed, unpacked
from nnap_em.data.rig import Declared, RigError, RigWarning, read_rig
from nnap_em.effects import catalogue
from nnap_em.em.build import build, build_system
from nnap_em.em.prior import ParameterPrior
from nnap_em.experiment.experiment import Design
from nnap_em.experiment.information import Fit
from nnap_em.fit.identifiability import identifiability, sentences
from nnap_em.machines.mjcf import read_machine
from nnap_em.model.simulate import examples
from nnap_em.numerics.gaussian import spd_solve
from nnap_em.report.design import parameter_entries
from nnap_em.systems import specs
from nnap_em.systems.bodies import physical
from nnap_em.systems.pseudo_inertia import Numbers, of_pseudo, pseudo, stepped

ROOT = Path(__file__).resolve().parents[1]
OWN = sorted((ROOT / "tests" / "machines").iterdir())
SHIPPED = [ROOT / "examples" / "machines" / name for name in ("cartpole.xml", "furuta.xml")]
ARMS = 1, 5


def _arm(folder: Path, joints: int = 3) -> Path:
    (folder / "arm.xml").write_text(arm(joints))
    return folder / "arm.xml"


@pytest.fixture(
    params=[*OWN, *SHIPPED, *ARMS],
    ids=lambda p: getattr(p, "name", f"arm{p}"),
)
def machine_file(request, tmp_path) -> Path:
    """A machine of each kind: chain, branch, slide, gear, armature, rotated frames, offset joints, URDF."""
    return request.param if isinstance(request.param, Path) else _arm(tmp_path, request.param)


def _mujoco(path: Path) -> mujoco.MjModel:
    if path.suffix != ".urdf":
        return mujoco.MjModel.from_xml_path(str(path))
    return mujoco.MjModel.from_xml_string(re.sub(r"(?s)<visual>.*?</visual>", "", path.read_text()))


def _states(model: mujoco.MjModel, count: int = 6) -> np.ndarray:
    """Coordinates and rates, a state a row."""
    return np.random.default_rng(0).uniform(-3.0, 3.0, (count, 2, model.nv))


def _physics(model: mujoco.MjModel, states: np.ndarray):
    """Mass matrices, and forces without acceleration, of MuJoCo."""
    data, mass = mujoco.MjData(model), np.zeros((len(states), model.nv, model.nv))
    bias = np.zeros((len(states), model.nv))
    for k, (data.qpos[:], data.qvel[:]) in enumerate(states):
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, mass[k])
        bias[k] = data.qfrc_bias - data.qfrc_spring
    return mass, bias


def _each(function, *rows):
    """A function of each row, in one small program: a loop is compiled sooner than what `vmap` makes of scalars."""
    return jax.jit(lambda rows: jax.lax.map(lambda row: function(*row), rows))(jax.tree.map(jnp.asarray, rows))


def _mass_and_bias(system):
    return lambda x: (system.mass(x[0]), system.bias(x[0], x[1]))


def _acceleration(system, x, force):
    return jnp.stack(system.acceleration(*x, force))


def _by_mass_matrix(system, x, force):
    return spd_solve(system.mass(x[0]), force - system.bias(*x))


def test_mass_bias_and_acceleration_are_those_of_mujoco(machine_file):
    model, system = _mujoco(machine_file), tree(machine_file)
    states, forces = _states(model), np.linspace(-1.0, 1.0, 6 * model.nv).reshape(6, -1)

    def own(x, force):
        return *_mass_and_bias(system)(x), _acceleration(system, x, force)

    ours, bias, rate = _each(own, states, forces)
    mass, truth = _physics(model, states)
    np.testing.assert_allclose(ours, mass, atol=1e-12, rtol=1e-12)
    np.testing.assert_allclose(bias, truth, atol=1e-11, rtol=1e-12)
    other = np.linalg.solve(mass, (forces - truth)[..., None])[..., 0]
    np.testing.assert_allclose(rate, other, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", ["branch.xml", "arm3"])
def test_derivatives_of_the_acceleration_are_those_of_the_mass_matrix(name, tmp_path):
    """Directional derivatives by states, forces and uncertain numbers; the reverse mode of the arm gives the same."""
    backwards, rng = name == "arm3", np.random.default_rng(1)
    known = ROOT / "tests" / "machines" / name
    system = build_system(read_rig(_rig(tmp_path, arm(3), model=UNCERTAIN), specs)) if backwards else tree(known)
    dof, values = len(system.coordinates), system.values
    shares, x, force = rng.uniform(0.9, 1.1, (6, len(values))), rng.normal(size=(6, 2, dof)), rng.normal(size=(6, dof))
    at = (
        {name: jnp.asarray(shares[:, i]) * values[name] for i, name in enumerate(values)},
        jnp.asarray(x),
        jnp.asarray(force),
    )
    way = jax.tree.map(lambda a: jnp.asarray(rng.normal(size=a.shape)), at)

    def both(at, way):
        of = lambda rule: lambda values, *rest: rule(system.with_parameters(values), *rest)  # noqa: E731
        out = [jax.jvp(of(rule), at, way)[1] for rule in (_acceleration, _by_mass_matrix)]
        if backwards:
            pulled = jax.vjp(of(_acceleration), *at)[1](jnp.arange(1.0, 4.0))
            out += [sum(jnp.sum(a * b) for a, b in zip(*map(jax.tree.leaves, (pulled, way)), strict=True))]
        return out

    own, truth, *along = _each(both, at, way)
    np.testing.assert_allclose(own, truth, rtol=1e-8, atol=1e-8)
    for pulled in along:
        np.testing.assert_allclose(pulled, own @ np.arange(1.0, 4.0), rtol=1e-8, atol=1e-8)


def test_drive_is_that_of_mujocos_motors(tmp_path):
    path = ROOT / "tests" / "machines" / "branch.xml"
    system, model = build_system(read_rig(_rig(tmp_path, path, measured=("left",)), specs)), _mujoco(path)
    data = mujoco.MjData(model)
    data.ctrl[:] = u = np.array([0.3, -0.2, 0.7])
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(system.drive(jnp.asarray(u)), data.qfrc_actuator, atol=1e-14)


def test_acrobot_of_the_file_is_the_built_in_one():
    parsed, built = tree(ROOT / "examples" / "machines" / "acrobot.xml"), examples["acrobot"]().model.system
    x = np.array([[[0.7, -1.9], [2.0, 5.0]]])
    (mass, bias), (other, truth) = (_each(_mass_and_bias(system), x) for system in (parsed, built))
    np.testing.assert_allclose(mass, other, rtol=1e-13)
    np.testing.assert_allclose(bias, truth, rtol=1e-12)


# --- rig.toml


def _rig(folder: Path, machine: Path | str, *, measured=("joint1",), model: str = "", rest: str = "") -> Path:
    """A rig.toml beside a machine file, which is copied or written."""
    name = machine.name if isinstance(machine, Path) else "machine.xml"
    (folder / name).write_text(machine.read_text() if isinstance(machine, Path) else machine)
    (folder / "rig.toml").write_text(file_rig(name, measured, f"{model}\n{rest}"))
    return folder / "rig.toml"


UNCERTAIN = """[model.uncertain]
link2.mass = { std = 0.1 }
link2.com.x = { mean = 0.012, std = 0.01 }
"link3.inertia.yy" = { std = 0.001 }
joint3.armature = 0.02
"""


def test_names_inputs_and_uncertain_numbers_are_those_of_the_file(tmp_path):
    rig = read_rig(_rig(tmp_path, arm(3), model=UNCERTAIN), specs)
    system = build_system(rig)
    assert system.coordinates == ("joint1", "joint2", "joint3")
    assert system.rates == ("djoint1", "djoint2", "djoint3")
    assert (rig.input_columns, rig.input_joints) == (("tau1", "tau2", "tau3"), (1, 2, 3))
    assert rig.parameters["link2.mass"] == Declared(2.5, 0.1)
    assert rig.parameters["link2.com.x"] == Declared(0.012, 0.01)
    assert rig.parameters["joint3.armature"] == Declared(0.02, 0.0)
    assert [rig.unit(n) for n in ("djoint2", "link2.mass", "link2.com.x", "joint3.armature")] == [
        "rad/s", "kg", "m", "kg m^2",
    ]  # fmt: skip
    assert float(system.parameter("link3.inertia.yy")) == pytest.approx(0.9 * 0.015)


@pytest.mark.parametrize(("joints", "read", "starts"), [(2, 2, 25), (2, 1, 325), (3, 3, 1), (3, 2, 65), (6, 5, 65)])
def test_starts_that_are_tried_do_not_grow_with_the_joints_that_are_read(joints, read, starts, tmp_path):
    """5 for a rate, 13 for an angle; of two joints the whole grid."""
    rig = read_rig(_rig(tmp_path, arm(joints), measured=[f"joint{i + 1}" for i in range(read)]), specs)
    t = 0.01 * np.arange(50.0)
    y = np.tile(2.0 * np.sin(4.0 * t)[None, :, None], (2, 1, read))
    logs = Dataset(np.tile(t, (2, 1)), np.zeros((2, 50, joints)), y, np.ones((2, 50), bool))
    assert build(rig, logs, key=jax.random.key(0)).bank.offsets.shape == (starts, 2 * joints)


def test_written_rig_reads_the_same(tmp_path):
    rig = read_rig(_rig(tmp_path, arm(3), model=UNCERTAIN), specs)
    assert written_again(rig, tmp_path) == rig
    named = read_rig(_rig(tmp_path, arm(3), rest='[input]\ncolumns = ["u"]\njoints = ["joint2"]'), specs)
    assert (named.input_columns, named.input_joints) == (("u",), (2,))
    assert written_again(named, tmp_path) == named


def test_a_state_is_called_as_the_sensor_that_is_measured(tmp_path):
    path = _rig(tmp_path, ROOT / "tests" / "machines" / "branch.xml", measured=("left_pos", "right"))
    system = build_system(read_rig(path, specs))
    assert system.coordinates == ("trunk_x", "trunk_turn", "left_pos", "right", "grip")
    assert system.unit("trunk_x") == "m" and system.force_unit(5) == "N"


def test_changed_numbers_move_the_physics_as_in_mujoco(tmp_path):
    rig = read_rig(_rig(tmp_path, arm(3), model=UNCERTAIN), specs)
    system = build_system(rig).with_parameters({"link2.mass": jnp.asarray(2.0)})
    model = mujoco.MjModel.from_xml_string(arm(3))
    model.body_mass[2] = 2.0
    model.body_ipos[2][0], model.dof_armature[2] = 0.012, 0.02
    states = _states(model)
    np.testing.assert_allclose(_each(lambda x: system.mass(x[0]), states), _physics(model, states)[0], atol=1e-12)


def test_friction_of_the_file_acts_where_none_is_learned_and_is_left_out_where_it_is(tmp_path):
    text = arm(2).replace('armature="0.05"', 'armature="0.05" damping="0.3" frictionloss="0.2"')
    with pytest.warns(RigWarning, match="damping and frictionloss of joint1 are left out"):
        learned = build_system(read_rig(_rig(tmp_path, text), specs))
    path = _rig(tmp_path, text)
    path.write_text(path.read_text().replace('"unknown"', '"none"'))
    known, q, v = build_system(read_rig(path, specs)), jnp.zeros(2), jnp.asarray([2.0, 1.0])
    np.testing.assert_allclose(known.bias(q, v) - learned.bias(q, v), [0.3 * 2.0 + 0.2, 0.0], atol=1e-12)


@pytest.mark.parametrize("name", ["branch.xml", "arm.urdf", "arm3"])
def test_a_payload_of_any_mass_and_centre_moves_the_machine_as_in_mujoco(name, tmp_path):
    """0.7 kg off the axis at each joint that carries loads, and at the spot of the last, added to its body by MuJoCo's
    own model editing.
    """
    path = _arm(tmp_path) if name == "arm3" else ROOT / "tests" / "machines" / name
    system, mass, states = tree(path), jnp.asarray(0.7), _states(_mujoco(path))
    loaded, truth, (*_, last) = [], [], system.variations
    assert last == ("payload", len(system.coordinates))
    for joint, away in [*((joint, [0.21, -0.12, 0.08]) for joint in system.spots), (last[1], [0.0, 0.0, 0.0])]:
        spot = system.spots[joint]
        effect = catalogue["payload"](mass, mass * jnp.asarray(away), spot.point, joint=joint)
        centre = np.add(spot.point, away)
        np.testing.assert_allclose([effect.values()[f"centre_{axis}"] for axis in "xyz"], centre, rtol=1e-12)
        loaded.append(effect.physics(system, jnp.zeros(())) if any(away) else system.vary(*last, mass))
        truth.append(_physics(_hung(path, system.machine.bodies[spot.body].name, 0.7, centre), states))
    for ours, theirs in zip(_each(lambda x: [_mass_and_bias(one)(x) for one in loaded], states), truth, strict=True):
        for part, other in zip(ours, theirs, strict=True):
            np.testing.assert_allclose(part, other, atol=1e-10, rtol=1e-12)


def _hung(path: Path, body: str, mass: float, centre: np.ndarray) -> mujoco.MjModel:
    """The machine of a file with a point mass on one of its bodies."""
    text = re.sub(r"(?s)<visual>.*?</visual>", "", path.read_text()) if path.suffix == ".urdf" else path.read_text()
    spec = mujoco.MjSpec.from_string(text)
    more = spec.body(body).add_body(name="load", pos=centre)
    more.mass, more.ipos, more.inertia, more.explicitinertial = mass, [0, 0, 0], [1e-15] * 3, True
    return spec.compile()


def test_a_load_of_no_mass_is_a_shift_of_the_centre_and_breaks_nothing(tmp_path):
    system = tree(_arm(tmp_path))
    q, v, way = jnp.asarray([0.3, -0.8, 1.1]), jnp.asarray([1.0, 2.0, -3.0]), jnp.asarray([1.0, 2.0, -1.0, 0.5])

    def forces(numbers):
        effect = catalogue["payload"](numbers[0], numbers[1:], system.spots[3].point, joint=3)
        parameters = jnp.stack(list(effect.values().values()))
        return jnp.concatenate([effect.physics(system, jnp.zeros(())).bias(q, v), parameters])

    (still, moved), slopes, unloaded = jax.jit(
        lambda: (jax.lax.map(forces, jnp.stack([0 * way, 1e-6 * way])), jax.jacrev(forces)(0 * way), system.bias(q, v))
    )()
    np.testing.assert_allclose(still[:3], unloaded, atol=1e-12)
    assert np.isfinite(slopes).all()
    np.testing.assert_allclose((moved - still)[:3], 1e-6 * slopes[:3] @ way, atol=1e-9)


def test_a_design_calls_numbers_of_a_file_and_of_effects_by_name_and_unit(tmp_path):
    rig = read_rig(_rig(tmp_path, arm(2), model="[model.uncertain]\nlink2.mass = {std = 0.1}"), specs)
    late = catalogue["input_delay"].of(0.004, joint=2)
    prior = ParameterPrior(("link2.mass", "0.delay"), jnp.asarray([2.0, 0.0]), jnp.asarray([0.1, 0.01]))
    system = build_system(rig)
    model = SimpleNamespace(system=system, effects=(late,), parameter=system.parameter)
    information = np.zeros((4, 4))
    fit = Fit(model, prior, jnp.zeros((2, 1)), jnp.eye(4), jnp.eye(4))
    design = Design(**dict.fromkeys(Design._fields))  # type: ignore[arg-type]
    design = design._replace(fit=fit, fitted=SimpleNamespace(rig=rig), expected=information, old=information)
    entries = parameter_entries(design)
    assert {name: entry["unit"] for name, entry in entries.items()} == {
        "link2.mass": "kg",
        "input delay at joint 2, delay": "s",
    }
    assert entries["input delay at joint 2, delay"]["value"] == pytest.approx(0.004)


def test_unphysical_bodies_have_no_numbers(tmp_path):
    rig = read_rig(_rig(tmp_path, arm(2), model="[model.uncertain]\nlink2.mass = {std = 0.1}"), specs)
    system = build_system(rig)
    mass = jax.jit(jax.vmap(lambda m: system.with_parameters({"link2.mass": m}).mass(jnp.zeros(2))))
    sound, negative = mass(jnp.asarray([2.5, -0.1]))
    assert np.isfinite(sound).all() and np.isnan(negative[1, 1])


def test_physical_says_the_same_as_the_pseudo_inertia():
    rng = np.random.default_rng(0)
    s = rng.normal(size=(40, 3, 3))
    half = s @ s.swapaxes(1, 2) + rng.uniform(-1.0, 1.0, (40, 1, 1)) * np.eye(3)
    inertia = np.trace(half, axis1=1, axis2=2)[:, None, None] * np.eye(3) - half
    accepted = jax.vmap(lambda one: physical(jnp.asarray(1.0), tuple(map(tuple, one))))(jnp.asarray(inertia))
    np.testing.assert_array_equal(accepted, np.linalg.eigvalsh(half).min(axis=1) > 0)
    assert 5 < np.sum(accepted) < 35


WHOLE = [f"link2.{what}" for what in ("mass", "com.x", "com.y", "com.z")]
WHOLE += [f"link2.inertia.{pair}" for pair in ("xx", "xy", "xz", "yy", "yz", "zz")]


def test_a_step_of_a_whole_body_ends_at_one_that_can_be(tmp_path):
    uncertain = "[model.uncertain]\n" + "\n".join(f"{name} = {{std = 0.1}}" for name in WHOLE)
    before = build_system(read_rig(_rig(tmp_path, arm(2), model=uncertain), specs))
    values = np.asarray([float(before.values[name]) for name in WHOLE])
    ways = np.maximum(np.abs(values), 1e-3) * np.random.default_rng(0).normal(size=(5, len(WHOLE)))

    def stepped_by(way):
        far = before.with_parameters(dict(zip(WHOLE, values + way, strict=True)))
        kept = far.reached_from(before)
        at_rest = [system.mass(jnp.zeros(2)) for system in (far, kept)]
        return *at_rest, *(jnp.stack([system.values[name] for name in WHOLE]) for system in (far, kept))

    far, kept, *_ = jax.jit(jax.vmap(stepped_by))(jnp.asarray(20.0 * ways))
    assert np.isnan(far[:, 1, 1]).all() and np.linalg.eigvalsh(kept).min() > 0
    *_, near, reached = jax.jit(jax.vmap(stepped_by))(jnp.asarray(1e-3 * ways))
    np.testing.assert_array_equal(near, reached)


def test_no_armature_goes_below_0(tmp_path):
    """Neither in a step nor by the rounding of its prior; other numbers have no bound of their own."""
    uncertain = "[model.uncertain]\nlink2.mass = {std = 0.1}\njoint1.armature = {std = 0.07}\njoint2.armature = {std=1}"
    rig = read_rig(_rig(tmp_path, arm(2), model=uncertain), specs)
    t, shape = 0.01 * np.arange(50.0)[None], np.ones((1, 50, 2))
    logs = Dataset(t, 0 * shape, np.sin(3 * t)[..., None], np.ones((1, 50), bool))
    problem = build(rig, logs, key=jax.random.key(0))
    np.testing.assert_allclose(problem.mstep.least, [-np.inf, -0.05 / 0.07, -0.025])
    weights = problem.mstep.weights(problem.model)
    w = weights.read(problem.model)
    for share in (1.0, 1 + 1e-15, 3.0):
        values = weights.write(problem.model, w.at[-2:].set(share * problem.mstep.least[-2:])).system.values
        assert [float(values[f"joint{i}.armature"]) for i in (1, 2)] == [0.0, 0.0]
    up = weights.write(problem.model, w.at[-3:].set(0.5)).system.values
    assert [float(up[name]) for name in rig.parameters] == pytest.approx([2.55, 0.05 + 0.035, 0.025 + 0.5])


def test_a_step_of_a_pseudo_inertia_is_itself_to_first_order():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(4, 4))
    before = of_pseudo(jnp.asarray(root @ root.T))
    np.testing.assert_allclose(pseudo(before), root @ root.T, rtol=1e-12)
    way = Numbers(*(jnp.asarray(rng.normal(size=np.shape(a))) for a in before))
    way = way._replace(inertia=way.inertia + way.inertia.T)

    def missed(share: float) -> float:
        after = jax.tree.map(lambda a, b: a + share * b, before, way)
        linear = stepped(before, after)
        return max(float(jnp.abs(a - b).max()) for a, b in zip(linear, after, strict=True))

    assert missed(1e-4) < 0.3 * missed(2e-4)  # it falls with the square
    assert np.linalg.eigvalsh(np.asarray(pseudo(stepped(before, jax.tree.map(lambda a: -3.0 * a, before))))).min() > 0


def test_what_no_motion_feels_is_told(tmp_path):
    uncertain = (
        "[model.uncertain]\nlink1.mass = {std = 0.1}\nlink1.inertia.zz = {std = 0.1}\njoint1.armature = {std=1.0}"
    )
    rig = read_rig(_rig(tmp_path, arm(2), model=uncertain), specs)
    result = identifiability(rig, build_system(rig))
    assert result.never == ()
    assert result.together == (("link1.mass", "link1.inertia.zz", "joint1.armature"),)  # one axis, upright
    uncertain = "[model.uncertain]\nlink1.com.z = {std=0.1}\nlink2.mass = {std=0.1}"
    rig = read_rig(_rig(tmp_path, arm(2), model=uncertain), specs)
    assert identifiability(rig, build_system(rig)) == (("link1.com.z",), (), ())
    assert "no motion depends on link1.com.z" in sentences(identifiability(rig, build_system(rig)))[0]


def test_neighbours_share_a_body():
    system = tree(ROOT / "tests" / "machines" / "branch.xml")
    assert [system.neighbours(j) for j in range(1, 6)] == [(1, 2), (1, 2, 3, 4), (2, 3), (2, 4, 5), (4, 5)]


def test_machine_is_the_same_from_its_text(machine_file):
    machine = read_machine(machine_file)
    assert unpacked(packed(machine)) == machine


def test_without_mujoco_the_message_says_what_to_install(tmp_path, monkeypatch):
    path = _rig(tmp_path, arm(1))
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(RigError, match=re.escape('pip install "nnap-em[robots]"')):
        read_rig(path, specs)


# --- what is refused

HINGE = '<joint name="a" axis="0 1 0"/>'
WEIGHT = '<inertial pos="0 0 -.1" mass="1" diaginertia=".01 .01 .01"/>'


def _one(body: str = HINGE + WEIGHT, rest: str = "<actuator><motor name='m' joint='a'/></actuator>") -> str:
    return f'<mujoco><worldbody><body name="b">{body}</body></worldbody>{rest}</mujoco>'


def _actuator(line: str) -> str:
    return _one(rest=f"<actuator>{line}</actuator>")


def _urdf(joints: str, *links: str) -> str:
    mass = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    named = "".join(f'<link name="{name}">{mass if name != "light" else ""}</link>' for name in links)
    return f'<robot name="r">{named}{joints}</robot>'


def _turning(name: str, parent: str, child: str, more: str = "", kind: str = "continuous") -> str:
    return f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>{more}</joint>'


TWO = f'<body name="c"><joint name="b2" axis="0 1 0"/>{WEIGHT}</body>'
SECOND = "<motor name='m' joint='a'/><motor name='n' joint='a'/>"
BAD = {
    "free joint": (_one('<freejoint name="base"/>' + WEIGHT, ""), "", "joint 'base' is free; the base is fixed"),
    "ball joint": (_one('<joint type="ball" name="hip"/>' + WEIGHT, ""), "", "'hip' is a ball joint; write it as"),
    "equality": (
        _one(HINGE + WEIGHT + TWO, "<equality><joint joint1='a' joint2='b2'/></equality>"),
        "", "1 equality constraints; a loop or coupling is no tree",
    ),
    "tendon": (
        _one(rest="<tendon><fixed name='t'><joint joint='a' coef='1'/></fixed></tendon>"),
        "", "1 tendons; put their springs and motors on joints",
    ),
    "muscle": (_actuator("<muscle name='p' joint='a' lengthrange='0 1'/>"), "", "actuator 'p' is a muscle"),
    "state": (_actuator("<intvelocity name='p' joint='a' kp='3' actrange='-1 1'/>"), "", "actuator 'p' has a state"),
    "two motors": (_actuator(SECOND), "", r"m and n drive one joint, 'a'; name one of them in \[input\] columns"),
    "no actuator": (_one(rest=""), "", "no actuator; write the torque columns and their joints"),
    "missing mesh": (
        '<mujoco><asset><mesh name="hull" file="hull.stl"/></asset><worldbody><body name="b">' + HINGE
        + '<geom type="mesh" mesh="hull"/></body></worldbody></mujoco>',
        "", "body 'b' has no <inertial>, and its mesh 'hull' is missing; put the mesh beside",
    ),
    "negative inertia": (_one(HINGE + WEIGHT.replace(".01 .01 .01", "-1 1 1")), "", "mass and inertia above 0"),
    "impossible inertia": (_one(HINGE + WEIGHT.replace(".01 .01 .01", "1 1 5")), "", "largest part is at most the sum"),
    "no mass": (_one(HINGE), "", "give every body that moves an <inertial>"),
    "unknown body": (_one(), "bb.mass = {std=1}", "no body or joint of machine.xml is called 'bb'; did you mean 'b'"),
    "unknown number": (_one(), "b.mas = {std=1}", "'b' has no 'mas'; did you mean 'mass'"),
    "a body that cannot be": (
        _one(), "b.inertia.xx = { mean = 0.1, std = 0.01 }", r"b\.inertia.*principal inertias .*sum of the others",
    ),
    "no std": (_one(), "b.mass = {mean=1.0}", r"found \{'mean': 1.0\}; write forearm.mass = "),
    "negative std": (_one(), "b.mass = {std=-1.0}", "found std = -1.0; write a standard deviation of 0"),
    "negative mean": (_one(), "b.mass = {mean=-1, std=1.0}", "found mean = -1; write a number above 0"),
    "no name": (_one(HINGE.replace('name="a"', "") + WEIGHT, ""), "", "a joint of body 'b' has no name; name it"),
    "unusable name": (_one(HINGE.replace('"a"', '"a b"') + WEIGHT, ""), "", "'a b': unusable name; write letters"),
    "reserved name": (_one(HINGE.replace('"a"', '"time"') + WEIGHT, ""), "", "'time' has a name that logs"),
    "a name that is a rate": (
        _one(HINGE + WEIGHT + TWO.replace('"b2"', '"da"')), "", "'da' is called as the rate of joint 'a'; rename",
    ),
    "same name twice": (_one(HINGE + WEIGHT + TWO.replace('"b2"', '"a"')), "", "a name of its own"),
    "motor called as its joint": (_actuator("<motor name='a' joint='a'/>"), "", "'a' is a state, and no torque"),
    "fluid": (_one(rest="<option density='1000'/>"), "", "bodies move in a fluid; set density and viscosity to 0"),
    "gravity compensation": (
        '<mujoco><worldbody><body name="b" gravcomp="1">' + HINGE + WEIGHT + "</body></worldbody></mujoco>",
        "", "body 'b' has gravcomp; log the torque",
    ),
    "nothing moves": (_one(WEIGHT, ""), "", "it has no joint; give the bodies hinges or slides"),
    "not XML": ("<mujoco><worldbody>", "", "not XML .*; give the MJCF or URDF file as it was written, whole"),
    "another root": ("<sdf/>", "", "its root element is <sdf>; give MJCF"),
    "URDF without inertia": (
        _urdf(_turning("j", "a", "light"), "a", "light"), "", "'light' moves and has no <inertial>; add <inertial>",
    ),
    "URDF loop": (
        _urdf(_turning("j", "a", "c") + _turning("k", "b", "c"), "a", "b", "c"), "", "'c' hangs on two joints",
    ),
    "URDF ring": (_urdf(_turning("j", "a", "b") + _turning("k", "b", "a"), "a", "b"), "", "links form a ring"),
    "URDF mimic": (
        _urdf(_turning("j", "a", "b") + _turning("k", "b", "c", '<mimic joint="j"/>'), "a", "b", "c"),
        "", "'k' mimics another",
    ),
    "URDF floating": (_urdf(_turning("j", "a", "b", kind="floating"), "a", "b"), "", "'j' is floating; fix the base"),
    "URDF lost link": (_urdf(_turning("j", "a", "z"), "a", "b"), "", "names a link 'z' that is not there"),
}  # fmt: skip


@pytest.mark.parametrize("text, uncertain, said", BAD.values(), ids=BAD)
def test_bad_files_are_refused_by_name_with_the_mend(tmp_path, text, uncertain, said):
    path = _rig(tmp_path, text, measured=("a",), model=f"[model.uncertain]\n{uncertain}" if uncertain else "")
    with pytest.raises(RigError, match=said) as refused:
        read_rig(path, specs)
    assert "; " in str(refused.value)  # what is wrong; what to do
    assert str(tmp_path) in str(refused.value)  # and where


def test_missing_files_are_refused(tmp_path):
    path = _rig(tmp_path, arm(1))
    (tmp_path / "machine.xml").unlink()
    with pytest.raises(RigError, match=r"machine.xml: cannot be read .*; file = names an MJCF or URDF file"):
        read_rig(path, specs)
    path.write_text(path.read_text().replace('file = "machine.xml"', ""))
    with pytest.raises(RigError, match=r"\[model\] file: missing; write file = "):
        read_rig(path, specs)


def test_missing_meshes_do_not_matter_where_inertials_are_there(tmp_path):
    shape = '<geom type="mesh" mesh="hull" material="grey"/>'
    asset = '<asset><mesh name="hull" file="hull.stl"/><material name="grey" texture="t"/></asset>'
    inner = f'<mujoco><worldbody><body name="b">{HINGE}{WEIGHT}{shape}</body></worldbody></mujoco>'
    (tmp_path / "inner.xml").write_text(inner)
    (tmp_path / "outer.xml").write_text(f'<mujoco>{asset}<include file="inner.xml"/></mujoco>')
    (tmp_path / "plain.xml").write_text(inner.replace(shape, ""))
    outer, plain = (read_machine(tmp_path / name) for name in ("outer.xml", "plain.xml"))
    assert outer._replace(file="") == plain._replace(file="")


# --- what is stored and handed on


def test_program_of_a_machine_with_seven_joints_has_its_numbers_inside(tmp_path):
    system = tree(_arm(tmp_path, 7))
    leaves = jax.tree.leaves(eqx.filter(system, eqx.is_array))
    assert leaves == [] and dataclasses.is_dataclass(system)
