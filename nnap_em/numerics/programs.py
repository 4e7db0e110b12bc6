"""Compiled programs hold memory maps, and a process may have 65,530 of them: those no longer needed are released."""

from pathlib import Path

import jax


def maps() -> int:
    """Memory maps of this process; 0 where the system does not report them."""
    try:
        return Path("/proc/self/maps").read_bytes().count(b"\n")
    except OSError:
        return 0


def release_programs(most: int = 40_000) -> bool:
    """Drop all compiled programs where they hold more than `most` maps; what is needed again is compiled again.

    A large program holds some hundred maps.
    """
    if maps() <= most:
        return False
    jax.clear_caches()
    return True
