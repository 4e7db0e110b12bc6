"""Flags of the compiler, and the release of programs: they hold memory maps, of which a process may have 65,530."""

import os
from pathlib import Path

import jax
from jaxlib import version

EMITTERS = "xla_cpu_use_fusion_emitters"


def use_older_emitters() -> None:
    """Let XLA compile for the processor with its older emitters; commands and examples do, before the first program.

    The smoother of two joints is traced and compiled in 14 s instead of 22, on one of 2 busy cores.  The next jaxlib,
    without the flag, would end the process over it; a user's own value stays.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if EMITTERS not in flags and tuple(map(int, version.__version__.split(".")[:2])) < (0, 11):
        os.environ["XLA_FLAGS"] = f"{flags} --{EMITTERS}=false".strip()


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
