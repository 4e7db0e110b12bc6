"""Programs that are kept as they were traced, so that the next run neither traces nor lowers them again.

JAX's own cache spares a run the compiling alone: to know what it looks for it traces and lowers the program first,
which took 14 of the 66 s of a diagnosis that had all its programs at hand.  Here a program is known by what decides it
before it is traced: the package's own text, the versions of what it stands on, and its arguments but for the numbers in
their arrays.  What else could decide it, such as an effect of a user's own, is not searched: such a program is not
kept.
"""

import json
import logging
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, ClassVar

import equinox as eqx
import jax
from jax.core import Tracer
from jax.sharding import Mesh

from .digest import digest, form_of, full_name, surroundings, tree_of


class _Programs:
    """The cache in use, and the programs made ready in this process; None for one that cannot be kept."""

    folder: ClassVar[Path | None] = None
    ready: ClassVar[dict[Any, Callable | None]] = {}


def use_cache(folder: Path | None) -> None:
    """Keep traced programs in this folder from here on; None: nowhere, as at first.  Commands do."""
    _Programs.folder = folder


def traced(run: Callable, function: Callable) -> Callable:
    """`run(*arguments)`, which is decided by `function`, compiled: its arguments but for arrays are constants of it."""
    plain = eqx.filter_jit(run)

    def call(*arguments):
        leaves, structure = jax.tree.flatten(arguments)
        if _Programs.folder is None or jax.process_count() > 1 or any(isinstance(leaf, Tracer) for leaf in leaves):
            return plain(*arguments)
        known = function, structure, tuple(_shape(leaf) if eqx.is_array(leaf) else leaf for leaf in leaves)
        if known not in _Programs.ready:
            _Programs.ready[known] = _ready(run, function, arguments, _Programs.folder)
        program = _Programs.ready[known]
        return plain(*arguments) if program is None else program(*(leaf for leaf in leaves if eqx.is_array(leaf)))

    return call


def _ready(run: Callable, function: Callable, arguments: Any, folder: Path) -> Callable | None:
    """The program, from the cache, or traced and put there; None where it cannot be kept."""
    dynamic, static = eqx.partition(arguments, eqx.is_array)
    arrays, inside = jax.tree.flatten(dynamic)
    structures = []

    def flat(*arrays):
        out, outside = jax.tree.flatten(run(*eqx.combine(jax.tree.unflatten(inside, arrays), static)))
        structures.append(outside)
        return out

    try:
        path = folder / _key(function, arrays, static)
        entry = _read(path)
        if entry is None:
            platforms = (jax.export.default_export_platform(),)
            exported = jax.export.export(_compiled(flat, run), platforms=platforms)(*arrays)
            entry = exported, structures[-1]
            form = form_of(jax.tree.unflatten(entry[1], exported.out_avals), _mark)
            _write(path, json.dumps(form).encode() + b"\n" + exported.serialize())
    except Exception as error:  # not everything can be written down; a mistake of `run` is raised by `run`
        logging.getLogger(__name__).debug("%s is not kept: %s", run.__name__, error)
        return None
    exported, outside = entry
    program = _compiled(lambda *arrays: exported.call(*arrays), run)
    return lambda *arrays: jax.tree.unflatten(outside, program(*arrays))


def _compiled(function: Callable, run: Callable) -> Any:
    """`function`, compiled under the name of `run`."""
    function.__name__ = function.__qualname__ = run.__name__
    return jax.jit(function)


def _mark(place: str, value: Any) -> int | None:
    """Mark of a leaf in the form of an outcome; TypeError for one that is no array."""
    if value is not None and not isinstance(value, jax.core.ShapedArray):
        raise TypeError(f"a {type(value).__name__} in its outcome")
    return None if value is None else 0


def _read(path: Path) -> tuple[jax.export.Exported, Any] | None:
    """Program and structure of its outcome, from the cache; None where there is none, or a damaged one."""
    try:
        form, _, program = path.read_bytes().partition(b"\n")
        outcome = tree_of(json.loads(form), lambda place, mark: mark)
        return jax.export.deserialize(bytearray(program)), jax.tree.structure(outcome)
    except Exception as error:  # whatever it is that was damaged: it is made anew
        logging.getLogger(__name__).debug("no kept program: %s", error)
        return None


def _write(path: Path, entry: bytes) -> None:
    """Keep it, whole or not at all, if there is room."""
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            part.write_bytes(entry)
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)


def _shape(a: jax.Array) -> tuple[tuple[int, ...], Any, bool]:
    """Shape and type of an array, and whether the type is weak, which a random key does not say."""
    return a.shape, a.dtype, getattr(a, "weak_type", False)


def _key(function: Callable, arrays: list[jax.Array], static: Any) -> str:
    """Key of a program; TypeError where something may decide it that is not described whole."""
    mesh = lambda leaf: f"{leaf.axis_names} {leaf.devices.shape}" if isinstance(leaf, Mesh) else leaf  # noqa: E731
    shapes = [(shape, str(dtype), weak) for shape, dtype, weak in map(_shape, arrays)]
    return digest(surroundings(), function, shapes, jax.tree.map(mesh, static), name=_name)


def _name(code: Any) -> str:
    """Module, name and line of a class or function; TypeError for one of another package, and for a closure."""
    lines, package = getattr(code, "__code__", None), str(code.__module__).partition(".")[0]
    # Packages whose text a key stands for, by its own hash or by their version
    packages = frozenset({"nnap_em", "jax", "jaxlib", "equinox", "numpy", "builtins"})
    if package not in packages or ("<" in code.__qualname__ and getattr(code, "__closure__", ()) is not None):
        raise TypeError(f"it holds {full_name(code)}")
    return f"{full_name(code)} {lines and lines.co_firstlineno}"
