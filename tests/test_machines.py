"""Machines from files: the physics against MuJoCo's own, names and numbers as the file has them, bad files refused."""

import re
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from helpers import file_rig, written_again
from machines import arm, physics, tree

from nnap_em.base.gaussian import spd_solve
from nnap_em.errors import RigError, RigWarning
from nnap_em.estimate.em.build import build_system
from nnap_em.estimate.identifiability import identifiability
from nnap_em.logs.draft.from_machine import draft_machine
from nnap_em.machines.files.mjcf import read_machine
from nnap_em.machines.machine import packed, unpacked
from nnap_em.machines.rig import Declared, read_rig
from nnap_em.machines.systems import specs
from nnap_em.model.effects import catalogue

ROOT = Path(__file__).resolve().parents[1]
MACHINES = ROOT / "tests" / "machines"
CARTPOLE = ROOT / "examples" / "machines" / "cartpole.xml"


def _arm(folder: Path, joints: int = 3) -> Path:
    (folder / "arm.xml").write_text(arm(joints))
    return folder / "arm.xml"


def _mujoco(path: Path) -> mujoco.MjModel:
    if path.suffix != ".urdf":
        return mujoco.MjModel.from_xml_path(str(path))
    return mujoco.MjModel.from_xml_string(re.sub(r"(?s)<visual>.*?</visual>", "", path.read_text()))


def _states(model: mujoco.MjModel, count: int = 6) -> np.ndarray:
    """Coordinates and rates, a state a row."""
    return np.random.default_rng(0).uniform(-3.0, 3.0, (count, 2, model.nv))


def _each(function, *rows):
    """A function of each row, in one small program: a loop is compiled sooner than what `vmap` makes of scalars."""
    return jax.jit(lambda rows: jax.lax.map(lambda row: function(*row), rows))(jax.tree.map(jnp.asarray, rows))


def _mass_and_bias(system):
    return lambda x: (system.mass(x[0]), system.bias(x[0], x[1]))


def _acceleration(system, x, force):
    return jnp.stack(system.acceleration(*x, force))


@pytest.mark.parametrize("machine", ["branch.xml", "arm.urdf", "cartpole.xml", 5])
def test_mass_bias_and_acceleration_are_those_of_mujoco(machine, tmp_path):
    """Chain, branch, slide, gear, armature, rotated frames, offset joints, URDF; packed, a machine is the same."""
    path = _arm(tmp_path, 5) if machine == 5 else {"cartpole.xml": CARTPOLE}.get(machine, MACHINES / str(machine))
    model, system = _mujoco(path), tree(path)
    assert jax.tree.leaves(eqx.filter(system, eqx.is_array)) == []  # the numbers of the file are part of the program
    assert unpacked(packed(read := read_machine(path))) == read
    states, forces = _states(model), np.linspace(-1.0, 1.0, 6 * model.nv).reshape(6, -1)

    def own(x, force):
        return *_mass_and_bias(system)(x), _acceleration(system, x, force)

    ours, bias, rate = _each(own, states, forces)
    mass, truth = physics(model, states)
    np.testing.assert_allclose(ours, mass, atol=1e-12, rtol=1e-12)
    np.testing.assert_allclose(bias, truth, atol=1e-11, rtol=1e-12)
    other = np.linalg.solve(mass, (forces - truth)[..., None])[..., 0]
    np.testing.assert_allclose(rate, other, rtol=1e-9, atol=1e-9)


