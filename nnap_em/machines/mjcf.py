"""A machine from MJCF or URDF: MuJoCo's compiler reads the file, what the physics here has no place for is refused."""

import re
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..data.machine import SENSE_UNITS, Body, Joint, JointSensor, Machine, Motor, Rotation, Sensor, Site
from ..data.rig import RigWarning, nearest
from ..data.servo import TORQUE
from .locked import NOTHING, Follows, Part, groups, holding, lock, matrix, vector
from .source import MachineError, in_own_lines, included, parse, refuse, text
from .urdf import Gear, bare, mimics, refuse_urdf, transmissions

_FREE, _BALL, _SLIDE, _HINGE = range(4)


_WHOLE = Part()


def read_machine(path: Path, part: Part = _WHOLE) -> Machine:
    """The tree of bodies and joints of an MJCF or URDF file, or a part of it, in SI units.

    Joints that are held without a value stand where the file has them, or where the joint that they follow puts them.
    Raises MachineError at what has no place in a model of a tree with a fixed base.
    """
    root = parse(path)
    follows = mimics(root)
    gears = transmissions(path, root) if root.tag == "robot" else {}
    model = _compiled(path, root, part)
    _refuse_unknown(path, model, part)
    _refuse_all(path, model, part)
    bodies = _bodies(model)
    numbers = [j for j in range(model.njnt) if int(model.jnt_type[j]) in (_SLIDE, _HINGE)]
    joints = tuple(_joint(model, j, gears) for j in numbers)
    driven = [motor for motor in _motors(model, part) if motor.joint in numbers]
    machine = Machine(
        file=path.name,
        gravity=vector(model.opt.gravity * (model.opt.disableflags & _flag("mjDSBL_GRAVITY") == 0)),
        bodies=bodies,
        joints=joints,
        motors=tuple(motor._replace(joint=numbers.index(motor.joint)) for motor in driven),
        joint_sensors=tuple(
            sensor._replace(joint=numbers.index(sensor.joint))
            for sensor in _joint_sensors(model)
            if sensor.joint in numbers
        ),
        sites=tuple(
            Site(model.site(i).name, int(model.site_bodyid[i]) - 1, vector(model.site_pos[i]))
            for i in range(model.nsite)
            if model.site_bodyid[i] > 0
        ),
        sensors=tuple(_sensors(model)),
    )
    if not part.whole:
        joined = range(len(bodies)) if root.tag == "robot" else {int(i) - 1 for i in model.jnt_bodyid}
        machine = _part(path, machine, part, {**follows, **_couplings(model)}, joined)
    _refuse_names(path, machine)
    return machine


def _part(path: Path, machine: Machine, part: Part, follows: Mapping[str, Follows], joined: Collection[int]) -> Machine:
    """The machine with its other joints held; warns of bodies without mass that join another."""
    values = {joint.name: part.locked.get(joint.name, joint.zero) for joint in machine.joints if part.holds(joint.name)}
    for _ in follows:  # a joint may follow one that follows another
        for name, law in follows.items():
            if name in values and law.joint in values and name not in part.locked:
                values[name] = law.value(values[law.joint])
    for joint in machine.joints:
        body = machine.bodies[joint.body]
        if joint.name in values and (body.mass <= NOTHING or np.trace(body.inertia) <= 10 * NOTHING):
            problem = f"body {body.name!r} hangs on the locked joint {joint.name!r} and has no mass or no inertia"
            warnings.warn(f"{path}: {problem}; it is joined to the body that carries it", RigWarning, 2)
    machine = lock(machine, values, joined)
    group = groups(machine, {joint.body for joint in machine.joints}.__contains__)
    for i in sorted({joint.body for joint in machine.joints}):
        group_bodies = [body for k, body in enumerate(machine.bodies) if group[k] == i + 1]
        if sum(body.mass for body in group_bodies) <= NOTHING:
            joint = next(joint.name for joint in machine.joints if joint.body == i)
            hint = f"give it an <inertial>, or hold its joint: {holding(joint)}"
            refuse(path, f"body {machine.bodies[i].name!r} moves and has no mass", hint)
    return machine


