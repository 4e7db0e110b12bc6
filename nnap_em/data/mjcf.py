"""A machine from MJCF or URDF: MuJoCo's compiler reads the file, what the physics here has no place for is refused."""

import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from .machine import SENSE_UNITS, Body, Gauge, Joint, Machine, Motor, Rotation, Sense, Spot, Vector
from .rig import RigError

_FREE, _BALL, _SLIDE, _HINGE = range(4)


class MachineError(RigError):
    """A machine file that cannot be used: the message names the file, what stands in the way, and the mend."""


def read_machine(path: Path) -> Machine:
    """The tree of bodies and joints of an MJCF or URDF file, in SI units.

    Raises MachineError at what has no place in a model of a tree with a fixed base.
    """
    root = _parse(path)
    model = _compiled(path, root)
    _refuse_all(path, model)
    bodies = _bodies(model)
    joints = tuple(_joint(model, j) for j in range(model.njnt))
    machine = Machine(
        file=path.name,
        gravity=_vector(model.opt.gravity * (model.opt.disableflags & _flag("mjDSBL_GRAVITY") == 0)),
        bodies=bodies,
        joints=joints,
        motors=tuple(_motors(model)),
        gauges=tuple(_gauges(model)),
        spots=tuple(
            Spot(model.site(i).name, int(model.site_bodyid[i]) - 1, _vector(model.site_pos[i]))
            for i in range(model.nsite)
            if model.site_bodyid[i] > 0
        ),
        senses=tuple(_senses(model)),
    )
    _refuse_names(path, machine)
    return machine


def refuse(path: Path, found: str, mend: str) -> NoReturn:
    """Raise MachineError."""
    raise MachineError(f"{path}: {found}; {mend}")


def _mujoco() -> Any:
    try:
        import mujoco
    except ImportError:
        raise MachineError(
            'type = "mjcf" needs MuJoCo\'s parser, which is not installed; pip install "nnap-em[robots]"'
        ) from None
    return mujoco


def _flag(name: str) -> int:
    return int(getattr(_mujoco().mjtDisableBit, name))


def _parse(path: Path) -> ET.Element:
    """The root of the file, which says what it is."""
    try:
        root = ET.parse(path).getroot()
    except OSError as error:
        refuse(path, f"cannot be read ({error.strerror})", "file = names an MJCF or URDF file beside rig.toml")
    except ET.ParseError as error:
        refuse(path, f"not XML ({error})", "give the MJCF or URDF file as it was written, whole")
    if root.tag not in ("mujoco", "robot"):
        refuse(path, f"its root element is <{root.tag}>", "give MJCF (<mujoco>) or URDF (<robot>); expand xacro first")
    return root


def _compiled(path: Path, root: ET.Element) -> Any:
    """MuJoCo's model; where only meshes or textures are missing, without the shapes of bodies that have an inertial."""
    mujoco = _mujoco()
    try:
        if root.tag == "robot":
            _refuse_urdf(path, root)
            return mujoco.MjModel.from_xml_string(_bare_urdf(root))
        return mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        said = " ".join(str(error).split())
    if root.tag == "mujoco" and re.search(r"opening file|resource|not found|reading file", said, re.I):
        whole = _included(path, root)
        _strip(path, whole)
        try:
            return mujoco.MjModel.from_xml_string(ET.tostring(whole, encoding="unicode"))
        except ValueError as error:
            said = " ".join(str(error).split())
    refuse(path, f"MuJoCo's compiler refuses it: {said}", _mend(said))


def _mend(said: str) -> str:
    """What to do about the commonest errors of the compiler."""
    mends = {
        r"mass and inertia of moving bodies": "give every body that moves an <inertial> with mass and inertia above 0",
        r"must satisfy A \+ B >= C": "an inertia's largest part is at most the sum of the other two: correct it",
        r"inertia.*(positive|negative)|(positive|negative).*inertia": "masses and inertias are above 0: correct it",
        r"repeated name|already|duplicate": "give every body, joint, motor and sensor a name of its own",
        r"opening file|not found": "put the file where it is looked for, or give its body an <inertial>",
        r"cycl|loop|parent": "a machine here is a tree: every link has one parent",
    }
    found = (mend for pattern, mend in mends.items() if re.search(pattern, said, re.I))
    return next(found, "correct the file; MuJoCo's viewer shows the same error")


