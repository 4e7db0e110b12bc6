"""The table from a law to its place in MuJoCo: one entry a law, each a function that writes it to a file."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..effects import AbstractEffect
from ..machines.spec import mujoco
from ..systems.frames import laid
from ..systems.tree import Tree

SOFT = 1e-4
"""Impedance of a contact, MuJoCo's smallest: the contact force is then that of its spring and damper to this share."""
MASSLESS = 1e-12
"""Mass of the body that carries a rotor [kg], whose inertia is the armature of its joint."""


class NoPlace(Exception):
    """A law that no element of MuJoCo holds: the message is the reason."""


class Drive(NamedTuple):
    """The way from a command to a torque: limit, delay, lag, gain, limit, in this order."""

    before: float = math.inf
    """Limit of the command, in its unit."""
    delay: float = 0.0
    """[s]"""
    lag: float = 0.0
    """Time constant [s]."""
    gain: float = 1.0
    after: float = math.inf
    """Limit of what the gain gives, in the unit of the command."""


class OpenFile(NamedTuple):
    """The file of a machine while laws are written to it."""

    spec: Any
    system: Tree
    """The machine with its estimated numbers, as it is at the first moment of the clock."""
    measured: tuple[str, ...]
    """Columns of the readings."""
    dt: float
    """Sample interval of the fit [s]."""
    step: float
    """Time step of the file [s]."""
    mobility: Float[np.ndarray, " dof"]
    """Acceleration of every joint per force at it, with all joints as declared: MuJoCo scales contacts by it."""
    pull: Float[np.ndarray, "dof 4"]
    """Force of springs at every joint as a cubic of its coordinate, the constant first [N m or N]."""
    drives: dict[int, Drive]
    """Drives by joint, counted from 1."""

    def joint(self, number: int) -> Any:
        """Joint of the file by its number, counted from 1."""
        return self.spec.joint(self.system.machine.joints[number - 1].name)

    def with_drive(self, joint: int, **changes: float) -> None:
        """Change the drive of one joint."""
        self.drives[joint] = self.drives[joint]._replace(**changes)


Place = Callable[[OpenFile, Any], None]


def placed(file: OpenFile, effects: Sequence[AbstractEffect]) -> tuple[tuple[AbstractEffect, str], ...]:
    """Write laws to a file; those without a place, with the reason, in the order of the model.

    A law of the command without a place acts before all that the file does with it, so that laws of the command
    which come before it have none either; delays may change places with it.
    """
    unplaced = []
    for place, effect in enumerate(effects):
        follower = _follower(effects, place)
        try:
            if follower is not None:
                raise NoPlace(f"it acts before {follower.name}, which has no place")
            _place(effect)(file, effect)
        except NoPlace as reason:
            unplaced.append((effect, str(reason)))
    return tuple(unplaced)


def _place(effect: AbstractEffect) -> Place:
    if effect.name not in PLACES:
        raise NoPlace(NO_PLACE.get(effect.name, "no element of MuJoCo has this form"))
    return PLACES[effect.name]


def of_command(effect: AbstractEffect) -> bool:
    """True for a law of what reaches a joint of the command."""
    return takes_time(effect) or type(effect).drive is not AbstractEffect.drive


def takes_time(effect: AbstractEffect) -> bool:
    """True for a law of the command over time."""
    return type(effect).input is not AbstractEffect.input


def _follower(effects: Sequence[AbstractEffect], place: int) -> AbstractEffect | None:
    """The law without a place before which a law of the command has to act."""
    first = effects[place]
    if not of_command(first) or first.name not in PLACES or first.name == "input_delay":
        return None
    after = (effect for effect in effects[place + 1 :] if of_command(effect) and effect.joint == first.joint)
    return next((effect for effect in after if effect.name not in PLACES), None)


# --- forces at a joint


