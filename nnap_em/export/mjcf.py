"""An identified machine written back as MJCF: bodies, friction, and every law that MuJoCo has a place for."""

import math
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from .. import __version__
from ..data.machine import Joint
from ..effects import AbstractEffect
from ..fit.identify import Identified
from ..model import hooks
from ..model.state_space import StateSpaceModel
from ..storage.files import replace_text
from ..systems.tree import Tree
from .actuator import actuator
from .content import Bristle, Contact, Content, Drive, JointContent, SensorContent
from .friction import REPORTED_MISS, FrictionForm, friction_forms
from .model import ExportError
from .placement import file_springs, placed

LONGEST_STEP = 5e-4
"""Longest time step of a written file [s]."""
SHORTEST = 5e-5
"""Shortest time step of a written file [s]."""
LARGEST_RELAXATION = 1.5
"""Largest relaxation of a bristle in a time step; beyond 2.8 the integrator diverges [1]."""
SOFT = 1e-4
"""Impedance of a contact, MuJoCo's smallest: the contact force is then that of its spring and damper to this share."""
ROOM = 10
"""Steps that a buffer of delayed values holds, over those of the delay: a file still plays at a shorter time step."""
MASSLESS = 1e-12
"""Mass of the body that carries a rotor [kg], whose inertia is the armature of its joint."""


class Motor(NamedTuple):
    """An actuator of the written file."""

    name: str
    joint: int
    """Counted from 0."""
    gear: float
    unit: float
    """Command of the fit for a unit of the control."""


def write_mjcf(fitted: Identified, out: Path | str, *, alone: bool = False) -> list[str]:
    """Write the identified machine to an MJCF file.

    Laws without a place go to a Python module beside it, `OUT_actuator.py`.

    Args:
        fitted: the model, of a machine from a file.
        out: the file.
        alone: write no module.

    Returns:
        Effects that MuJoCo cannot express, a sentence each.

    Raises:
        ExportError: the machine did not come from a file; with `alone`, a law has no place in MuJoCo. Nothing is
            written.
    """
    out = Path(out)
    as_it_is(fitted, fitted.model)
    return write_variant(fitted, fitted.model, friction_forms(fitted), out, alone=alone)


def write_variant(
    fitted: Identified, model: StateSpaceModel, forms: Sequence[FrictionForm], out: Path, *, alone: bool = False
) -> list[str]:
    """`write_mjcf` for a model and friction near those of a fit."""
    system = as_it_is(fitted, model)
    if model.servos:
        raise ExportError(
            "its inputs are commands of servos, which MJCF here has no form for; write --urdf or --c instead"
        )
    content, unplaced = placed(content_of(fitted, model, system, forms), model.effects)
    content = with_dips(content)
    if alone and unplaced:
        effect, reason = unplaced[0]
        raise ExportError(
            f"{named(effect)} has no place in MuJoCo ({reason}); leave out --alone to have {beside(out).name} play it, "
            "or diagnose again without this law"
        )
    left = [
        f"friction of {name}: its form misses {100 * form.missed:.0f} % of the learned curve"
        for name, form in zip(system.coordinates, forms, strict=True)
        if form.missed > REPORTED_MISS
    ]
    acting = actuator(fitted, model, unplaced, motors_of(fitted, system)) if unplaced else None
    left += [
        f"{named(effect)} ({reason}): {beside(out).name if acting and effect in acting.plays else 'nothing'} plays it"
        for effect, reason in unplaced
    ]
    root = _model(content, motors_of(fitted, system))
    notes = "".join(f"\n  - {line}" for line in left) or " nothing"
    comment = f" Written by nnap_em {__version__} from {system.machine.file}.  No shapes.  Not in here:{notes} "
    root.insert(0, ET.Comment(comment.replace("--", "- -")))
    ET.indent(root)
    if acting and acting.plays:
        replace_text(beside(out), acting.text)
    replace_text(out, ET.tostring(root, encoding="unicode") + "\n")
    return left


def beside(out: Path) -> Path:
    """The Python module beside a written file."""
    return out.with_name(f"{out.stem.replace('-', '_')}_actuator.py")


def as_it_is(fitted: Identified, model: StateSpaceModel) -> Tree:
    """The machine with all that is estimated of its bodies.

    Raises ExportError where it did not come from a file.
    """
    system = model.system
    if not isinstance(system, Tree):
        reason = f"the machine {fitted.rig.system!r} is built in, and has no file to be written back to"
        raise ExportError(f'{reason}; declare it by type = "mjcf" and its file')
    true = hooks.machine(model.effects, system, jnp.zeros(()))
    assert isinstance(true, Tree)
    return true