# --- files whose meshes are elsewhere


def _refuse_urdf(path: Path, root: ET.Element) -> None:
    """What MuJoCo would say in its own words, or not at all."""
    links = {str(link.get("name")): link for link in root.findall("link")}
    parents: dict[str, str] = {}
    for joint in root.findall("joint"):
        name, kind = joint.get("name"), joint.get("type")
        parent, child = (_link(joint, end) for end in ("parent", "child"))
        for end in (parent, child):
            if end not in links:
                refuse(path, f"joint {name!r} names a link {end!r} that is not there", "add it, or correct its name")
        if child in parents:
            refuse(path, f"link {child!r} hangs on two joints", "a machine here is a tree: cut the loop at one of them")
        parents[child] = parent
        if kind in ("floating", "planar"):
            refuse(path, f"joint {name!r} is {kind}", "fix the base, or model the joint as slides and hinges")
        if joint.find("mimic") is not None:
            refuse(path, f"joint {name!r} mimics another", "free it of the other: couplings are no tree")
        if kind != "fixed" and links[child].find("inertial") is None and not _carries(child, root):
            mend = "add <inertial> with <mass> and <inertia>: shapes alone say nothing about weight"
            refuse(path, f"link {child!r} moves and has no <inertial>", mend)
    if parents and not set(links) - set(parents):
        refuse(path, "its links form a ring", "a machine here is a tree: one link has no parent")
    for name in parents:
        seen, at = {name}, name
        while at in parents:
            at = parents[at]
            if at in seen:
                refuse(path, f"link {name!r} is its own ancestor", "a machine here is a tree: cut the ring at a joint")
            seen.add(at)


def _link(joint: ET.Element, end: str) -> str:
    """The link at an end of a joint."""
    found = joint.find(end)
    return "" if found is None else str(found.get("link"))


def _carries(link: str, root: ET.Element) -> bool:
    """Whether a link without mass carries one that has, fixed to it."""
    for joint in root.findall("joint"):
        if joint.get("type") == "fixed" and _link(joint, "parent") == link:
            name = _link(joint, "child")
            here = next(one for one in root.findall("link") if one.get("name") == name)
            if here.find("inertial") is not None or _carries(name, root):
                return True
    return False


def _bare_urdf(root: ET.Element) -> str:
    """Without shapes: they weigh nothing here, and their files are elsewhere."""
    for link in root.findall("link"):
        for shape in (*link.findall("visual"), *link.findall("collision")):
            link.remove(shape)
    return ET.tostring(root, encoding="unicode")


def _included(path: Path, node: ET.Element) -> ET.Element:
    """The whole file, with what it includes in its place."""
    for child in list(node):
        if child.tag == "include":
            place, inner = list(node).index(child), path.parent / str(child.get("file"))
            node.remove(child)
            for k, part in enumerate(_included(path, _parse_part(inner))):
                node.insert(place + k, part)
        else:
            _included(path, child)
    return node


def _parse_part(path: Path) -> ET.Element:
    try:
        return ET.parse(path).getroot()
    except (OSError, ET.ParseError) as error:
        refuse(path, f"cannot be included ({error})", "put the included file where the main file looks for it")


def _strip(path: Path, root: ET.Element) -> None:
    """Take away shapes of bodies that have an inertial, and all assets; refuse shapes that are needed and not there."""
    if (compiler := root.find("compiler")) is not None and compiler.get("inertiafromgeom") == "true":
        refuse(path, 'inertiafromgeom = "true", but its meshes are missing', "put them beside the file")
    for world in root.findall("worldbody"):
        _strip_body(path, world, "world", weighed=True)
    for tag in ("asset", "contact", "keyframe", "visual", "deformable"):
        for part in root.findall(tag):
            root.remove(part)


