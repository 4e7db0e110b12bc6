"""An identified machine written back as MJCF: bodies, friction, and laws that MuJoCo has a plain element for."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ... import __version__
from ...base.files import replace_own
from ...errors import ExportError
from ...estimate.identify import Identified
from ...machines.files.spec import compiled, in_comment, mujoco, written
from ...machines.servo import TORQUE
from ...machines.systems.tree import Tree
from ...model import hooks
from ...model.effects import AbstractEffect
from .friction import REPORTED_MISS, FrictionForm, friction_forms
from .placement import Drive, OpenFile, late, placed, sensor


class Motor(NamedTuple):
    """An actuator of the written file."""

    name: str
    joint: int
    """Counted from 0."""
    gear: float
    unit: float
    """Command of the fit for a unit of the control."""
    kind: str = TORQUE
    """Kind of the actuator in the file that came in, one of `servo.KINDS`."""


def write_mjcf(fitted: Identified, out: Path | str) -> list[str]:
    """Write the identified machine to an MJCF file.

    Args:
        fitted: the model, of a machine from a file.
        out: the file.

    Returns:
        What is not in it, a sentence each: laws without a plain element in MuJoCo, and what its friction misses.

    Raises:
        ExportError: the machine did not come from a file. Nothing is written.
    """
    out, model = Path(out), fitted.model
    system, forms = as_it_is(fitted), friction_forms(fitted)
    file = _opened(fitted, system, forms)
    unplaced = placed(file, model.effects)
    left = servos_of(fitted)
    for name, form in zip(system.coordinates, forms, strict=True):
        if form.missed > REPORTED_MISS:
            left.append(f"friction of {name}: its form misses {100 * form.missed:.0f} % of the learned curve")
        if form.breakaway > form.coulomb:
            left.append(f"breakaway of {name}: {form.breakaway:.3g} over a Coulomb friction of {form.coulomb:.3g}")
    left += [f"{named(effect)} ({reason})" for effect, reason in unplaced]
    _springs(file)
    _noise(file, np.exp(0.5 * np.asarray(model.log_r)))
    for motor, element in zip(motors_of(fitted, system), list(file.spec.actuators), strict=False):
        if motor.joint + 1 in file.drives or motor.joint + 1 not in system.joints:  # else the command of a servo
            _motor(file, motor, element)
    notes = "".join(f"\n  - {line}" for line in left) or " nothing"
    comment = f"Written by nnap_em {__version__} from {system.machine.file}.  Not in here:{notes} "
    file.spec.comment = f"{file.spec.comment}\n {in_comment(comment)}"
    file.spec.compile()
    replace_own({out: written(file.spec, out.parent)})
    return left


def as_it_is(fitted: Identified) -> Tree:
    """The machine with all that is estimated of its bodies.

    Raises ExportError where it did not come from a file.
    """
    model, system = fitted.model, fitted.model.system
    if not isinstance(system, Tree):
        reason = f"the machine {fitted.rig.system!r} is built in, and has no file to be written back to"
        raise ExportError(f'{reason}; declare it by type = "mjcf" and its file')
    true = hooks.machine(model.effects, system, jnp.zeros(()))
    assert isinstance(true, Tree)
    return true


def servos_of(fitted: Identified) -> list[str]:
    """Servos with their numbers, a sentence each."""
    return [
        f"the {servo.kind} servo of {servo.column}: {_listed(servo.values)}"
        for servo in fitted.model.servos or ()
        if servo.values
    ]


def motors_of(fitted: Identified, system: Tree) -> list[Motor]:
    """Actuators of the file, then those of joints that the rig drives without one."""
    machine = system.machine
    inputs = dict(zip(system.joints, system.gears or (1.0,) * len(system.joints), strict=True))
    motors = [
        Motor(motor.name, motor.joint, motor.gear, motor.gear / inputs.get(motor.joint + 1, motor.gear), motor.kind)
        for motor in machine.motors
    ]
    driven = {motor.joint + 1 for motor in motors}
    columns = zip(fitted.rig.input_columns, system.joints, strict=True)
    return motors + [Motor(name, joint - 1, inputs[joint], 1.0) for name, joint in columns if joint not in driven]


def named(effect: AbstractEffect) -> str:
    """A law with its place and its numbers."""
    at = f" at joint {effect.joint}" if effect.joint else f" of {effect.channel}" if effect.channel else ""
    return f"{effect.name}{at}{': ' * bool(effect.values())}{_listed(effect.values())}"


def _listed(values: Mapping[str, Any]) -> str:
    return ", ".join(f"{name} = {float(value):.4g}" for name, value in values.items())


def _opened(fitted: Identified, system: Tree, forms: Sequence[FrictionForm]) -> OpenFile:
    """The machine's file with the numbers of the fit, before its laws."""
    spec, machine = mujoco().MjSpec.from_string(fitted.rig.file), system.machine
    simulated = compiled(Path(machine.file), spec)
    _bodies(simulated, system)
    for j, (joint, form) in enumerate(zip(machine.joints, forms, strict=True)):
        simulated.dof_armature[j] = float(system.values.get(f"{joint.name}.armature", joint.armature))
        simulated.dof_damping[j], simulated.dof_dampingpoly[j] = form.viscous, 0.0
        simulated.dof_frictionloss[j] = form.coulomb
    spec.copy_back(simulated)
    for motor, element in zip(machine.motors, list(spec.actuators), strict=True):
        element.name = motor.name
    longest = 5e-4  # time step of a written file at most [s]
    step = fitted.model.dt / math.ceil(fitted.model.dt / longest - 1e-9)
    spec.option.timestep, spec.option.integrator = step, int(mujoco().mjtIntegrator.mjINT_RK4)
    pull = np.zeros((len(forms), 4))
    for j, (joint, form) in enumerate(zip(machine.joints, forms, strict=True)):
        stiffness = float(system.values.get(f"{joint.name}.stiffness", joint.stiffness))
        pull[j, :2] = stiffness * joint.rest + form.offset, -stiffness
    servos = fitted.model.servos or (None,) * len(system.joints)
    pairs = zip(system.joints, servos, strict=True)
    drives = {joint: Drive() for joint, servo in pairs if servo is None or not servo.feeds_back}
    file = OpenFile(spec, system, fitted.rig.measured, fitted.model.dt, step, pull, drives)
    for motor in motors_of(fitted, system)[len(machine.motors) :]:
        _acting_on(file, machine.joints[motor.joint].name, motor.name, motor.gear)
    return file


