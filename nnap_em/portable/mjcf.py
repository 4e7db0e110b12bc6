"""What was identified, written back as MJCF: bodies, springs, and friction as far as MuJoCo has a place for it."""

import xml.etree.ElementTree as ET
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy.optimize
from jaxtyping import Float

from .. import __version__
from ..data.machine import Joint, Machine
from ..effects.position import TorsionalSpring
from ..em.identify import Identified, friction_table
from ..model import hooks
from ..storage.files import replace_text
from ..systems.bodies import numbers
from ..systems.tree import Tree
from .export import ExportError

SHARE = 0.1
"""Share of a learned curve beyond which what Coulomb and viscous friction miss of it is told."""


class Friction(NamedTuple):
    """Coulomb and viscous friction nearest to a learned curve."""

    dry: float
    """[N m or N]"""
    damping: float
    """[N m s/rad or N s/m]"""
    left: float
    """Root mean square of what they miss, over that of the curve."""


def write_mjcf(fitted: Identified, out: Path) -> list[str]:
    """Write the identified machine to the file `out`, and return what MuJoCo has no place for, a sentence each.

    Raises ExportError where the machine did not come from a file.
    """
    system = fitted.model.system
    if not isinstance(system, Tree):
        found = f"the machine {fitted.rig.system!r} is built in, and has no file to be written back to"
        raise ExportError(f'{found}; declare it by type = "mjcf" and its file')
    true = hooks.machine(fitted.model.effects, system, jnp.zeros(()))
    assert isinstance(true, Tree)
    curves = _curves(fitted)
    springs, left = _springs(fitted)
    for name, curve in zip(true.coordinates, curves, strict=True):
        if curve.left > SHARE:
            said = f"friction of {name}: Coulomb and viscous miss {100 * curve.left:.0f} % of the learned curve"
            left.append(f"{said} (a Stribeck dip, or other friction in either direction)")
    machine = _with_springs(true.machine, true, springs)
    root = _model(machine, true, curves)
    notes = "".join(f"\n  - {line}" for line in left) or " nothing"
    said = f" Written by nnap_em {__version__} from {machine.file}.  No shapes.  Not in here:{notes} "
    root.insert(0, ET.Comment(said.replace("--", "- -")))
    ET.indent(root)
    replace_text(out, ET.tostring(root, encoding="unicode") + "\n")
    return left


def coulomb_viscous(
    v: Float[np.ndarray, " node"], torque: Float[np.ndarray, " node"], std: Float[np.ndarray, " node"]
) -> Friction:
    """The two numbers that come nearest to a curve of friction torque, where it is known best, and never push."""
    weight = 1 / np.maximum(std, 0.05 * np.max(np.abs(torque), initial=1e-300))
    basis = np.stack([np.sign(v), v], axis=1) * weight[:, None]
    found, _ = scipy.optimize.nnls(basis, -torque * weight)
    missed = torque + np.stack([np.sign(v), v], axis=1) @ found
    share = np.sqrt(np.average(missed**2, weights=weight) / max(np.average(torque**2, weights=weight), 1e-300))
    return Friction(float(found[0]), float(found[1]), float(share))


def _curves(fitted: Identified) -> list[Friction]:
    """Of every joint; the file's where none is learned."""
    system = fitted.model.system
    assert isinstance(system, Tree)
    if not fitted.rig.friction:
        return [Friction(joint.dry, joint.damping, 0.0) for joint in system.machine.joints]
    nodes = np.asarray(fitted.m_step.weights(fitted.model).nodes)
    even = np.linspace(-1.0, 1.0, 80)[None] * np.max(np.abs(nodes), axis=1)[:, None]  # nodes crowd about rest
    table = friction_table(fitted, jnp.asarray(even))
    joints = zip(*map(np.asarray, (table.velocity, table.torque, table.std)), strict=True)
    return [coulomb_viscous(*joint) for joint in joints]


def _springs(fitted: Identified) -> tuple[dict[int, tuple[float, float]], list[str]]:
    """Stiffness and rest of the springs that were found, by joint; and what of the effects has no place."""
    springs, left = {}, []
    for effect in fitted.model.effects:
        if isinstance(effect, TorsionalSpring):
            found = effect.values()
            springs[effect.joint - 1] = (float(found["k"]), float(found["theta0"]))
        elif not _is_body(fitted, effect):
            at = f" at joint {effect.joint}" if effect.joint else ""
            values = ", ".join(f"{name} = {float(value):.4g}" for name, value in effect.values().items())
            left.append(f"{effect.name}{at}: {values or 'a learned function'}")
    return springs, left


