"""Types of what the functions of `nnap_em` take and return, for annotations."""

from .comparison.compare import Comparison
from .data.logs import Logs
from .diagnosis.findings import Finding
from .experiment.experiment import Design
from .fit.check import CheckResult
from .fit.identify import FrictionTable
from .fit.observer import Observation, Observer
from .fit.predict import Prediction

__all__ = ["CheckResult", "Comparison", "Design", "Finding", "FrictionTable", "Logs"]
__all__ += ["Observation", "Observer", "Prediction"]