def _bodies(simulated: Any, system: Tree) -> None:
    """Set mass, centre and inertia of the bodies of MuJoCo's model that have others than in the file."""
    for i, body in enumerate(system.machine.bodies, 1):
        mass, centre, inertia = (np.asarray(number, float) for number in system.body_numbers(i - 1))
        if mass != body.mass or np.any(centre != body.centre) or np.any(inertia != body.inertia):
            simulated.body_mass[i], simulated.body_ipos[i] = mass, centre
            simulated.body_inertia[i], axes = np.linalg.eigh(inertia)
            axes[:, 2] *= np.linalg.det(axes)
            mujoco().mju_mat2Quat(simulated.body_iquat[i], axes.ravel())


def _acting_on(file: OpenFile, joint: str, name: str, gear: float) -> Any:
    motor = file.spec.add_actuator(name=name, target=joint, trntype=mujoco().mjtTrn.mjTRN_JOINT)
    motor.set_to_motor()
    motor.gear = [gear, 0.0, 0.0, 0.0, 0.0, 0.0]
    motor.ctrllimited = motor.forcelimited = motor.actlimited = False
    return motor


def _springs(file: OpenFile) -> None:
    """Write the pull at every joint: stiffness about a rest, and a constant that has no rest as a passive motor."""
    for joint, (a, b, c, d) in zip(file.system.machine.joints, file.pull.tolist(), strict=True):
        element, rest = file.spec.joint(joint.name), _rest(a, b, c, d)
        slopes = [-(b + rest * (2 * c + 3 * d * rest)), -(c + 3 * d * rest), -d]
        element.stiffness, element.springref = slopes, rest if any((b, c, d)) else element.springref
        constant = a + rest * (b + rest * (c + rest * d))
        if abs(constant) > 1e-12 * abs(a):  # the cogging without poles of a motor without input; since MuJoCo 4.0
            motor, none = _acting_on(file, joint.name, f"{joint.name}_offset", 1.0), mujoco().mjtCtrlInput.mjINPUT_NONE
            cogging = constant, 0.0, 0.5 * math.pi
            motor.set_to_dcmotor(motorconst=[0.0, 0.0], resistance=1.0, ctrlspec=int(none), cogging=cogging)


def _rest(a: float, b: float, c: float, d: float) -> float:
    """A coordinate at which the springs pull to neither side, the steepest that pulls back; 0 where there is none."""
    roots = np.roots([d, c, b, a]) if d or c else np.array([-a / b] if b else [])
    real = [float(q.real) for q in roots if abs(q.imag) < 1e-9 * (1 + abs(q))]
    return min(real, key=lambda q: b + q * (2 * c + 3 * d * q), default=0.0)


def _noise(file: OpenFile, noise: Float[np.ndarray, " obs"]) -> None:
    for column, std in reversed(list(zip(file.measured, noise.tolist(), strict=True))):  # the first of a sensor stays
        if (element := sensor(file, column)) is not None:
            element.noise = std


def _motor(file: OpenFile, motor: Motor, element: Any) -> None:
    """The way from a control to a force; the state of a lag is held over a step, half a step late."""
    unit, drive = abs(motor.unit), file.drives.get(motor.joint + 1, Drive())
    if motor.kind != TORQUE:
        element.set_to_motor()
    if math.isfinite(drive.limit):
        element.ctrllimited, element.ctrlrange = True, [-drive.limit / unit, drive.limit / unit]
    late(element, drive.delay, file.step)
    if drive.lag:
        element.dyntype = mujoco().mjtDyn.mjDYN_FILTEREXACT
        element.dynprm[0] = max(drive.lag - 0.5 * file.step, 0.05 * file.step)
    element.gainprm[0] *= drive.gain
