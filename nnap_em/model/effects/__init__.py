"""The catalogue of what a machine may have and its model lack: every effect of every file of this folder."""

import importlib
import pkgutil

from .base import AbstractEffect, Candidate, JointEffect, OperatingPoint, SearchScales, SensorEffect, fields, flat
from .function import free_form


def _leaves(kind: type[AbstractEffect]) -> list[type[AbstractEffect]]:
    return [leaf for sub in kind.__subclasses__() for leaf in (_leaves(sub) or [sub])]


for _module in sorted(m.name for m in pkgutil.iter_modules(__path__)):
    importlib.import_module(f"{__name__}.{_module}")

catalogue: dict[str, type[AbstractEffect]] = {kind.name: kind for kind in _leaves(AbstractEffect)}
"""Effects by their names."""

__all__ = [
    "AbstractEffect", "Candidate", "JointEffect", "OperatingPoint", "SearchScales", "SensorEffect", "catalogue",
    "fields", "flat", "free_form",
]  # fmt: skip
