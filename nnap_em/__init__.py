"""Identify what a physics model of a machine does not know, from logs, and find what it lacks.

The main jobs are functions of the package; the rest is in `smoothers`, `plots`, `export`, `systems` and
`errors`.  Each name is loaded at its first use, so that `import nnap_em` costs nothing.
"""

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from . import errors, export, plots, smoothers, systems
    from .comparison.compare import compare
    from .data.dataset import Dataset, pad
    from .data.logs import read_logs
    from .data.rig import Rig
    from .diagnosis.diagnose import diagnose
    from .diagnosis.findings import findings
    from .diagnosis.outcome import Diagnosis
    from .experiment.experiment import design
    from .fit.check import check
    from .fit.identify import Identified, friction_table, identify, parameter_table
    from .fit.known import identify_from
    from .fit.observer import observer
    from .fit.predict import horizon_errors, predict, smooth
    from .fit.store import load, save
    from .model.simulate import simulate
    from .systems import read_rig, register, register_equations

__all__ = [
    "Dataset", "Diagnosis", "Identified", "Rig", "__version__", "check", "compare", "design", "diagnose", "errors",
    "export", "findings", "friction_table", "horizon_errors", "identify", "identify_from", "load", "observer", "pad",
    "parameter_table", "plots", "predict", "read_logs", "read_rig", "register", "register_equations", "save",
    "simulate", "smooth", "smoothers", "systems",
]  # fmt: skip
_homes = {
    "comparison.compare": "compare",
    "data.dataset": "Dataset pad",
    "data.logs": "read_logs",
    "data.rig": "Rig",
    "diagnosis.findings": "findings",
    "diagnosis.outcome": "Diagnosis",
    "diagnosis.diagnose": "diagnose",
    "experiment.experiment": "design",
    "fit.check": "check",
    "fit.identify": "Identified friction_table identify parameter_table",
    "fit.known": "identify_from",
    "fit.observer": "observer",
    "fit.predict": "horizon_errors predict smooth",
    "fit.store": "load save",
    "model.simulate": "simulate",
    "systems": "read_rig register register_equations",
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
