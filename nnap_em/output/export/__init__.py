"""A fitted model for programs that have no JAX."""

from .c99 import write_c
from .mjcf import write_mjcf
from .model import write_model
from .online import write_observer
from .urdf import write_urdf

__all__ = ["write_c", "write_mjcf", "write_model", "write_observer", "write_urdf"]