def _refuse_unknown(path: Path, model: Any, part: Part) -> None:
    """Joints of rig.toml that the file does not have."""
    names = [model.joint(j).name for j in range(model.njnt)]
    for key, declared in (("joints", part.joints or ()), ("locked", part.locked)):
        for name in declared:
            if name not in names:
                refuse(path, f"[model] {key} names {name!r}, which is no joint of it", nearest(name, names))
    for j, name in enumerate(names):
        if name in part.locked and int(model.jnt_type[j]) not in (_SLIDE, _HINGE):
            refuse(path, f"joint {name!r} is held by more than one number", "name the joints that move: joints = [...]")


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


def _build(spec: Any, part: Part) -> Any:
    """MuJoCo's model of a file; that of a part may have bodies without mass, on joints that are held."""
    if not part.whole:
        spec.compiler.boundmass = max(spec.compiler.boundmass, 0.1 * NOTHING)
        spec.compiler.boundinertia = max(spec.compiler.boundinertia, 0.1 * NOTHING)
        spec.compiler.fusestatic = False
    return spec.compile()


def _compiled(path: Path, root: ET.Element, part: Part) -> Any:
    """MuJoCo's model; where only meshes or textures are missing, without the shapes of bodies that have an inertial."""
    mujoco, message = _mujoco(), ""
    if root.tag == "robot":
        refuse_urdf(path, root, part)
        root = bare(root)
    else:
        try:
            return _build(mujoco.MjSpec.from_file(str(path)), part)
        except ValueError as error:
            message = " ".join(str(error).split())
        root = included(path, root)
    missing = re.search(r"opening file|resource|not found|reading file", message, re.I)
    if missing:
        _strip(path, root)
    try:
        model = _build(mujoco.MjSpec.from_string(text(root)), part)
        if missing or not message:
            return model
    except ValueError as error:
        again = " ".join(str(error).split())
        if missing or not message or re.sub(r"line \d+", "", again) == re.sub(r"line \d+", "", message):
            message = in_own_lines(again, root)  # MuJoCo counts no lines of included files
    refuse(path, f"MuJoCo's compiler refuses it: {message}", _hint(message))


def _hint(message: str) -> str:
    """Remedies for the commonest errors of the compiler."""
    hints = {
        r"mass and inertia of moving bodies": "give every body that moves an <inertial> with mass and inertia above 0",
        r"must satisfy A \+ B >= C": "an inertia's largest part is at most the sum of the other two: correct it",
        r"inertia.*(positive|negative)|(positive|negative).*inertia": "masses and inertias are above 0: correct it",
        r"repeated name|already|duplicate": "give every body, joint, motor and sensor a name of its own",
        r"opening file|not found": "put the file where it is looked for, or give its body an <inertial>",
        r"cycl|loop|parent": "a machine here is a tree: every link has one parent",
    }
    matching = (hint for pattern, hint in hints.items() if re.search(pattern, message, re.I))
    return next(matching, "correct the file; MuJoCo's viewer shows the same error")


def _couplings(model: Any) -> dict[str, Follows]:
    """The joints of an MJCF file that an equality constraint couples to another."""
    kind, out = int(_mujoco().mjtEq.mjEQ_JOINT), {}
    for i in range(model.neq):
        first, second = int(model.eq_obj1id[i]), int(model.eq_obj2id[i])
        if int(model.eq_type[i]) == kind and second >= 0:
            zeros = (float(model.qpos0[model.jnt_qposadr[j]]) for j in (first, second))
            law = tuple(float(c) for c in model.eq_data[i][:5])
            out[model.joint(first).name] = Follows(model.joint(second).name, law, *zeros)
    return out


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
            problem = f"body {name!r} has no <inertial>, and its mesh {child.get('mesh')!r} is missing"
            refuse(path, problem, "put the mesh beside the file, or give the body an <inertial>")
        elif child.tag in ("geom", "camera", "light"):
            if weighed or child.tag != "geom":
                body.remove(child)
            else:
                child.attrib.pop("material", None)


# --- what has no place here


