"""Common parts of the commands: set-up, data sets, model files, and runs that go on after a stop."""

import argparse
import hashlib
import os
import platform
import re
import tempfile
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from .. import errors
from ..base.digits import counted
from ..base.files import check_own, cores, sweep
from ..base.journal import Journal, keeping
from ..base.log import Log
from ..base.parallel import use_every_device
from ..base.programs import use_older_emitters
from ..base.traced import use_cache
from ..errors import DataError, DataWarning, RigError
from ..estimate.em.build import build_system, measure_scales
from ..estimate.em.equations import infinite_rates
from ..estimate.identify import Identified
from ..estimate.known import differences
from ..estimate.predict import GIVEN
from ..estimate.store import AFTER_FILE, MODEL_FILE, Stored, fingerprint, model_file, read, save
from ..explain.check import ERROR, WARNING, rates, torques
from ..logs.dataset import Dataset
from ..logs.formats import has_logs, header, write_csv
from ..logs.read import Logs, check_split, read_logs, together
from ..machines.rig import Rig, read_rig
from ..machines.systems import specs
from ..output.report.tables import FRICTION


class Halted(RuntimeError):
    """A file could not be written: the message names it, the steps that are kept, and the way to continue."""


_PUBLIC = [getattr(errors, name) for name in errors.__all__]
WARNINGS = tuple(kind for kind in _PUBLIC if issubclass(kind, Warning))
MISTAKES = (Halted, *(kind for kind in _PUBLIC if kind not in WARNINGS))
REPORTS = ("report.json", "report.html")
MISFIT_STATUS = 3
"""Exit status of a fit that does not describe the motion."""
UNFINISHED = "unfinished"
"""Folder of the finished steps of a run that is not."""


def set_up() -> None:
    """64-bit numbers, every core, and programs kept for the next call, traced and compiled, if there is a place."""
    jax.config.update("jax_enable_x64", True)
    use_older_emitters()
    # Devices made of the cores of one machine at most: sequences are dealt out to them, and there are seldom more
    most_devices = 64
    if not jax.distributed.is_initialized():  # or they are dealt out
        if "JAX_NUM_CPU_DEVICES" not in os.environ:
            with suppress(RuntimeError):  # JAX runs already: it keeps the devices that it has
                jax.config.update("jax_num_cpu_devices", min(most_devices, cores()))
        use_every_device()
    folder = getattr(jax.config, "jax_compilation_cache_dir", None)
    if folder is None:
        folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "nnap_em" / "jax" / _processor()
        with suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK):
            return
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)  # many small programs
    elif not folder or "JAX_COMPILATION_CACHE_DIR" not in os.environ:  # none, or set in this process, not for commands
        return
    use_cache(Path(folder) / "traced")


def _processor() -> str:
    """Digest of the features of the processor: a program of another one may end with an illegal instruction here."""
    try:
        features = re.search(r"(?m)^(flags|Features).*", Path("/proc/cpuinfo").read_text())
    except OSError:
        features = None
    return hashlib.sha256((features[0] if features else platform.machine()).encode()).hexdigest()[:16]


class Bench(NamedTuple):
    """A data set."""

    rig: Rig
    train: Logs
    test: Logs | None  # Only where there are any; as predictions of the reported error may see them


def read_bench(folder: Path, trust: bool, further: Sequence[Path] = ()) -> Bench:
    """A data set, with `further` logs of the same rig to train on; `trust`: no reading is masked."""
    rig = read_rig(folder / "rig.toml", specs)
    train = read_training(rig, (folder, *further), trust)
    test = read_logs(folder / "test", rig, trust=trust, until=GIVEN) if has_logs(folder / "test") else None
    check_split(train, test)
    return Bench(rig, train, test)


def require_joints(rig: Rig, what: str) -> None:
    """Raise DataError where a command needs a machine with joints, and the rig is written as equations."""
    if rig.equations:
        raise DataError(f"{what}: rig {rig.name!r} is written as equations; this needs a machine with joints")


def read_training(rig: Rig, folders: Sequence[Path], trust: bool) -> Logs:
    """The training logs of a data set, and of further folders: those in train/, or in the folder itself."""
    first, *others = folders
    places = [first / "train", *(folder if has_logs(folder) else folder / "train" for folder in others)]
    names = (folder.resolve().name for folder in folders)
    parts = {name: read_logs(place, rig, trust=trust) for name, place in zip(names, places, strict=True)}
    if len(parts) < len(folders):
        raise DataError(f"{folders[0]}: two folders have one name; rename one: names of files begin with it")
    return together(parts)


def logs_of(file: Path, stored: Stored, folders: Sequence[Path], trust: bool) -> tuple[Rig, Logs]:
    """Rig and training logs of the fit in `file`: of these folders, or of those that it names."""
    folders = folders or list(map(Path, stored.notes.get("logs", [])))
    gone = [folder for folder in folders if not folder.is_dir()]
    if gone or not folders:
        problem = f"its logs are not at {gone[0]}" if gone else "it does not say where its logs are"
        raise DataError(f"{file}: {problem}; give their folder with --logs FOLDER")
    rig = read_rig(folders[0] / "rig.toml", specs)
    train = read_training(rig, folders, trust)
    if stored.fingerprint and fingerprint(train.data) != stored.fingerprint:
        wrong = "; give those with --logs FOLDER, or identify again with these"
        raise DataError(f"{folders[0]}: not the logs, or not read as those, of the fit in {file}{wrong}")
    return rig, train


