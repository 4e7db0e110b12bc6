"""A cache: a folder of entries under keys, shared by all processes; an entry may be lost at any time."""

from contextlib import suppress
from pathlib import Path

from .files import replace_bytes, sweep


class Cache:
    """One file for each key; each is there whole or not at all.  What killed processes left half written goes."""

    def __init__(self, folder: Path):
        self.folder = folder
        with suppress(OSError):
            sweep(folder)

    def get(self, key: str) -> bytes | None:
        """Entry under this key, if there is one that can be read."""
        try:
            return (self.folder / key).read_bytes()
        except OSError:
            return None

    def put(self, key: str, content: bytes) -> None:
        """Keep it, if there is room."""
        with suppress(OSError):
            replace_bytes(self.folder / key, content)
