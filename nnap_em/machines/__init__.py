"""Declarations: `rig.toml`, an MJCF or URDF file, or equations give a `Rig` and its equations of motion."""

from .systems import AbstractPlant, AbstractSystem, Equations, register, register_equations, root, specs

__all__ = ["AbstractPlant", "AbstractSystem", "Equations", "register", "register_equations", "root", "specs"]
