"""The machines that ship: one file each, found by the name that `rig.toml` gives as the model's type."""

import dataclasses
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from .. import rig as rigs
from ..files.from_file import declare
from ..rig import Rig, SystemSpec
from . import acrobot, declared, equations, pendulum, slide, tree
from .base import AbstractSystem
from .equations import Equations
from .expression import root
from .plant import AbstractPlant

systems: dict[str, Any] = {
    "acrobot": acrobot.Acrobot,
    "pendubot": acrobot.Acrobot,
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
systems |= {"mjcf": tree.Tree, "equations": equations.Equations}  # whose files name states and parameters
specs |= {"mjcf": SystemSpec((), (), {}, 0, declare=declare)}
specs |= {"equations": SystemSpec((), (), {}, 0, declare=declared.declare)}


def read_rig(path: Path | str) -> Rig:
    """The rig that a rig.toml declares, in SI units, of a machine that ships or that was registered.

    Args:
        path: the file.

    Returns:
        What is declared.

    Raises:
        RigError: with every mistake, a line each: file, key and what to do.

    Example:
        >>> nnap_em.read_rig(f"{folder}/rig.toml").measured
        ('x',)
    """
    return rigs.read_rig(path, specs)


def register(name: str, system: type[AbstractSystem]) -> None:
    """Make a machine known as `type = name` in `rig.toml`, in this process.

    Call it before `read_rig`, and before `load` of a model of this machine.

    Args:
        name: for rig.toml.
        system: its class.

    Raises:
        ValueError: the name is taken.
    """
    if systems.get(name, system) is not system:
        raise ValueError(f"{name!r} is the name of {systems[name].__name__}; give the machine another one")
    systems[name] = system
    specs[name] = spec(system)


def register_equations(
    name: str,
    rate: equations.Rate,
    *,
    states: Mapping[str, str],
    inputs: Mapping[str, str],
    parameters: Sequence[str],
    units: Mapping[str, str] | None = None,
) -> None:
    """Make equations known as `type = name` in `rig.toml`, in this process, by a Python function.

    Args:
        name: for rig.toml.
        rate: `rate(x, u, p)` gets states, inputs and parameters as attributes (`x.h1`) and returns the derivatives
            of all states by their names [per second].
        states: unit of every state.
        inputs: unit of every input.
        parameters: names of the parameters.
        units: those of parameters that have one.

    Raises:
        ValueError: the name is taken.
    """
    known = equations.functions.get(name, rate), systems.get(name, equations.Equations)
    if known != (rate, equations.Equations):
        raise ValueError(f"{name!r} is taken; give the equations another name")
    of = equations.Text(dict(states), dict(inputs), {}, {}, tuple(parameters), units=dict(units or {}), function=name)
    equations.functions[name], systems[name] = rate, equations.Equations
    specs[name] = SystemSpec((), (), {}, 0, declare=partial(declared.declare, of=of))


__all__ = ["AbstractPlant", "AbstractSystem", "Equations", "register", "register_equations", "root", "specs"]
