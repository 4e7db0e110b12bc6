"""The command line: arguments in, exit status out; the work is in `commands`, and JAX is loaded only for it."""

import argparse
import functools
import importlib
import math
import os
import sys
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from .. import __version__
from ..base.log import silent

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

A data set is a folder with rig.toml, train/*.csv and, if there is one, test/*.csv.  SI units: s, N m, rad, rad/s.
"""
COMMANDS = ("simulate", "init", "import", "check", "identify", "diagnose", "design", "compare", "predict", "smooth")
COMMANDS += ("export",)
SYSTEMS = ("acrobot", "pendubot", "pendulum", "slide")
SMOOTHERS = {
    "cubature": "gaussian.CubatureSmoother",
    "ekf": "gaussian.ExtendedKalmanSmoother",
    "particle": "particle.smoother.banked",
}
"""Function of `nnap_em.estimate.smoother` that makes a smoother with its options from the hypotheses of the start."""


def parser() -> argparse.ArgumentParser:
    """All commands with their options."""
    form: dict[str, Any] = {"formatter_class": argparse.RawDescriptionHelpFormatter, "allow_abbrev": False}
    about = "Find which physical effect the model of a machine lacks, from its logs; identify friction, noise, numbers."
    top = argparse.ArgumentParser(prog="nnap-em", description=about, epilog=_MAIN, **form)
    top.add_argument("--version", action="version", version=f"nnap-em {__version__}")
    under = top.add_subparsers(dest="command", metavar="COMMAND", required=True)
    commands: dict[str, argparse._ActionsContainer] = {}
    for name in COMMANDS:  # the help of a command is the docstring of its module, which is not imported for that
        text = Path(__file__).with_name(f"{_MODULES.get(name, name)}.py").read_text()
        summary, _, examples = text.split('"""')[1].partition("\n\n")
        short = f"{summary[0].lower()}{summary[1:]}".rstrip(".")
        commands[name] = under.add_parser(name, help=short, description=summary, epilog=examples, **form)
    commands["machine"] = commands["init"].add_mutually_exclusive_group()

    def add(to: str, name: str, text: str, metavar: Any = None, kind: Any = None, **more: Any) -> None:
        """Add an argument to some commands: a path where it has the name of a value alone."""
        more |= {"metavar": metavar} if metavar else {}
        more |= {"type": kind or Path} if kind or metavar else {}
        for command in to.split():
            commands[command].add_argument(name, help=text, **more)

    several: dict[str, Any] = {"action": "append", "default": []}
    flag: dict[str, Any] = {"action": "store_true"}
    fits, model = "identify diagnose", "model.npz, or the folder that holds it"
    add("simulate", "out", "the new folder", "OUT")
    add("simulate", "--system", "the machine (default: acrobot)", choices=SYSTEMS, default="acrobot")
    add("simulate", "--sequences", "training sequences (20)", "N", _count, default=20)
    add("simulate", "--test", "test sequences (5)", "N", _natural, default=5)
    add("simulate", "--steps", "sample intervals of each (500)", "N", _count, default=500)
    add("simulate", "--measured", "which states are read", "STATE", str, nargs="+")
    for option, what in (("process", "kick per step"), ("measurement", "readings")):
        text = f"standard deviations: {what} of positions [rad or m] and of rates [rad/s or m/s]"
        add("simulate", f"--{option}-noise", text, ("POSITION", "RATE"), _positive, nargs=2)
    add("init", "log", "a CSV file with a header, MCAP, ROS bag or HDF5", "LOG")
    add("machine", "--system", "the machine, where the columns do not determine it", choices=SYSTEMS)
    text = 'the machine as MJCF or URDF, which stays where it is, or "equations" to be written'
    add("machine", "--model", text, "FILE")
    add("init", "--out", "for rig.toml (default: that of the log, above train/)", "FOLDER")
    add("import", "logs", "MCAP, ROS bag, HDF5, CSV, Excel, Parquet or MAT", "LOG", nargs="+")
    add("import", "--rig", "rig.toml; its [import] says what is where", "RIG", required=True)
    add("import", "--out", "the new data set", "FOLDER", required=True)
    add("import", "--test", "last sequences kept for the test, or share (0.2)", "N", _part, default=0.2)
    add("import", "--shift", "add seconds to the times of a topic", "TOPIC=S", _shift, **several)
    add("import", "--unwrap", "take out the jumps of a counter", "COLUMN", str, **several)
    add(f"check {fits}", "folder", "the data set: rig.toml, train/, test/", "FOLDER")
    add("design", "folder", "model.npz or after.npz, or the folder that holds it", "FIT")
    add(f"{fits} design", "--out", "folder for the results", "OUT", required=True)
    add(fits, "--more", "a folder of further logs to train on", "NEW", **several)
    add(fits, "--from", "a fit of the machine to begin from", "FIT", dest="start")
    add("identify", "--smoother", "the E-step (default: cubature)", choices=SMOOTHERS, default="cubature")
    add("identify", "--particles", "for --smoother particle", "N", _count)
    add("identify", "--epochs", "at most so many in all (40)", "N", _count, default=40)
    add("diagnose", "--minutes", "answer after about M minutes with what is found by then", "M", _minutes)
    add("design", "--seconds", "of all sequences together (60)", "S", _time, default=60.0)
    add("design", "--sequences", "how many (6)", "N", _count, default=6)
    add("diagnose design", "--logs", "of that fit, where they were moved", "FOLDER", **several)
    add(f"{fits} design", "--quiet", "no lines of progress", **flag)
    add("compare", "fits", model, "FIT", nargs="+")
    add("compare", "--out", "folder for the page and the numbers", "OUT")
    add("predict smooth export", "model", model, "MODEL")
    add("predict smooth", "folder", "the logs, such as bench/test", "FOLDER")
    add("predict smooth", "--out", "folder for the CSV files", "DIR", required=True)
    add("predict", "--given", "readings up to here are used [s]", "S", _time, required=True)
    text = "use spikes and what a stuck, late or saturated sensor reads"
    add(f"check {fits} design predict smooth", "--trust-readings", text, **flag)
    add(f"simulate {fits} design predict", "--seed", "of all random numbers (0)", "SEED", _natural, default=0)
    add("export", "--out", "folder for the files", "OUT")
    add("export", "--mjcf", "write a machine that came from a file back as MJCF", "FILE")
    add("export", "--urdf", "write a machine that came from a URDF file back as URDF", "FILE")
    add("export", "--c", "friction and feed-forward torque as C99", "FILE")
    add("export", "--observer", "write an online estimator of the states as C99", "FILE")
    add("export", "--float", "numbers of 32 bits in that estimator", **flag)
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
        from . import common  # loads JAX

        with warnings.catch_warnings():
            warnings.showwarning = _warn  # pyrefly: ignore[bad-assignment]  (called by place)
            for kind in common.WARNINGS:
                warnings.simplefilter("always", kind)
            common.set_up()
            run = importlib.import_module(f".{_MODULES.get(args.command, args.command)}", __package__).run
            return run(args, silent if getattr(args, "quiet", False) else _log) or 0
    except KeyboardInterrupt as stopped:
        _log(str(stopped) or "stopped; the files that were written are whole")
        return 130
    except Exception as error:
        line = _line(error)
        if line is None:
            raise
        _log(f"error: {line}")
        return 2


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


def _number(text: str, kind: Callable[[str], float], low: int | float, form: str) -> Any:
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
