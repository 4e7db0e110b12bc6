"""Parts of URDF that MuJoCo's compiler refuses unclearly, misreads or leaves out: rings, mimics, rotors."""

import warnings
from collections.abc import Collection
from pathlib import Path
from xml.etree import ElementTree as ET

from ..data.rig import RigWarning
from .locked import Part, holding
from .source import place, refuse


def warn_of_rotors(path: Path, root: ET.Element) -> None:
    """Warn of a `<transmission>` with the inertia of a rotor, which is not read."""
    for element in root.iter("transmission"):
        if any("inertia" in part.tag.lower() for part in element.iter()):
            hint = "write its inertia times the reduction squared as JOINT.armature in [model.uncertain]"
            warnings.warn(f"{path}: {place(element)}: the rotor of a <transmission> is not read; {hint}", RigWarning, 2)


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