def _spring(file: OpenFile, effect: Any) -> None:
    """`stiffness` (a cubic) and `springref` of the joint; since MuJoCo 3.7."""
    pull = float(effect.moment), -float(effect.slope), -float(effect.square), -float(effect.cube)
    file.pull[effect.joint - 1] += pull


def _offset(file: OpenFile, effect: Any) -> None:
    """Passive `<dcmotor>`, `cogging` without poles, since MuJoCo 4.0; with a spring its `springref`."""
    file.pull[effect.joint - 1, 0] += float(effect.value)


def _cogging(file: OpenFile, effect: Any) -> None:
    """Passive `<dcmotor cogging=...>`, its `gear` the periods per turn; since MuJoCo 4.0."""
    joint = file.joint(effect.joint).name
    for turn, sine, cosine in ((1, effect.sine, effect.cosine), (2, effect.sine2, effect.cosine2)):
        amplitude, k, phase = math.hypot(sine, cosine), turn * float(effect.k), math.atan2(cosine, sine)
        if amplitude > 0:  # poles are whole numbers: k is a gear
            number = 1 + sum(one.name.startswith(f"{joint}_cogging") for one in file.spec.actuators)
            passive(file, joint, f"cogging{number}", gear=k, cogging=(amplitude / k, 1.0, phase))


def passive(file: OpenFile, joint: str, what: str, gear: float = 1.0, **numbers: Sequence[float]) -> None:
    """A torque that MuJoCo has as that of a motor without input: cogging, a bristle, a constant."""
    motor = acting_on(file, joint, f"{joint}_{what}", gear)
    motor.set_to_dcmotor(
        motorconst=[0.0, 0.0], resistance=1.0, ctrlspec=int(mujoco().mjtCtrlInput.mjINPUT_NONE), **numbers
    )


def acting_on(file: OpenFile, joint: str, name: str, gear: float) -> Any:
    """A new motor of a joint, with nothing of the classes of the file."""
    motor = file.spec.add_actuator(name=name, target=joint, trntype=mujoco().mjtTrn.mjTRN_JOINT)
    motor.set_to_motor()
    motor.gear = [gear, 0.0, 0.0, 0.0, 0.0, 0.0]
    motor.ctrllimited = motor.forcelimited = motor.actlimited = False
    return motor


def _stop(file: OpenFile, effect: Any) -> None:
    """`range` of the joint, a spring and damper that only push; the law also holds back a joint that leaves."""
    joint = file.joint(effect.joint)
    if joint.solimp_limit[0] == SOFT:
        raise NoPlace("a joint has one range")
    stiffness, damping = np.exp(effect.stiffness), np.exp(effect.damping)
    _contact(joint, (effect.lower, effect.upper), stiffness, damping, file.mobility[effect.joint - 1])


def _contact(limited: Any, ends: tuple[Any, Any], stiffness: Any, damping: Any, mobility: Any) -> None:
    """Limit a joint or tendon by a spring and a damper that push back beyond either end, and never pull."""
    limited.limited, limited.range = True, [float(end) for end in ends]
    limited.solref_limit = [-float(stiffness * mobility), -float(damping * mobility)]
    limited.solimp_limit = [SOFT, SOFT, 1.0, 0.5, 1.0]


def _back_emf(file: OpenFile, effect: Any) -> None:
    """`damping` of the joint."""
    file.joint(effect.joint).damping[0] += float(effect.b)


def _drag(file: OpenFile, effect: Any) -> None:
    """`damping` of the joint, quadratic, at a joint; since MuJoCo 3.7."""
    if effect.joint is None:
        raise NoPlace("the drag of one point is no drag of a body")
    file.joint(effect.joint).damping[1] += float(effect.c)


def _bristle(file: OpenFile, effect: Any) -> None:
    """Passive `<dcmotor input="none" lugre=...>`; since MuJoCo 4.0."""  # with the friction of its joint


# --- bodies and base


