"""A machine from MJCF or URDF: MuJoCo's compiler reads the file, what the physics here has no place for is refused."""

import re
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..machine import SENSE_UNITS, Body, Joint, JointSensor, Machine, Motor, Rotation, Sensor, Site, Vector
from ..rig import nearest
from ..servo import TORQUE
from .locked import Part, hold, holding
from .spec import NOTHING, compiled, mujoco, opened, refuse, weightless, written

_WHOLE = Part()


class MachineFile(NamedTuple):
    """A machine, and its file as MJCF, a part of it where only a part moves."""

    machine: Machine
    text: str


def read_machine(path: Path, part: Part = _WHOLE) -> Machine:
    """The tree of bodies and joints of an MJCF or URDF file, or a part of it, in SI units.

    Joints that are held without a value stand where the file has them, or where the joint that they follow puts them.
    Raises MachineError at what has no place in a model of a tree with a fixed base.
    """
    return read_file(path, part).machine


def read_file(path: Path, part: Part = _WHOLE) -> MachineFile:
    """`read_machine` with the file itself."""
    spec = opened(path)
    if not part.whole:
        _hold(path, spec, part)
    _refuse_all(path, weightless(path, spec), _WHOLE)
    model = compiled(path, spec)
    machine = _machine(path, model)
    _refuse_names(path, machine)
    return MachineFile(machine, written(spec))


def stuck(path: Path, logged: Collection[str]) -> dict[str, float]:
    """Values for the joints of a file that move no mass, and for couplings of which a log has neither joint."""
    model = weightless(path, opened(path))
    light = model.body_subtreemass[model.jnt_bodyid] <= NOTHING * model.nbody
    held = {model.joint(j).name: 0.0 for j in np.flatnonzero(light)}
    for name, (leader, law) in _couplings(model).items():
        held |= {} if {name, leader} & {*logged} else {leader: 0.0, name: law(0.0)}
    return held


def _machine(path: Path, model: Any) -> Machine:
    return Machine(
        file=path.name,
        gravity=_vector(model.opt.gravity * (model.opt.disableflags & int(mujoco().mjtDisableBit.mjDSBL_GRAVITY) == 0)),
        bodies=_bodies(model),
        joints=tuple(_joint(model, j) for j in range(model.njnt)),
        motors=tuple(_motors(model)),
        joint_sensors=tuple(
            JointSensor(model.sensor(i).name, int(model.sensor_objid[i]), kind == "jointvel")
            for i in range(model.nsensor)
            if (kind := _kind("mjtSensor", model.sensor_type[i])) in ("jointpos", "jointvel")
        ),
        sites=tuple(
            Site(model.site(i).name, int(model.site_bodyid[i]) - 1, _vector(model.site_pos[i]))
            for i in range(model.nsite)
            if model.site_bodyid[i] > 0
        ),
        sensors=tuple(_sensors(model)),
    )


def _hold(path: Path, spec: Any, part: Part) -> None:
    model = weightless(path, spec)
    names = [model.joint(j).name for j in range(model.njnt)]
    for key, declared in (("joints", part.joints or ()), ("locked", part.locked)):
        for name in declared:
            if name not in names:
                refuse(path, f"[model] {key} names {name!r}, which is no joint of it", nearest(name, names))
    _refuse_all(path, model, part)
    single = [j for j in range(model.njnt) if _kind("mjtJoint", model.jnt_type[j]) in ("slide", "hinge")]
    zeros = {model.joint(j).name: float(model.qpos0[model.jnt_qposadr[j]]) for j in single}
    for name in part.locked:
        if name not in zeros:
            refuse(
                path,
                f"[model] locked: {name!r} turns as a ball, no number is its place",
                "name those that move in joints",
            )
    values = {name: part.locked.get(name, zero) for name, zero in zeros.items() if part.holds(name)}
    follows = _couplings(model)
    for _ in follows:  # a joint may follow one that follows another
        for name, (leader, law) in follows.items():
            if name in values and leader in values and name not in part.locked:
                values[name] = law(values[leader])
    hold(spec, model, part, values)


def _kind(of: str, value: Any) -> str:
    """The name of a kind of MuJoCo's: "slide" of `mjJNT_SLIDE`, of the enumeration `mjtJoint`."""
    return getattr(mujoco(), of)(int(value)).name.rpartition("_")[2].lower()


def _couplings(model: Any) -> dict[str, tuple[str, Callable[[float], float]]]:
    """Joints that an equality constraint couples to another: that one, and the coordinate by that of the other."""
    out = {}
    for i in range(model.neq):
        pair = int(model.eq_obj1id[i]), int(model.eq_obj2id[i])
        if _kind("mjtEq", model.eq_type[i]) == "joint" and pair[1] >= 0:
            zero, of = (float(model.qpos0[model.jnt_qposadr[j]]) for j in pair)
            terms = np.polynomial.Polynomial(np.array(model.eq_data[i][:5], float))
            law = lambda leader, zero=zero, of=of, terms=terms: float(zero + terms(leader - of))  # noqa: E731
            out[model.joint(pair[0]).name] = model.joint(pair[1]).name, law
    return out  # pyrefly: ignore[bad-return]  (defaults of a lambda)