def _refuse_all(path: Path, model: Any, part: Part) -> None:
    for problem, hint in _obstacles(model, part):
        refuse(path, problem, hint)


def _obstacles(model: Any, part: Part) -> Iterator[tuple[str, str]]:
    """Obstacles by name, each with its remedy."""
    held = [part.holds(model.joint(j).name) for j in range(model.njnt)]
    for j in range(model.njnt):
        if held[j]:
            continue
        name, kind = model.joint(j).name or f"number {j + 1}", int(model.jnt_type[j])
        if kind == _FREE:
            yield f"joint {name!r} is free", "the base is fixed here: take the free joint out"
        if kind == _BALL:
            yield f"joint {name!r} is a ball joint", "write it as three hinges of one body"
        if _any(model, "jnt_stiffnesspoly", j) or _any(model, "jnt_springyield", j):
            yield f"the spring of joint {name!r} is not linear", "leave the linear part; diagnose finds what is missing"
    if model.njnt == 0:
        yield "nothing moves: it has no joint", "give the bodies hinges or slides"
    elif all(held):
        yield "nothing moves: every joint is held", "leave some out of [model] locked, or name them in joints = [...]"
    if closed := list(_closed(model, held)):
        lines = list(dict.fromkeys(name for names in closed for name in names))
        hint = "a loop or coupling is no tree: take <equality> out"
        hint += f", or hold the joints that it closes: {holding(*lines)}" if lines else ""
        yield f"it has {len(closed)} equality constraints" + ("" if part.whole else " on joints that move"), hint
    loose = [i for i in range(model.ntendon) if not _still(model, i, held)]
    if loose:
        yield f"it has {len(loose)} tendons", "put their springs and motors on joints, and take <tendon> out"
    for i in range(getattr(model, "nactuator", model.nu)):
        if _moves(model, i, held):
            yield from _actuator(model, i)
    if model.opt.density or model.opt.viscosity:
        yield "bodies move in a fluid", "set density and viscosity to 0; diagnose finds drag"
    if np.any(model.body_gravcomp):
        name = model.body(int(np.flatnonzero(model.body_gravcomp)[0])).name
        yield f"body {name!r} has gravcomp", "log the torque that compensates its weight as an input, and take it out"
    if getattr(model, "nflex", 0):
        yield "it has flexible bodies", "bodies are rigid here: take them out"


def _closed(model: Any, held: list[bool]) -> Iterator[list[str]]:
    """The joints that move of each equality constraint that is not between parts that are held against each other."""
    mujoco = _mujoco()
    parents = [int(model.body_parentid[i]) for i in range(model.nbody)]
    moving = [
        [j for j in range(model.njnt) if int(model.jnt_bodyid[j]) == i and not held[j]] for i in range(model.nbody)
    ]

    def above(body: int) -> set[int]:
        joints: set[int] = set()
        while body > 0:
            joints |= set(moving[body])
            body = parents[body]
        return joints

    for i in range(model.neq):
        kind, ends = int(model.eq_type[i]), (int(model.eq_obj1id[i]), int(model.eq_obj2id[i]))
        if kind == int(mujoco.mjtEq.mjEQ_JOINT):
            free = {j for j in ends if j >= 0 and not held[j]}
        elif kind in (int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD)):
            sites = int(model.eq_objtype[i]) == int(mujoco.mjtObj.mjOBJ_SITE)
            one, two = (int(model.site_bodyid[end]) if sites else end for end in ends)
            free = above(one) ^ above(two)
        else:
            yield []
            continue
        if free:
            yield [model.joint(j).name for j in sorted(free)]


def _still(model: Any, tendon: int, held: list[bool]) -> bool:
    """True for a tendon that runs over joints alone, all of them held."""
    first, count, kind = (
        int(model.tendon_adr[tendon]),
        int(model.tendon_num[tendon]),
        int(_mujoco().mjtWrap.mjWRAP_JOINT),
    )
    wraps = range(first, first + count)
    return all(int(model.wrap_type[k]) == kind and held[int(model.wrap_objid[k])] for k in wraps)


