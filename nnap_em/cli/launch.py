"""Several processes for one command: `python -m nnap_em.cli.launch 2 identify FOLDER --out OUT`.

Every process does the same on its share of the sequences; the first one writes and reports.  For several machines, give
on each of them

    python -m nnap_em.cli.launch --coordinator HOST:PORT --first K --here N COUNT identify FOLDER --out OUT

HOST is the first machine and PORT free there; K processes run on the machines before this one, N on this one, and COUNT
in all.  FOLDER is needed on each, and OUT too where a run goes on after a stop.
"""

import argparse
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

from ..base.files import cores

PATIENCE = 600
"""Time that processes wait for each other [s]: one may compile while the others are done, on a machine that is busy."""


def free_address() -> str:
    """An address on this machine at which nobody listens."""
    with socket.socket() as s:
        s.bind(("localhost", 0))
        return f"localhost:{s.getsockname()[1]}"


def work(coordinator: str, count: int, index: int, threads: int, command: list[str]) -> None:
    """One process: join the others, then run the command; all but the first into a folder that is thrown away."""
    import jax

    from ..base import parallel
    from . import main as cli
    from .common import UNFINISHED

    jax.config.update("jax_num_cpu_devices", threads)
    jax.distributed.initialize(coordinator, count, index, initialization_timeout=PATIENCE)
    parallel.use_every_device()
    if index == 0:
        status = cli.main(command)
        if status == 130:
            os._exit(status)  # it has reported what is kept; jax.distributed would wait for the others here
        sys.exit(status)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # or the first one would wait for this one and report nothing
    place = command.index("--out") + 1
    out = Path(command[place])
    with tempfile.TemporaryDirectory() as spare:
        copy = Path(spare) / "out"
        if (kept := out / UNFINISHED).is_dir():
            shutil.copytree(kept, copy / UNFINISHED, ignore=shutil.ignore_patterns(".*.part"))
        sys.stdout = sys.stderr = open(os.devnull, "w")  # noqa: SIM115
        sys.exit(cli.main([*command[:place], str(copy), *command[place + 1 :]]))


def watch(children: list[subprocess.Popen], first: int) -> int:
    """Wait for all; where one dies, end the others, which would wait for it for ever.  The exit status."""
    farewell = 10  # time for the first process to report its finished steps when it is stopped by Ctrl-C [s]
    try:
        while any(child.poll() is None for child in children):
            if any(child.poll() for child in children):
                time.sleep(1.0)  # so that the message of the one that died is out
                break
            time.sleep(0.05)
        failed = [(first + i, code) for i, child in enumerate(children) if (code := child.poll())]
        if not failed or (children[0].returncode or 0) > 0:
            return children[0].returncode or 0  # the first one has reported the reason
        index, code = failed[0]
        cause = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with status {code}"
        kept = "the others were ended. What was finished is kept: give the same command again"
        print(f"error: process {index} {cause}; {kept}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:  # a terminal sends it to the children, too
        with suppress(subprocess.TimeoutExpired):
            children[0].wait(farewell)
        return 130
    finally:
        for child in children:
            if child.poll() is None:
                child.kill()
            child.wait()


def main() -> None:
    """Start the processes of this machine."""
    arguments = argparse.ArgumentParser(
        prog="python -m nnap_em.cli.launch", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    arguments.add_argument("processes", type=int, help="how many in all")
    arguments.add_argument("command", nargs=argparse.REMAINDER, help="a command of nnap-em with --out")
    arguments.add_argument("--coordinator", help="HOST:PORT of the first process, where there are several machines")
    arguments.add_argument("--first", type=int, default=0, help="processes on machines before this one")
    arguments.add_argument("--here", type=int, help="processes on this machine; all, if not given")
    arguments.add_argument("--work", type=int, nargs=2, help=argparse.SUPPRESS)
    args = arguments.parse_args()
    if args.work:
        index, threads = args.work
        work(args.coordinator, args.processes, index, threads, args.command)
        return
    local = args.here or args.processes
    last = args.first + local - 1
    for wrong, problem in (
        ("--out" not in args.command, "the command needs --out FOLDER"),
        (args.coordinator and not args.here, "--coordinator needs --here N: processes on this machine"),
        (not args.first <= last < args.processes, f"no processes {args.first} to {last} of {args.processes}"),
    ):
        if wrong:
            arguments.error(problem)
    threads = max(1, cores() // local)
    address = args.coordinator or free_address()
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # as in `cli`: the processes load JAX before that
    waits = ("xla_cpu_collective_call_terminate_timeout_seconds", "xla_cpu_collective_timeout_seconds")
    os.environ["XLA_FLAGS"] = " ".join([os.environ.get("XLA_FLAGS", ""), *(f"--{name}={PATIENCE}" for name in waits)])
    children = []
    for index in range(args.first, args.first + local):
        order = ["--coordinator", address, "--work", str(index), str(threads), str(args.processes), *args.command]
        children.append(subprocess.Popen([sys.executable, "-m", "nnap_em.cli.launch", *order]))
    sys.exit(watch(children, args.first))


if __name__ == "__main__":
    main()
