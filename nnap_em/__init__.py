"""Identify what a physics model of a machine does not know, from logs, and find what it lacks.

The main jobs are functions of the package; the rest is in `machines`, `estimate`, `output` and `errors`.  Each name is
loaded at its first use, so that `import nnap_em` costs nothing.
"""

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from . import errors, estimate, machines, output
    from .estimate.identify import Identified, friction_table, identify, parameter_table
    from .estimate.known import identify_from
    from .estimate.observer import observer
    from .estimate.predict import horizon_errors, predict, smooth
    from .estimate.store import load, save
    from .explain.check import check
    from .explain.compare.compare import compare
    from .explain.design.experiment import design
    from .explain.diagnosis.diagnose import diagnose
    from .explain.diagnosis.findings import findings
    from .explain.diagnosis.outcome import Diagnosis
    from .logs.dataset import Dataset, pad
    from .logs.read import read_logs
    from .machines.rig import Rig
    from .machines.systems import read_rig, register, register_equations
    from .model.simulate import simulate

__all__ = [
    "Dataset", "Diagnosis", "Identified", "Rig", "__version__", "check", "compare", "design", "diagnose", "errors",
    "estimate", "findings", "friction_table", "horizon_errors", "identify", "identify_from", "load", "machines",
    "observer", "output", "pad", "parameter_table", "predict", "read_logs", "read_rig", "register",
    "register_equations", "save", "simulate", "smooth",
]  # fmt: skip
_homes = {
    "explain.compare.compare": "compare",
    "logs.dataset": "Dataset pad",
    "logs.read": "read_logs",
    "machines.rig": "Rig",
    "explain.diagnosis.findings": "findings",
    "explain.diagnosis.outcome": "Diagnosis",
    "explain.diagnosis.diagnose": "diagnose",
    "explain.design.experiment": "design",
    "explain.check": "check",
    "estimate.identify": "Identified friction_table identify parameter_table",
    "estimate.known": "identify_from",
    "estimate.observer": "observer",
    "estimate.predict": "horizon_errors predict smooth",
    "estimate.store": "load save",
    "model.simulate": "simulate",
    "machines.systems": "read_rig register register_equations",
}
_home = {name: home for home, names in _homes.items() for name in names.split()}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if name not in _home:
        return importlib.import_module(f"{__name__}.{name}")
    value = getattr(importlib.import_module(f"{__name__}.{_home[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
