"""Files that are there whole or not at all: texts, bytes, and arrays under a JSON header."""

import io
import json
import os
import shutil
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import numpy as np

from .. import __version__
from ..errors import StoreError


class Kind(NamedTuple):
    """Kind of a file of arrays, and hints where it is another."""

    name: str
    """Stands in the header."""
    format: int
    noun: str
    give: str
    """The hint for a file that is not of this kind, or not whole."""
    again: str
    """The hint for a file of another format."""


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1


def replace_bytes(path: Path, content: bytes) -> None:
    """Write a file whole or not at all (through a temporary file in its folder, which is made if need be).

    Raises OSError with the name of the file, also where the disk is full.
    """
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with part.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), str(path)) from error
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)


def replace_text(path: Path, text: str) -> None:
    """Write a text file whole or not at all (through a temporary file in its folder, which is made if need be)."""
    replace_bytes(path, text.encode())


_MARKS = (b"ritten by nnap_em", b'"nnap_em": "', b'"kind": "nnap_em ')
"""Texts of which one stands in each file that the package writes: sources and pages, JSON, arrays."""


def check_own(paths: Iterable[Path], header: str = "") -> None:
    """Raise StoreError where a file is there that the package did not write: nobody else's is ever replaced.

    A table is the package's own where its first line is `header`.
    """
    for path in paths:
        if not path.exists():
            continue
        content = b"" if path.is_dir() else path.read_bytes()
        first = content.partition(b"\n")[0].strip().decode(errors="replace")
        if not any(mark in content for mark in _MARKS) and (not header or first != header):
            refuse(path, "is there already, and nnap_em did not write it", "move it away, or name another place")


def replace_own(files: Mapping[Path, str]) -> None:
    """Write text files, each whole or not at all, and none where one of somebody else would be replaced."""
    check_own(files)
    for path, text in files.items():
        replace_text(path, text)


@contextmanager
def whole_folder(out: Path) -> Iterator[Path]:
    """A folder to write into, which is at `out` once all is written, and gone where something fails.

    Raises StoreError where something is at `out` already.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        refuse(out, "is there already", "give a new folder, or empty this one")
    out.parent.mkdir(parents=True, exist_ok=True)
    part = Path(tempfile.mkdtemp(prefix=f".{out.name}.", dir=out.parent))
    try:
        yield part
        part.chmod(0o755)
        os.replace(part, out)
    finally:
        shutil.rmtree(part, ignore_errors=True)


def sweep(folder: Path) -> None:
    """Remove from `folder` what killed processes left half written."""
    for part in folder.glob(".*.part"):
        part.unlink(missing_ok=True)


def write_arrays(path: Path, kind: Kind, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
    """Write `arrays` and a header to one npz file, whole or not at all."""
    full = {"kind": kind.name, "format": kind.format, "version": __version__, **header}
    content = io.BytesIO()
    np.savez(content, allow_pickle=False, header=np.frombuffer(json.dumps(full).encode(), np.uint8), **arrays)
    replace_bytes(path, content.getvalue())


def read_arrays(path: Path, kind: Kind) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Header and arrays of a file of this kind and format; the checksums of zip show damaged bytes.

    Raises StoreError for any other.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        refuse(path, f"cannot be read ({error.strerror})", kind.give)
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        header = json.loads(arrays.pop("header").tobytes())
    except Exception:  # what the parsers raise on damaged bytes is open-ended
        problem = f"no {kind.noun}, or damaged or cut short ({len(content)} bytes)"
        refuse(path, problem, f"{kind.give}, from a copy that is whole")
    if not isinstance(header, dict) or header.get("kind") != kind.name:
        refuse(path, "an npz of another program", kind.give)
    if header.get("format") != kind.format:
        by = f"format {header.get('format')} (nnap_em {header.get('version')}), this version reads format {kind.format}"
        refuse(path, by, kind.again)
    return header, arrays


def refuse(path: Path, problem: str, hint: str) -> NoReturn:
    """Raise StoreError."""
    raise StoreError(f"{path}: {problem}; {hint}")
