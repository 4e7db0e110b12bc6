"""Trees by their parts: as JSON, and as a digest, in every process alike, numbers to the last bit, code by name."""

import dataclasses
import functools
import hashlib
import importlib.metadata
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeGuard

import jax
import jax.numpy as jnp
import numpy as np


def plain(value: Any) -> bool:
    """True for a value that JSON gives back unchanged; tuples come back as tuples."""
    if isinstance(value, tuple):
        return all(map(plain, value))
    return value is None or type(value) in (bool, int, float, str)


def is_key(value: Any) -> TypeGuard[jax.Array]:
    """True for an array of random keys."""
    return isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jax.dtypes.prng_key)


def parts(node: Any) -> dict[str, Any] | None:
    """The children of a node of a tree by their names; None for a leaf."""
    if dataclasses.is_dataclass(node) and not isinstance(node, type):
        return {field.name: getattr(node, field.name) for field in dataclasses.fields(node)}
    if isinstance(node, Mapping):
        return dict(node)
    if isinstance(node, tuple | list):
        return dict(zip(getattr(node, "_fields", map(str, range(len(node)))), node, strict=True))
    return None


def form_of(node: Any, leaf: Callable[[str, Any], Any], place: str = "") -> Any:
    """JSON of a tree: kind and parts of each node, and `leaf(place, value)`, no list, for each leaf."""
    if (inside := parts(node)) is None:
        return leaf(place, node)
    kind = type(node)
    forms = {name: form_of(part, leaf, f"{place}/{name}") for name, part in inside.items()}
    return [f"{kind.__module__}:{kind.__qualname__}", forms]


def tree_of(form: Any, leaf: Callable[[str, Any], Any], place: str = "") -> Any:
    """The tree that `form_of` described, with `leaf(place, entry)` for each leaf: data, no code of its kinds is run.

    Raises TypeError for a kind that is not loaded, or has other parts here.
    """
    if not isinstance(form, list):
        return leaf(place, form)
    module, _, name = form[0].partition(":")
    kind: Any = getattr(sys.modules.get(module), name, None)
    values = {part: tree_of(inside, leaf, f"{place}/{part}") for part, inside in form[1].items()}
    if kind is dict:
        return values
    if kind in (tuple, list):
        return kind(values.values())
    fields = getattr(kind, "_fields", None)
    if isinstance(kind, type) and dataclasses.is_dataclass(kind):
        fields = [field.name for field in dataclasses.fields(kind)]
    if fields is None or list(fields) != list(values):
        raise TypeError(f"{form[0]} at {place.strip('/')} is not loaded, or of another structure")
    if issubclass(kind, tuple):
        return kind._make(values.values())
    copy = object.__new__(kind)  # as equinox itself does: `__init__` may take other arguments
    for part, value in values.items():
        object.__setattr__(copy, part, value)
    return copy


def full_name(code: Any) -> str:
    """Module and name of a class or function."""
    return f"{code.__module__}.{code.__qualname__}"


def digest(*trees: Any, name: Callable[[Any], str] = full_name) -> str:
    """SHA-256 of all that stands in `trees`; classes and functions count by `name`.

    Raises TypeError for objects that cannot be distinguished.
    """
    sha256 = hashlib.sha256()

    def feed(text: str, content: bytes = b"") -> None:
        sha256.update(f"{text}\0".encode() + content)

    def walk(node: Any) -> None:
        if (inside := parts(node)) is not None:
            feed(f"{name(type(node))}{list(inside)}")
            for part in inside.values():
                walk(part)
        elif is_key(node):
            feed(str(jax.random.key_impl(node)), np.asarray(jax.random.key_data(node)).tobytes())
        elif isinstance(node, jax.Array | np.ndarray | np.generic):
            array = np.asarray(node)
            feed(f"{array.dtype.str}{array.shape}", array.tobytes())
        elif plain(node):
            feed(repr(node))
        elif callable(node) and hasattr(node, "__qualname__"):
            feed(name(node))
        else:
            raise TypeError(f"{full_name(type(node))} cannot be distinguished from another of its kind")

    walk(trees)
    return sha256.hexdigest()


@functools.cache
def surroundings() -> str:
    """The package's text, what it stands on and how JAX is set, as one number."""
    package, sha256 = Path(__file__).resolve().parents[1], hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        sha256.update(str(path.relative_to(package)).encode() + path.read_bytes())
    stands_on = ("jax", "jaxlib", "equinox", "diffrax", "numpy")
    versions = [f"{name} {importlib.metadata.version(name)}" for name in stands_on]
    sha256.update(repr((versions, jax.default_backend(), jax.config.read("jax_enable_x64"))).encode())
    return sha256.hexdigest()
