"""Files of machines as people have them: xacro, transmissions, links without mass, lines of the user's own file."""

import warnings
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest

from nnap_em.data.rig import RigWarning, read_rig
from nnap_em.init.from_machine import draft_machine
from nnap_em.machines.mjcf import Part, read_machine
from nnap_em.machines.source import MachineError
from nnap_em.machines.spec import in_comment
from nnap_em.systems import specs

MASS = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
NONE = '<inertial><mass value="0"/><inertia ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"/></inertial>'


def _link(name: str, inside: str = "") -> str:
    return f'<link name="{name}">{inside}</link>'


def _joint(name: str, parent: str, child: str, kind: str = "continuous", inside: str = "") -> str:
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    return f'<joint name="{name}" type="{kind}">{ends}<axis xyz="0 1 0"/>{inside}</joint>'


ARM = _link("base") + _link("l1", MASS) + _link("l2", MASS) + _joint("j1", "base", "l1") + _joint("j2", "l1", "l2")


def _urdf(folder: Path, inside: str, root: str = '<robot name="r">') -> Path:
    (folder / "m.urdf").write_text(f"<?xml version='1.0'?>\n{root}{inside}</robot>")
    return folder / "m.urdf"


# --- xacro

XACRO = '<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro">'
UNEXPANDED = {
    "macro": (XACRO, f'<xacro:macro name="arm">{ARM}</xacro:macro><xacro:arm/>', "<xacro:macro>"),
    "include": (XACRO, '<xacro:include filename="arm.xacro"/>', "<xacro:include>"),
    "no namespace": ('<robot name="r">', '<xacro:include filename="arm.xacro"/>', "<xacro:include>"),
    "property": (XACRO, '<xacro:property name="m" value="2"/>' + ARM, "<xacro:property>"),
    "expression": ('<robot name="r">', ARM.replace('mass value="1"', 'mass value="${2 * m}"'), "the value '${2 * m}'"),
    "argument": ('<robot name="r">', ARM.replace('name="j1"', 'name="$(arg p)j1"'), "the value '$(arg p)'"),
    "text": ('<robot name="r">', ARM + "<transmission><n>${n}</n></transmission>", "the value '${n}'"),
}


@pytest.mark.parametrize(("root", "inside", "said"), UNEXPANDED.values(), ids=UNEXPANDED)
def test_xacro_is_to_be_expanded_first(tmp_path, root, inside, said):
    with pytest.raises(MachineError) as refused:
        read_machine(_urdf(tmp_path, inside, root))
    assert f"line 2: {said} is xacro; expand it first, with xacro m.urdf > expanded.urdf" in str(refused.value)


def test_what_xacro_leaves_behind_is_no_macro(tmp_path):
    """Expanded files keep the declaration; paths in shapes and plugins are not read."""
    shape = '<visual><geometry><mesh filename="$(find a)/l.stl"/></geometry></visual>'
    rest = "<gazebo><plugin><file>$(find a)/b.yaml</file></plugin></gazebo>"
    path = _urdf(tmp_path, ARM.replace(MASS, shape + MASS) + rest, XACRO)
    assert [joint.name for joint in read_machine(path).joints] == ["j1", "j2"]


def test_a_name_with_dashes_may_stand_in_a_comment():
    for text in ("a--b", "a---b", "--", "- -", "a-b"):
        assert ET.fromstring(f"<a><!-- {in_comment(text)} --></a>").tag == "a"
    assert in_comment("a---b") == "a- - -b" and in_comment("a-b") == "a-b"


# --- transmissions

RATIO, MOTOR = "<mechanicalReduction>101</mechanicalReduction>", "<motorInertia>5e-5</motorInertia>"


def test_the_rotor_of_a_transmission_is_said_to_be_left_out(tmp_path):
    block = f'\n<transmission name="t"><joint name="j1"/><actuator>{RATIO}{{}}</actuator></transmission>'
    with pytest.warns(RigWarning, match="line 3: the rotor of a <transmission> is not read; write its inertia times"):
        machine = read_machine(_urdf(tmp_path, ARM + block.format(MOTOR)))
    assert [joint.armature for joint in machine.joints] == [0.0, 0.0]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read_machine(_urdf(tmp_path, ARM + block.format("")))  # torques are those at the joint


# --- lines of the user's own file

SHAPES = """
    <!-- a shape,
         which weighs nothing -->
    <visual>
      <geometry><box
         size="1 1 1"/></geometry>
    </visual>
"""


@pytest.mark.parametrize("ends", ["\n", "\r\n"])
@pytest.mark.parametrize("before", ["", SHAPES], ids=["plain", "shapes"])
def test_a_message_of_the_compiler_has_the_line_of_the_file(tmp_path, before, ends):
    wrong = _joint("fix", "l1", "ee", "fixed").replace("0 1 0", "100").replace("><", ">\n<")
    path = _urdf(tmp_path, ARM.replace(MASS, before + MASS, 1) + '\n<link name="ee"/>\n' + wrong)
    text = path.read_text()
    path.write_bytes(text.replace("\n", ends).encode())
    line = next(i for i, one in enumerate(text.splitlines(), 1) if 'xyz="100"' in one)
    with pytest.raises(MachineError, match=rf"m\.urdf: .*Element 'axis', line {line};"):
        read_machine(path)


