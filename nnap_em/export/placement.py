"""The table from a law to its place in MuJoCo: one entry a law, each a function that adds it to a file's content."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..effects import AbstractEffect
from ..systems.frames import laid
from .content import Bristle, Contact, Content, Rotor, added, spring


class NoPlace(Exception):
    """A law that no element of MuJoCo holds: the message is the reason."""


Place = Callable[[Content, Any], Content]


class Placed(NamedTuple):
    """The content with all laws that MuJoCo holds, and the others with the reason, in the order of the model."""

    content: Content
    unplaced: tuple[tuple[AbstractEffect, str], ...]


def placed(content: Content, effects: Sequence[AbstractEffect]) -> Placed:
    """The content with laws added.

    A law of the command without a place acts before all that the file does with it, so that laws of the command
    which come before it have none either; delays may change places with it.
    """
    unplaced = []
    for place, effect in enumerate(effects):
        follower = _follower(effects, place)
        try:
            if follower is not None:
                raise NoPlace(f"it acts before {follower.name}, which has no place")
            content = _place(effect)(content, effect)
        except NoPlace as reason:
            unplaced.append((effect, str(reason)))
    return Placed(content, tuple(unplaced))


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


def _spring(content: Content, effect: Any) -> Content:
    """`stiffness` (a cubic) and `springref` of the joint; since MuJoCo 3.7."""
    pull = float(effect.moment), -float(effect.slope), -float(effect.square), -float(effect.cube)
    return content.with_joint(effect.joint, pull=added(content.joint(effect.joint).pull, pull))


def _offset(content: Content, effect: Any) -> Content:
    """Passive `<dcmotor>`, `cogging` without poles, since MuJoCo 4.0; with a spring its `springref`."""
    constant = float(effect.value), 0.0, 0.0, 0.0
    return content.with_joint(effect.joint, pull=added(content.joint(effect.joint).pull, constant))


def _cogging(content: Content, effect: Any) -> Content:
    """Passive `<dcmotor cogging=...>`, its `gear` the periods per turn; since MuJoCo 4.0."""
    k, pairs = float(effect.k), ((effect.sine, effect.cosine), (effect.sine2, effect.cosine2))
    tones = [
        (math.hypot(sine, cosine), turn * k, math.atan2(cosine, sine)) for turn, (sine, cosine) in enumerate(pairs, 1)
    ]
    tones = [tone for tone in tones if tone[0] > 0]
    return content.with_joint(effect.joint, tones=(*content.joint(effect.joint).tones, *tones))


def _stop(content: Content, effect: Any) -> Content:
    """`range` of the joint, a spring and damper that only push; the law also holds back a joint that leaves."""
    if content.joint(effect.joint).stop is not None:
        raise NoPlace("a joint has one range")
    numbers = effect.lower, effect.upper, np.exp(effect.stiffness), np.exp(effect.damping)
    return content.with_joint(effect.joint, stop=Contact(*map(float, numbers)))


def _back_emf(content: Content, effect: Any) -> Content:
    """`damping` of the joint."""
    return content.with_joint(effect.joint, viscous=content.joint(effect.joint).viscous + float(effect.b))


def _drag(content: Content, effect: Any) -> Content:
    """`damping` of the joint, quadratic, at a joint; since MuJoCo 3.7."""
    if effect.joint is None:
        raise NoPlace("the drag of one point is no drag of a body")
    return content.with_joint(effect.joint, drag=content.joint(effect.joint).drag + float(effect.c))


def _bristle(content: Content, effect: Any) -> Content:
    """Passive `<dcmotor input="none" lugre=...>`; since MuJoCo 4.0."""
    return content.with_joint(
        effect.joint, bristle=Bristle(float(np.exp(effect.log_sigma)), max(float(effect.damping), 0.0))
    )


# --- bodies and base


def _in_bodies(content: Content, effect: Any) -> Content:
    """Mass, centre and inertia of the body, where the machine of the file has such a variation."""
    if (effect.name, effect.joint) not in content.system.variations:
        raise NoPlace("the machine does not vary so")
    return content


def _tilt(content: Content, effect: Any) -> Content:
    """`gravity`, where the first joint carries the whole machine."""
    frames, machine = laid(content.system.text).frames, content.system.machine
    if frames[0].slide or any(frame.before < 0 for frame in frames[1:]):
        raise NoPlace("the first joint does not carry the whole machine")
    axis, angle = np.asarray(frames[0].turn)[:, 2], -float(effect.angle)
    cross = np.cross(np.eye(3), axis)
    turn = np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    first = machine.joints[0]
    stiffness = float(content.system.values.get(f"{first.name}.stiffness", first.stiffness))
    moved = stiffness * -float(effect.angle), 0.0, 0.0, 0.0  # the law turns the spring of the file, too
    x, y, z = map(float, turn @ np.asarray(content.gravity))
    return content.with_joint(1, pull=added(content.joint(1).pull, moved))._replace(gravity=(x, y, z))


# --- between command and torque


def _gain(content: Content, effect: Any) -> Content:
    """`gainprm` of the motor."""
    drive, gain = content.drives[effect.joint], 1 + float(effect.excess)
    return content.with_drive(effect.joint, gain=drive.gain * gain, after=drive.after * abs(gain))


def _saturation(content: Content, effect: Any) -> Content:
    """`ctrlrange` of the motor or, behind a lag, `forcerange`."""
    drive, limit = content.drives[effect.joint], float(effect.limit)
    if drive.lag:
        return content.with_drive(effect.joint, after=min(drive.after, limit))
    return content.with_drive(effect.joint, before=min(drive.before, limit / abs(drive.gain)))


def _delay(content: Content, effect: Any) -> Content:
    """`delay`, `nsample` and `interp="linear"` of the motor; since MuJoCo 3.5."""
    return content.with_drive(effect.joint, delay=content.drives[effect.joint].delay + max(float(effect.delay), 0.0))


def _lag(content: Content, effect: Any) -> Content:
    """`dyntype="filterexact"` of the motor."""
    drive = content.drives[effect.joint]
    if drive.lag or math.isfinite(drive.after):
        raise NoPlace("an actuator has one state, and no limit before it but that of the command")
    return content.with_drive(effect.joint, lag=max(float(effect.tau), 0.05 * content.dt))


def _flexibility(content: Content, effect: Any) -> Content:
    """Rotor joined by a `<fixed>` tendon, its spring; the model has one joint more."""
    inertia, k, damping = (float(np.exp(x)) for x in (effect.log_inertia, effect.log_k, effect.log_damping))
    return _with_rotor(content, effect.joint, Rotor(inertia, k, damping))


def _backlash(content: Content, effect: Any) -> Content:
    """Rotor joined by a `<fixed>` tendon, its `range`; the model has one joint more."""
    inertia, k, damping = (float(np.exp(x)) for x in (effect.log_inertia, effect.log_k, effect.log_damping))
    half = 0.5 * max(float(effect.gap), 1e-9)
    return _with_rotor(content, effect.joint, Rotor(inertia, play=Contact(-half, half, k, damping)))


def _with_rotor(content: Content, joint: int, rotor: Rotor) -> Content:
    if content.joint(joint).rotor is not None:
        raise NoPlace("a joint has one motor")
    return content.with_joint(joint, rotor=rotor)


# --- readings


def _sensor_delay(content: Content, effect: Any) -> Content:
    """`delay`, `nsample` and `interp="linear"` of the sensor; since MuJoCo 3.5."""
    return content.with_sensors(effect.channel, delay=max(float(effect.delay), 0.0))


def _quantisation(content: Content, effect: Any) -> Content:
    """`noise` of the sensor, as the fitted noise of the reading has the rounding already."""
    return content


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


def file_springs(content: Content) -> Content:
    """The content with the springs of the file."""
    for number, joint in enumerate(content.system.machine.joints, 1):
        stiffness = float(content.system.values.get(f"{joint.name}.stiffness", joint.stiffness))
        content = content.with_joint(number, pull=added(content.joint(number).pull, spring(stiffness, joint.rest)))
    return content
