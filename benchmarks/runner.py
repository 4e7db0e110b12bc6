"""Parts that benchmarks share: the folder of recordings, a command in a process of its own, the line above a table."""

import json
import os
import platform
import subprocess
import sys
import tempfile
import threading
import time
from datetime import date
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

from nnap_em.cli.common import MISFIT_STATUS

ROOT = Path(__file__).resolve().parent.parent
SHARED = ROOT.parent / "shared" / "data"
"""Recordings, which are no part of the repository."""


def commit() -> str:
    """The commit that is run, `-dirty` where files differ; empty outside a clone."""
    command = ["git", "describe", "--always", "--dirty", "--exclude", "*"]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False).stdout.strip()


def made(*peers: str, of: str = "", command: str = "") -> str:
    """Day, machine, versions (of `peers`, too), commit and command of a table: by default those of this process."""
    versions = ", ".join(f"{name} {version(name)}" for name in ("jax", *peers))
    machine = f"{platform.machine()}, {len(os.sched_getaffinity(0))} cores, Python {platform.python_version()}"
    return f"{date.today()}, {machine}, {versions}, {of or commit()}; `{command or ' '.join(['python', *sys.argv])}`\n"


class Ran(NamedTuple):
    """A command that ended."""

    status: int
    seconds: float
    """From start to end [s]."""
    processor_seconds: float
    memory: float
    """Largest of the process [GB]."""
    said: list[str]
    """The lines of its standard output and error."""
    report: dict[str, Any] | None
    """None where it failed."""


def nnap_em(
    *words: str | Path, out: Path, core: int | None = None, limit: float | None = None, cache: Path | None = None
) -> Ran:
    """`nnap-em WORDS --out OUT`, ended after `limit` [s]; a `core` has the process and one device of JAX alone; `cache`
    is the folder of compiled programs.
    """
    command = [sys.executable, "-m", "nnap_em.cli.main", *map(str, words), "--out", str(out)]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    if core is not None:
        environment |= {"JAX_NUM_CPU_DEVICES": "1", "OPENBLAS_NUM_THREADS": "1"}
    if cache is not None:
        environment |= {"XDG_CACHE_HOME": str(cache)}
    with tempfile.TemporaryFile("w+") as said:
        began = time.perf_counter()
        process = subprocess.Popen(command, env=environment, stdout=said, stderr=said)
        if core is not None:
            os.sched_setaffinity(process.pid, {core})
        (end := threading.Timer(limit or threading.TIMEOUT_MAX, process.kill)).start()
        _, status, used = os.wait4(process.pid, 0)
        end.cancel()
        said.seek(0)
        lines = said.read().strip().splitlines()
    status = os.waitstatus_to_exitcode(status)
    report = json.loads((out / "report.json").read_text()) if status in (0, MISFIT_STATUS) else None
    return Ran(status, time.perf_counter() - began, used.ru_utime + used.ru_stime, used.ru_maxrss / 1e6, lines, report)
