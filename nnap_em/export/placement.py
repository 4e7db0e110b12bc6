"""The table from a law to its plain place in MuJoCo: one entry a law, each a function that writes it to a file."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..effects import AbstractEffect
from ..machines.spec import mujoco
from ..systems.tree import Tree


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
            if of_command(effect) and effect.joint not in file.drives:
                raise NoPlace("its command is that of a servo")
            if effect.name not in PLACES:
                raise NoPlace("it has no plain element in MuJoCo")
            PLACES[effect.name](file, effect)
        except NoPlace as reason:
            unplaced.append((effect, str(reason)))
    return tuple(unplaced)


def of_command(effect: AbstractEffect) -> bool:
    """True for a law of what reaches a joint of the command."""
    kind = type(effect)
    return kind.input is not AbstractEffect.input or kind.drive is not AbstractEffect.drive


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


def acting_on(file: OpenFile, joint: str, name: str, gear: float) -> Any:
    """A new motor of a joint, with nothing of the classes of the file."""
    motor = file.spec.add_actuator(name=name, target=joint, trntype=mujoco().mjtTrn.mjTRN_JOINT)
    motor.set_to_motor()
    motor.gear = [gear, 0.0, 0.0, 0.0, 0.0, 0.0]
    motor.ctrllimited = motor.forcelimited = motor.actlimited = False
    return motor


def _back_emf(file: OpenFile, effect: Any) -> None:
    """`damping` of the joint."""
    file.joint(effect.joint).damping[0] += float(effect.b)


# --- bodies


def _payload(file: OpenFile, effect: Any) -> None:
    """Mass, centre and inertia of the body."""  # that of `OpenFile.system`


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
    "motor_back_emf": _back_emf,
    "payload": _payload,
    "motor_gain": _gain,
    "saturation": _saturation,
    "input_delay": _delay,
    "actuator_lag": _lag,
    "sensor_delay": _sensor_delay,
    "sensor_quantization": _quantisation,
}
"""Functions that add a law to the content, by its name in the catalogue; first lines are the places in a table."""