def prepared(args: argparse.Namespace, file: str, log: Log) -> tuple[Bench, Stored | None]:
    """Data set of a run that writes `file`, and the fit of --from; logs what will be replaced and where rigs differ."""
    bench = read_bench(args.folder, args.trust_readings, args.more)
    warn_of_logs(args.folder, bench)
    check_own(args.out / name for name in (MODEL_FILE, "before.npz", AFTER_FILE, *REPORTS, "friction.png"))
    check_own(args.out.glob("friction*.csv"), FRICTION)
    if (args.out / file).exists():
        log(f"the {'fit' if file == MODEL_FILE else 'diagnosis'} in {args.out} will be replaced")
    if args.start is None:
        return bench, None
    start = model_file(args.start)
    stored = read(start)
    for line in differences(stored.fitted.rig, bench.rig):
        log(f"{line}; that of the fit is used")
    if stored.fingerprint and stored.fingerprint == fingerprint(bench.train.data):
        raise DataError(f"{args.folder}: the logs of the fit in {start}; give others")
    return bench, stored


def write_models(args: argparse.Namespace, fits: Mapping[str, Identified], data: Dataset, **notes: Any) -> None:
    """Write fits to `data`; reports that are not of them are removed before."""
    for name in REPORTS:
        (args.out / name).unlink(missing_ok=True)
    notes["logs"] = [str(folder.resolve()) for folder in (args.folder, *args.more)]  # found from any other folder
    for name, fitted in fits.items():
        save(args.out / name, fitted, fingerprint=fingerprint(data), notes=notes)


def own_logs(args: argparse.Namespace, stored: Stored, log: Log) -> Dataset | None:
    """The logs of the fit of --from, where they are at hand."""
    try:
        return logs_of(model_file(args.start), stored, args.logs, args.trust_readings)[1].data
    except (DataError, RigError) as error:
        log(f"{error}: what these show as well is not left out")
        return None


def warn_of_logs(folder: Path, bench: Bench) -> None:
    """Warn where rates are not those of their coordinates, or inputs cannot be those of the declared bodies."""
    rig, data = bench.rig, bench.train.data
    system, found = build_system(rig), list(rates(rig, data))
    if not rig.equations:
        found += torques(rig, system, data, measure_scales(rig, system, data))
    elif infinite := infinite_rates(rig, system, bench.train):
        raise DataError(f"{folder / 'train'}: {infinite}")
    for finding in found:
        if finding.mark == ERROR:
            warnings.warn(f"{folder / 'train'}: column {finding.text}", DataWarning, 2)
        elif finding.subject in ("scale", "range") or (finding.subject, finding.mark) == ("rate", WARNING):
            warnings.warn(f"{folder / 'train'}: {finding.text}", DataWarning, 2)


def write_states(folder: Path, logs: Logs, states: tuple[str, ...], mean, std) -> None:
    """One file per sequence; a value that is no number becomes an empty field; a log is never replaced."""
    names = ("time", *states, *(f"{name}_std" for name in states))
    paths = [(folder / file).with_suffix(".csv") for file in logs.files]
    check_own(paths, header(names))
    for i, (file, path) in enumerate(zip(logs.files, paths, strict=True)):
        rows = np.asarray(logs.data.valid[i])
        values = np.concatenate([mean[i][rows], std[i][rows]], axis=1)
        if not np.isfinite(values).all():
            warnings.warn(f"{file}: {np.count_nonzero(~np.isfinite(values))} values run away: empty", DataWarning, 2)
            values = np.where(np.isfinite(values), values, np.nan)
        columns = np.asarray(logs.data.t[i])[rows], *values.T
        write_csv(path, dict(zip(names, columns, strict=True)))


@contextmanager
def resumable(args: argparse.Namespace, bench: Bench, log: Log) -> Iterator[Journal]:
    """Keep every finished step until all is done (or longer, if it is left `open`), and do none again that was kept."""
    journal, made = Journal(args.out / UNFINISHED), not args.out.exists()
    args.out.mkdir(parents=True, exist_ok=True)
    tempfile.TemporaryFile(dir=args.out).close()  # refused where it cannot be written to
    try:
        sweep(args.out)
        sweep(journal.folder)
        if journal.files:
            kept = counted(len(journal.files), "finished step")
            log(f"{kept} in {journal.folder}: those of this run are not done again")
        count, rows = bench.train.data.valid.shape
        log(f"compiling for {counted(count, 'sequence')} of {rows} rows (the first time takes longest) ...")
        with keeping(journal):
            yield journal
        if not journal.open:
            journal.clear()
    except KeyboardInterrupt:
        raise KeyboardInterrupt(go_on(journal)) from None
    except OSError as error:
        file = f"{error.filename}: " if error.filename else ""
        raise Halted(f"{file}{error.strerror or error}; {go_on(journal)}") from error
    finally:
        for empty in (journal.folder, args.out) if made else ():
            with suppress(OSError):  # it is not
                empty.rmdir()


def go_on(journal: Journal) -> str:
    """The finished steps that are kept, and how to go on from them."""
    if not journal.done:
        return "stopped before the end of a step; nothing new is kept"
    return f"stopped with {counted(len(journal.done), 'finished step')} kept; the same command goes on"
