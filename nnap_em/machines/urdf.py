"""Parts of URDF that MuJoCo's compiler refuses unclearly, misreads or leaves out: rings, mimics, transmissions."""

import math
import warnings
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree as ET

from ..data.rig import RigWarning
from .locked import Part, holding
from .source import place, refuse

_REDUCTION, _INERTIA = ("mechanicalreduction", "gearratio"), ("motorinertia", "rotorinertia")
"""Names of the numbers of a `<transmission>` in ros_control, ros2_control and Drake, in small letters without _."""


class Gear(NamedTuple):
    """A motor behind a gear, as the joint has it."""

    reduction: float = 1.0
    """Turns of the motor for one of the joint [1, or rad/m]."""
    inertia: float = 0.0
    """Inertia of the rotor at the joint: reduction^2 times its own [kg m^2, or kg]."""


def transmissions(path: Path, root: ET.Element) -> dict[str, Gear]:
    """Gears of a URDF file by joint; warns of a `<transmission>` that is not one gear of one joint.

    A file that has the same transmission in two dialects has one motor.
    """
    gears: dict[str, Gear] = {}
    for element in root.iter("transmission"):
        ratios = {ratio for ratio in _numbers(path, element, _REDUCTION) if ratio != 1}
        inertias = list(_numbers(path, element, _INERTIA))
        joints = {str(joint.get("name")) for joint in element.findall("joint")}
        if not ratios and not any(inertias):
            continue
        if len(joints) != 1 or len(ratios) > 1 or not joints <= {joint.get("name") for joint in root.findall("joint")}:
            problem = (
                f"<transmission> {element.get('name')!r} is left out, as it is not one gear of one joint of the file"
            )
            hint = "its rotor is [model.uncertain] JOINT.armature: reduction^2 times its inertia"
            warnings.warn(f"{path}: {place(element)}: {problem}; {hint}", RigWarning, 2)
            continue
        (joint,), ratio = joints, abs(next(iter(ratios), 1.0))
        gear = Gear(ratio, ratio**2 * sum(inertias))
        gears[joint] = max(gear, gears.get(joint, gear), key=lambda one: one.inertia)
    return gears


def _numbers(path: Path, transmission: ET.Element, names: tuple[str, ...]) -> Iterator[float]:
    """Numbers of these names anywhere in a `<transmission>`, as text or as an attribute `value`."""
    for element in transmission.iter():
        if element.tag.rpartition(":")[2].replace("_", "").lower() in names:
            written = element.get("value", element.text or "").strip()
            try:
                number = float(written)
            except ValueError:
                number = math.nan
            if not math.isfinite(number) or (names is _INERTIA and number < 0) or (names is _REDUCTION and not number):
                refuse(path, f"<{element.tag}> is {written!r}", "write a number in SI units, or take it out", element)
            yield number


def stuck(root: ET.Element, logged: Collection[str]) -> dict[str, float]:
    """Values for the joints of a URDF file that move no mass, and for couplings of which a log has neither joint."""
    joints = {str(joint.get("name")): joint for joint in root.findall("joint") if joint.get("type") != "fixed"}
    held = {name: 0.0 for name, joint in joints.items() if not _weighs(_link(joint, "child"), root)}
    for joint in root.findall("joint"):
        if (mimic := joint.find("mimic")) is not None:
            name, leader = str(joint.get("name")), str(mimic.get("joint"))
            held |= {} if {name, leader} & {*logged} else {leader: 0.0, name: float(mimic.get("offset", 0.0))}
    return held


def _weighs(link: str, root: ET.Element, kinds: Collection[str] = ()) -> bool:
    """True if a link has an inertial, or one that it carries, on joints of these kinds or on any."""
    own = any(one.get("name") == link and one.find("inertial") is not None for one in root.findall("link"))
    joints = (joint for joint in root.findall("joint") if not kinds or joint.get("type") in kinds)
    carried = (_link(joint, "child") for joint in joints if _link(joint, "parent") == link)
    return own or any(_weighs(child, root, kinds) for child in carried)


def refuse_urdf(path: Path, root: ET.Element, part: Part) -> None:
    """Refusals where the message of MuJoCo is unclear, or where it has none."""
    links = {str(link.get("name")): link for link in root.findall("link")}
    parents: dict[str, str] = {}
    for joint in root.findall("joint"):
        name, kind = joint.get("name"), joint.get("type")
        parent, child = (_link(joint, end) for end in ("parent", "child"))
        for end in (parent, child):
            if end not in links:
                problem = f"joint {name!r} names a link {end!r} that is not there"
                refuse(path, problem, "add it, or correct its name", joint)
        if child in parents:
            hint = "a machine here is a tree: cut the loop at one of them"
            refuse(path, f"link {child!r} hangs on two joints", hint, joint)
        parents[child] = parent
        held = part.holds(str(name))
        if kind == "planar" or (kind == "floating" and not held):
            refuse(path, f"joint {name!r} is {kind}", "fix the base, or model the joint as slides and hinges", joint)
        if (mimic := joint.find("mimic")) is not None:
            leader = str(mimic.get("joint"))
            if not (held and part.holds(leader)):
                hint = f"free it of the other: couplings are no tree; or hold both: {holding(leader, str(name))}"
                refuse(path, f"joint {name!r} mimics another", hint, joint)
        if kind != "fixed" and not held and not _weighs(child, root, ("fixed",)):
            hint = "add <inertial> with <mass> and <inertia>: shapes alone say nothing about weight"
            hint += f"; or hold its joint: {holding(str(name))}"
            refuse(path, f"link {child!r} moves and has no <inertial>", hint, links[child])
    if parents and not set(links) - set(parents):
        refuse(path, "its links form a ring", "a machine here is a tree: one link has no parent")
    for name in parents:
        seen, at = {name}, name
        while at in parents:
            at = parents[at]
            if at in seen:
                hint = "a machine here is a tree: cut the ring at a joint"
                refuse(path, f"link {name!r} is its own ancestor", hint, links[name])
            seen.add(at)


def _link(joint: ET.Element, end: str) -> str:
    """The link at an end of a joint."""
    element = joint.find(end)
    return "" if element is None else str(element.get("link"))
