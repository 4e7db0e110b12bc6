"""What the commands do: read, call the library, write whole files."""

import argparse
import dataclasses
import io
import math
import os
import platform
import shlex
import shutil
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from . import __version__
from .build import build_system, measure_scales
from .check import BAD, check, torques
from .data import Logs, check_split, read_logs
from .diagnose import findings
from .draft import draft
from .em import EMState, FitError
from .export import ExportError, export
from .files import StoreError, cores, replace_bytes, replace_text, sweep
from .formats import DataError, DataWarning, has_logs, write_csv
from .identify import FrictionTable, Identified, begin, friction_table, identify, parameter_table
from .journal import Journal, keeping
from .law import PARAMETERS, UNITS, describe, fit_law
from .loop import close_the_loop
from .model import StateSpaceModel
from .parallel import use_every_device
from .particle import ParticleSmoother
from .predict import GIVEN, HORIZONS, horizon_errors, predict, smooth, smoothed_states
from .report import write_diagnosis
from .rig import Declared, Rig, RigError, RigWarning, nearest, parameter_unit, read_rig, write_rig
from .simulate import Experiment, examples, sweep_experiment
from .smoother import AbstractSmoother, CubatureSmoother, ExtendedKalmanSmoother, StartBank
from .store import Stored, fingerprint, notes, read, save
from .systems import specs
from .tables import masked, state_unit, visited_nodes, write_friction, write_json


class Halted(RuntimeError):
    """A file could not be written: the message names it, and says what is kept and how to go on."""


MISTAKES = (RigError, DataError, StoreError, FitError, ExportError, Halted)
WARNINGS = (RigWarning, DataWarning)
MODEL, CHECKPOINT, REPORT = "model.npz", "checkpoint.npz", "report.json"
UNFINISHED = "unfinished"
"""Folder of the finished steps of a diagnosis that is not."""
MOST = 64
"""Devices made of the cores of one machine at most: sequences are dealt out to them, and there are seldom more."""
Say = Callable[[str], None]
"""Where lines of progress go."""


class Epoch(NamedTuple):
    """One line of progress."""

    epoch: int
    horizon_s: float
    log_likelihood: float
    left_out: list[int]
    """Sequences that took no part."""
    seconds: float


def set_up() -> None:
    """64-bit numbers, every core, and compiled programs kept for the next call if there is a place for them."""
    jax.config.update("jax_enable_x64", True)
    if not jax.distributed.is_initialized():  # or they are dealt out
        if "JAX_NUM_CPU_DEVICES" not in os.environ:
            with suppress(RuntimeError):  # JAX runs already: it keeps the devices that it has
                jax.config.update("jax_num_cpu_devices", min(MOST, cores()))
        use_every_device()
    if getattr(jax.config, "jax_compilation_cache_dir", None) is not None:
        return
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = Path(home) / "nnap_em" / "jax"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    if os.access(folder, os.W_OK):
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)  # many small programs


def run_simulate(args: argparse.Namespace, say: Say) -> None:
    """Write a data set with known truth."""
    if args.out.exists() and (not args.out.is_dir() or any(args.out.iterdir())):
        raise DataError(f"{args.out}: is there already; give a new folder, or empty this one")
    model, sweep = examples[args.system]()
    states = specs[args.system].states
    measured = tuple(args.measured) if args.measured else tuple(states[i] for i in model.measured)
    for name in measured:
        if name not in states:
            raise DataError(f"--measured {name}: no state of this system; {nearest(name, states)}")
    if len(set(measured)) < len(measured):
        raise DataError(f"--measured {' '.join(measured)}: a state stands there twice; name each once")
    model = _noisy(model, states, measured, args.process_noise, args.measurement_noise)
    count = args.sequences + args.test
    experiment = sweep_experiment(model, sweep, count, args.steps, key=jax.random.key(args.seed))
    rig = _declare(args.system, model, states, measured)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    part = Path(tempfile.mkdtemp(prefix=f".{args.out.name}.", dir=args.out.parent))
    try:
        write_rig(rig, part / "rig.toml")
        for i in range(count):
            group, number = ("train", i) if i < args.sequences else ("test", i - args.sequences)
            readings, truth = _sequence(experiment, i, rig, states)
            write_csv(part / group / f"{number:03d}.csv", readings)
            write_csv(part / "truth" / group / f"{number:03d}.csv", truth)
        write_friction(part / "truth" / "friction.csv", *_true_friction(model, np.asarray(experiment.x)))
        part.chmod(0o755)
        os.replace(part, args.out)
        say(f"wrote {args.sequences} training and {args.test} test sequences to {args.out}")
    finally:
        shutil.rmtree(part, ignore_errors=True)


