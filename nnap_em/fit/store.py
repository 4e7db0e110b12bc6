"""A fitted model as one file: loading gives the same numbers to the last bit.

The file is an npz: one member per array, named by its place in the tree, and a JSON header that holds the rig and
the plain values.  No code is stored; loading builds the model anew from the rig and puts the numbers in.
"""

import dataclasses
import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .. import __version__
from ..data.dataset import Dataset
from ..data.limits import Bounds
from ..data.rig import Declared, Rig
from ..effects import catalogue, parts
from ..numerics.digest import plain
from ..smoother import kinds
from ..storage.files import Kind, read_arrays, refuse, write_arrays
from ..storage.leaves import describe, name_of, restore, tuples, walk
from ..systems import systems
from .identify import Identified, begin

MODEL_KIND = Kind(
    "nnap_em fitted model", 4, "model",
    give="give the model.npz that `nnap-em identify` wrote",
    again="identify again, or use the version that wrote it",
)  # fmt: skip

MODEL_FILE, AFTER_FILE = "model.npz", "after.npz"
"""Files of an identification and of a diagnosis."""


class Stored(NamedTuple):
    """Content of a model file."""

    fitted: Identified
    fingerprint: str
    """Digest of the training data; empty if it was not given."""
    notes: dict[str, Any]
    """Whatever the writer wished to keep, as JSON."""


def model_file(path: Path) -> Path:
    """The model that is meant by a file, or by the folder of an identification or of a diagnosis."""
    if not path.is_dir():
        return path
    return path / AFTER_FILE if not (path / MODEL_FILE).exists() and (path / AFTER_FILE).exists() else path / MODEL_FILE


def fingerprint(data: Dataset) -> str:
    """SHA-256 of the content of `data`, to recognise the same data later."""
    arrays = [np.asarray(part) for part in data]
    return hashlib.sha256(b"".join(f"{a.dtype.str}{a.shape}".encode() + a.tobytes() for a in arrays)).hexdigest()


def save(
    path: Path | str, fitted: Identified, *, fingerprint: str = "", notes: Mapping[str, Any] | None = None
) -> None:
    """Write a fit to one file, whole or not at all; it loads with the same numbers to the last bit.

    Args:
        path: the file, an npz.
        fitted: the fit.
        fingerprint: digest of its training data.
        notes: whatever else should be kept, as JSON.

    Raises:
        StoreError: it could not be loaded again, since it is of another structure than `identify` makes.

    Example:
        >>> nnap_em.save(f"{folder}/model.npz", fit)
    """
    path = Path(path)
    arrays: dict[str, np.ndarray] = {}
    leaves: dict[str, dict[str, Any]] = {}

    def leaf(place: str, value: Any) -> Any:
        try:
            leaves[place], array = describe(value)
        except TypeError as error:
            refuse(path, f"{place} is a {error}", "arrays, numbers and named functions can be stored")
        if array is not None:
            arrays[place] = array
        return value

    walk(_tree(fitted), leaf)
    header = {
        "rig": dataclasses.asdict(fitted.rig),
        "effects": [_sketch(path, effect) for effect in fitted.model.effects],
        "smoother": _sketch(path, fitted.smoother),
        "leaves": leaves,
        "fingerprint": fingerprint,
        "notes": dict(notes or {}),
    }
    _assemble(path, {"version": __version__, **header}, arrays)
    write_arrays(path, MODEL_KIND, header, arrays)


def load(path: Path | str) -> Identified:
    """The fit that a file holds, with the numbers that were saved.

    Args:
        path: of `save`, or model.npz or after.npz of the commands.

    Returns:
        The fit.

    Raises:
        StoreError: the file is damaged, foreign, or of another version.

    Example:
        >>> nnap_em.save(f"{folder}/model.npz", fit)
        >>> nnap_em.load(f"{folder}/model.npz").rig == rig
        True
    """
    return read(Path(path)).fitted


def read(path: Path) -> Stored:
    """All that `path` holds.

    Raises StoreError if the file is damaged, foreign, or of another version.
    """
    header, arrays = read_arrays(path, MODEL_KIND)
    try:
        return Stored(_assemble(path, header, arrays), header["fingerprint"], header["notes"])
    except (KeyError, TypeError, AttributeError) as error:
        refuse(path, f"its header lacks something ({error!r})", "identify again with this version")


def _tree(fitted: Identified) -> dict[str, Any]:
    return {name: value for name, value in fitted._asdict().items() if name != "rig"}