def content_of(fitted: Identified, model: StateSpaceModel, system: Tree, forms: Sequence[FrictionForm]) -> Content:
    """The content of a machine before its laws."""
    noise = np.exp(0.5 * np.asarray(model.log_r))
    sensors = {name: SensorContent(noise=float(std)) for name, std in zip(fitted.rig.measured, noise, strict=True)}
    joints = tuple(JointContent(form=form) for form in forms)
    drives = {joint: Drive() for joint in system.joints}
    return file_springs(Content(system, system.machine.gravity, model.dt, joints, drives, sensors))


def with_dips(content: Content) -> Content:
    """The content with a stiff bristle at every joint whose friction dips: MuJoCo has a dip only there."""
    inertia = 1 / _mobility(content.system)
    for number, joint in enumerate(content.joints, 1):
        form = joint.form
        if joint.bristle is None and form.breakaway > form.coulomb:
            soft = form.breakaway / (max(form.smooth, 0.01 * form.stribeck) * content.dt)
            stiffness = min(soft, LARGEST_RELAXATION * _level(form) / (form.fastest * LONGEST_STEP))
            bristle = Bristle(stiffness, float(np.sqrt(stiffness * inertia[number - 1])))
            content = content.with_joint(number, bristle=bristle)
    return content


def motors_of(fitted: Identified, system: Tree) -> list[Motor]:
    """Actuators of the file, then those of joints that the rig drives without one."""
    machine = system.machine
    inputs = dict(zip(system.joints, system.gears or (1.0,) * len(system.joints), strict=True))
    motors = [
        Motor(motor.name, motor.joint, motor.gear, motor.gear / inputs.get(motor.joint + 1, motor.gear))
        for motor in machine.motors
    ]
    driven = {motor.joint + 1 for motor in motors}
    columns = zip(fitted.rig.input_columns, system.joints, strict=True)
    return motors + [Motor(name, joint - 1, inputs[joint], 1.0) for name, joint in columns if joint not in driven]


def named(effect: AbstractEffect) -> str:
    """A law with its place and its numbers."""
    at = f" at joint {effect.joint}" if effect.joint else f" of {effect.channel}" if effect.channel else ""
    values = ", ".join(f"{name} = {float(value):.4g}" for name, value in effect.values().items())
    return f"{effect.name}{at}{': ' + values if values else ''}"


# --- XML


def _model(content: Content, motors: Sequence[Motor]) -> ET.Element:
    machine = content.system.machine
    root = ET.Element("mujoco", model=Path(machine.file).stem)
    ET.SubElement(root, "compiler", angle="radian", autolimits="true")
    step = content.dt / math.ceil(content.dt / _longest_step(content) - 1e-9)
    ET.SubElement(root, "option", timestep=_text(step), integrator="RK4", gravity=_text(*content.gravity))
    world = ET.SubElement(root, "worldbody")
    mobility = _mobility(content.system)
    places = _bodies(world, content, mobility)
    tendons = ET.Element("tendon")
    for j, joint in enumerate(content.joints):
        if joint.rotor is not None:
            _rotor(world, tendons, machine.joints[j].name, joint, mobility[j])
    if len(tendons):
        root.append(tendons)
    actuators = ET.SubElement(root, "actuator")
    for motor in motors:
        _motor(actuators, content, motor, step)
    for j, joint in enumerate(content.joints):
        _passive(actuators, machine.joints[j].name, joint)
    _sensors(ET.SubElement(root, "sensor"), content, places, world, step)
    return root


def _longest_step(content: Content) -> float:
    """Longest time step that the bristles bear: one relaxes at stiffness |v| / level [s]."""
    rates = [
        laws.bristle.stiffness * laws.form.fastest / _level(laws.form)
        for laws in content.joints
        if laws.bristle is not None and _bristled(laws)
    ]
    return max(min([LONGEST_STEP, *(LARGEST_RELAXATION / rate for rate in rates)]), SHORTEST)


def _level(form: FrictionForm) -> float:
    """Coulomb torque of a bristle, which may not vanish."""
    return max(form.coulomb, 1e-2 * form.breakaway)


def _mobility(system: Tree) -> np.ndarray:
    """Acceleration of every joint per force at it, with all joints as declared: MuJoCo scales contacts by it."""
    still = jnp.asarray([joint.zero for joint in system.machine.joints], float)
    return np.diagonal(np.linalg.inv(np.asarray(system.mass(still))))


