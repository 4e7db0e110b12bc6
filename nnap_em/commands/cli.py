"""The command line: arguments in, exit status out; the work is in `commands`, and JAX is loaded only for it."""

import argparse
import functools
import importlib
import math
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any, TypeVar

from .. import __version__
from ..storage.log import Log, silent

_MODULES = {"import": "import_logs"}
"""Modules that cannot be called like their command: `import` is a word of Python."""
_MAIN = """\
examples:
  nnap-em simulate bench                            the paper's acrobot: a data set with known truth
  nnap-em init log.csv --system acrobot --out mine  a first rig.toml from the log, to be filled in
  nnap-em import run.mcap --rig rig.toml --out bench  a data set from logs of a robot: MCAP, HDF5, CSV, ...
  nnap-em check bench                               whether the logs can identify what is asked
  nnap-em identify bench --out fit                  friction, noise and uncertain parameters from bench/train
  nnap-em diagnose bench --out found                what the declared model lacks, and the error before and after
  nnap-em design found --out next                   the inputs to play next, so that what is open is answered
  nnap-em compare monday friday --out changed       what changed between fits of one machine, and what did not
  nnap-em predict fit bench/test --given 1 --out prediction
  nnap-em smooth fit bench/test --out smoothed
  nnap-em export fit --out exported                 all numbers of the model as JSON, with units

A data set is a folder with rig.toml, train/*.csv and, if there is one, test/*.csv.  SI units: s, N m, rad, rad/s.
"""
SYSTEMS = ("acrobot", "pendubot", "pendulum", "slide")
SMOOTHERS = {
    "cubature": "gaussian.CubatureSmoother",
    "ekf": "gaussian.ExtendedKalmanSmoother",
    "particle": "particle.smoother.banked",
}
"""Function of `nnap_em.smoother` that makes a smoother with its options from the hypotheses of the start."""