# --- what has no place here


def _refuse_all(path: Path, model: Any, part: Part) -> None:
    held = {j for j in range(model.njnt) if part.holds(model.joint(j).name)}
    for j in sorted({*range(model.njnt)} - held):
        name, kind = model.joint(j).name or f"number {j + 1}", _kind("mjtJoint", model.jnt_type[j])
        if kind == "free":
            refuse(path, f"joint {name!r} is free", "the base is fixed here: take the free joint out")
        if kind == "ball":
            refuse(path, f"joint {name!r} is a ball joint", "write it as three hinges of one body")
        if np.any(model.jnt_stiffnesspoly[j]) or np.any(model.jnt_springyield[j]):
            hint = "leave the linear part; diagnose finds what is missing"
            refuse(path, f"the spring of joint {name!r} is not linear", hint)
    if len(held) == model.njnt:
        refuse(path, "nothing moves: it has no joint, or all are held", "give it hinges or slides; hold fewer of them")
    if closed := list(_closed(model, held)):
        lines = [model.joint(j).name for j in dict.fromkeys(j for joints in closed for j in sorted(joints))]
        hint = "a loop or coupling is no tree: take <equality> or <mimic> out"
        hint += f", or hold the joints that it closes: {holding(*lines)}" if lines else ""
        where = "" if part.whole else " on joints that move"
        refuse(path, f"it has {len(closed)} equality constraints{where}", hint)
    for i in range(model.nactuator):
        if _moves(model, i, held):
            _check_actuator(path, model, i)
    for there, (problem, hint) in (
        (
            not all(_still(model, i, held) for i in range(model.ntendon)),
            ("tendons", "put their springs and motors on joints, and take <tendon> out"),
        ),
        (model.opt.density or model.opt.viscosity, ("a fluid", "set density and viscosity to 0; diagnose finds drag")),
        (np.any(model.body_gravcomp), ("gravcomp", "log the torque that compensates weights as an input, take it out")),
        (model.nflex, ("flexible bodies", "bodies are rigid here: take them out")),
    ):
        if there:
            refuse(path, f"it has {problem}", hint)


def _closed(model: Any, held: set[int]) -> Iterator[set[int]]:
    """The joints that move of each equality constraint that is not between parts that are held against each other."""
    for i in range(model.neq):
        kind, ends = _kind("mjtEq", model.eq_type[i]), (int(model.eq_obj1id[i]), int(model.eq_obj2id[i]))
        if kind == "joint":
            joints = {*ends} - {-1}
        elif kind in ("connect", "weld"):
            sites = _kind("mjtObj", model.eq_objtype[i]) == "site"
            one, two = (_above(model, int(model.site_bodyid[end]) if sites else end) for end in ends)
            joints = one ^ two
        else:
            yield set()
            continue
        if joints - held:
            yield joints - held


def _above(model: Any, body: int) -> set[int]:
    first = int(model.body_jntadr[body])
    own = {*range(first, first + int(model.body_jntnum[body]))}
    return own | _above(model, int(model.body_parentid[body])) if body else set()


def _still(model: Any, tendon: int, held: set[int]) -> bool:
    """True for a tendon that runs over joints alone, all of them held."""
    first = int(model.tendon_adr[tendon])
    wraps = range(first, first + int(model.tendon_num[tendon]))
    return all(_kind("mjtWrap", model.wrap_type[k]) == "joint" and int(model.wrap_objid[k]) in held for k in wraps)


def _moves(model: Any, actuator: int, held: set[int]) -> bool:
    """True for an actuator that drives something that moves."""
    acts, end = _kind("mjtTrn", model.actuator_trntype[actuator]), int(model.actuator_trnid[actuator][0])
    return end not in held if acts in _JOINTS else not (acts == "tendon" and _still(model, end, held))


_JOINTS = ("joint", "jointinparent")


def _check_actuator(path: Path, model: Any, i: int) -> None:
    """Raise MachineError unless an actuator is a motor or a servo of a joint."""
    name = model.actuator(i).name or f"number {i + 1}"
    parts = ("mjtGain", "gain"), ("mjtBias", "bias"), ("mjtDyn", "dyn"), ("mjtTrn", "trn")
    gain, bias, state, acts = (_kind(of, getattr(model, f"actuator_{part}type")[i]) for of, part in parts)
    hint = "log the torque that it gives and make it <motor>, or take it out and name columns and joints in [input]"
    if state != "none" and gain != "muscle":
        hint = "take the lag out of it (timeconst, dyntype): the fit can find one, as actuator_lag"
        goal = "log the goal that it has integrated and make it <position>"
        refuse(path, f"actuator {name!r} has a state of its own", goal if state == "integrator" else hint)
    plain = gain in ("fixed", "affine") and bias in ("none", "affine")
    if not plain or (drive := _drive(model, i)) is None:
        refuse(path, f"actuator {name!r} is no motor, servo or damper (gain: {gain}, bias: {bias})", hint)
    if drive[0] != TORQUE and (limits := _limits(model, i)) and not np.isclose(-limits[0], limits[1]):
        hint = "make it symmetric about 0, or declare the limit in [input]: kind, its gains and limit = ..."
        refuse(path, f"the torque of actuator {name!r} is limited to {limits[0]:g} ... {limits[1]:g}", hint)
    if acts not in _JOINTS:
        refuse(path, f"actuator {name!r} drives no joint", "let every motor drive a joint")