def _strip_body(path: Path, body: ET.Element, name: str, weighed: bool) -> None:
    weighed = weighed or body.find("inertial") is not None
    for child in list(body):
        if child.tag == "body":
            _strip_body(path, child, str(child.get("name")), False)
        elif child.tag == "frame":
            _strip_body(path, child, name, weighed)
        elif child.tag == "geom" and not weighed and child.get("mesh"):
            found = f"body {name!r} has no <inertial>, and its mesh {child.get('mesh')!r} is missing"
            refuse(path, found, "put the mesh beside the file, or give the body an <inertial>")
        elif child.tag in ("geom", "camera", "light"):
            if weighed or child.tag != "geom":
                body.remove(child)
            else:
                child.attrib.pop("material", None)


# --- what has no place here


def _refuse_all(path: Path, model: Any) -> None:
    for found, mend in _obstacles(model):
        refuse(path, found, mend)


def _obstacles(model: Any) -> Iterator[tuple[str, str]]:
    """What stands in the way, by name, with the mend."""
    for j in range(model.njnt):
        name, kind = model.joint(j).name or f"number {j + 1}", int(model.jnt_type[j])
        if kind == _FREE:
            yield f"joint {name!r} is free", "the base is fixed here: take the free joint out"
        if kind == _BALL:
            yield f"joint {name!r} is a ball joint", "write it as three hinges of one body"
        if _any(model, "jnt_stiffnesspoly", j) or _any(model, "jnt_springyield", j):
            yield f"the spring of joint {name!r} is not linear", "leave the linear part; diagnose finds what is missing"
    if model.njnt == 0:
        yield "nothing moves: it has no joint", "give the bodies hinges or slides"
    if model.neq:
        yield f"it has {model.neq} equality constraints", "a loop or coupling is no tree: take <equality> out"
    if model.ntendon:
        yield f"it has {model.ntendon} tendons", "put their springs and motors on joints, and take <tendon> out"
    for i in range(model.nu):
        yield from _actuator(model, i)
    if model.opt.density or model.opt.viscosity:
        yield "bodies move in a fluid", "set density and viscosity to 0; diagnose finds drag"
    if np.any(model.body_gravcomp):
        name = model.body(int(np.flatnonzero(model.body_gravcomp)[0])).name
        yield f"body {name!r} has gravcomp", "log the torque that compensates its weight as an input, and take it out"
    if getattr(model, "nflex", 0):
        yield "it has flexible bodies", "bodies are rigid here: take them out"


def _any(model: Any, field: str, i: int) -> bool:
    return bool(np.any(getattr(model, field, np.zeros(i + 1))[i]))


def _actuator(model: Any, i: int) -> Iterator[tuple[str, str]]:
    mujoco = _mujoco()
    name = model.actuator(i).name or f"number {i + 1}"
    gain, bias, state, acts = (
        int(getattr(model, f"actuator_{kind}type")[i]) for kind in ("gain", "bias", "dyn", "trn")
    )
    mend = "log the torque that it gives and make it <motor>, or take it out and name torque columns in [input]"
    if gain == int(mujoco.mjtGain.mjGAIN_MUSCLE) or state == int(mujoco.mjtDyn.mjDYN_MUSCLE):
        yield f"actuator {name!r} is a muscle", mend
    elif state != int(mujoco.mjtDyn.mjDYN_NONE):
        yield f"actuator {name!r} has a state of its own", mend
    elif bias != int(mujoco.mjtBias.mjBIAS_NONE):
        yield f"actuator {name!r} is a servo (position, velocity or damper)", mend
    elif gain != int(mujoco.mjtGain.mjGAIN_FIXED):
        yield f"actuator {name!r} has a gain that is not fixed", mend
    elif acts not in (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)):
        yield f"actuator {name!r} drives no joint", "let every motor drive a joint"


def _refuse_names(path: Path, machine: Machine) -> None:
    """Names become columns, keys of rig.toml and file names: letters, digits, _ and -, none twice, none reserved."""
    for joint in machine.joints:
        if not joint.name:
            body = machine.bodies[joint.body].name
            refuse(path, f"a joint of body {body!r} has no name", "name it: that is what its coordinate is called")
        if not re.fullmatch(r"[^\W\d][\w-]*", joint.name):
            refuse(path, f"joint {joint.name!r}: unusable name", "write letters, digits, _ and -, a letter first")
    names = [joint.name for joint in machine.joints]
    for name in names:
        if f"d{name}" in names:
            refuse(path, f"joint {'d' + name!r} is called as the rate of joint {name!r}", "rename one of the two")
        if name in ("time", "u", "all", "type", "file"):
            refuse(path, f"joint {name!r} has a name that logs and rig.toml use", "rename it")


