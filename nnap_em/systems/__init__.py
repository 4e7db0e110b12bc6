"""The machines that ship: one file each, found by the name that `rig.toml` gives as the model's type."""

import dataclasses

from ..rig import SystemSpec
from . import acrobot, pendubot, pendulum, slide
from .base import AbstractSystem

systems: dict[str, type[AbstractSystem]] = {
    "acrobot": acrobot.Acrobot,
    "pendubot": pendubot.Pendubot,
    "pendulum": pendulum.Pendulum,
    "slide": slide.Slide,
}


def spec(system: type[AbstractSystem]) -> SystemSpec:
    """What `rig.toml` may say of a system."""
    names = [f.name for f in dataclasses.fields(system) if f.name != "joints"]
    return SystemSpec(
        states=system.coordinates + system.rates,
        parameters=tuple(n for n in names if n not in system.optional),
        optional=system.optional,
        joints=len(system.coordinates),
    )


specs: dict[str, SystemSpec] = {name: spec(system) for name, system in systems.items()}

__all__ = ["AbstractSystem", "specs", "systems"]