def _moves(model: Any, actuator: int, held: list[bool]) -> bool:
    """True for an actuator that drives something that moves."""
    kinds, acts, end = _mujoco().mjtTrn, int(model.actuator_trntype[actuator]), int(model.actuator_trnid[actuator][0])
    if acts in (int(kinds.mjTRN_JOINT), int(kinds.mjTRN_JOINTINPARENT)):
        return not held[end]
    return not (acts == int(kinds.mjTRN_TENDON) and _still(model, end, held))


def _any(model: Any, field: str, i: int) -> bool:
    return bool(np.any(getattr(model, field, np.zeros(i + 1))[i]))


def _actuator(model: Any, i: int) -> Iterator[tuple[str, str]]:
    mujoco = _mujoco()
    name = model.actuator(i).name or f"number {i + 1}"
    gain, bias, state, acts = (
        int(getattr(model, f"actuator_{kind}type")[i]) for kind in ("gain", "bias", "dyn", "trn")
    )
    hint = "log the torque that it gives and make it <motor>, or take it out and name columns and joints in [input]"
    if gain == int(mujoco.mjtGain.mjGAIN_MUSCLE) or state == int(mujoco.mjtDyn.mjDYN_MUSCLE):
        yield f"actuator {name!r} is a muscle", hint
    elif state != int(mujoco.mjtDyn.mjDYN_NONE):
        lag = "log the goal that it has integrated and make it <position>" if _integrates(model, i) else _LAG
        yield f"actuator {name!r} has a state of its own", lag
    elif bias not in (int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE)):
        yield f"actuator {name!r} has a bias that is not affine", hint
    elif gain not in (int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtGain.mjGAIN_AFFINE)):
        yield f"actuator {name!r} has a gain that is neither fixed nor affine", hint
    elif (drive := _drive(model, i)) is None:
        hint = "write kind, gain, kp and kd of it in [input], and make it <motor>; or log its torque"
        yield f"the gain of actuator {name!r} changes with position, or with rate beside another part", hint
    elif drive[0] != TORQUE and (limits := _limits(model, i)) and not np.isclose(-limits[0], limits[1]):
        hint = "make it symmetric about 0, or declare the limit in [input]: kind, its gains and limit = ..."
        yield f"the torque of actuator {name!r} is limited to {limits[0]:g} ... {limits[1]:g}", hint
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
            place=vector(model.body_pos[i]),
            turn=_rotation(model.body_quat[i]),
            mass=float(model.body_mass[i]),
            centre=vector(model.body_ipos[i]),
            inertia=_inertia(model, i),
        )
        for i in range(1, model.nbody)
    )


def _inertia(model: Any, i: int) -> Rotation:
    turn = np.asarray(_rotation(model.body_iquat[i]))
    whole = turn @ np.diag(model.body_inertia[i]) @ turn.T
    return matrix(0.5 * (whole + whole.T))


def _joint(model: Any, j: int, gears: Mapping[str, Gear]) -> Joint:
    dof, place = int(model.jnt_dofadr[j]), int(model.jnt_qposadr[j])
    gear = gears.get(model.joint(j).name, Gear())
    return Joint(
        name=model.joint(j).name,
        body=int(model.jnt_bodyid[j]) - 1,
        slide=int(model.jnt_type[j]) == _SLIDE,
        axis=vector(model.jnt_axis[j]),
        anchor=vector(model.jnt_pos[j]),
        zero=float(model.qpos0[place]),
        stiffness=float(np.ravel(model.jnt_stiffness[j])[0]),
        rest=float(model.qpos_spring[place]),
        armature=float(model.dof_armature[dof]) + gear.inertia,
        damping=float(np.ravel(model.dof_damping[dof])[0]),
        dry=float(model.dof_frictionloss[dof]),
        range=(float(model.jnt_range[j][0]), float(model.jnt_range[j][1])) if model.jnt_limited[j] else None,
        reduction=gear.reduction,
    )