# --- plain numbers


def _bodies(model: Any) -> tuple[Body, ...]:
    return tuple(
        Body(
            name=model.body(i).name or f"body{i}",
            parent=int(model.body_parentid[i]) - 1,
            place=_vector(model.body_pos[i]),
            turn=_rotation(model.body_quat[i]),
            mass=float(model.body_mass[i]),
            centre=_vector(model.body_ipos[i]),
            inertia=_inertia(model, i),
        )
        for i in range(1, model.nbody)
    )


def _inertia(model: Any, i: int) -> Rotation:
    turn = np.asarray(_rotation(model.body_iquat[i]))
    whole = turn @ np.diag(model.body_inertia[i]) @ turn.T
    return _matrix(0.5 * (whole + whole.T))


def _joint(model: Any, j: int) -> Joint:
    dof, place = int(model.jnt_dofadr[j]), int(model.jnt_qposadr[j])
    return Joint(
        name=model.joint(j).name,
        body=int(model.jnt_bodyid[j]) - 1,
        slide=int(model.jnt_type[j]) == _SLIDE,
        axis=_vector(model.jnt_axis[j]),
        anchor=_vector(model.jnt_pos[j]),
        zero=float(model.qpos0[place]),
        stiffness=float(np.ravel(model.jnt_stiffness[j])[0]),
        rest=float(model.qpos_spring[place]),
        armature=float(model.dof_armature[dof]),
        damping=float(np.ravel(model.dof_damping[dof])[0]),
        dry=float(model.dof_frictionloss[dof]),
        range=(float(model.jnt_range[j][0]), float(model.jnt_range[j][1])) if model.jnt_limited[j] else None,
    )


def _motors(model: Any) -> Iterator[Motor]:
    for i in range(model.nu):
        gain = float(model.actuator_gainprm[i][0]) * float(model.actuator_gear[i][0])
        yield Motor(model.actuator(i).name or f"u{i + 1}", int(model.actuator_trnid[i][0]), gain)


def _gauges(model: Any) -> Iterator[Gauge]:
    kinds = _mujoco().mjtSensor
    for i in range(model.nsensor):
        kind, rate = int(model.sensor_type[i]), int(kinds.mjSENS_JOINTVEL)
        if kind in (int(kinds.mjSENS_JOINTPOS), rate):
            yield Gauge(model.sensor(i).name, int(model.sensor_objid[i]), kind == rate)


def _senses(model: Any) -> Iterator[Sense]:
    """The components of every sensor that reads no joint."""
    mujoco = _mujoco()
    sites, joints = int(mujoco.mjtObj.mjOBJ_SITE), (mujoco.mjtSensor.mjSENS_JOINTPOS, mujoco.mjtSensor.mjSENS_JOINTVEL)
    for i in range(model.nsensor):
        if int(model.sensor_type[i]) in map(int, joints):
            continue
        kind, at = mujoco.mjtSensor(int(model.sensor_type[i])).name.removeprefix("mjSENS_").lower(), -1
        if int(model.sensor_objtype[i]) == sites and int(model.sensor_refid[i]) < 0:
            at = int(model.sensor_objid[i])
        elif kind in SENSE_UNITS:
            kind = f"{kind} of no site, or in no frame of the world"
        place, turn = (model.site_pos[at], model.site_quat[at]) if at >= 0 else (np.zeros(3), np.array([1.0, 0, 0, 0]))
        body = int(model.site_bodyid[at]) - 1 if at >= 0 else -1
        for axis, letter in enumerate("xyz"):
            yield Sense(f"{model.sensor(i).name}.{letter}", kind, axis, body, _vector(place), _rotation(turn))


def _rotation(quaternion: np.ndarray) -> Rotation:
    w, x, y, z = np.asarray(quaternion, float) / np.linalg.norm(quaternion)
    return _matrix(
        np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
    )


def _matrix(values: np.ndarray) -> Rotation:
    a, b, c = (_vector(row) for row in values)
    return a, b, c


def _vector(values: np.ndarray) -> Vector:
    x, y, z = (float(value) for value in values)
    return x, y, z
