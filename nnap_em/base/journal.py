"""Finished steps of a long computation on disk, so that one that was killed goes on where it was.

    with keeping(Journal(folder)):
        closed = diagnose(rig, data, key=key)

A step is a function that gives the same for the same arguments, and a file holds the outcome of one call.  It is found
again by a digest of all that the function was given, and of the package and what it stands on: what is not there, is
damaged, or differs in one bit, is computed anew.  Outside `keeping` nothing of this happens.  After a deadline
(`deadline.py`) no new step begins.
"""

import contextlib
import contextvars
import functools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import jax

from ..errors import StoreError
from .deadline import in_time
from .digest import digest, surroundings
from .files import Kind, read_arrays, sweep, write_arrays
from .leaves import describe, name_of, restore
from .parallel import everywhere

STEP_KIND = Kind("nnap_em finished step", 2, "finished step", *2 * ["it is done again"])
HERE: Any = object()
"""Stands for one array or number in the form of an outcome."""

_journal: contextvars.ContextVar["Journal | None"] = contextvars.ContextVar("nnap_em_journal", default=None)
_Step = TypeVar("_Step", bound=Callable)


class Journal:
    """A folder of finished steps."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.open = False
        """True for a computation that was not finished in its time, and is to be continued."""
        self.done: set[str] = set()
        """Names of the finished steps of this computation."""

    @property
    def files(self) -> list[Path]:
        """Finished steps of any computation."""
        return list(self.folder.glob(f"*-{32 * '?'}.npz"))

    def clear(self) -> None:
        """Remove the finished steps, and the folder if nothing else is in it."""
        sweep(self.folder)
        for path in self.files:
            path.unlink(missing_ok=True)
        with contextlib.suppress(OSError):
            self.folder.rmdir()

    def find(self, name: str, form: Any) -> Any:
        """The outcome kept under `name`, of the structure of `form`; None if there is none."""
        try:
            header, arrays = read_arrays(self.folder / f"{name}.npz", STEP_KIND)
        except StoreError:  # none, or damaged
            return None
        blanks, structure = jax.tree.flatten(form)
        self.done.add(name)
        leaves = enumerate(zip(header["leaves"], blanks, strict=True))
        return jax.tree.unflatten(structure, [restore(e, arrays.get(str(i)), blank) for i, (e, blank) in leaves])

    def keep(self, name: str, outcome: Any) -> None:
        """Write an outcome."""
        leaves = [describe(leaf) for leaf in jax.tree.leaves(outcome)]
        arrays = {str(i): array for i, (_, array) in enumerate(leaves) if array is not None}
        header = {"leaves": [entry for entry, _ in leaves]}
        write_arrays(self.folder / f"{name}.npz", STEP_KIND, header, arrays)
        self.done.add(name)


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
        def remembered(*args, **options):
            journal = _journal.get()
            if journal is None:
                in_time()
                return function(*args, **options)
            name = f"{name_of(function)}-{digest(surroundings(), name_of(function), args, options)[:32]}"
            outcome = journal.find(name, form(*args, **options))
            if everywhere(outcome is not None):
                return outcome
            in_time()
            outcome = function(*args, **options)
            journal.keep(name, outcome)
            return outcome

        return remembered  # type: ignore[return-value]

    return make