def run_init(args: argparse.Namespace, say: Say) -> None:
    """Write a first rig.toml for a log, to be filled in; one that is there stays as it is."""
    home = args.csv.parent.parent if args.csv.parent.name in ("train", "test") else args.csv.parent
    path = (args.out or home) / "rig.toml"
    if path.exists():
        raise DataError(f"{path}: is there already; give another --out, or remove it")
    found = draft(args.csv, args.system, specs)
    replace_text(path, found.text)
    for note in found.notes:
        say(f"in the log: {note}")
    say(f"wrote {path}" + (f"; fill in {', '.join(found.missing)}" if found.missing else ""))


def run_check(args: argparse.Namespace, say: Say) -> int:
    """Say whether the logs can identify what is asked, a line per question; 1 where they cannot."""
    rig, train, test = _read(args.folder, args.trust_readings)
    found = check(rig, train, test, key=jax.random.key(0))
    for finding in found:
        print(f"{finding.mark:4}  {finding.subject:8}  {finding.text}")
    bad = sum(finding.mark == BAD for finding in found)
    say(f"{bad} of {len(found)} answers are bad" if bad else "nothing speaks against a fit")
    return int(bad > 0)


def run_identify(args: argparse.Namespace, say: Say) -> None:
    """Fit the declared unknowns to the training logs; the test logs serve for the reported error alone."""
    began = time.perf_counter()
    rig, train, test = _read(args.folder, args.trust_readings)
    _warn_of_torques(args.folder, rig, train)
    mark = fingerprint(train.data)
    settings = {"smoother": args.smoother, "particles": args.particles, "seed": args.seed}
    start, history = _begin(args, rig, train, mark, settings, say)
    with _folder(args.out), _telling(lambda: _how_to_go_on(args, history)):
        count, rows = train.data.valid.shape
        say(f"compiling for {count} sequences of {rows} rows (the first time takes longest) ...")
        watch = _Watch(args, start, train, mark, settings, history, say)
        fitted = identify(
            rig,
            train.data,
            key=jax.random.key(args.seed),
            smoother=_smoother(args),
            epochs=args.epochs,
            start=start,
            watch=watch,
        )
        (args.out / REPORT).unlink(missing_ok=True)  # an older one is not of the model that is written now
        save(args.out / MODEL, fitted, fingerprint=mark, notes={"settings": settings, "epochs": history})
        _report(args, fitted, train, test, history, began, say)


def run_diagnose(args: argparse.Namespace, say: Say) -> None:
    """Find what the declared model lacks, and report it; the test logs serve for the reported errors alone."""
    began = time.perf_counter()
    rig, train, test = _read(args.folder, args.trust_readings)
    _warn_of_torques(args.folder, rig, train)
    mark = fingerprint(train.data)
    journal = Journal(
        args.out / UNFINISHED, {"rig.toml": dataclasses.asdict(rig), "training data": mark, "--seed": args.seed}
    )
    if args.resume:
        journal.check()
        say(f"resumed with {len(journal)} finished steps" if len(journal) else _nothing(args))
    with _folder(args.out), _telling(lambda: _how_to_go_on_finding(args, journal)):
        if args.resume:
            sweep(journal.folder)
        else:
            journal.clear()
        count, rows = train.data.valid.shape
        say(f"compiling for {count} sequences of {rows} rows (the first time takes longest) ...")
        with keeping(journal):
            closed = close_the_loop(rig, train.data, key=jax.random.key(args.seed), say=say)
        found = findings(closed)
        for name in (REPORT, "report.html"):  # older ones are not of the models that are written now
            (args.out / name).unlink(missing_ok=True)
        for name, fitted in (("before", closed.before), ("after", closed.after)):
            save(args.out / f"{name}.npz", fitted, fingerprint=mark, notes={"settings": {"seed": args.seed}})
        write_diagnosis(args.out, closed, found, train, test, seed=args.seed, began=began, say=say)
        journal.clear()


