"""Readers by kind of file."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from ...errors import DataError
from . import bags, hdf5_file, table_file
from .recording import Address, Recording

readers: dict[str, Any] = {
    ".mcap": bags,
    ".db3": bags,
    ".bag": bags,
    ".h5": hdf5_file,
    ".hdf5": hdf5_file,
    **dict.fromkeys((".csv", ".parquet", ".mat", ".txt", ".tsv", ".lvm", *table_file.SHEETS), table_file),
}
"""Module by the end of the name; for another kind of file, add one.  `topics(path)` lists topics and their fields,
`read(path, fields)` gives the numbers at some paths of some topics.
"""
_ELSEWHERE = {
    ".trace": "save the trace as *.trace.csv in CODESYS",
    ".svdx": "export it as CSV: TC3ScopeExportTool.exe svd={path} target={stem}.csv silent",
    ".svd": "export it as CSV: TC3ScopeExportTool.exe svd={path} target={stem}.csv silent",
}
"""Commands that write a file that is not read as one that is."""


def reader(path: Path) -> Any:
    """The reader for a file; DataError where there is none, or no file."""
    if path.is_dir():
        raise DataError(f"{path}: is a folder; give the log in it")
    if not path.is_file():
        raise DataError(f"{path}: there is no such file; check the path")
    suffix = path.suffix.lower()
    if suffix in _ELSEWHERE:
        raise DataError(f"{path}: {suffix} is not read; {_ELSEWHERE[suffix].format(path=path, stem=path.stem)}")
    if suffix not in readers:
        raise DataError(f"{path}: logs end in {', '.join(readers)}; rename it, or write one of these")
    return readers[suffix]


def read(path: Path, addresses: Iterable[Address]) -> Recording:
    """The numbers at these addresses."""
    fields: dict[str, dict[str, None]] = {}
    for at in addresses:
        fields.setdefault(at.topic, {})[at.path] = None
    return reader(path).read(path, {topic: tuple(paths) for topic, paths in fields.items()})
