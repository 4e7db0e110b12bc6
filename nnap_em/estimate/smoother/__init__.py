"""E-steps: every smoother gives one `Posterior`."""

from .posterior import AbstractSmoother, Posterior

__all__ = ["AbstractSmoother", "Posterior"]