def test_derivatives_of_the_acceleration_are_those_of_the_mass_matrix(tmp_path):
    """Directional derivatives by states, forces and uncertain numbers; the reverse mode gives the same."""
    system, rng = build_system(read_rig(_rig(tmp_path, arm(3), model=UNCERTAIN), specs)), np.random.default_rng(1)
    shares, x, force = rng.uniform(0.9, 1.1, 4), rng.normal(size=(2, 3)), rng.normal(size=3)
    values = {name: share * value for share, (name, value) in zip(shares, system.values.items(), strict=True)}
    at = jax.tree.map(jnp.asarray, (values, x, force))
    way = jax.tree.map(lambda a: jnp.asarray(rng.normal(size=a.shape)), at)

    def both(at, way):
        of = lambda rule: lambda values, *rest: rule(system.with_parameters(values), *rest)  # noqa: E731
        by_mass_matrix = lambda system, x, force: spd_solve(system.mass(x[0]), force - system.bias(*x))  # noqa: E731
        own, truth = (jax.jvp(of(rule), at, way)[1] for rule in (_acceleration, by_mass_matrix))
        pulled = jax.vjp(of(_acceleration), *at)[1](jnp.arange(1.0, 4.0))
        return own, truth, sum(jnp.sum(a * b) for a, b in zip(*map(jax.tree.leaves, (pulled, way)), strict=True))

    own, truth, pulled = jax.jit(both)(at, way)
    np.testing.assert_allclose(own, truth, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(pulled, own @ np.arange(1.0, 4.0), rtol=1e-8, atol=1e-8)


def test_drive_is_that_of_mujocos_motors(tmp_path):
    path = MACHINES / "branch.xml"
    system, model = build_system(read_rig(_rig(tmp_path, path, measured=("left",)), specs)), _mujoco(path)
    data = mujoco.MjData(model)
    data.ctrl[:] = u = np.array([0.3, -0.2, 0.7])
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(system.drive(jnp.asarray(u)), data.qfrc_actuator, atol=1e-14)


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
    assert written_again(rig, tmp_path) == rig
    named = read_rig(_rig(tmp_path, arm(3), rest='[input]\ncolumns = ["u"]\njoints = ["joint2"]'), specs)
    assert (named.input_columns, named.input_joints) == (("u",), (2,))
    assert written_again(named, tmp_path) == named


def test_changed_numbers_move_the_physics_as_in_mujoco(tmp_path):
    rig = read_rig(_rig(tmp_path, arm(3), model=UNCERTAIN), specs)
    system = build_system(rig).with_parameters({"link2.mass": jnp.asarray(2.0)})
    model = mujoco.MjModel.from_xml_string(arm(3))
    model.body_mass[2] = 2.0
    model.body_ipos[2][0], model.dof_armature[2] = 0.012, 0.02
    states = _states(model)
    np.testing.assert_allclose(_each(lambda x: system.mass(x[0]), states), physics(model, states)[0], atol=1e-12)


def test_friction_of_the_file_acts_where_none_is_learned_and_is_left_out_where_it_is(tmp_path):
    text = arm(2).replace('armature="0.05"', 'armature="0.05" damping="0.3" frictionloss="0.2"')
    with pytest.warns(RigWarning, match="damping and frictionloss of joint1 are left out"):
        learned = build_system(read_rig(_rig(tmp_path, text), specs))
    path = _rig(tmp_path, text)
    path.write_text(path.read_text().replace('"unknown"', '"none"'))
    known, q, v = build_system(read_rig(path, specs)), jnp.zeros(2), jnp.asarray([2.0, 1.0])
    np.testing.assert_allclose(known.bias(q, v) - learned.bias(q, v), [0.3 * 2.0 + 0.2, 0.0], atol=1e-12)


def test_a_payload_of_any_mass_and_centre_moves_the_machine_as_in_mujoco(tmp_path):
    """0.7 kg off the axis at the joint that carries loads, and at its spot, added to its body by MuJoCo's own model
    editing.
    """
    path = _arm(tmp_path)
    system, mass, states = tree(path), jnp.asarray(0.7), _states(_mujoco(path))
    loaded, truth, (*_, last) = [], [], system.variations
    assert last == ("payload", len(system.coordinates))
    for joint, away in [*((joint, [0.21, -0.12, 0.08]) for joint in system.spots), (last[1], [0.0, 0.0, 0.0])]:
        spot = system.spots[joint]
        effect = catalogue["payload"](mass, mass * jnp.asarray(away), spot.point, joint=joint)
        centre = np.add(spot.point, away)
        np.testing.assert_allclose([effect.values()[f"centre_{axis}"] for axis in "xyz"], centre, rtol=1e-12)
        loaded.append(effect.physics(system, jnp.zeros(())) if any(away) else system.vary(*last, mass))
        truth.append(physics(_hung(path, system.machine.bodies[spot.body].name, 0.7, centre), states))
    for ours, theirs in zip(_each(lambda x: [_mass_and_bias(one)(x) for one in loaded], states), truth, strict=True):
        for part, other in zip(ours, theirs, strict=True):
            np.testing.assert_allclose(part, other, atol=1e-10, rtol=1e-12)


def _hung(path: Path, body: str, mass: float, centre: np.ndarray) -> mujoco.MjModel:
    """The machine of a file with a point mass on one of its bodies."""
    spec = mujoco.MjSpec.from_file(str(path))
    more = spec.body(body).add_body(name="load", pos=centre)
    more.mass, more.ipos, more.inertia, more.explicitinertial = mass, [0, 0, 0], [1e-15] * 3, True
    return spec.compile()


def test_unphysical_bodies_have_no_numbers(tmp_path):
    rig = read_rig(_rig(tmp_path, arm(2), model="[model.uncertain]\nlink2.mass = {std = 0.1}"), specs)
    system = build_system(rig)
    mass = jax.jit(jax.vmap(lambda m: system.with_parameters({"link2.mass": m}).mass(jnp.zeros(2))))
    sound, negative = mass(jnp.asarray([2.5, -0.1]))
    assert np.isfinite(sound).all() and np.isnan(negative[1, 1])


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


def test_what_no_motion_feels_is_told(tmp_path):
    uncertain = (
        "[model.uncertain]\nlink1.mass = {std = 0.1}\nlink1.inertia.zz = {std = 0.1}\njoint1.armature = {std=1.0}"
    )
    rig = read_rig(_rig(tmp_path, arm(2), model=uncertain), specs)
    result = identifiability(rig, build_system(rig))
    assert result.never == ()
    assert result.together == (("link1.mass", "link1.inertia.zz", "joint1.armature"),)  # one axis, upright


def test_without_mujoco_the_message_says_what_to_install(tmp_path, monkeypatch):
    path = _rig(tmp_path, arm(1))
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(RigError, match=re.escape('pip install "nnap-em[robots]"')):
        read_rig(path, specs)


# --- files as people have them

HINGE = '<joint name="a" axis="0 1 0"/>'
WEIGHT = '<inertial pos="0 0 -.1" mass="1" diaginertia=".01 .01 .01"/>'
MASS = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
NONE = '<inertial><mass value="0"/><inertia ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"/></inertial>'
MOTOR = "<actuator><motor name='m' joint='a'/></actuator>"


def _one(body: str = HINGE + WEIGHT, rest: str = MOTOR, more: str = "") -> str:
    return f'<mujoco><worldbody><body name="b"{more}>{body}</body></worldbody>{rest}</mujoco>'


def _links(*names: str, inside: str = MASS) -> str:
    return "".join(f'<link name="{name}">{inside}</link>' for name in names)


def _turning(name: str, parent: str, child: str, more: str = "", kind: str = "continuous") -> str:
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    return f'<joint name="{name}" type="{kind}">{ends}<axis xyz="0 1 0"/>{more}</joint>'


def _urdf(inside: str) -> str:
    return f"<?xml version='1.0'?>\n<robot name=\"r\">{inside}</robot>"


ARM = _links("base", inside="") + _links("l1", "l2") + _turning("j1", "base", "l1") + _turning("j2", "l1", "l2")
SECOND = f'<body name="c"><joint name="b2" axis="0 1 0"/>{WEIGHT}</body>'
BODY = "[model.uncertain]\nb."
BAD = {  # name: file, lines of [model], and what the message says
    "free joint": (_one('<freejoint name="base"/>' + WEIGHT, ""), "", "joint 'base' is free; the base is fixed"),
    "equality": (
        _one(HINGE + WEIGHT + SECOND, "<equality><joint joint1='a' joint2='b2'/></equality>"),
        "", r"1 equality constraints; a loop or coupling is no tree: .* locked = \{ a = 0.0, b2 = 0.0 \}",
    ),
    "two motors": (_one(rest=MOTOR * 2 + "").replace("'m'", "'n'", 1), "", r"n and m drive one joint, 'a'; let one"),
    "no actuator": (_one(rest=""), "", "no actuator; write the torque columns and their joints"),
    "of MuJoCo": (_one(HINGE + WEIGHT.replace(".01 .01 .01", "1 1 5")), "", "inertia must .* 'b'.* largest part of an"),
    "no mass": (_one(HINGE), "", r"mass and inertia of moving bodies .*'b'.*its joint is held: \[model\] locked"),
    "unknown body": (_one(), "[model.uncertain]\nbb.mass = 1", "no body or joint of machine.xml is called 'bb'; did"),
    "a body that cannot be": (
        _one(), f"{BODY}inertia.xx = {{ mean = 0.1, std = 0.01 }}", "principal inertias .*sum of the others",
    ),
    "unusable name": (_one(HINGE.replace('"a"', '"a b"') + WEIGHT, ""), "", "'a b' of body 'b': unusable name; write"),
    "motor called as its joint": (_one().replace("'m'", "'a'"), "", "'a' is the time or a state, and no torque"),
    "fluid": (_one(rest="<option density='1000'/>"), "", "it has a fluid; set density and viscosity to 0"),
    "gravity compensation": (_one(more=' gravcomp="1"'), "", "it has gravcomp; log the torque"),
    "not XML": ("<mujoco>\n<worldbody>", "", "XML parse error .*; correct the file"),
    "URDF loop": (_urdf(ARM + _turning("j", "base", "l2")), "", "multiple parents.*line 2; correct the file: bod"),
    "xacro": (_urdf('\n<xacro:macro name="arm"/>'), "", "line 3: <xacro:macro> is xacro; expand it first, with"),
}  # fmt: skip


@pytest.mark.parametrize("text, uncertain, said", BAD.values(), ids=BAD)
def test_bad_files_are_refused_by_name_with_the_mend(tmp_path, text, uncertain, said):
    path = _rig(tmp_path, text, measured=("a",), model=uncertain)
    with pytest.raises(RigError, match=said) as refused:
        read_rig(path, specs)
    assert str(tmp_path) in str(refused.value)  # and where


def test_the_rotor_of_a_transmission_is_said_to_be_left_out(tmp_path, recwarn):
    path, block = tmp_path / "m.urdf", '\n<transmission name="t"><joint name="j1"/>{}</transmission>'
    path.write_text(_urdf(ARM + block.format("<mechanicalReduction>101</mechanicalReduction>")))
    plain = read_machine(path)  # torques are those at the joint
    assert not recwarn
    path.write_text(_urdf(ARM + block.format("<motorInertia>5e-5</motorInertia>")))
    with pytest.warns(RigWarning, match="the rotor of a <transmission> is not read; write its inertia times"):
        assert read_machine(path) == plain


def test_a_missing_file_is_refused(tmp_path):
    path = _rig(tmp_path, arm(1))
    (tmp_path / "machine.xml").unlink()
    with pytest.raises(RigError, match=r"machine.xml: cannot be read .*; file = names an MJCF or URDF file"):
        read_rig(path, specs)


def test_what_weighs_nothing_changes_nothing(tmp_path, capfd):
    """Missing meshes and textures, included files, frames on fixed joints, limits without room, macros in shapes."""
    shape = '<geom type="mesh" mesh="hull" material="grey"/>'
    asset = '<asset><mesh name="hull" file="hull.stl"/><material name="grey" texture="t"/></asset>'
    (tmp_path / "inner.xml").write_text(_one(HINGE + WEIGHT + shape, ""))
    (tmp_path / "outer.xml").write_text(f'<mujoco>{asset}<include file="inner.xml"/></mujoco>')
    (tmp_path / "plain.xml").write_text(_one(rest=""))
    outer, plain = (read_machine(tmp_path / name) for name in ("outer.xml", "plain.xml"))
    assert outer._replace(file="") == plain._replace(file="")
    frames = [("f0", "world", "base"), ("f1", "base", "camera"), ("f2", "l2", "tool")]
    links = _links("world", "camera", inside=NONE) + _links("tool", inside="")
    mesh = '<visual><geometry><mesh filename="$(find a)/l.stl"/></geometry></visual>'
    shut = '<limit lower="0" upper="0.0" effort="0" velocity="0"/>'  # as exporters of CAD programs write them
    framed = (
        ARM.replace(MASS, mesh + MASS, 1).replace("</joint>", shut + "</joint>", 1).replace("continuous", "revolute", 1)
    )
    (tmp_path / "plain.urdf").write_text(_urdf(ARM))
    (tmp_path / "framed.urdf").write_text(
        _urdf(framed + links + "".join(_turning(*f, kind="fixed") for f in frames) + "<gazebo><p>${x}</p></gazebo>")
    )
    bare, full = (read_machine(tmp_path / f"{name}.urdf") for name in ("plain", "framed"))
    assert full.joints == bare.joints and "".join(capfd.readouterr()) == ""
    assert [body.name for body in full.bodies] == [body.name for body in bare.bodies]
    for one, other in zip(full.bodies, bare.bodies, strict=True):
        np.testing.assert_allclose(
            [one.mass, *np.ravel(one.inertia)], [other.mass, *np.ravel(other.inertia)], atol=1e-12
        )


FINGERS = _links("f1", "f2") + _links("tip", inside="") + _turning("open", "l2", "f1", kind="prismatic")
FINGERS += _turning("follow", "l2", "f2", '<mimic joint="open" multiplier="-1" offset="0.02"/>', "prismatic")
FINGERS += _turning("button", "f1", "tip")


def test_a_draft_holds_joints_that_move_no_mass_and_couplings_that_no_log_has(tmp_path):
    path, log, t = tmp_path / "m.urdf", tmp_path / "log.csv", 0.01 * np.arange(200.0)
    path.write_text(_urdf(ARM + FINGERS))
    rows = np.column_stack([t, np.sin(t), np.cos(t), np.cos(3 * t)])
    np.savetxt(log, rows, delimiter=",", header="time,j1,j2,tau_j1", comments="")
    draft = draft_machine(log, path, tmp_path).text
    assert 'locked = { "button" = 0, "open" = 0, "follow" = 0.02 }' in draft
    (tmp_path / "rig.toml").write_text(draft)
    assert read_rig(tmp_path / "rig.toml", specs).measured == ("j1", "j2")
    log.write_text(log.read_text().replace("j2", "open"))
    with pytest.raises(RigError, match="1 equality constraints"):  # it moves: the log has it
        draft_machine(log, path, tmp_path)
