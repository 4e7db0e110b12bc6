"""An identified machine written as URDF: masses, centres, inertias, damping and friction of its joints."""

import math
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np

from .. import __version__
from ..data.machine import Joint
from ..fit.identify import Identified
from ..machines.spec import in_comment
from ..storage.files import replace_own
from ..systems.tree import Tree
from .friction import REPORTED_MISS, FrictionForm, friction_forms
from .mjcf import as_it_is, named

NO_LIMIT = 1e9
"""Limit of a slide without stops, of an effort or a rate without limit: URDF requires one."""


def write_urdf(fitted: Identified, out: Path | str) -> list[str]:
    """Write the identified machine to a URDF file.

    Args:
        fitted: the model, of a machine from a file.
        out: the file.

    Returns:
        Effects that URDF cannot express, a sentence each.

    Raises:
        ExportError: the machine did not come from a file.
    """
    out = Path(out)
    system = as_it_is(fitted, fitted.model)
    forms = friction_forms(fitted)
    numbers_of = lambda servo: ", ".join(f"{key} = {float(value):.4g}" for key, value in servo.values.items())  # noqa: E731
    servos = [servo for servo in fitted.model.servos or () if servo.feeds_back]
    left = [f"the {servo.kind} servo of {servo.column}: {numbers_of(servo)}" for servo in servos]
    # Laws that URDF holds, by name: in the numbers of the bodies and in the damping
    laws = ("payload", "link_inertia", "link_length", "center_of_mass", "motor_back_emf")
    left += [named(effect) for effect in fitted.model.effects if effect.name not in laws]
    for joint, form in zip(system.machine.joints, forms, strict=True):
        form_misses = form._replace(breakaway=form.coulomb, offset=0.0) != form or form.missed > REPORTED_MISS
        left += [f"friction of {joint.name} beside Coulomb and viscous"] if form_misses else []
        left += [f"the spring of {joint.name}"] if joint.stiffness else []
        armature = float(system.values.get(f"{joint.name}.armature", joint.armature))
        left += [f"the armature of {joint.name}"] if armature else []
    root = ET.Element("robot", name=Path(system.machine.file).stem)
    lost = in_comment("; ".join(left) or "nothing")
    root.append(ET.Comment(f" Written by nnap_em {__version__}.  No shapes.  Not in here: {lost} "))
    ET.SubElement(root, "link", name=_base(system))
    numbers = _joints(fitted, forms)
    frames: list[tuple[str, np.ndarray]] = []
    for i, body in enumerate(system.machine.bodies):
        parent, pose = frames[body.parent] if body.parent >= 0 else (_base(system), np.eye(4))
        frames.append(_body(root, system, numbers, i, parent, pose @ _pose(body.turn, body.place)))
    ET.indent(root)
    replace_own({out: ET.tostring(root, encoding="unicode") + "\n"})
    return left


def _joints(fitted: Identified, forms: list[FrictionForm]) -> list[tuple[float, float, float]]:
    """Viscous and Coulomb friction of every joint, and the limit of its torque."""
    numbers = []
    for j, form in enumerate(forms, 1):
        laws = [(effect.name, effect.values()) for effect in fitted.model.effects if effect.joint == j]
        back_emf = sum(float(values["b"]) for name, values in laws if name == "motor_back_emf")
        limits = [float(values["limit"]) for name, values in laws if name == "saturation"]
        numbers.append((form.viscous + back_emf, form.coulomb, min(limits, default=NO_LIMIT)))
    return numbers


def _base(system: Tree) -> str:
    names = {body.name for body in system.machine.bodies}
    return next(name for name in ("base", "base_link", "world", "nnap_base") if name not in names)