def _in_bodies(file: OpenFile, effect: Any) -> None:
    """Mass, centre and inertia of the body, where the machine of the file has such a variation."""
    if (effect.name, effect.joint) not in file.system.variations:
        raise NoPlace("the machine does not vary so")


def _tilt(file: OpenFile, effect: Any) -> None:
    """`gravity`, where the first joint carries the whole machine."""
    frames, machine = laid(file.system.text).frames, file.system.machine
    if frames[0].slide or any(frame.before < 0 for frame in frames[1:]):
        raise NoPlace("the first joint does not carry the whole machine")
    axis, angle = np.asarray(frames[0].turn)[:, 2], -float(effect.angle)
    cross = np.cross(np.eye(3), axis)
    turn = np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    first = machine.joints[0]
    stiffness = float(file.system.values.get(f"{first.name}.stiffness", first.stiffness))
    file.pull[0, 0] += stiffness * -float(effect.angle)  # the law turns the spring of the file, too
    file.spec.option.gravity = turn @ file.spec.option.gravity


# --- between command and torque


def _gain(file: OpenFile, effect: Any) -> None:
    """`gainprm` of the motor."""
    drive, gain = file.drives[effect.joint], 1 + float(effect.excess)
    file.with_drive(effect.joint, gain=drive.gain * gain, after=drive.after * abs(gain))


def _saturation(file: OpenFile, effect: Any) -> None:
    """`ctrlrange` of the motor or, behind a lag, `forcerange`."""
    drive, limit = file.drives[effect.joint], float(effect.limit)
    if drive.lag:
        return file.with_drive(effect.joint, after=min(drive.after, limit))
    return file.with_drive(effect.joint, before=min(drive.before, limit / abs(drive.gain)))


def _delay(file: OpenFile, effect: Any) -> None:
    """`delay`, `nsample` and `interp="linear"` of the motor; since MuJoCo 3.5."""
    file.with_drive(effect.joint, delay=file.drives[effect.joint].delay + max(float(effect.delay), 0.0))


def _lag(file: OpenFile, effect: Any) -> None:
    """`dyntype="filterexact"` of the motor."""
    drive = file.drives[effect.joint]
    if drive.lag or math.isfinite(drive.after):
        raise NoPlace("an actuator has one state, and no limit before it but that of the command")
    file.with_drive(effect.joint, lag=max(float(effect.tau), 0.05 * file.dt))


def _flexibility(file: OpenFile, effect: Any) -> None:
    """Rotor joined by a `<fixed>` tendon, its spring; the model has one joint more."""
    tendon = _rotor(file, effect.joint, float(np.exp(effect.log_inertia)))
    tendon.stiffness[0], tendon.damping[0] = float(np.exp(effect.log_k)), float(np.exp(effect.log_damping))
    tendon.springlength = [0.0, 0.0]


def _backlash(file: OpenFile, effect: Any) -> None:
    """Rotor joined by a `<fixed>` tendon, its `range`; the model has one joint more."""
    inertia, half = float(np.exp(effect.log_inertia)), 0.5 * max(float(effect.gap), 1e-9)
    tendon, mobility = _rotor(file, effect.joint, inertia), file.mobility[effect.joint - 1] + 1 / (inertia + MASSLESS)
    _contact(tendon, (-half, half), np.exp(effect.log_k), np.exp(effect.log_damping), mobility)


def _rotor(file: OpenFile, number: int, inertia: float) -> Any:
    """The tendon between a joint and its motor, a wheel of its own."""
    joint = file.joint(number).name
    name = rotor(joint)
    if file.spec.joint(name) is not None:
        raise NoPlace("a joint has one motor")
    body = file.spec.worldbody.add_body(name=name, mass=MASSLESS, inertia=[MASSLESS] * 3, ipos=[0.0] * 3)
    body.explicitinertial = True
    still = {"damping": [0.0] * 3, "stiffness": [0.0] * 3, "frictionloss": 0.0, "limited": False}
    body.add_joint(name=name, axis=[0.0, 0.0, 1.0], armature=inertia, **still)
    tendon = file.spec.add_tendon(name=f"{joint}_transmission", armature=0.0, **still)
    tendon.wrap_joint(name, 1.0)
    tendon.wrap_joint(joint, -1.0)
    return tendon


