"""Readers by kind of file."""

from pathlib import Path

from ..data.dataset import DataError
from . import hdf5_file, mcap_file, table_file
from .recording import Reader

readers: dict[str, Reader] = {
    ".mcap": mcap_file,
    ".h5": hdf5_file,
    ".hdf5": hdf5_file,
    ".csv": table_file,
    ".parquet": table_file,
    ".mat": table_file,
}
"""Reader by the end of the name; for another kind of file, add one that has `topics` and `read`."""


def reader(path: Path) -> Reader:
    """The reader for a file; DataError where there is none, or no file."""
    if not path.is_file():
        raise DataError(f"{path}: there is no such file; check the path")
    if path.suffix.lower() not in readers:
        raise DataError(f"{path}: logs end in {', '.join(readers)}; rename it, or write one of these")
    return readers[path.suffix.lower()]
