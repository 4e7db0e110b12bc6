"""Compiled programs hold memory maps, and a process may have 65,530 of them: those no longer needed are released."""

from pathlib import Path

import jax

MOST_MAPS = 40_000
"""Maps beyond which programs are released; a large one holds some hundred."""


def maps() -> int:
    """Memory maps of this process; 0 where the system does not report them."""
    try:
        return Path("/proc/self/maps").read_bytes().count(b"\n")
    except OSError:
        return 0


def release_programs(most: int = MOST_MAPS) -> bool:
    """Drop all compiled programs where they hold more than `most` maps; what is needed again is compiled again."""
    if maps() <= most:
        return False
    jax.clear_caches()
    return True
