"""What one takes home: figures (`plots`), models for programs that have no JAX (`export`), and reports."""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from . import export, plots

__all__ = ["export", "plots"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return importlib.import_module(f"{__name__}.{name}")