def rotor(joint: str) -> str:
    """Name of the rotor of a joint."""
    return f"{joint}_rotor"


# --- readings


def _sensor_delay(file: OpenFile, effect: Any) -> None:
    """`delay`, `nsample` and `interp="linear"` of the sensor; since MuJoCo 3.5."""
    for column in file.measured:
        if effect.channel in (column, "all") and (one := sensor(file, column) or _joint_sensor(file, column)):
            late(one, max(float(effect.delay), 0.0), file.step)


def sensor(file: OpenFile, column: str) -> Any:
    """The sensor of a column in the file, if it has one."""
    return file.spec.sensor(column) or file.spec.sensor(column.rpartition(".")[0])


def _joint_sensor(file: OpenFile, column: str) -> Any:
    """A new sensor of a joint, by the name of its state."""
    machine, kinds = file.system.machine, mujoco().mjtSensor
    rate, place = divmod(machine.states.index(column), len(machine.joints))
    kind = kinds.mjSENS_JOINTVEL if rate else kinds.mjSENS_JOINTPOS
    joint = machine.joints[place].name
    return file.spec.add_sensor(name=column, type=kind, objtype=mujoco().mjtObj.mjOBJ_JOINT, objname=joint)


def late(element: Any, delay: float, step: float) -> None:
    """Delay a motor or a sensor, interpolated between steps; MuJoCo's shortest delay is one step."""
    # Steps that a buffer of delayed values holds, over those of the delay: a file still plays at a shorter time step
    room = 10
    if delay > 0:
        element.delay = max(delay + 0.5 * step, step)  # interpolation begins to rise half a step early, on average
        element.nsample, element.interp = room * (math.ceil(delay / step) + 1), 1


def _quantisation(file: OpenFile, effect: Any) -> None:
    """`noise` of the sensor, as the fitted noise of the reading has the rounding already."""


PLACES: Mapping[str, Place] = {
    "torsional_spring": _spring,
    "torque_offset": _offset,
    "cogging": _cogging,
    "hard_stop": _stop,
    "motor_back_emf": _back_emf,
    "air_drag": _drag,
    "presliding_friction": _bristle,
    "payload": _in_bodies,
    "link_inertia": _in_bodies,
    "link_length": _in_bodies,
    "center_of_mass": _in_bodies,
    "base_tilt": _tilt,
    "motor_gain": _gain,
    "saturation": _saturation,
    "input_delay": _delay,
    "actuator_lag": _lag,
    "joint_flexibility": _flexibility,
    "backlash": _backlash,
    "sensor_delay": _sensor_delay,
    "sensor_quantization": _quantisation,
}
"""Functions that add a law to the content, by its name in the catalogue; first lines are the places in a table."""

NO_PLACE: Mapping[str, str] = {
    "dead_zone": "an actuator is linear between its limits",
    "one_sided_loss": "an actuator has one gain for both directions",
    "position_dependent_friction": "friction of a joint does not depend on its position",
    "friction_drift": "friction of a joint does not depend on time",
    "load_friction": "friction of a joint does not depend on the torque through it",
    "unknown_function": "a learned function has no element",
    "periodic_force": "no element depends on time",
    "eddy_brake": "damping of a joint does not depend on its position",
    "payload_step": "bodies keep their mass",
    "base_vibration": "the base of a fixed machine does not move",
    "sensor_bias": "a sensor has no offset",
    "sensor_scale": "a sensor has no scale",
    **dict.fromkeys(("change", "coulomb_change", "viscous_change"), "it is a change since a fit: identify --from"),
}
"""Reasons against a place for each other law, by name."""
