"""The table from a law to its plain place in MuJoCo, with the function that writes it to a file."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ...machines.files.spec import mujoco
from ...machines.systems.tree import Tree
from ...model.effects import AbstractEffect


class NoPlace(Exception):
    """A law that no element of MuJoCo holds: the message is the reason."""


class Drive(NamedTuple):
    """The way from a command to a torque: limit in its unit, delay [s], lag [s], gain, in this order."""

    limit: float = math.inf
    delay: float = 0.0
    lag: float = 0.0
    gain: float = 1.0


class OpenFile(NamedTuple):
    """The file of a machine while laws are written to it."""

    spec: Any
    system: Tree
    """The machine with its estimated numbers, as it is at the first moment of the clock."""
    measured: tuple[str, ...]
    dt: float
    """Sample interval of the fit [s]; `step`: time step of the file [s]."""
    step: float
    pull: Float[np.ndarray, "dof 4"]
    """Force of springs at every joint as a cubic of its coordinate, the constant first [N m or N]."""
    drives: dict[int, Drive]
    """By joint, counted from 1."""

    def with_drive(self, joint: int, **changes: float) -> None:
        """Change the drive of one joint."""
        self.drives[joint] = self.drives[joint]._replace(**changes)


class Place(NamedTuple):
    """An element of MuJoCo that holds a law."""

    where: str
    """Its name in a table."""
    write: Callable[[OpenFile, Any], None] = lambda file, law: None


def placed(file: OpenFile, effects: Sequence[AbstractEffect]) -> list[tuple[AbstractEffect, str]]:
    """Write laws to a file; those without a place, with the reason, in the order of the model."""
    unplaced = []
    for effect in effects:
        try:
            if of_command(effect) and effect.joint not in file.drives:
                raise NoPlace("its command is that of a servo")
            if effect.name not in PLACES:
                raise NoPlace("it has no plain element in MuJoCo")
            PLACES[effect.name].write(file, effect)
        except NoPlace as reason:
            unplaced.append((effect, str(reason)))
    return unplaced


def of_command(effect: AbstractEffect) -> bool:
    """True for a law of what reaches a joint of the command."""
    kind = type(effect)
    return kind.input is not AbstractEffect.input or kind.drive is not AbstractEffect.drive


def _spring(file: OpenFile, law: Any) -> None:
    file.pull[law.joint - 1] += float(law.moment), -float(law.slope), -float(law.square), -float(law.cube)


def _offset(file: OpenFile, law: Any) -> None:
    file.pull[law.joint - 1, 0] += float(law.value)


def _back_emf(file: OpenFile, law: Any) -> None:
    file.spec.joint(file.system.machine.joints[law.joint - 1].name).damping[0] += float(law.b)


def _gain(file: OpenFile, law: Any) -> None:
    file.with_drive(law.joint, gain=file.drives[law.joint].gain * (1 + float(law.excess)))


def _saturation(file: OpenFile, law: Any) -> None:
    drive = file.drives[law.joint]
    if drive.lag:
        raise NoPlace("it acts behind a lag")
    file.with_drive(law.joint, limit=min(drive.limit, float(law.limit) / abs(drive.gain)))


def _delay(file: OpenFile, law: Any) -> None:
    file.with_drive(law.joint, delay=file.drives[law.joint].delay + max(float(law.delay), 0.0))


def _lag(file: OpenFile, law: Any) -> None:
    if file.drives[law.joint].lag:
        raise NoPlace("an actuator has one state")
    file.with_drive(law.joint, lag=max(float(law.tau), 0.05 * file.dt))


def _sensor_delay(file: OpenFile, law: Any) -> None:
    for column in file.measured:
        if law.channel in (column, "all"):
            late(sensor(file, column) or _joint_sensor(file, column), max(float(law.delay), 0.0), file.step)


def sensor(file: OpenFile, column: str) -> Any:
    """The sensor of a column in the file, if it has one."""
    return file.spec.sensor(column) or file.spec.sensor(column.rpartition(".")[0])


def _joint_sensor(file: OpenFile, column: str) -> Any:
    joints, kinds = file.system.machine.joints, mujoco().mjtSensor
    rate, place = divmod(file.system.machine.states.index(column), len(joints))
    kind = kinds.mjSENS_JOINTVEL if rate else kinds.mjSENS_JOINTPOS
    return file.spec.add_sensor(name=column, type=kind, objtype=mujoco().mjtObj.mjOBJ_JOINT, objname=joints[place].name)


def late(element: Any, delay: float, step: float) -> None:
    """Delay a motor or a sensor, interpolated between steps; MuJoCo's shortest delay is one step."""
    # Steps that a buffer of delayed values holds, over those of the delay: a file still plays at a shorter time step
    room = 10
    if delay > 0:
        element.delay = max(delay + 0.5 * step, step)  # interpolation begins to rise half a step early, on average
        element.nsample, element.interp = room * (math.ceil(delay / step) + 1), 1


LATE = '`delay`, `nsample` and `interp="linear"` of the {}; since MuJoCo 3.5'
PLACES: Mapping[str, Place] = {
    "torsional_spring": Place("`stiffness` (a cubic) and `springref` of the joint; since MuJoCo 3.7", _spring),
    "torque_offset": Place(
        "passive `<dcmotor>`, `cogging` without poles, since MuJoCo 4.0; with a spring its `springref`", _offset
    ),
    "motor_back_emf": Place("`damping` of the joint", _back_emf),
    "payload": Place("mass, centre and inertia of the body"),  # those of `OpenFile.system`
    "motor_gain": Place("`gainprm` of the motor", _gain),
    "saturation": Place("`ctrlrange` of the motor", _saturation),
    "input_delay": Place(LATE.format("motor"), _delay),
    "actuator_lag": Place('`dyntype="filterexact"` of the motor', _lag),
    "sensor_delay": Place(LATE.format("sensor"), _sensor_delay),
    "sensor_quantization": Place("`noise` of the sensor, as the fitted noise of the reading has the rounding already"),
}
"""Places of laws, by their names in the catalogue."""