def _assemble(path: Path, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> Identified:
    """The model that `header` and `arrays` describe, on the skeleton that its rig gives."""
    rig = _rig(header["rig"])
    if rig.system not in systems:
        refuse(path, f"its system {rig.system!r} is not registered here", f"registered are {', '.join(systems)}")
    wide = any(array.dtype == np.float64 for array in arrays.values())
    if wide and jnp.zeros(()).dtype != np.float64:
        refuse(path, "its numbers have 64 bits", 'first call jax.config.update("jax_enable_x64", True)')
    leaves: dict[str, dict[str, Any]] = dict(header["leaves"])
    leaves.pop("/rise", None)  # `state.stop` says it

    def differs(place: str, problem: str) -> NoReturn:
        problem = f"another structure at {place.strip('/')}: {problem} (it was written by nnap_em {header['version']}"
        refuse(path, f"{problem}, this is {__version__})", "identify again with this version")

    def leaf(place: str, value: Any) -> Any:
        if place not in leaves:
            differs(place, "missing in the file")
        entry, array = leaves.pop(place), arrays.get(place)
        if entry["is"] == "code" and name_of(value) != entry["of"]:
            differs(place, f"{entry['of']!r} in the file")
        if entry["is"] not in ("code", "plain"):
            axes = None if entry["is"] == "key" or value is None else np.ndim(value)
            if array is None or callable(value) or axes not in (None, array.ndim):
                differs(place, "of another shape" if array is not None else "no array in the file")
        return restore(entry, array, value)

    known = {kind.__name__: kind for kind in (*catalogue.values(), *parts)}
    effects = tuple(_drawn(path, sketch, "effect", known) for sketch in header["effects"])
    tree = _tree(begin(rig, _blank(rig), key=jax.random.key(0), effects=effects))
    tree["smoother"] = _drawn(path, header["smoother"], "smoother", kinds)
    tree = walk(tree, leaf)
    for place, entry in leaves.items():
        if entry.get("of", entry):  # what is gone and was empty changes nothing
            differs(place, "unknown here")
    return Identified(rig=rig, **tree)


def _sketch(path: Path, node: Any) -> Any:
    """The structure of an effect or a smoother as JSON: modules by name, arrays by their number of axes."""
    if isinstance(node, eqx.Module):
        kind = type(node)
        parts = {f.name: _sketch(path, getattr(node, f.name)) for f in dataclasses.fields(node)}
        return {"kind": kind.__name__, "parts": parts}
    if isinstance(node, tuple) and not plain(node):
        return {"items": [_sketch(path, item) for item in node]}
    if not (eqx.is_array(node) or plain(node)):
        refuse(path, f"an effect or smoother has a {type(node).__name__}", "modules, arrays and numbers can be stored")
    return {"axes": np.ndim(node)} if eqx.is_array(node) else {"plain": node}


def _drawn(path: Path, sketch: Mapping[str, Any], noun: str, known: Mapping[str, type]) -> Any:
    """An effect or smoother of that structure, of `known` kinds, to put the numbers in."""
    if "kind" in sketch:
        if sketch["kind"] not in known:
            refuse(path, f"its {noun} {sketch['kind']!r} is not known here", "first import what adds it")
        skeleton = object.__new__(known[sketch["kind"]])
        for name, part in sketch["parts"].items():
            object.__setattr__(skeleton, name, _drawn(path, part, noun, known))
        return skeleton
    if "items" in sketch:
        return tuple(_drawn(path, item, noun, known) for item in sketch["items"])
    return jnp.zeros((1,) * sketch["axes"]) if "axes" in sketch else tuples(sketch["plain"])


def _rig(entries: Mapping[str, Any]) -> Rig:
    values: dict[str, Any] = {name: tuples(value) for name, value in entries.items()}
    if not values.get("memory"):  # of a version whose friction could have one
        values.pop("memory", None)
    for part in ("parameters", "start"):
        values[part] = {name: Declared(**pair) for name, pair in entries[part].items()}
    pairs = lambda table: {name: tuple(pair) for name, pair in table.items()}  # noqa: E731
    values["limits"] = Bounds(**{part: pairs(table) for part, table in entries["limits"].items()})
    values["ranges"] = pairs(entries["ranges"])
    return Rig(**values)


def _blank(rig: Rig, rows: int = 32) -> Dataset:
    """Placeholder logs of the right shape; all their numbers are replaced by those of the file."""
    t = rig.dt * np.arange(rows)
    swing = np.sin(t / t[-1])[None, :, None]
    u, y = (np.repeat(swing, n, axis=2) for n in (len(rig.input_columns), len(rig.measured)))
    return Dataset(t[None], u, y, np.ones((1, rows), bool))