def _bodies(world: ET.Element, content: Content, mobility: np.ndarray) -> list[ET.Element]:
    machine, places = content.system.machine, []
    for i, body in enumerate(machine.bodies):
        element = ET.SubElement(
            places[body.parent] if body.parent >= 0 else world,
            "body",
            name=body.name,
            pos=_text(*body.place),
            xyaxes=_text(*(row[0] for row in body.turn), *(row[1] for row in body.turn)),
        )
        places.append(element)
        for j, joint in enumerate(machine.joints):
            if joint.body == i:
                ET.SubElement(element, "joint", _joint(content, joint, content.joints[j], mobility[j]))
        mass, centre, inertia = content.system.body_numbers(i)
        if float(mass) > 0:
            full = [inertia[a][b] for a, b in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
            ET.SubElement(element, "inertial", pos=_text(*centre), mass=_text(mass), fullinertia=_text(*full))
        for site in machine.sites:
            if site.body == i:
                ET.SubElement(element, "site", name=site.name, pos=_text(*site.place))
    return places


def _joint(content: Content, joint: Joint, laws: JointContent, mobility: float) -> dict[str, str]:
    """Attributes of a joint, those aside that are MuJoCo's own."""
    viscous, bristled = laws.form.viscous + laws.viscous, _bristled(laws)
    attributes = {
        "name": joint.name,
        "type": "slide" if joint.slide else "hinge",
        "axis": _text(*joint.axis),
        "pos": _text(*joint.anchor),
        "armature": _text(content.system.values.get(f"{joint.name}.armature", joint.armature)),
        "damping": _text(viscous, laws.drag) if laws.drag else _text(viscous),
        "frictionloss": _text(0.0 if bristled else laws.form.coulomb),
    }
    attributes |= {"ref": _text(joint.zero)} if joint.zero else {}
    attributes |= _spring(laws)
    if laws.stop is not None:
        return attributes | {"range": _text(laws.stop.low, laws.stop.high)} | _contact(laws.stop, mobility, "limit")
    return attributes | ({"range": _text(*joint.range)} if joint.range else {})


def _spring(laws: JointContent) -> dict[str, str]:
    """Stiffness and rest of a pull; a constant that has no rest goes to `_passive`."""
    rest = _rest(laws)
    if not any(laws.pull[1:]):
        return {}
    _, b, c, d = laws.pull
    slopes = -(b + rest * (2 * c + 3 * d * rest)), -(c + 3 * d * rest), -d
    return {"stiffness": _text(*(slopes if c or d else slopes[:1])), "springref": _text(rest)}


def _rest(laws: JointContent) -> float:
    """Stable equilibrium of the springs, the stiffest if there are several; 0 where there is none."""
    a, b, c, d = laws.pull
    roots = np.roots([d, c, b, a]) if d or c else np.array([-a / b] if b else [])
    real = np.real(roots[np.abs(np.imag(roots)) < 1e-9 * (1 + np.abs(roots))])
    return float(min(real, key=lambda q: b + q * (2 * c + 3 * d * q), default=0.0))


def _contact(contact: Contact, mobility: float, of: str) -> dict[str, str]:
    """Solver parameters of a limit that is a spring and a damper."""
    return {
        f"solref{of}": _text(-contact.stiffness * mobility, -contact.damping * mobility),
        f"solimp{of}": _text(SOFT, SOFT, 1.0, 0.5, 1.0),
    }


def _rotor(world: ET.Element, tendons: ET.Element, name: str, laws: JointContent, mobility: float) -> None:
    """The motor as a wheel of its own, joined to its joint by a tendon."""
    rotor = laws.rotor
    assert rotor is not None
    body = ET.SubElement(world, "body", name=f"{name}_rotor")
    ET.SubElement(body, "joint", name=f"{name}_rotor", type="hinge", axis="0 0 1", armature=_text(rotor.inertia))
    tiny = _text(MASSLESS)
    ET.SubElement(body, "inertial", pos="0 0 0", mass=tiny, diaginertia=f"{tiny} {tiny} {tiny}")
    attributes = {"name": f"{name}_transmission"}
    if rotor.play is None:
        attributes |= {"stiffness": _text(rotor.stiffness), "damping": _text(rotor.damping), "springlength": "0"}
    else:
        attributes |= {"range": _text(rotor.play.low, rotor.play.high)}
        attributes |= _contact(rotor.play, mobility + 1 / (rotor.inertia + MASSLESS), "limit")
    tendon = ET.SubElement(tendons, "fixed", attributes)
    ET.SubElement(tendon, "joint", joint=f"{name}_rotor", coef="1")
    ET.SubElement(tendon, "joint", joint=name, coef="-1")


def _motor(actuators: ET.Element, content: Content, motor: Motor, step: float) -> None:
    name, joint = content.system.machine.joints[motor.joint].name, content.joints[motor.joint]
    attributes = {"name": motor.name, "joint": f"{name}_rotor" if joint.rotor else name, "gear": _text(motor.gear)}
    drive = content.drives.get(motor.joint + 1, Drive())
    options = _drive(drive, abs(motor.unit), step)
    ET.SubElement(actuators, "general" if {"gainprm", "dyntype"} & set(options) else "motor", attributes | options)


def _drive(drive: Drive, unit: float, step: float) -> dict[str, str]:
    """Attributes of the way from a control to a force; the state of a lag is held over a step, half a step late."""
    attributes = {}
    if math.isfinite(drive.before):
        attributes["ctrlrange"] = _text(-drive.before / unit, drive.before / unit)
    if math.isfinite(drive.after):
        attributes["forcerange"] = _text(-drive.after / unit, drive.after / unit)
    if drive.delay > 0:
        attributes |= _late(drive.delay, step)
    if drive.lag:
        attributes |= {"dyntype": "filterexact", "dynprm": _text(max(drive.lag - 0.5 * step, 0.05 * step))}
    if drive.gain != 1:
        attributes["gainprm"] = _text(drive.gain)
    return attributes


def _late(delay: float, step: float) -> dict[str, str]:
    """Attributes of a delay, interpolated between steps; MuJoCo's shortest is one step."""
    late = max(delay + 0.5 * step, step)  # interpolation begins to rise half a step early, on average
    return {"delay": _text(late), "nsample": str(ROOM * (math.ceil(delay / step) + 1)), "interp": "linear"}


def _passive(actuators: ET.Element, name: str, laws: JointContent) -> None:
    """Torques of a joint that MuJoCo has as those of a passive motor: cogging, a bristle, a constant."""
    still = {"joint": name, "input": "none", "motorconst": "0", "resistance": "1"}

    def add(what: str, **attributes: str) -> None:
        ET.SubElement(actuators, "dcmotor", {"name": f"{name}_{what}", **still, **attributes})

    for i, (amplitude, k, phase) in enumerate(laws.tones, 1):  # poles are whole numbers: k is a gear
        add(f"cogging{i}", gear=_text(k), cogging=_text(amplitude / k, 1.0, phase))
    constant = laws.form.offset + _unheld(laws)
    if constant:
        add("offset", cogging=_text(constant, 0.0, 0.5 * math.pi))
    if _bristled(laws):
        form, bristle = laws.form, laws.bristle
        assert bristle is not None
        add("bristle", lugre=_text(*bristle, _level(form), form.breakaway, form.stribeck))


def _unheld(laws: JointContent) -> float:
    """Constant pull that no rest holds."""
    a, b, c, d = laws.pull
    rest = _rest(laws)
    return a + rest * (b + rest * (c + rest * d)) if abs(a) > 0 else 0.0


def _bristled(laws: JointContent) -> bool:
    return laws.bristle is not None and laws.form.breakaway > 0


def _sensors(
    sensors: ET.Element, content: Content, bodies: Sequence[ET.Element], base: ET.Element, step: float
) -> None:
    machine = content.system.machine
    named = {sensor.name for sensor in machine.joint_sensors}
    for sensor in machine.joint_sensors:
        kind = "jointvel" if sensor.rate else "jointpos"
        attributes = {"name": sensor.name, "joint": machine.joints[sensor.joint].name}
        ET.SubElement(sensors, kind, attributes | _reading(content.sensors.get(sensor.name), step))
    dof = len(machine.joints)
    for name, sensor in content.sensors.items():
        if name in named or name not in machine.states or not sensor.delay:
            continue
        place = machine.states.index(name)
        kind = "jointvel" if place >= dof else "jointpos"
        attributes = {"name": name, "joint": machine.joints[place % dof].name}
        ET.SubElement(sensors, kind, attributes | _reading(sensor, step))
    for name, sensor in {one.name.rpartition(".")[0]: one for one in machine.sensors}.items():
        axes = _text(*(row[0] for row in sensor.turn), *(row[1] for row in sensor.turn))
        where = bodies[sensor.body] if sensor.body >= 0 else base
        ET.SubElement(where, "site", name=f"{name}_site", pos=_text(*sensor.place), xyaxes=axes)
        at = {"objtype": "site", "objname": f"{name}_site"} if sensor.kind == "framepos" else {"site": f"{name}_site"}
        reading = next((content.sensors[f"{name}.{x}"] for x in "xyz" if f"{name}.{x}" in content.sensors), None)
        ET.SubElement(sensors, sensor.kind, {"name": name, **at, **_reading(reading, step)})


def _reading(sensor: SensorContent | None, step: float) -> dict[str, str]:
    """Noise and delay of a sensor."""
    if sensor is None:
        return {}
    return {"noise": _text(sensor.noise)} | (_late(sensor.delay, step) if sensor.delay > 0 else {})


def _text(*values) -> str:
    return " ".join(f"{float(value):.12g}" for value in values)