def parser() -> argparse.ArgumentParser:
    """All commands with their options."""
    top = _new(
        argparse.ArgumentParser,
        "Find which physical effect the model of a machine lacks, from its logs; identify friction, noise and numbers.",
        _MAIN,
        prog="nnap-em",
    )
    top.add_argument("--version", action="version", version=f"nnap-em {__version__}")
    commands = top.add_subparsers(dest="command", metavar="COMMAND", required=True)

    def command(name: str) -> argparse.ArgumentParser:
        """The parser of a command, whose help is the docstring of its module, which is not imported for that."""
        text = Path(__file__).with_name(f"{_MODULES.get(name, name)}.py").read_text()
        summary, _, examples = text.split('"""')[1].partition("\n\n")
        short = f"{summary[0].lower()}{summary[1:]}".rstrip(".")
        return _new(commands.add_parser, summary, examples, name=name, help=short)

    simulate = command("simulate")
    _file(simulate, "out", "OUT", "the new folder")
    simulate.add_argument("--system", choices=SYSTEMS, default="acrobot", help="the machine (default: acrobot)")
    simulate.add_argument("--sequences", type=_count, default=20, metavar="N", help="training sequences (20)")
    simulate.add_argument("--test", type=_natural, default=5, metavar="N", help="test sequences (5)")
    simulate.add_argument("--steps", type=_count, default=500, metavar="N", help="sample intervals of each (500)")
    simulate.add_argument("--seed", type=_natural, default=0, help="of all random numbers (0)")
    simulate.add_argument("--measured", nargs="+", metavar="STATE", help="which states are read")
    for kind, what in (("process", "kick per step"), ("measurement", "readings")):
        text = f"standard deviations: {what} of positions [rad or m] and of rates [rad/s or m/s]"
        simulate.add_argument(f"--{kind}-noise", nargs=2, type=_positive, metavar=("POSITION", "RATE"), help=text)

    init = command("init")
    _file(init, "log", "LOG", "a CSV file with a header, MCAP, ROS bag or HDF5")
    machine = init.add_mutually_exclusive_group()
    machine.add_argument("--system", choices=SYSTEMS, help="the machine, where the columns do not determine it")
    text = 'the machine as MJCF or URDF, which stays where it is, or "equations" to be written'
    _file(machine, "--model", "FILE", text)
    _file(init, "--out", "FOLDER", "for rig.toml (default: that of the log, above train/)")

    several: dict[str, Any] = {"action": "append", "default": []}
    importing = command("import")
    _file(importing, "logs", "LOG", "MCAP, ROS bag, HDF5, CSV, Excel, Parquet or MAT", nargs="+")
    _file(importing, "--rig", "RIG", "rig.toml; its [import] says what is where", required=True)
    _file(importing, "--out", "FOLDER", "the new data set", required=True)
    text = "last sequences kept for the test, or share (0.2)"
    importing.add_argument("--test", type=_part, default=0.2, metavar="N", help=text)
    text = "add seconds to the times of a topic"
    importing.add_argument("--shift", type=_shift, metavar="TOPIC=S", help=text, **several)
    importing.add_argument("--unwrap", metavar="COLUMN", help="take out the jumps of a counter", **several)

    check = command("check")
    identify = command("identify")
    diagnose = command("diagnose")
    for bench in (check, identify, diagnose):
        _file(bench, "folder", "FOLDER", "the data set: rig.toml, train/, test/")
    for fits in (identify, diagnose):
        _file(fits, "--out", "OUT", "folder for the results", required=True)
        _file(fits, "--more", "NEW", "a folder of further logs to train on", **several)
        _file(fits, "--from", "FIT", "a fit of the machine to begin from", dest="start")
    identify.add_argument("--smoother", choices=SMOOTHERS, default="cubature", help="the E-step (default: cubature)")
    identify.add_argument("--particles", type=_count, metavar="N", help="for --smoother particle")
    identify.add_argument("--epochs", type=_count, default=40, metavar="N", help="at most so many in all (40)")
    text = "answer after about M minutes with what is found by then"
    diagnose.add_argument("--minutes", type=_minutes, metavar="M", help=text)
    _file(diagnose, "--logs", "FOLDER", "of that fit, where they were moved", **several)

    design = command("design")
    _file(design, "folder", "FIT", "model.npz or after.npz, or the folder that holds it")
    _file(design, "--out", "OUT", "folder for the results", required=True)
    design.add_argument("--seconds", type=_time, default=60.0, metavar="S", help="of all sequences together (60)")
    design.add_argument("--sequences", type=_count, default=6, metavar="N", help="how many (6)")
    _file(design, "--logs", "FOLDER", "of the fit, where they were moved", **several)
    for fits in (identify, diagnose, design):
        fits.add_argument("--seed", type=_natural, default=0, help="of all random numbers (0)")
        fits.add_argument("--quiet", action="store_true", help="no lines of progress")
        fits.add_argument("--profile", action="store_true", help="print the seconds of stages and programs")

    compare = command("compare")
    _file(compare, "fits", "FIT", "model.npz, or the folder that holds it", nargs="+")
    _file(compare, "--out", "OUT", "folder for the page and the numbers")

    predict = command("predict")
    smooth = command("smooth")
    for use in (predict, smooth):
        _file(use, "model", "MODEL", "model.npz, or the folder that holds it")
        _file(use, "folder", "FOLDER", "the logs, such as bench/test")
        _file(use, "--out", "DIR", "folder for the CSV files", required=True)
    predict.add_argument("--given", type=_time, required=True, metavar="S", help="readings up to here are used [s]")
    predict.add_argument("--seed", type=_natural, default=0, help="of the sample paths (0)")

    text = "use spikes and what a stuck, late or saturated sensor reads"
    for reads in (check, identify, diagnose, design, predict, smooth):
        reads.add_argument("--trust-readings", action="store_true", help=text)

    export = command("export")
    _file(export, "model", "MODEL", "model.npz, or the folder that holds it")
    _file(export, "--out", "OUT", "folder for the files")
    _file(export, "--mjcf", "FILE", "write a machine that came from a file back as MJCF")
    _file(export, "--urdf", "FILE", "write a machine that came from a URDF file back as URDF")
    _file(export, "--c", "FILE", "friction and feed-forward torque as C99")
    _file(export, "--observer", "FILE", "write an online estimator of the states as C99")
    export.add_argument("--float", action="store_true", help="numbers of 32 bits in that estimator")
    return top


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command: 0 is done, 1 a check with an error, 2 refused with one line on stderr, 3 a fit that does not
    describe the motion, 130 Ctrl-C.
    """
    arguments = parser()
    args = arguments.parse_args(argv)
    for command, option, needed, what in (
        ("identify", "particles", lambda: args.smoother == "particle", "--smoother particle"),
        ("diagnose", "logs", lambda: args.start, "--from FIT"),
        ("export", "float", lambda: args.observer, "--observer FILE"),
    ):
        if args.command == command and getattr(args, option) and not needed():
            arguments.error(f"--{option} goes with {what}")
    if args.command == "export" and not any((args.out, args.mjcf, args.urdf, args.c, args.observer)):
        arguments.error("say where to: --out OUT, --mjcf, --urdf, --c or --observer FILE")
    try:
        # The matrices are small: more threads only wait for each other, and for long where the cores are busy.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        # XLA takes tuning hints of its own for features of a processor, and logs an error for each kept program.
        os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # [github.com/openxla/xla/issues/44565]
        from ..numerics.profile import profiling  # loads JAX
        from . import common

        with warnings.catch_warnings(), _stoppable(silent if getattr(args, "quiet", False) else _log) as log:
            warnings.showwarning = _warn
            for kind in common.WARNINGS:
                warnings.simplefilter("always", kind)
            common.set_up()
            run = importlib.import_module(f".{_MODULES.get(args.command, args.command)}", __package__).run
            with profiling(getattr(args, "profile", False)):
                return run(args, log) or 0
    except KeyboardInterrupt as stopped:
        _log(str(stopped) or "stopped; the files that were written are whole")
        return 130
    except Exception as error:
        line = _line(error)
        if line is None:
            raise
        _log(f"error: {line}")
        return 2


@contextmanager
def _stoppable(log: Log) -> Iterator[Log]:
    """`log`, which ends a command that lost its Ctrl-C: exceptions raised in a garbage collection are dropped."""
    interrupted = []

    def handle(number: int, frame: FrameType | None) -> None:
        interrupted.append(number)
        raise KeyboardInterrupt

    def line(text: str) -> None:
        log(text)
        if interrupted:
            raise KeyboardInterrupt

    ours = threading.current_thread() is threading.main_thread()
    ours = ours and signal.getsignal(signal.SIGINT) is signal.default_int_handler  # not where it is ignored
    if ours:
        signal.signal(signal.SIGINT, handle)
    try:
        yield line
    finally:
        if ours:
            signal.signal(signal.SIGINT, signal.default_int_handler)


def _line(error: Exception) -> str | None:
    """The message of a mistake of the caller or of the machine; None for one of ours."""
    from . import common

    if isinstance(error, OSError):
        return f"{error.filename}: {error.strerror}" if error.filename else str(error.strerror or error)
    lines = [" ".join(line.split()) for line in str(error).splitlines()]  # several mistakes of a rig.toml, a line each
    return "\n".join(lines) if isinstance(error, common.MISTAKES) else None


def _warn(message: Warning | str, category: type[Warning], *_) -> None:
    if "persistent compilation cache" not in str(message):
        _log(f"warning: {message}")


def _log(text: str) -> None:
    print(f"nnap-em: {text}", file=sys.stderr, flush=True)


def _new(make: Callable[..., argparse.ArgumentParser], summary: str, examples: str, **options: str):
    form = argparse.RawDescriptionHelpFormatter
    return make(description=summary, epilog=examples, formatter_class=form, allow_abbrev=False, **options)


def _file(command: argparse._ActionsContainer, name: str, metavar: str, text: str, **options: Any) -> None:
    """Add the path of a file or folder to the arguments of a command."""
    command.add_argument(name, metavar=metavar, type=Path, help=text, **options)


_N = TypeVar("_N", int, float)


def _number(text: str, kind: type[_N], low: int | float, form: str) -> _N:
    try:
        if low <= (value := kind(text)) < math.inf:
            return value
    except ValueError:
        pass
    raise argparse.ArgumentTypeError(f"found {text!r}; give {form}")


_count = functools.partial(_number, kind=int, low=1, form="a whole number of 1 or more")
_natural = functools.partial(_number, kind=int, low=0, form="a whole number of 0 or more")
_positive = functools.partial(_number, kind=float, low=math.ulp(0.0), form="a number above 0")
_time = functools.partial(_number, kind=float, low=0.0, form="seconds, 0 or more")
_minutes = functools.partial(_number, kind=float, low=math.ulp(0.0), form="minutes, more than 0")


def _part(text: str) -> float:
    value = _number(text, float, 0.0, "a whole number, or a share below 1")
    return value if value < 1 else float(_natural(text))


def _shift(text: str) -> tuple[str, float]:
    topic, _, seconds = text.rpartition("=")
    return topic, _number(seconds, float, -1e12, "TOPIC=SECONDS, such as /joint_states=-0.012")


if __name__ == "__main__":
    sys.exit(main())