def run_predict(args: argparse.Namespace, say: Say) -> None:
    """Write the distribution of every state after the readings up to the given time."""
    fitted = read(_model_file(args.model)).fitted
    logs = read_logs(args.folder, fitted.rig, trust=args.trust_readings, until=args.given)
    found = predict(fitted, logs.data, args.given, key=jax.random.key(args.seed))
    _write_states(args.out, logs, fitted, np.asarray(found.mean), np.asarray(found.std))
    say(f"wrote {len(logs.files)} files to {args.out}")


def run_smooth(args: argparse.Namespace, say: Say) -> None:
    """Write the distribution of every state after all readings of the sequence."""
    fitted = read(_model_file(args.model)).fitted
    logs = read_logs(args.folder, fitted.rig, trust=args.trust_readings)
    state = smoothed_states(fitted, logs.data)
    std = np.sqrt(np.diagonal(np.asarray(state.cov), axis1=-2, axis2=-1))
    _write_states(args.out, logs, fitted, np.asarray(state.mean), std)
    say(f"wrote {len(logs.files)} files to {args.out}")


def run_export(args: argparse.Namespace, say: Say) -> None:
    """Write the model for other programs."""
    export(read(_model_file(args.model)).fitted, args.out)
    say(f"wrote parameters.json, predictor.py and model.stablehlo to {args.out}")


commands: dict[str, Callable[[argparse.Namespace, Say], int | None]] = {
    "simulate": run_simulate,
    "init": run_init,
    "check": run_check,
    "identify": run_identify,
    "diagnose": run_diagnose,
    "predict": run_predict,
    "smooth": run_smooth,
    "export": run_export,
}


def _read(folder: Path, trust: bool) -> tuple[Rig, Logs, Logs | None]:
    """A data set; test logs only where there are any, as predictions of the reported error may see them."""
    rig = read_rig(folder / "rig.toml", specs)
    train = read_logs(folder / "train", rig, trust=trust)
    test = read_logs(folder / "test", rig, trust=trust, until=GIVEN) if has_logs(folder / "test") else None
    check_split(train, test)
    return rig, train, test


def _warn_of_torques(folder: Path, rig: Rig, train: Logs) -> None:
    """Warn where the inputs cannot be those of the declared bodies."""
    system = build_system(rig)
    for finding in torques(rig, system, train.data, measure_scales(rig, system, train.data)):
        if finding.mark == BAD:
            warnings.warn(f"{folder / 'train'}: column {finding.text}", DataWarning, 2)


# --- simulate


def _noisy(model: StateSpaceModel, states, measured, process, reading) -> StateSpaceModel:
    """`model` with other readings and noise; a rate that is read for the first time is five times as noisy."""
    dof = len(states) // 2
    r = np.exp(0.5 * np.asarray(model.log_r))
    position, rate = reading or (r[0], next((s for i, s in zip(model.measured, r, strict=True) if i >= dof), 5 * r[0]))
    index = tuple(states.index(name) for name in measured)
    log_r = 2 * jnp.log(jnp.asarray([rate if i >= dof else position for i in index]))
    log_q = model.log_q if process is None else 2 * jnp.log(jnp.repeat(jnp.asarray(process), dof))
    return StateSpaceModel(
        system=model.system,
        unknown=model.unknown,
        start=model.start,
        log_q=log_q,
        log_r=log_r,
        measured=index,
        dt=model.dt,
    )


def _declare(system: str, model: StateSpaceModel, states, measured) -> Rig:
    """The truth as a rig: all known save friction and process noise."""
    spec, std = specs[system], np.sqrt(np.diag(np.asarray(model.start.cov)))
    values = {name: float(getattr(model.system, name)) for name in (*spec.parameters, *spec.optional)}
    return Rig(
        name=f"simulated {system}",
        system=system,
        parameters={n: Declared(v, 0.0) for n, v in values.items() if n not in spec.optional or v != spec.optional[n]},
        friction=True,
        input_columns=tuple(f"u{j}" if len(model.system.joints) > 1 else "u" for j in model.system.joints),
        input_joints=model.system.joints,
        dt=model.dt,
        clock="sequence",
        measured=measured,
        noise_std={n: _short(s) for n, s in zip(measured, np.exp(0.5 * np.asarray(model.log_r)), strict=True)},
        start={
            name: Declared(_short(model.start.mean[i]), _short(std[i]))
            for i, name in enumerate(states)
            if name not in measured
        },
    )


