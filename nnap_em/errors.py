"""Errors and warnings of the library: each message names the place and what to do."""

from .comparison.compare import CompareError
from .data.dataset import DataError
from .data.logs import DataWarning
from .data.rig import RigError, RigWarning
from .em.loop import FitError
from .experiment.limits import DesignError
from .export.model import ExportError
from .storage.files import StoreError

__all__ = ["CompareError", "DataError", "DataWarning", "DesignError", "ExportError", "FitError", "RigError"]
__all__ += ["RigWarning", "StoreError"]
