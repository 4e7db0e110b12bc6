"""Laws that MuJoCo has no element for, as a Python module beside the MJCF file, in NumPy alone."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp

from .. import __version__
from ..effects import AbstractEffect
from ..effects.base import OperatingPoint
from ..fit.identify import Identified
from ..model import hooks
from ..model.state_space import StateSpaceModel
from ..systems.tree import Tree
from . import acting
from .model import literal, unrolled
from .placement import takes_time


class Acting(NamedTuple):
    """A module and the laws in it."""

    text: str
    plays: tuple[AbstractEffect, ...]


def actuator(
    fitted: Identified, model: StateSpaceModel, unplaced: Sequence[tuple[AbstractEffect, str]], motors: Sequence[Any]
) -> Acting:
    """The module of the laws that a written file does not hold; those of bodies and with states of their own aside.

    Raises ExportError where NumPy cannot follow a law.
    """
    rig, system = fitted.rig, model.system
    assert isinstance(system, Tree)
    laws = tuple(effect for effect, _ in unplaced if _momentary(effect))
    dof, driven = len(system.coordinates), [motor for motor in motors if motor.joint + 1 in system.joints]

    def command(u):
        for effect in laws:
            for i, motor in enumerate(driven):
                if effect.joint == motor.joint + 1:
                    u = u.at[i].set(effect.drive(u[i]))
        return (u,)

    def torque(q, v, drive, time):
        scene = OperatingPoint(system, q, v, drive, time[0], model.unknown(v), model.unknown)
        return (hooks.added(laws, scene, jnp.zeros(0, q.dtype), jnp.zeros_like(q)),)

    def reading(y):
        return (hooks.read(laws, rig.measured, y, lambda delay: y),)

    still, one = jnp.zeros(dof), jnp.zeros(1)
    functions = [
        unrolled("command", command, u=jnp.zeros(len(driven))),
        unrolled("torque", torque, q=still, v=still, drive=still, time=one),
        unrolled("reading", reading, y=jnp.zeros(len(rig.measured))),
    ]
    numbers = {
        "coordinates": tuple(joint.name for joint in system.machine.joints),
        "motors": tuple(motor.name for motor in driven),
        "driven": tuple(motor.joint for motor in driven),
        "units": tuple(motor.unit for motor in driven),
        "measured": rig.measured,
    }
    fields = "\n".join(f"    {name}={literal(value)}," for name, value in numbers.items())
    body = Path(acting.__file__).read_text(encoding="utf-8").partition('"""\n')[2]
    names = ", ".join(dict.fromkeys(effect.name for effect in laws))
    title = (
        f'"""Laws of {system.machine.file} that MuJoCo has no element for: {names}.  Written by nnap_em {__version__}.'
    )
    usage = """

It needs NumPy only:

    actuator = Actuator(model, LAWS)
    mujoco.set_mjcb_control(actuator)
    actuator.command[:] = ...  # in place of data.ctrl
\"\"\"
"""
    tail = f"LAWS = Laws(\n{fields}\n    command=command,\n    torque=torque,\n    reading=reading,\n)\n"
    parts = [title + usage + body.rstrip(), *(f"\n{f}".rstrip() for f in functions), "", tail]
    return Acting("\n\n".join(parts), laws)


def _momentary(effect: AbstractEffect) -> bool:
    """True for a law without states that changes no body and no command over time."""
    return not (effect.memory or takes_time(effect) or type(effect).physics is not AbstractEffect.physics)