def _short(value: Any) -> float:
    """A number without the last digits of a logarithm and back."""
    return float(f"{float(value):.12g}")


def _sequence(experiment: Experiment, i: int, rig: Rig, states) -> tuple[dict[str, Any], dict[str, Any]]:
    """The columns of one log, and those of its truth."""
    t, u, y, _ = (np.asarray(a[i]) for a in experiment.data)
    known = {"time": t} | dict(zip(rig.input_columns, u.T, strict=True))
    x = dict(zip(states, np.asarray(experiment.x[i]).T, strict=True))
    return known | dict(zip(rig.measured, y.T, strict=True)), known | x


def _true_friction(model: StateSpaceModel, x: Float[np.ndarray, "seq time state"]):
    velocity = visited_nodes(x[..., x.shape[-1] // 2 :].reshape(-1, x.shape[-1] // 2))
    torque = np.asarray(jax.vmap(model.unknown)(jnp.asarray(velocity.T)).T)
    return velocity, torque, np.zeros_like(torque)


# --- identify


def _smoother(args: argparse.Namespace) -> Callable[[StartBank], AbstractSmoother]:
    size = {} if args.particles is None else {"num_particles": args.particles}
    return {
        "cubature": CubatureSmoother,
        "ekf": ExtendedKalmanSmoother,
        "particle": lambda bank: ParticleSmoother(CubatureSmoother(bank), **size),
    }[args.smoother]


class _Watch:
    """After every epoch: the checkpoint first, then the line of progress."""

    def __init__(self, args, start: Identified, train: Logs, mark: str, settings, history: list, say) -> None:
        self.args, self.start, self.train, self.say = args, start, train, say
        self.mark, self.settings, self.history = mark, settings, history
        self.last = time.perf_counter()

    def __call__(self, state: EMState, seen: int, used: Bool[np.ndarray, " seq"]) -> None:
        now = time.perf_counter()
        out = np.flatnonzero(~np.asarray(used)).tolist()
        epoch = Epoch(state.epoch, seen * self.start.rig.dt, float(state.loglik[-1]), out, now - self.last)
        self.history.append(epoch._asdict())
        self.last = now
        fitted = self.start._replace(state=state)
        notes = {"settings": self.settings, "epochs": self.history}
        save(self.args.out / CHECKPOINT, fitted, fingerprint=self.mark, notes=notes)
        noise = [f"{name} {np.exp(0.5 * r):.3g}" for name, r in _readings(fitted) if name not in fitted.rig.noise_std]
        sampled = f"  effective samples {state.ess:.0f}" if np.isfinite(state.ess) else ""
        self.say(
            f"epoch {state.epoch:3d} of {self.args.epochs}  horizon {epoch.horizon_s:.2f} s"
            f"  log-likelihood {epoch.log_likelihood:.2f} per sequence"
            f"  noise std {', '.join(noise) or 'as declared'}"
            f"{sampled}  left out {len(out)} of {len(used)}  {epoch.seconds:.1f} s"
        )


def _readings(fitted: Identified) -> list[tuple[str, float]]:
    return list(zip(fitted.rig.measured, np.asarray(fitted.model.log_r).tolist(), strict=True))


def _begin(args: argparse.Namespace, rig: Rig, train: Logs, mark: str, settings, say: Say) -> tuple[Identified, list]:
    """The state before the first epoch, or the last one that is kept."""
    if args.resume and (args.out / CHECKPOINT).exists():
        start, history = _resume(args, rig, mark, settings)
        say(f"resumed after epoch {start.state.epoch}")
        return start, history
    if args.resume:
        say(_nothing(args))
    return begin(rig, train.data, key=jax.random.key(args.seed)), []


def _nothing(args: argparse.Namespace) -> str:
    return f"nothing to go on from in {args.out}: begins at the start"


def _resume(args: argparse.Namespace, rig: Rig, mark: str, settings: Mapping[str, Any]) -> tuple[Identified, list]:
    """The state to go on from; refused where it belongs to another rig, other logs or other options."""
    path = args.out / CHECKPOINT
    stored: Stored = read(path)
    if stored.fitted.rig != rig:
        raise StoreError(f"{path}: made for another rig.toml; leave --resume out to begin anew, or give another --out")
    if stored.fingerprint != mark:
        raise StoreError(f"{path}: made from other training data; leave --resume out to begin anew")
    for name, value in stored.notes["settings"].items():
        if settings[name] != value:
            mend = f"resume with --{name} {value}" if value is not None else f"resume without --{name}"
            raise StoreError(f"{path}: made with --{name} {value}, not {settings[name]}; {mend}, or begin anew")
    return stored.fitted, stored.notes["epochs"]


def _how_to_go_on(args: argparse.Namespace, history: list) -> str:
    kept = 0
    with suppress(StoreError):  # the last epoch may have been stopped while it was written
        kept = len(notes(args.out / CHECKPOINT)["epochs"])
    if kept == 0 or kept not in (len(history) - 1, len(history)):
        return "stopped before the end of the first epoch; nothing was kept"
    command = ["nnap-em", "identify", str(args.folder), "--out", str(args.out), "--smoother", args.smoother]
    command += ["--particles", str(args.particles)] if args.particles else []
    command += ["--epochs", str(args.epochs), "--seed", str(args.seed), *_trusting(args), "--resume"]
    return f"stopped after epoch {kept}; to go on: {shlex.join(command)}"


def _how_to_go_on_finding(args: argparse.Namespace, journal: Journal) -> str:
    if not len(journal):
        return "stopped before the end of the first step; nothing was kept"
    command = ["nnap-em", "diagnose", str(args.folder), "--out", str(args.out), "--seed", str(args.seed)]
    command += [*_trusting(args), "--resume"]
    return f"stopped with {len(journal)} finished steps kept; to go on: {shlex.join(command)}"


def _trusting(args: argparse.Namespace) -> list[str]:
    return ["--trust-readings"] * args.trust_readings


@contextmanager
def _telling(kept: Callable[[], str]) -> Iterator[None]:
    """Say what is kept where one is stopped, or where a file cannot be written."""
    try:
        yield
    except KeyboardInterrupt:
        raise KeyboardInterrupt(kept()) from None
    except OSError as error:
        file = f"{error.filename}: " if error.filename else ""
        raise Halted(f"{file}{error.strerror or error}; {kept()}") from error


@contextmanager
def _folder(path: Path) -> Iterator[None]:
    """A folder that can be written to; a new one does not stay behind empty when something fails."""
    new = not path.exists()
    path.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=path):
        pass
    sweep(path)
    try:
        yield
    finally:
        for empty in (path / UNFINISHED, path) if new else ():
            with suppress(OSError):  # it is not
                empty.rmdir()


def _report(
    args: argparse.Namespace,
    fitted: Identified,
    train: Logs,
    test: Logs | None,
    history: list[dict[str, Any]],
    began: float,
    say: Say,
) -> None:
    """Table and figure of the friction and, last of all, the report."""
    states, laws = specs[fitted.rig.system].states, None
    if fitted.rig.friction:
        visited = _velocities(fitted, train, history)
        table = friction_table(fitted, jnp.asarray(visited_nodes(visited)))
        laws = _laws(fitted, table, say)
        write_friction(args.out / "friction.csv", *(np.asarray(a) for a in (table.velocity, table.torque, table.std)))
        _draw(args.out / "friction.png", fitted, table, visited)
    error = None
    if test:
        found = predict(fitted, test.data, GIVEN, key=jax.random.key(0))
        error = horizon_errors(found, fitted, test.data, GIVEN)
        for name, values in error.items():
            pairs = zip(HORIZONS, values, strict=True)
            say(f"error {name}: " + ", ".join(f"{v:.3g} over {h:g} s" for h, v in pairs if not math.isnan(v)))
    times = {"given_s": GIVEN, "horizons_s": list(HORIZONS)}
    noise = {n: {"std": math.exp(0.5 * r), "estimated": n not in fitted.rig.noise_std} for n, r in _readings(fitted)}
    parameters = {n: {"value": v, "std": s, "unit": parameter_unit(n)} for n, (v, s) in parameter_table(fitted).items()}
    for name, entry in parameters.items():
        say(f"{name} = {entry['value']:.6g} +- {entry['std']:.2g} {entry['unit']}")
    kicks = np.exp(0.5 * np.asarray(fitted.model.log_q)).tolist()
    document = {
        "format": 1,
        "rig": fitted.rig.name,
        "system": fitted.rig.system,
        "fit": error and {**times, **error},
        "error": error and {**times, "fit": error},
        "error_note": None if error else "no test sequences (FOLDER/test/*.csv), so no prediction error",
        "noise": {
            "measurement": {
                name: {**entry, "unit": state_unit(fitted.model.system, name)} for name, entry in noise.items()
            },
            "process_per_step": {
                name: {"std": std, "unit": state_unit(fitted.model.system, name)}
                for name, std in zip(states, kicks, strict=True)
            },
        },
        "parameters": parameters,
        "friction_law": laws,
        "log_likelihood": fitted.state.loglik.tolist(),
        "epochs": [{**e, "left_out": [train.files[i] for i in e["left_out"]]} for e in history],
        "left_out": [train.files[i] for i in history[-1]["left_out"]],
        "masked": masked(train, test),
        "smoother": args.smoother,
        "seed": args.seed,
        "seconds": time.perf_counter() - began,
        "versions": {"nnap_em": __version__, "python": platform.python_version()}
        | {name: version(name) for name in ("jax", "jaxlib", "equinox", "numpy")},
        "model": MODEL,
    }
    write_json(args.out / REPORT, document)
    say(f"wrote {args.out / REPORT}" + ("" if error else f" ({document['error_note']})"))


def _velocities(fitted: Identified, train: Logs, history: list[dict[str, Any]]) -> Float[np.ndarray, "sample dof"]:
    """Smoothed velocities of the training sequences that took part."""
    mean = np.asarray(smooth(fitted, train.data).state.mean)
    valid = np.array(train.data.valid)
    valid[history[-1]["left_out"]] = False
    inside = valid & np.isfinite(mean).all(axis=-1)
    return mean[inside][:, mean.shape[-1] // 2 :]


def _laws(fitted: Identified, table: FrictionTable, say: Say) -> list[dict[str, Any]]:
    """The Stribeck law nearest to each map."""
    system = fitted.model.system
    law = fit_law(table.velocity, table.torque, table.cov)
    sentences = describe(law, system.coordinates, system.angles)
    out = []
    for j, sentence in enumerate(sentences):
        say(sentence)
        numbers = zip(PARAMETERS, law.value[j].tolist(), law.std[j].tolist(), UNITS[system.angles[j]], strict=True)
        terms = {name: {"value": v, "std": s, "unit": of} for name, v, s, of in numbers}
        out.append({"joint": j + 1, "parameters": terms, "text": sentence})
    return out


def _draw(path: Path, fitted: Identified, table: FrictionTable, visited: Float[np.ndarray, "sample dof"]) -> None:
    from .plots import friction_figure  # loads matplotlib

    figure = friction_figure(table, visited=list(visited.T), rotary=fitted.model.system.angles)
    image = io.BytesIO()
    figure.savefig(image, format="png")
    replace_bytes(path, image.getvalue())


# --- predict and smooth


def _model_file(path: Path) -> Path:
    return path / MODEL if path.is_dir() else path


def _write_states(folder: Path, logs: Logs, fitted: Identified, mean, std) -> None:
    """One file per sequence; a value that is no number becomes an empty field, and is told."""
    states = specs[fitted.rig.system].states
    for i, file in enumerate(logs.files):
        rows = np.asarray(logs.data.valid[i])
        values = np.concatenate([mean[i][rows], std[i][rows]], axis=1)
        if not np.isfinite(values).all():
            warnings.warn(f"{file}: {np.count_nonzero(~np.isfinite(values))} values run away: empty", DataWarning, 2)
            values = np.where(np.isfinite(values), values, np.nan)
        names = (*states, *(f"{name}_std" for name in states))
        time_ = {"time": np.asarray(logs.data.t[i])[rows]}
        write_csv((folder / file).with_suffix(".csv"), time_ | dict(zip(names, values.T, strict=True)))
