"""The machines that ship: one file each, found by the name that `rig.toml` gives as the model's type."""

import dataclasses

from ..data.rig import SystemSpec
from ..machines.from_file import declare
from . import acrobot, pendubot, pendulum, slide, tree
from .base import AbstractSystem

systems: dict[str, type[AbstractSystem]] = {
    "acrobot": acrobot.Acrobot,
    "pendubot": pendubot.Pendubot,
    "pendulum": pendulum.Pendulum,
    "slide": slide.Slide,
}


def spec(system: type[AbstractSystem], driven: int = 1) -> SystemSpec:
    """Keys of a system in `rig.toml`, whose usual input drives the joint `driven`."""
    names = [f.name for f in dataclasses.fields(system) if f.name != "joints"]
    return SystemSpec(
        states=system.coordinates + system.rates,
        parameters=tuple(n for n in names if n not in system.optional),
        optional=system.optional,
        joints=len(system.coordinates),
        driven=driven,
    )


specs: dict[str, SystemSpec] = {name: spec(system) for name, system in systems.items()}
specs["acrobot"] = spec(acrobot.Acrobot, *acrobot.drives)
systems["mjcf"] = tree.Tree
specs["mjcf"] = SystemSpec((), (), {}, 0, declare=declare)  # the file names states and parameters


def register(name: str, system: type[AbstractSystem]) -> None:
    """Make a machine of yours known as `type = name` in `rig.toml`, in this process; a name that is taken is refused.

    Call it before `read_rig` and before `load` of a model of this machine.
    """
    if systems.get(name, system) is not system:
        raise ValueError(f"{name!r} is the name of {systems[name].__name__}; give the machine another one")
    systems[name] = system
    specs[name] = spec(system)


__all__ = ["AbstractSystem", "register", "specs", "systems"]