def _motors(model: Any, part: Part) -> Iterator[Motor]:
    held = [part.holds(model.joint(j).name) for j in range(model.njnt)]
    for i in range(getattr(model, "nactuator", model.nu)):
        if not _moves(model, i, held):
            continue
        kind, numbers = _drive(model, i) or (TORQUE, {})
        gear = float(model.actuator_gear[i][0])
        if kind == TORQUE:  # its limits are not taken: the log has the torque as it was
            gear, numbers = gear * float(model.actuator_gainprm[i][0]), {}
        elif limits := _limits(model, i):
            numbers |= {"limit": limits[1]}
        name = model.actuator(i).name or f"u{i + 1}"
        yield Motor(name, int(model.actuator_trnid[i][0]), gear, kind, tuple(numbers.items()))


_LAG = "take the lag out of it (timeconst, dyntype): the fit can find one, as actuator_lag"


def _integrates(model: Any, i: int) -> bool:
    return int(model.actuator_dyntype[i]) == int(_mujoco().mjtDyn.mjDYN_INTEGRATOR)


def _drive(model: Any, i: int) -> tuple[str, dict[str, float]] | None:
    """The kind and numbers of an actuator without a state: force = gain u + bias, both affine in position and rate.

    None where the gain is no constant, and not the rate alone (`<damper>`).
    [MuJoCo documentation, Computation, Actuation model]
    """
    mujoco = _mujoco()
    gain, bias = (np.asarray(getattr(model, f"actuator_{part}prm")[i][:3], float) for part in ("gain", "bias"))
    if int(model.actuator_gaintype[i]) == int(mujoco.mjtGain.mjGAIN_FIXED):
        gain = gain * [1.0, 0.0, 0.0]
    if int(model.actuator_biastype[i]) == int(mujoco.mjtBias.mjBIAS_NONE):
        bias = np.zeros(3)
    extras = _late(model, i) | ({"bias": float(bias[0])} if bias[0] else {})
    kp, kd = (float(0.0 - x) for x in bias[1:])
    if not np.any(gain[1:]):
        if not np.any(bias) and not extras:
            return TORQUE, {}
        if kp == gain[0] > 0:
            return "position", {"kp": kp, "kd": kd, **extras}
        if kp == 0 and kd == gain[0] > 0:
            return "velocity", {"kv": kd, **extras}
        return "affine", {"gain": float(gain[0]), "kp": kp, "kd": kd, **extras}
    if not np.any(gain[:2]) and gain[2] < 0 and not np.any(bias[1:]):
        return "damper", {"kv": float(-gain[2]), **extras}
    return None


def _late(model: Any, i: int) -> dict[str, float]:
    """The delay of an actuator [s], by a buffer of commands."""
    delay = float(np.ravel(getattr(model, "actuator_delay", np.zeros(i + 1))[i])[0])
    return {"delay": delay} if delay > 0 else {}


def _limits(model: Any, i: int) -> tuple[float, float] | None:
    """Limits of what an actuator gives before its gear: its own, and those of all actuators of its joint."""
    joint, gear = int(model.actuator_trnid[i][0]), float(model.actuator_gear[i][0])
    ranges = [model.actuator_forcerange[i]] if model.actuator_forcelimited[i] else []
    if model.jnt_actfrclimited[joint]:
        ranges.append(np.sort(np.asarray(model.jnt_actfrcrange[joint]) / gear))
    return (max(float(x[0]) for x in ranges), min(float(x[1]) for x in ranges)) if ranges else None


def _joint_sensors(model: Any) -> Iterator[JointSensor]:
    kinds = _mujoco().mjtSensor
    for i in range(model.nsensor):
        kind, rate = int(model.sensor_type[i]), int(kinds.mjSENS_JOINTVEL)
        if kind in (int(kinds.mjSENS_JOINTPOS), rate):
            yield JointSensor(model.sensor(i).name, int(model.sensor_objid[i]), kind == rate)


def _sensors(model: Any) -> Iterator[Sensor]:
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
            yield Sensor(f"{model.sensor(i).name}.{letter}", kind, axis, body, vector(place), _rotation(turn))


def _rotation(quaternion: np.ndarray) -> Rotation:
    w, x, y, z = np.asarray(quaternion, float) / np.linalg.norm(quaternion)
    return matrix(
        np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
    )