def _body(root: ET.Element, system: Tree, laws: list, i: int, parent: str, pose: np.ndarray) -> tuple[str, np.ndarray]:
    """Links and joints of one body at `pose` in the frame of its parent link; its link, and its frame in there."""
    machine = system.machine
    body = machine.bodies[i]
    joints = [j for j, joint in enumerate(machine.joints) if joint.body == i]
    for k, j in enumerate(joints):
        joint, last = machine.joints[j], j == joints[-1]
        link = body.name if last else f"{body.name}_{k + 1}"
        anchor = _pose(np.eye(3), joint.anchor)
        kind = "prismatic" if joint.slide else "revolute" if joint.range else "continuous"
        element = ET.SubElement(root, "joint", name=joint.name, type=kind)
        _origin(element, pose @ anchor @ _moved(joint, -joint.zero))
        ET.SubElement(element, "parent", link=parent)
        ET.SubElement(element, "child", link=link)
        ET.SubElement(element, "axis", xyz=_text(*joint.axis))
        viscous, dry, effort = laws[j]
        if kind != "continuous":
            low, high = map(_text, joint.range or (-NO_LIMIT, NO_LIMIT))
            ET.SubElement(element, "limit", lower=low, upper=high, effort=_text(effort), velocity=_text(NO_LIMIT))
        ET.SubElement(element, "dynamics", damping=_text(viscous), friction=_text(dry))
        parent, pose = link, np.linalg.inv(anchor)
        if not last:
            nearly_none = 1e-12  # mass and inertia of a link between two joints of one body [kg, kg m^2]
            _inertial(ET.SubElement(root, "link", name=link), nearly_none, np.zeros(3), nearly_none * np.eye(3))
    if not joints:
        element = ET.SubElement(root, "joint", name=f"{body.name}_mount", type="fixed")
        _origin(element, pose)
        ET.SubElement(element, "parent", link=parent)
        ET.SubElement(element, "child", link=body.name)
        pose = np.eye(4)
    link = ET.SubElement(root, "link", name=body.name)
    mass, centre, inertia = system.body_numbers(i)
    if float(mass) > 0:
        place = pose @ np.array([*map(float, centre), 1.0])
        _inertial(link, float(mass), place[:3], np.array([[float(x) for x in row] for row in inertia]))
    return body.name, pose


def _inertial(link: ET.Element, mass: float, centre: np.ndarray, inertia: np.ndarray) -> None:
    inertial = ET.SubElement(link, "inertial")
    ET.SubElement(inertial, "origin", xyz=_text(*centre), rpy="0 0 0")
    ET.SubElement(inertial, "mass", value=_text(mass))
    axes = [(a, b) for a in range(3) for b in range(a, 3)]
    ET.SubElement(inertial, "inertia", {f"i{'xyz'[a]}{'xyz'[b]}": _text(inertia[a, b]) for a, b in axes})


def _origin(element: ET.Element, pose: np.ndarray) -> None:
    turn = pose[:3, :3]
    pitch = math.atan2(-turn[2, 0], math.hypot(turn[0, 0], turn[1, 0]))
    if math.hypot(turn[0, 0], turn[1, 0]) > 1e-9:
        roll, yaw = math.atan2(turn[2, 1], turn[2, 2]), math.atan2(turn[1, 0], turn[0, 0])
    else:  # straight up or down: roll and yaw turn about one axis
        roll, yaw = 0.0, math.atan2(-turn[0, 1], turn[1, 1])
    ET.SubElement(element, "origin", xyz=_text(*pose[:3, 3]), rpy=_text(roll, pitch, yaw))


def _pose(turn, place) -> np.ndarray:
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = turn, place
    return out


def _moved(joint: Joint, by: float) -> np.ndarray:
    """Motion of a joint by an angle or a distance, in its frame."""
    axis = np.asarray(joint.axis, float)
    if joint.slide:
        return _pose(np.eye(3), by * axis)
    cross = np.cross(np.eye(3), axis)
    return _pose(np.eye(3) + math.sin(by) * cross + (1 - math.cos(by)) * cross @ cross, np.zeros(3))


def _text(*values: float) -> str:
    return " ".join(repr(float(value)) for value in values)
