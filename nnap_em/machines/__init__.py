"""What is declared: `rig.toml`, an MJCF or URDF file, or equations in; a `Rig` and its equations of motion out."""

from .systems import AbstractPlant, AbstractSystem, Equations, register, register_equations, root, specs

__all__ = ["AbstractPlant", "AbstractSystem", "Equations", "register", "register_equations", "root", "specs"]
