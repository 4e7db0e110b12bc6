"""An identified machine written back as MJCF: bodies, friction, and every law that MuJoCo has a place for."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .. import __version__
from ..data.servo import TORQUE
from ..effects import AbstractEffect
from ..effects.presliding import PreslidingFriction
from ..fit.identify import Identified
from ..machines.spec import compiled, in_comment, mujoco, written
from ..model import hooks
from ..model.state_space import StateSpaceModel
from ..storage.files import replace_own
from ..systems.tree import Tree
from .actuator import actuator
from .friction import REPORTED_MISS, FrictionForm, friction_forms
from .model import ExportError
from .placement import Drive, OpenFile, acting_on, late, passive, placed, rotor, sensor

LONGEST_STEP = 5e-4
"""Longest time step of a written file [s]."""
LARGEST_RELAXATION = 1.5
"""Largest relaxation of a bristle in a time step; beyond 2.8 the integrator diverges [1]."""


Bristle = tuple[float, float]
"""Stiffness [N m/rad or N/m] and damping [N m s/rad or N s/m] of a LuGre bristle."""


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
    out, model = Path(out), fitted.model
    system, forms = as_it_is(fitted, model), friction_forms(fitted)
    if model.servos:
        raise ExportError(
            "its inputs are commands of servos, which MJCF here has no form for; write --urdf or --c instead"
        )
    if not fitted.rig.file:
        raise ExportError("it is from before fits held their machine's file; identify again")
    file, bristles = _opened(fitted, model, system, forms)
    unplaced = placed(file, model.effects)
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
    _springs(file)
    for j, bristle in bristles.items():
        numbers = (*bristle, _level(forms[j]), forms[j].breakaway, forms[j].stribeck)
        passive(file, system.machine.joints[j].name, "bristle", lugre=numbers)
    _noise(file, np.exp(0.5 * np.asarray(model.log_r)))
    for motor, element in zip(motors_of(fitted, system), list(file.spec.actuators), strict=False):
        _motor(file, motor, element)
    notes = "".join(f"\n  - {line}" for line in left) or " nothing"
    comment = f"Written by nnap_em {__version__} from {system.machine.file}.  Not in here:{notes} "
    file.spec.comment = f"{file.spec.comment}\n {in_comment(comment)}"
    file.spec.compile()
    module = {beside(out): acting.text} if acting and acting.plays else {}
    replace_own({**module, out: written(file.spec, out.parent)})
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
    values = ", ".join(f"{name} = {float(value):.4g}" for name, value in effect.values().items())
    return f"{effect.name}{at}{': ' + values if values else ''}"


def _opened(
    fitted: Identified, model: StateSpaceModel, system: Tree, forms: Sequence[FrictionForm]
) -> tuple[OpenFile, Mapping[int, Bristle]]:
    """The machine's file with the numbers of the fit, before its laws, and the bristles of its joints."""
    spec, machine = mujoco().MjSpec.from_string(fitted.rig.file), system.machine
    simulated = compiled(Path(machine.file), spec)
    _bodies(simulated, system)
    still = jnp.asarray([joint.zero for joint in machine.joints], float)
    mobility, bristles = np.diagonal(np.linalg.inv(np.asarray(system.mass(still)))), {}
    for j, (joint, form) in enumerate(zip(machine.joints, forms, strict=True)):
        bristles |= _bristle(j, form, model, 1 / mobility[j])
        simulated.dof_armature[j] = float(system.values.get(f"{joint.name}.armature", joint.armature))
        simulated.dof_damping[j], simulated.dof_dampingpoly[j] = form.viscous, 0.0
        simulated.dof_frictionloss[j] = 0.0 if j in bristles else form.coulomb
    spec.copy_back(simulated)
    for motor, element in zip(machine.motors, list(spec.actuators), strict=True):
        element.name = motor.name
    step = model.dt / math.ceil(model.dt / _longest_step(forms, bristles) - 1e-9)
    spec.option.timestep, spec.option.integrator = step, int(mujoco().mjtIntegrator.mjINT_RK4)
    pull = np.zeros((len(forms), 4))
    for j, (joint, form) in enumerate(zip(machine.joints, forms, strict=True)):
        stiffness = float(system.values.get(f"{joint.name}.stiffness", joint.stiffness))
        pull[j, :2] = stiffness * joint.rest + form.offset, -stiffness
    drives = {joint: Drive() for joint in system.joints}
    file = OpenFile(spec, system, fitted.rig.measured, model.dt, step, mobility, pull, drives)
    for motor in motors_of(fitted, system)[len(machine.motors) :]:
        acting_on(file, machine.joints[motor.joint].name, motor.name, motor.gear)
    return file, bristles