def test_a_message_without_a_line_gets_that_of_the_element(tmp_path):
    with pytest.raises(MachineError, match=r"Element name 'l2', line 4, id 2"):
        read_machine(_urdf(tmp_path, ARM.replace(_link("l2", MASS), "\n\n" + _link("l2", NONE))))


@pytest.mark.parametrize("included", [False, True], ids=["one file", "included"])
def test_a_message_about_an_included_file_names_it(tmp_path, included):
    body = '\n\n<worldbody><body name="b"><joint name="a" axs="0 1 0"/></body></worldbody>'
    (tmp_path / "inner.xml").write_text(f"<mujoco>{body}</mujoco>")
    inner = '\n<include file="inner.xml"/>' if included else body
    (tmp_path / "m.xml").write_text(f"<mujoco>{inner}</mujoco>")
    place = "line 3 of inner.xml" if included else "line 3"
    with pytest.raises(MachineError, match=rf"unrecognized attribute: 'axs' Element 'joint', {place};"):
        read_machine(tmp_path / "m.xml")


def test_an_element_of_an_included_file_is_named_with_it(tmp_path):
    (tmp_path / "inner.xml").write_text(
        '<mujoco><worldbody>\n<body name="b"><joint name="a"/></body></worldbody></mujoco>'
    )
    (tmp_path / "m.xml").write_text('<mujoco>\n\n\n<include file="inner.xml"/></mujoco>')
    with pytest.raises(MachineError, match=r"Element name 'b', line 2 of inner.xml, id 1; give every body that moves"):
        read_machine(tmp_path / "m.xml")
    (tmp_path / "inner.xml").unlink()
    with pytest.raises(
        MachineError, match=r"'inner.xml' Element 'include', line 4; put the included file where the main"
    ):
        read_machine(tmp_path / "m.xml")


def test_a_link_that_moves_without_mass_is_refused_with_its_line(tmp_path):
    path = _urdf(tmp_path, ARM.replace(_link("l2", MASS), "\n\n" + _link("l2")))
    with pytest.raises(MachineError, match=r"line 4: link 'l2' moves and has no <inertial>; .*locked = \{ j2 = 0.0 \}"):
        read_machine(path)


# --- links without mass that never move


@pytest.mark.parametrize("part", [Part(), Part(joints=("j1",)), Part(locked={"j2": 0.3})], ids=["all", "one", "locked"])
@pytest.mark.parametrize("inertial", ["", NONE], ids=["no inertial", "an inertial of none"])
def test_links_without_mass_that_never_move_change_nothing(tmp_path, part, inertial):
    """A base, a frame before it, and one on it, and frames of the tool."""
    frames = [("f0", "world", "base"), ("f1", "base", "camera"), ("f2", "camera", "lens"), ("f3", "l2", "tool")]
    links = "".join(_link(name, inertial) for name in ("world", "camera", "lens", "tool"))
    more = ARM.replace(_link("base"), _link("base", inertial)) + links
    more += "".join(_joint(*frame, kind="fixed") for frame in frames)
    plain = read_machine(_urdf(tmp_path, ARM), part)
    framed = read_machine(_urdf(tmp_path, more), part)
    assert framed.joints == plain.joints
    for one, other in zip(framed.bodies, plain.bodies, strict=True):
        assert one.name == other.name
        np.testing.assert_allclose(one.mass, other.mass, atol=1e-12)
        np.testing.assert_allclose(one.inertia, other.inertia, atol=1e-12)


def test_limits_without_room_are_no_limits_and_print_nothing(tmp_path, capfd):
    shut = '<limit lower="0" upper="0.0" effort="0" velocity="0"/>'  # as exporters of CAD programs write them
    path = _urdf(tmp_path, ARM + _link("l3", MASS) + _joint("j3", "l2", "l3", "revolute", shut))
    assert read_machine(path).joints[2].range is None
    assert "".join(capfd.readouterr()) == ""


FINGERS = _link("f1", MASS) + _link("f2", MASS) + _link("tip") + _joint("open", "l2", "f1", "prismatic")
FINGERS += _joint("follow", "l2", "f2", "prismatic", '<mimic joint="open" multiplier="-1" offset="0.02"/>')
FINGERS += _joint("button", "f1", "tip")


def test_a_draft_holds_joints_that_move_no_mass_and_couplings_that_no_log_has(tmp_path):
    path, log = _urdf(tmp_path, ARM + FINGERS), tmp_path / "log.csv"
    t = 0.01 * np.arange(200.0)
    rows = np.column_stack([t, np.sin(t), np.cos(t), np.cos(3 * t)])
    np.savetxt(log, rows, delimiter=",", header="time,j1,j2,tau_j1", comments="")
    with pytest.warns(RigWarning, match="body 'tip' hangs on the locked joint 'button' and has no mass"):
        draft = draft_machine(log, path, tmp_path).text
    assert 'locked = { "button" = 0, "open" = 0, "follow" = 0.02 }' in draft
    (tmp_path / "rig.toml").write_text(draft)
    with pytest.warns(RigWarning, match="has no mass"):
        assert read_rig(tmp_path / "rig.toml", specs).measured == ("j1", "j2")
    log.write_text(log.read_text().replace("j2", "open"))
    with pytest.raises(MachineError, match="joint 'follow' mimics another"):  # it moves: the log has it
        draft_machine(log, path, tmp_path)
