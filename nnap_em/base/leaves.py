"""Leaves of a tree, each an entry of a JSON header and, if it is an array, the array: back to the last bit."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .digest import is_key, plain


def tuples(value: Any) -> Any:
    """Plain value as it was before JSON."""
    return tuple(map(tuples, value)) if isinstance(value, list | tuple) else value


def name_of(code: Any) -> str:
    """A function or callable object by name."""
    return getattr(code, "__name__", type(code).__name__)


def describe(value: Any) -> tuple[dict[str, Any], np.ndarray | None]:
    """Description of a leaf in the header, and its array if it is one.

    Raises TypeError where it is nothing that can be stored.
    """
    if is_key(value):
        return {"is": "key", "of": str(jax.random.key_impl(value))}, np.asarray(jax.random.key_data(value))
    if isinstance(value, jax.Array):
        return {"is": "weak" if value.weak_type and value.ndim == 0 else "jax"}, np.asarray(value)
    if isinstance(value, np.ndarray | np.generic):
        return {"is": "numpy"}, np.asarray(value)
    if plain(value):
        return {"is": "plain", "of": value}, None
    if callable(value):
        return {"is": "code", "of": name_of(value)}, None
    raise TypeError(type(value).__name__)


def restore(entry: dict[str, Any], array: np.ndarray | None, code: Any = None) -> Any:
    """The leaf that `describe` described; for a function that is `code`."""
    match entry["is"]:
        case "plain":
            return tuples(entry["of"])
        case "code":
            return code
        case "key":
            return jax.random.wrap_key_data(jnp.asarray(array), impl=entry["of"])
        case "weak":
            assert array is not None
            return jnp.asarray(array.item())
        case "jax":
            return jax.device_put(array)  # no program for every shape
        case _:
            return np.asarray(array)