def _bodies(simulated: Any, system: Tree) -> None:
    """Set mass, centre and inertia of the bodies of MuJoCo's model that have others than in the file."""
    for i, body in enumerate(system.machine.bodies, 1):
        mass, centre, inertia = (np.asarray(number, float) for number in system.body_numbers(i - 1))
        if mass != body.mass or np.any(centre != body.centre) or np.any(inertia != body.inertia):
            simulated.body_mass[i], simulated.body_ipos[i] = mass, centre
            simulated.body_inertia[i], axes = np.linalg.eigh(inertia)
            axes[:, 2] *= np.linalg.det(axes)
            mujoco().mju_mat2Quat(simulated.body_iquat[i], axes.ravel())


def _bristle(j: int, form: FrictionForm, model: StateSpaceModel, inertia: float) -> dict[int, Bristle]:
    """Bristle of a joint by law or, a stiff one, where its friction dips: MuJoCo has a dip only there."""
    if form.breakaway <= 0:
        return {}
    for effect in model.effects:
        if isinstance(effect, PreslidingFriction) and effect.joint == j + 1:
            return {j: (float(np.exp(effect.log_sigma)), max(float(effect.damping), 0.0))}
    if form.breakaway <= form.coulomb:
        return {}
    soft = form.breakaway / (max(form.smooth, 0.01 * form.stribeck) * model.dt)
    stiffness = min(soft, LARGEST_RELAXATION * _level(form) / (form.fastest * LONGEST_STEP))
    return {j: (stiffness, float(np.sqrt(stiffness * inertia)))}


def _longest_step(forms: Sequence[FrictionForm], bristles: Mapping[int, Bristle]) -> float:
    """Longest time step that the bristles bear: one relaxes at stiffness |v| / level [s]."""
    rates = [stiffness * forms[j].fastest / _level(forms[j]) for j, (stiffness, _) in bristles.items()]
    shortest = 5e-5  # shortest time step of a written file [s]
    return max(min([LONGEST_STEP, *(LARGEST_RELAXATION / rate for rate in rates)]), shortest)


def _level(form: FrictionForm) -> float:
    """Coulomb torque of a bristle, which may not vanish."""
    return max(form.coulomb, 1e-2 * form.breakaway)


def _springs(file: OpenFile) -> None:
    """Write the pull at every joint: stiffness about a rest, and a constant that has no rest as a passive motor."""
    for joint, (a, b, c, d) in zip(file.system.machine.joints, file.pull.tolist(), strict=True):
        element, rest = file.spec.joint(joint.name), _rest(a, b, c, d)
        slopes = [-(b + rest * (2 * c + 3 * d * rest)), -(c + 3 * d * rest), -d]
        element.stiffness, element.springref = slopes, rest if any((b, c, d)) else element.springref
        constant = a + rest * (b + rest * (c + rest * d))
        if abs(constant) > 1e-12 * abs(a):
            passive(file, joint.name, "offset", cogging=(constant, 0.0, 0.5 * math.pi))


def _rest(a: float, b: float, c: float, d: float) -> float:
    """A coordinate at which the springs pull to neither side, the steepest that pulls back; 0 where there is none."""
    roots = np.roots([d, c, b, a]) if d or c else np.array([-a / b] if b else [])
    real = np.real(roots[np.abs(np.imag(roots)) < 1e-9 * (1 + np.abs(roots))])
    return float(min(real, key=lambda q: b + q * (2 * c + 3 * d * q), default=0.0))


def _noise(file: OpenFile, noise: Float[np.ndarray, " obs"]) -> None:
    for column, std in reversed(list(zip(file.measured, noise.tolist(), strict=True))):  # the first of a sensor stays
        if (element := sensor(file, column)) is not None:
            element.noise = std


def _motor(file: OpenFile, motor: Motor, element: Any) -> None:
    """The way from a control to a force; the state of a lag is held over a step, half a step late."""
    joint, unit = file.system.machine.joints[motor.joint], abs(motor.unit)
    drive = file.drives.get(motor.joint + 1, Drive())
    if motor.kind != TORQUE:
        element.set_to_motor()
    if file.spec.joint(rotor(joint.name)) is not None:
        element.target = rotor(joint.name)
    if math.isfinite(drive.before):
        element.ctrllimited, element.ctrlrange = True, [-drive.before / unit, drive.before / unit]
    if math.isfinite(drive.after):
        after = drive.after * abs(element.gainprm[0]) / unit
        element.forcelimited, element.forcerange = True, [-after, after]
    late(element, drive.delay, file.step)
    if drive.lag:
        element.dyntype = mujoco().mjtDyn.mjDYN_FILTEREXACT
        element.dynprm[0] = max(drive.lag - 0.5 * file.step, 0.05 * file.step)
    element.gainprm[0] *= drive.gain
