"""Identify what a physics model of a machine does not know, from logs, and find what it lacks.

The names below are loaded at their first use, so that `import nnap_em` costs nothing and sets nothing up.
"""

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from .comparison.compare import CompareError, Comparison, compare
    from .data.dataset import DataError, Dataset, pad
    from .data.logs import DataWarning, Logs, read_logs
    from .data.rig import Rig, RigError, RigWarning, read_rig, write_rig
    from .design.experiment import Design, design_experiment
    from .design.limits import DesignError
    from .diagnose.findings import Finding, findings
    from .diagnose.outcome import Closed
    from .diagnose.search import close_the_loop
    from .em.loop import EMState, FitError, Schedule
    from .fit.branches import Branch, branches
    from .fit.identify import Identified, friction_table, identify, parameter_table
    from .fit.observer import Observation, Observer, observer
    from .fit.predict import Prediction, horizon_errors, predict, smooth
    from .fit.store import load, save
    from .identifiability.check import CheckResult, check
    from .model.friction import FrictionNetwork
    from .model.simulate import Experiment, examples, paper_experiment, paper_model, simulate
    from .model.state_space import StateSpaceModel
    from .numerics.parallel import all_devices, over
    from .portable.c99 import write_c
    from .portable.draws import write_draws
    from .portable.export import ExportError, export
    from .portable.fmu import write_fmu
    from .portable.mjcf import write_mjcf
    from .portable.online import write_observer
    from .portable.urdf import write_urdf
    from .smoother.gaussian import ExtendedKalmanSmoother
    from .smoother.mixture import MixtureSmoother
    from .smoother.particle import ParticleSmoother
    from .smoother.posterior import Posterior
    from .storage.files import StoreError
    from .systems import AbstractPlant, AbstractSystem, register, register_equations, root, specs

__all__ = [
    "AbstractPlant",
    "AbstractSystem",
    "Branch",
    "CheckResult",
    "Closed",
    "CompareError",
    "Comparison",
    "DataError",
    "DataWarning",
    "Dataset",
    "Design",
    "DesignError",
    "EMState",
    "Experiment",
    "ExportError",
    "ExtendedKalmanSmoother",
    "Finding",
    "FitError",
    "FrictionNetwork",
    "Identified",
    "Logs",
    "MixtureSmoother",
    "Observation",
    "Observer",
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
    "branches",
    "check",
    "close_the_loop",
    "compare",
    "design_experiment",
    "examples",
    "export",
    "findings",
    "friction_table",
    "horizon_errors",
    "identify",
    "load",
    "observer",
    "over",
    "pad",
    "paper_experiment",
    "paper_model",
    "parameter_table",
    "predict",
    "read_logs",
    "read_rig",
    "register",
    "register_equations",
    "root",
    "save",
    "simulate",
    "smooth",
    "specs",
    "write_c",
    "write_draws",
    "write_fmu",
    "write_mjcf",
    "write_observer",
    "write_rig",
    "write_urdf",
]
_homes = {
    "identifiability.check": ("CheckResult", "check"),
    "data.dataset": ("DataError", "Dataset", "pad"),
    "data.logs": ("DataWarning", "Logs", "read_logs"),
    "design.experiment": ("Design", "design_experiment"),
    "design.limits": ("DesignError",),
    "comparison.compare": ("CompareError", "Comparison", "compare"),
    "diagnose.findings": ("Finding", "findings"),
    "em.loop": ("EMState", "FitError", "Schedule"),
    "portable.export": ("ExportError", "export"),
    "portable.c99": ("write_c",),
    "portable.draws": ("write_draws",),
    "portable.fmu": ("write_fmu",),
    "portable.online": ("write_observer",),
    "portable.mjcf": ("write_mjcf",),
    "portable.urdf": ("write_urdf",),
    "storage.files": ("StoreError",),
    "model.friction": ("FrictionNetwork",),
    "fit.branches": ("Branch", "branches"),
    "fit.identify": ("Identified", "friction_table", "identify", "parameter_table"),
    "fit.observer": ("Observation", "Observer", "observer"),
    "diagnose.search": ("close_the_loop",),
    "diagnose.outcome": ("Closed",),
    "model.state_space": ("StateSpaceModel",),
    "numerics.parallel": ("all_devices", "over"),
    "smoother.particle": ("ParticleSmoother",),
    "fit.predict": ("Prediction", "horizon_errors", "predict", "smooth"),
    "data.rig": ("Rig", "RigError", "RigWarning", "read_rig", "write_rig"),
    "model.simulate": ("Experiment", "examples", "paper_experiment", "paper_model", "simulate"),
    "smoother.gaussian": ("ExtendedKalmanSmoother",),
    "smoother.mixture": ("MixtureSmoother",),
    "smoother.posterior": ("Posterior",),
    "fit.store": ("load", "save"),
    "systems": ("AbstractPlant", "AbstractSystem", "register", "register_equations", "root", "specs"),
}
_home = {name: home for home, names in _homes.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _home:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_home[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
