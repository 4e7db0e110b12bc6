"""Identify what a physics model of a machine does not know, from logs, and find what it lacks.

The names below are loaded at their first use, so that `import nnap_em` costs nothing and sets nothing up.
"""

import importlib
import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from .check import Finding, check
    from .data import Dataset, Logs, pad, read_logs
    from .diagnose import findings
    from .em import EMState, FitError, Schedule
    from .export import ExportError, export
    from .files import StoreError
    from .formats import DataError, DataWarning
    from .friction import FrictionNetwork
    from .identify import Identified, friction_table, identify, parameter_table
    from .loop import Closed, close_the_loop
    from .model import StateSpaceModel
    from .parallel import all_devices, over
    from .particle import ParticleSmoother
    from .predict import Prediction, horizon_errors, predict, smooth
    from .rig import Rig, RigError, RigWarning, read_rig, write_rig
    from .simulate import Experiment, examples, paper_experiment, paper_model, simulate
    from .smoother import ExtendedKalmanSmoother, Posterior
    from .store import load, save
    from .systems import AbstractSystem, register, specs

__all__ = [
    "AbstractSystem",
    "Closed",
    "DataError",
    "DataWarning",
    "Dataset",
    "EMState",
    "Experiment",
    "ExportError",
    "ExtendedKalmanSmoother",
    "Finding",
    "FitError",
    "FrictionNetwork",
    "Identified",
    "Logs",
    "ParticleSmoother",
    "Posterior",
    "Prediction",
    "Rig",
    "RigError",
    "RigWarning",
    "Schedule",
    "StateSpaceModel",
    "StoreError",
    "__version__",
    "all_devices",
    "check",
    "close_the_loop",
    "examples",
    "export",
    "findings",
    "friction_table",
    "horizon_errors",
    "identify",
    "load",
    "over",
    "pad",
    "paper_experiment",
    "paper_model",
    "parameter_table",
    "predict",
    "read_logs",
    "read_rig",
    "register",
    "save",
    "simulate",
    "smooth",
    "specs",
    "write_rig",
]
_homes = {
    "check": ("Finding", "check"),
    "data": ("Dataset", "Logs", "pad", "read_logs"),
    "diagnose": ("findings",),
    "em": ("EMState", "FitError", "Schedule"),
    "export": ("ExportError", "export"),
    "files": ("StoreError",),
    "formats": ("DataError", "DataWarning"),
    "friction": ("FrictionNetwork",),
    "identify": ("Identified", "friction_table", "identify", "parameter_table"),
    "loop": ("Closed", "close_the_loop"),
    "model": ("StateSpaceModel",),
    "parallel": ("all_devices", "over"),
    "particle": ("ParticleSmoother",),
    "predict": ("Prediction", "horizon_errors", "predict", "smooth"),
    "rig": ("Rig", "RigError", "RigWarning", "read_rig", "write_rig"),
    "simulate": ("Experiment", "examples", "paper_experiment", "paper_model", "simulate"),
    "smoother": ("ExtendedKalmanSmoother", "Posterior"),
    "store": ("load", "save"),
    "systems": ("AbstractSystem", "register", "specs"),
}
_home = {name: home for home, names in _homes.items() for name in names}


class _Package(ModuleType):
    """A package in which names such as `identify` and `predict` mean the functions, not the modules that they are in.

    Importing a submodule binds it in its package; which would hide the function.
    """

    def __setattr__(self, name: str, value: Any) -> None:
        if name not in _home or not isinstance(value, ModuleType):
            ModuleType.__setattr__(self, name, value)


def __getattr__(name: str) -> Any:
    if name not in _home:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_home[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


sys.modules[__name__].__class__ = _Package
