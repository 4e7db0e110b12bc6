"""Sequences spread over the devices of JAX: `with over(all_devices()): ...`."""

from .numerics.parallel import all_devices, over

__all__ = ["all_devices", "over"]