def _refuse_names(path: Path, machine: Machine) -> None:
    """Names become columns, keys of rig.toml and file names: letters, digits, _ and -, none twice, none reserved."""
    names, reserved = [joint.name for joint in machine.joints], ("time", "u", "all", "type", "file")
    for name, joint in zip(names, machine.joints, strict=True):
        if not re.fullmatch(r"[^\W\d][\w-]*", name) or name in reserved:
            problem = f"joint {name!r} of body {machine.bodies[joint.body].name!r}: unusable name"
            refuse(path, problem, f"write letters, digits, _ and -, a letter first; not {', '.join(reserved)}")
        if f"d{name}" in names:
            refuse(path, f"joint {'d' + name!r} is called as the rate of joint {name!r}", "rename one of the two")


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
        slide=_kind("mjtJoint", model.jnt_type[j]) == "slide",
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
    for i in range(model.nactuator):
        kind, numbers = _drive(model, i) or (TORQUE, {})
        gear = float(model.actuator_gear[i][0])
        if kind == TORQUE:  # its limits are not taken: the log has the torque as it was
            gear, numbers = gear * float(model.actuator_gainprm[i][0]), {}
        elif limits := _limits(model, i):
            numbers |= {"limit": limits[1]}
        name = model.actuator(i).name or f"u{i + 1}"
        yield Motor(name, int(model.actuator_trnid[i][0]), gear, kind, tuple(numbers.items()))


def _drive(model: Any, i: int) -> tuple[str, dict[str, float]] | None:
    """The kind and numbers of an actuator without a state: force = gain u + bias, both affine in position and rate.

    None where the gain is no constant, and not the rate alone (`<damper>`).
    [MuJoCo documentation, Computation, Actuation model]
    """
    gain, bias = (np.asarray(getattr(model, f"actuator_{part}prm")[i][:3], float) for part in ("gain", "bias"))
    if _kind("mjtGain", model.actuator_gaintype[i]) == "fixed":
        gain = gain * [1.0, 0.0, 0.0]
    if _kind("mjtBias", model.actuator_biastype[i]) == "none":
        bias = np.zeros(3)
    late = float(np.ravel(model.actuator_delay[i])[0])
    extras = ({"delay": late} if late > 0 else {}) | ({"bias": float(bias[0])} if bias[0] else {})
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


def _limits(model: Any, i: int) -> tuple[float, float] | None:
    """Limits of what an actuator gives before its gear: its own, and those of all actuators of its joint."""
    joint, gear = int(model.actuator_trnid[i][0]), float(model.actuator_gear[i][0])
    ranges = [model.actuator_forcerange[i]] if model.actuator_forcelimited[i] else []
    if model.jnt_actfrclimited[joint]:
        ranges.append(np.sort(np.asarray(model.jnt_actfrcrange[joint]) / gear))
    return (max(float(x[0]) for x in ranges), min(float(x[1]) for x in ranges)) if ranges else None


def _sensors(model: Any) -> Iterator[Sensor]:
    for i in range(model.nsensor):
        kind, at = _kind("mjtSensor", model.sensor_type[i]), -1
        if kind in ("jointpos", "jointvel"):
            continue
        if _kind("mjtObj", model.sensor_objtype[i]) == "site" and int(model.sensor_refid[i]) < 0:
            at = int(model.sensor_objid[i])
        elif kind in SENSE_UNITS:
            kind = f"{kind} of no site, or in no frame of the world"
        place, turn = (model.site_pos[at], model.site_quat[at]) if at >= 0 else (np.zeros(3), np.array([1.0, 0, 0, 0]))
        body = int(model.site_bodyid[at]) - 1 if at >= 0 else -1
        for axis, letter in enumerate("xyz"):
            yield Sensor(f"{model.sensor(i).name}.{letter}", kind, axis, body, _vector(place), _rotation(turn))


def _rotation(quaternion: np.ndarray) -> Rotation:
    turn = np.zeros(9)
    mujoco().mju_quat2Mat(turn, quaternion / np.linalg.norm(quaternion))
    return _matrix(turn.reshape(3, 3))


def _vector(values: np.ndarray) -> Vector:
    x, y, z = (float(value) for value in values)
    return x, y, z


def _matrix(values: np.ndarray) -> Rotation:
    a, b, c = (_vector(row) for row in values)
    return a, b, c
