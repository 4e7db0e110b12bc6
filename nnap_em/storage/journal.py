"""Finished steps of a long computation on disk, so that one that was killed goes on where it was.

    with keeping(Journal(folder, {"seed": 0})):
        closed = diagnose(rig, data, key=key)

A step is a function that gives the same for the same arguments, and a file holds the outcome of one call.  It is found
again by a digest of all that the function was given: a resumed run computes what is not there, and a step whose
arguments differ in one bit is computed anew.  Outside `keeping` nothing of this happens.  After a deadline
(`deadline.py`) no new step begins.
"""

import contextlib
import contextvars
import functools
import json
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np

from .. import __version__
from ..numerics.digest import digest
from ..numerics.parallel import everywhere
from ..numerics.profile import stage
from .deadline import in_time
from .files import Kind, read_arrays, refuse, sweep, write_arrays
from .leaves import describe, name_of, restore

_AGAIN = "remove it, and --resume does this step again; or leave --resume out to begin anew"
STEP_KIND = Kind("nnap_em finished step", 1, "finished step", _AGAIN, _AGAIN, _AGAIN, _AGAIN)
HERE: Any = object()
"""Stands for one array or number in the form of an outcome."""

_journal: contextvars.ContextVar["Journal | None"] = contextvars.ContextVar("nnap_em_journal", default=None)
_Step = TypeVar("_Step", bound=Callable)


class Journal:
    """A folder of finished steps; `of` names, as JSON, the computation to which they belong."""

    def __init__(self, folder: Path, of: Mapping[str, Any]):
        self.folder = folder
        self.open = False
        """True for a computation that was not finished in its time, and is to be continued."""
        self.of = json.loads(json.dumps(dict(of)))
        self.by = {"nnap_em": __version__, "jax": jax.__version__}

    def __len__(self) -> int:
        """Number of finished steps."""
        return sum(1 for _ in self.folder.glob("*.npz"))

    def check(self) -> None:
        """Raises StoreError, with its name, for a file that is no finished step of this computation."""
        for path in sorted(self.folder.glob("*.npz")):
            self._read(path)

    def clear(self) -> None:
        """Remove the finished steps, and the folder if nothing else is in it."""
        sweep(self.folder)
        own = re.compile(r"[a-z_]+-[0-9a-f]{32}\.npz")
        for path in self.folder.glob("*.npz"):
            if own.fullmatch(path.name):
                path.unlink(missing_ok=True)
        with contextlib.suppress(OSError):
            self.folder.rmdir()

    def find(self, name: str, form: Any) -> Any:
        """The outcome kept under `name`, of the structure of `form`; None if there is none."""
        path = self.folder / f"{name}.npz"
        if not path.exists():
            return None
        entries, arrays = self._read(path)
        blanks, structure = jax.tree.flatten(form)
        if len(entries) != len(blanks):
            refuse(path, f"{len(entries)} numbers and arrays, not {len(blanks)}", _AGAIN)
        leaves = enumerate(zip(entries, blanks, strict=True))
        return jax.tree.unflatten(structure, [restore(e, arrays.get(str(i)), blank) for i, (e, blank) in leaves])

    def keep(self, name: str, outcome: Any) -> None:
        """Write an outcome."""
        leaves = [describe(leaf) for leaf in jax.tree.leaves(outcome)]
        arrays = {str(i): array for i, (_, array) in enumerate(leaves) if array is not None}
        header = {"of": self.of, "by": self.by, "leaves": [entry for entry, _ in leaves]}
        write_arrays(self.folder / f"{name}.npz", STEP_KIND, header, arrays)

    def _read(self, path: Path) -> tuple[list[dict[str, Any]], dict[str, np.ndarray]]:
        header, arrays = read_arrays(path, STEP_KIND)
        by, of = header.get("by"), header.get("of")
        if by != self.by:
            origin, this = (" and ".join(f"{k} {v}" for k, v in (d or {}).items()) for d in (by, self.by))
            refuse(path, f"made by {origin}, this is {this}", "leave --resume out to begin anew")
        for name, value in self.of.items():
            if (other := (of or {}).get(name)) != value:
                option = isinstance(value, int) or name.startswith("--")
                origin = f"with {name} {other}, not {value}" if option else f"from another {name}"
                again = f"resume with {name} {other}" if other is not None else f"resume without {name}"
                hint = f"{again}, or begin anew" if option else "leave --resume out to begin anew"
                refuse(path, f"made {origin}", f"{hint}, or give another --out")
        return header["leaves"], arrays


@contextlib.contextmanager
def keeping(journal: Journal) -> Iterator[None]:
    """Keep the steps of what is called inside in `journal`, and take from there those that it has."""
    token = _journal.set(journal)
    try:
        yield
    finally:
        _journal.reset(token)


def step(form: Callable[..., Any]) -> Callable[[_Step], _Step]:
    """Makes a function a step; `form` gives, from the same arguments, the structure of what it returns."""

    def make(function: _Step) -> _Step:
        @functools.wraps(function)
        @stage(function.__module__.rpartition(".")[2])
        def remembered(*args, **options):
            journal = _journal.get()
            if journal is None:
                in_time()
                return function(*args, **options)
            name = f"{name_of(function)}-{digest(name_of(function), args, options)[:32]}"
            outcome = journal.find(name, form(*args, **options))
            if everywhere(outcome is not None):
                return outcome
            in_time()
            outcome = function(*args, **options)
            journal.keep(name, outcome)
            return outcome

        return remembered  # type: ignore[return-value]

    return make
