"""The user's URDF file with the identified numbers: masses, centres, inertias, damping, friction, limits of torque."""

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ... import __version__
from ...base.files import replace_own
from ...errors import ExportError
from ...estimate.identify import Identified
from ...machines.files.spec import in_comment
from ...machines.machine import AXES, PAIRS
from .friction import REPORTED_MISS, friction_forms
from .mjcf import as_it_is, named, servos_of


def write_urdf(fitted: Identified, out: Path | str) -> list[str]:
    """Write the URDF file of an identified machine again, with its numbers; all else stays, joints that were held too.

    Args:
        fitted: the model, of a machine from a URDF file.
        out: the file.

    Returns:
        Effects that URDF cannot express, a sentence each.

    Raises:
        ExportError: the machine did not come from a URDF file. Nothing is written.
    """
    system, forms = as_it_is(fitted), friction_forms(fitted)
    if not fitted.rig.urdf:
        raise ExportError(f"{system.machine.file} is no URDF file; write --mjcf")
    root = ET.fromstring(fitted.rig.urdf, ET.XMLParser(target=ET.TreeBuilder(insert_comments=True)))
    # Laws that URDF holds, by name: in the numbers of bodies, in damping and in effort
    laws = ("payload", "motor_back_emf", "saturation")
    left = servos_of(fitted) + [named(effect) for effect in fitted.model.effects if effect.name not in laws]
    elements = {str(element.get("name")): element for element in root if element.tag == "joint"}
    for number, (joint, form) in enumerate(zip(system.machine.joints, forms, strict=True), 1):
        form_misses = form._replace(breakaway=form.coulomb, offset=0.0) != form or form.missed > REPORTED_MISS
        left += [f"friction of {joint.name} beside Coulomb and viscous"] if form_misses else []
        for what in ("armature", "stiffness"):
            left += [f"the {what} of {joint.name}"] if float(system.values.get(f"{joint.name}.{what}", 0.0)) else []
        own = [(law.name, law.values()) for law in fitted.model.effects if law.joint == number]
        damping = form.viscous + sum(float(values["b"]) for name, values in own if name == "motor_back_emf")
        if joint.name not in elements:  # one of the three of a planar joint
            left.append(f"friction and limit of {joint.name}, which is no joint of its own")
            continue
        _set(elements[joint.name], "dynamics", damping=damping, friction=form.coulomb)
        if limits := [float(values["limit"]) for name, values in own if name == "saturation"]:
            _set(elements[joint.name], "limit", effort=min(limits))
    links = {str(element.get("name")): element for element in root if element.tag == "link"}
    for i, body in enumerate(system.machine.bodies):
        before = _pseudo_inertia(body.mass, body.centre, body.inertia)
        change = _pseudo_inertia(*system.body_numbers(i)) - before
        if np.any(change) and not _add(links[body.name], change):
            left.append(f"the numbers of {body.name}: links on its fixed joints alone have more")
    lost = in_comment("; ".join(left) or "nothing")
    root.insert(0, ET.Comment(f" Written by nnap_em {__version__}.  Not in here: {lost} "))
    replace_own({Path(out): ET.tostring(root, encoding="unicode") + "\n"})
    return left


def _set(parent: ET.Element, tag: str, **values: object) -> None:
    """An element of a joint or of an inertial with these attributes; a new limit has one for the rate, too."""
    if (element := parent.find(tag)) is None:
        element = ET.SubElement(parent, tag, {"velocity": "1e9"} if tag == "limit" else {})
    element.attrib.update({name: str(value) for name, value in values.items()})


def _pseudo_inertia(mass, centre, inertia) -> Float[np.ndarray, "4 4"]:
    """Mass, centre [m] and inertia about it as one matrix, which adds where bodies are joined and is positive definite.

    [Wensing, Kim & Slotine 2018, IEEE Robot. Autom. Lett. 3(1), eq. 15]
    """
    centre, inertia = np.asarray(centre, float), np.asarray(inertia, float)
    out = float(mass) * np.outer([*centre, 1.0], [*centre, 1.0])
    out[:3, :3] += 0.5 * np.trace(inertia) * np.eye(3) - inertia
    return out


def _add(link: ET.Element, change: Float[np.ndarray, "4 4"]) -> bool:
    """Change the inertial of a link by a pseudo-inertia; False where no body has what is left of it."""
    inertial = link.find("inertial")
    parts = {part.tag: part.attrib for part in (() if inertial is None else inertial)}
    numbers = lambda tag, key, default: np.array(str(parts.get(tag, {}).get(key, default)).split(), float)  # noqa: E731
    inertia = np.zeros((3, 3))
    for i, j in PAIRS:
        inertia[i, j] = inertia[j, i] = numbers("inertia", f"i{AXES[i]}{AXES[j]}", "0")[0]
    turn = Rotation.from_euler("xyz", numbers("origin", "rpy", "0 0 0")).as_matrix()
    own = _pseudo_inertia(numbers("mass", "value", "0")[0], numbers("origin", "xyz", "0 0 0"), turn @ inertia @ turn.T)
    own += change
    mass = own[3, 3]
    if mass <= 0 or np.linalg.eigvalsh(own)[0] < -1e-9 * np.trace(own):
        return False
    inertial = ET.SubElement(link, "inertial") if inertial is None else inertial
    centre = own[:3, 3] / mass
    second = own[:3, :3] - mass * np.outer(centre, centre)
    inertia = np.trace(second) * np.eye(3) - second
    _set(inertial, "origin", xyz=" ".join(map(str, centre.tolist())), rpy="0 0 0")
    _set(inertial, "mass", value=mass)
    _set(inertial, "inertia", **{f"i{AXES[i]}{AXES[j]}": inertia[i, j] for i, j in PAIRS})
    return True
