"""E-steps: every smoother gives one `Posterior`."""

import importlib
import pkgutil

import equinox as eqx

from .posterior import AbstractSmoother, Posterior

kinds: dict[str, type[eqx.Module]] = {
    name: kind
    for module in pkgutil.walk_packages(__path__, f"{__name__}.")
    for name, kind in vars(importlib.import_module(module.name)).items()
    if isinstance(kind, type) and issubclass(kind, eqx.Module) and kind.__module__ == module.name
}
"""Smoothers and what they are made of, by name: a stored model names those of its smoother."""

__all__ = ["AbstractSmoother", "Posterior", "kinds"]
