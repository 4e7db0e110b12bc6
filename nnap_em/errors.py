"""Errors and warnings of the library: each message names the place and what to do."""

__all__ = ["CompareError", "DataError", "DataWarning", "DesignError", "ExportError", "FitError", "RigError"]
__all__ += ["RigWarning", "StoreError"]


class CompareError(ValueError):
    """Fits that cannot be compared: the message names them and the reason, with a hint."""


class DataError(ValueError):
    """A mistake in a log: the message names the file, the place, the value and a hint."""


class DataWarning(UserWarning):
    """Something in a log that is possible but seldom meant."""


class DesignError(ValueError):
    """No experiment can be designed: the message has the reason and a hint."""


class ExportError(ValueError):
    """A model that has no form outside JAX; the message names the reason."""


class FitError(RuntimeError):
    """EM cannot go on: every sequence is lost."""


class FormulaError(ValueError):
    """A mistake in a formula: the place in its text, the problem and the remedy."""


class RigError(ValueError):
    """A mistake in rig.toml: the message names the file, the table and key, what was found and the remedy."""


class RigWarning(UserWarning):
    """Something in rig.toml that is possible but seldom meant."""


class MachineError(RigError):
    """A machine file that cannot be used: the message names the file, the obstacle, and the remedy."""


class StoreError(ValueError):
    """A file that is not what it should be: the message names the file, the mistake and a hint."""
