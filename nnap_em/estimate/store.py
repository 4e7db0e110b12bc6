"""A fitted model as one file: loading gives the same numbers to the last bit.

The file is an npz: one member per array, named by its place in the tree, and a JSON header that holds the kinds of all
nodes by name, and the plain values. No code is stored, and none of a kind is run on loading.
"""

import inspect
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .. import __version__
from ..base.digest import digest, form_of, tree_of
from ..base.files import Kind, read_arrays, refuse, write_arrays
from ..base.leaves import describe, restore
from ..logs.dataset import Dataset
from ..machines.systems import systems
from .identify import Identified

MODEL_KIND = Kind(
    "nnap_em fitted model", 5, "model",
    give="give the model.npz that `nnap-em identify` wrote",
    again="identify again, or use the version that wrote it",
)  # fmt: skip

MODEL_FILE, AFTER_FILE = "model.npz", "after.npz"
"""Files of an identification and of a diagnosis."""

_IDENTITY = inspect.signature(eqx.nn.MLP.__init__).parameters["final_activation"].default
_CODE = {code.__name__: code for code in (jax.nn.tanh, jnp.zeros_like, _IDENTITY)}
"""Functions that a fit may hold, those of its friction, by name."""


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
    return digest(data)


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
        StoreError: it could not be loaded again.

    Example:
        >>> nnap_em.save(f"{folder}/model.npz", fit)
    """
    path = Path(path)
    arrays: dict[str, np.ndarray] = {}

    def leaf(place: str, value: Any) -> Any:
        entry, array = describe(value)
        if array is not None:
            arrays[place] = array
        return entry

    try:
        form = form_of(fitted, leaf)
        _fit(form, arrays)
    except (KeyError, TypeError) as error:
        refuse(path, f"the fit holds what no file can ({error})", "arrays, numbers and loaded modules can be stored")
    write_arrays(path, MODEL_KIND, {"fit": form, "fingerprint": fingerprint, "notes": dict(notes or {})}, arrays)


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
    wide = any(array.dtype == np.float64 for array in arrays.values())
    if wide and jnp.zeros(()).dtype != np.float64:
        refuse(path, "its numbers have 64 bits", 'first call jax.config.update("jax_enable_x64", True)')
    try:
        stored = Stored(_fit(header["fit"], arrays), header["fingerprint"], header["notes"])
    except (KeyError, TypeError) as error:
        by = f"written by nnap_em {header['version']}, this is {__version__}"
        refuse(path, f"not as here: {error} ({by})", "first import what adds its parts, or identify again")
    if stored.fitted.rig.system not in systems:
        problem = f"its system {stored.fitted.rig.system!r} is not registered here"
        refuse(path, problem, f"registered are {', '.join(systems)}")
    return stored


def _fit(form: Any, arrays: Mapping[str, np.ndarray]) -> Identified:
    def leaf(place: str, entry: dict[str, Any]) -> Any:
        array = None if entry["is"] in ("plain", "code") else arrays[place]
        return restore(entry, array, _CODE[entry["of"]] if entry["is"] == "code" else None)

    return tree_of(form, leaf)