def _is_body(fitted: Identified, effect) -> bool:
    """Whether an effect is a change of a body for good, which the numbers of the bodies hold."""
    return (effect.name, effect.joint) in fitted.model.system.variations


def _with_springs(machine: Machine, system: Tree, found: dict[int, tuple[float, float]]) -> Machine:
    """Two springs on a joint are one."""
    joints = []
    for j, joint in enumerate(machine.joints):
        own = float(system.values.get(f"{joint.name}.stiffness", joint.stiffness))
        more, rest = found.get(j, (0.0, joint.rest))
        both = own + more
        rest = (own * joint.rest + more * rest) / both if both else joint.rest
        armature = float(system.values.get(f"{joint.name}.armature", joint.armature))
        joints.append(joint._replace(stiffness=both, rest=rest, armature=armature))
    return machine._replace(joints=tuple(joints))


def _model(machine: Machine, system: Tree, curves: list[Friction]) -> ET.Element:
    root = ET.Element("mujoco", model=Path(machine.file).stem)
    ET.SubElement(root, "compiler", angle="radian", autolimits="true")
    ET.SubElement(root, "option", gravity=_text(*machine.gravity))
    world = ET.SubElement(root, "worldbody")
    places: list[ET.Element] = []
    for i, body in enumerate(machine.bodies):
        own = ET.SubElement(
            places[body.parent] if body.parent >= 0 else world,
            "body",
            name=body.name,
            pos=_text(*body.place),
            xyaxes=_text(*(row[0] for row in body.turn), *(row[1] for row in body.turn)),
        )
        places.append(own)
        for joint, curve in zip(machine.joints, curves, strict=True):
            if joint.body == i:
                ET.SubElement(own, "joint", _joint(joint, curve))
        mass, centre, inertia = numbers(body, system.values)
        if float(mass) > 0:
            full = [inertia[a][b] for a, b in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
            ET.SubElement(own, "inertial", pos=_text(*centre), mass=_text(mass), fullinertia=_text(*full))
        for spot in machine.spots:
            if spot.body == i:
                ET.SubElement(own, "site", name=spot.name, pos=_text(*spot.place))
    motors = ET.SubElement(root, "actuator")
    for motor in machine.motors:
        joint = machine.joints[motor.joint].name
        ET.SubElement(motors, "motor", name=motor.name, joint=joint, gear=_text(motor.gear))
    sensors = ET.SubElement(root, "sensor")
    for gauge in machine.gauges:
        kind = "jointvel" if gauge.rate else "jointpos"
        ET.SubElement(sensors, kind, name=gauge.name, joint=machine.joints[gauge.joint].name)
    for name, sense in {one.name.rpartition(".")[0]: one for one in machine.senses}.items():
        axes = _text(*(row[0] for row in sense.turn), *(row[1] for row in sense.turn))
        where = places[sense.body] if sense.body >= 0 else world
        ET.SubElement(where, "site", name=f"{name}_site", pos=_text(*sense.place), xyaxes=axes)
        at = {"objtype": "site", "objname": f"{name}_site"} if sense.kind == "framepos" else {"site": f"{name}_site"}
        ET.SubElement(sensors, sense.kind, {"name": name, **at})
    return root


def _joint(joint: Joint, curve: Friction) -> dict[str, str]:
    """Its attributes, those aside that are MuJoCo's own."""
    given = {
        "name": joint.name,
        "type": "slide" if joint.slide else "hinge",
        "axis": _text(*joint.axis),
        "pos": _text(*joint.anchor),
        "armature": _text(joint.armature),
        "damping": _text(curve.damping),
        "frictionloss": _text(curve.dry),
    }
    given |= {"ref": _text(joint.zero)} if joint.zero else {}
    given |= {"stiffness": _text(joint.stiffness), "springref": _text(joint.rest)} if joint.stiffness else {}
    return given | ({"range": _text(*joint.range)} if joint.range else {})


def _text(*values) -> str:
    return " ".join(f"{float(value):.12g}" for value in values)
