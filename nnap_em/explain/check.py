"""Test of whether logs can identify what is declared, before EM: one line per subject, ok, warning or error."""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from ..base.digits import counted
from ..base.gaussian import Gaussian
from ..base.parallel import each
from ..errors import RigError
from ..estimate.em.build import LAG, NO_MACHINE, Scales, build_system, measure_scales
from ..estimate.em.equations import infinite_rates, motion
from ..estimate.em.readings import onset
from ..estimate.em.servos import build_servos, steps_of_sample
from ..estimate.em.simulated import filter_path
from ..estimate.identifiability import identifiability, not_identifiable, sentences
from ..estimate.identify import Identified, begin
from ..estimate.smoother.kalman import TANGENT, ekf, kalman_filter
from ..estimate.smoother.posterior import AbstractSmoother
from ..logs.dataset import Array, Dataset
from ..logs.noise import fast_reading_noise
from ..logs.read import REPEAT, Logs, logs_of_arrays
from ..machines.machine import unpacked
from ..machines.rig import HOLD, SMOOTH, Rig
from ..machines.servo import TORQUE
from ..machines.systems import AbstractSystem
from ..model.base import prepare
from ..model.friction import NoFriction
from ..model.state_space import MOST_STEPS, StateSpaceModel
from .inverse_dynamics import UNEXPLAINED, Lag, explanations, gains, lag, mistakes, regression
from .rates import bridged, timing

OK, WARNING, ERROR = "ok", "warning", "error"
SEQUENCES, SECONDS, FEWEST_SAMPLES = 6, 1.0, 10
"""Number of the sequences smoothed with the first model, and their length, which must determine the state [s, and rows
where samples are that slow]: a wrong model loses a hidden joint later on."""
POSES = 256
"""Rows of the logs, evenly over them, in which the loads of joints are taken."""
RECORDED = 10.0
"""Length of a recording in slowest time constants."""
SAME_HOLD = 0.25
"""Distance to the lag of the other hold, half a row, within which that is meant [rows]: half way."""
LOST = "the declared model cannot follow the logs; look at units, signs and parameters"
_LONG = 20.0, 500  # s and rows of a sequence from which on it is better cut: a hidden joint is lost later on


class CheckResult(NamedTuple):
    """Result of one check of a data set, in plain words."""

    mark: str
    """`ok`, `warning` (a fit may do) or `error` (a fit would be in vain)."""
    subject: str
    text: str


class Along(NamedTuple):
    """The declared physics along the logs, friction left out, as the first model smooths them."""

    x: Float[np.ndarray, "seq time state"]
    transition: Float[np.ndarray, "seq time state state"]
    """Jacobian of the next state."""
    reading: Float[np.ndarray, "seq time obs state"]
    """Jacobian of the reading."""
    rate: Float[np.ndarray, "seq time state state"] | None = None
    """Jacobian of the time derivative of the state [1/s]."""


def check(
    rig: Rig, train: Logs | Dataset, test: Logs | Dataset | None = None, *, key: PRNGKeyArray
) -> list[CheckResult]:
    """Check whether logs can identify what a rig declares; nothing is fitted.

    Args:
        rig: what is declared.
        train: logs to be fitted, of `read_logs` or of `pad`.
        test: logs to be predicted, or None.
        key: random key of the start of the problem.

    Returns:
        Results of all checks, each with its mark (ok, warning, error) and reason; where there is too little data, what
        is missing.

    Raises:
        DataError: arrays are not of the rig: other columns, another interval, a row without an input.

    Example:
        >>> [result.text for result in nnap_em.check(rig, logs, None, key=key) if result.mark == "error"]
        []
    """
    train, test = logs_of_arrays(train, rig), None if test is None else logs_of_arrays(test, rig)
    data = Dataset(*(np.asarray(part) for part in train.data))
    results = [*_amount(rig, data, test), *_readings(rig, train), *rates(rig, data)]
    if results[0].mark == ERROR:
        return results
    try:
        parts = [("train", train), ("test", test)] if rig.equations else []
        infinite = [(name, infinite_rates(rig, build_system(rig), part)) for name, part in parts if part is not None]
        if broken := [CheckResult(ERROR, "rates", f"{name}: {text}") for name, text in infinite if text]:
            return [*results, *broken]
        problem = begin(rig, data, key=key)
    except RigError:
        return [CheckResult(ERROR, "bodies", f"{NO_MACHINE}: look at their signs and units"), *results]
    system = problem.model.system
    if rig.equations:
        return [*results, *_equations(rig, problem, data)]
    if (steps := steps_of_sample(system, build_servos(rig), data, rig.dt)) > MOST_STEPS:
        text = f"the stiffest servo would need {steps:.0f} integration steps of a sample, and gets {MOST_STEPS}"
        return [*results, CheckResult(ERROR, "servo", f"{text}: look at the units of its gains, or sample faster")]
    scales = measure_scales(rig, system, data)
    model = eqx.tree_at(lambda m: m.unknown, problem.model, NoFriction(jnp.asarray(0.1 * scales.torque)))
    head = _first(data, max(round(SECONDS / rig.dt), FEWEST_SAMPLES) + 1)
    along = Along(*(np.asarray(part) for part in each(_along, (model, problem.smoother, problem.state.key), head)))
    return [
        *results,
        *_sampling(rig, along, scales),
        *_noise(rig, model, data),
        *torques(rig, system, data, scales),
        *dynamics(rig, system, data),
        *_motion(rig, model, data, along),
        *_observability(model, along, np.asarray(head.valid)[:, :-1]),
    ]


def _equations(rig: Rig, problem: Identified, data: Dataset) -> Iterator[CheckResult]:
    """Modes of equations against rows and recordings, noise, and observability of their states over whole logs."""
    model, longest, unit = problem.model, float(data.valid.sum(axis=1).max()) * rig.dt, rig.time_unit
    seen = motion(model, data)
    fastest, brief = 1 / max(seen.fastest, 1e-12), longest < RECORDED * seen.slowest < np.inf
    ends = dict.fromkeys(f"{time:.3g}" for time in (fastest, seen.slowest) if time < 1e6 * longest)
    modes = f"time constants of the declared equations {' to '.join(ends)} {unit}" if ends else "no time constants"
    text = f"rows {rig.dt:g} {unit} apart, {modes}" + ", none decays" * bool(ends and seen.slowest == np.inf)
    text += f"; integrators: {', '.join(seen.kept)}" if seen.kept else ""
    text += f"; unstable: {', '.join(seen.unstable)}, at {seen.growth:.3g} 1/{unit}" if seen.growth else ""
    lost, wild = not len(seen.rate), seen.growth * 2 * rig.dt > 1
    hints = {
        "no states follow the readings: look at signs, units and parameters": (lost, lost),
        "errors grow too fast between two rows: sample faster, or look at units and signs": (wild, wild),
        "the fastest is over between two rows: sample faster, or look at the units of parameters": (fastest < rig.dt,),
        f"record {RECORDED:g} of the slowest at least, here {longest:.3g} {unit}": (brief,),
    }
    yield _row("sampling", f"{text}; predictions are judged up to {model.pace:g} {unit} ahead", hints)
    yield from _noise(rig, model, data)
    yield _determined(rig, model, data)


def _determined(rig: Rig, model: StateSpaceModel, data: Dataset) -> CheckResult:
    """States that whole logs determine, by the covariance of the last one under the declared equations alone.

    That of a filter without process noise along the path of the first model, in units of how far each state moves: a
    start that decays is known by the inputs, one that an integrator keeps only by a reading.
    """
    names, system = model.system.states, model.system
    path = np.asarray(each(filter_path, model, jax.device_put(data))[0])[np.asarray(data.valid)]
    scale = np.maximum([_std(one) for one in path.T], 1e-12)
    wide = Gaussian(model.start.mean, jnp.diag(jnp.asarray(scale**2)))
    last = np.asarray(each(_last_covariance, (model, wide), jax.device_put(data))) / np.outer(scale, scale)
    last = last[np.isfinite(last).all(axis=(1, 2))]
    if not len(last):
        return CheckResult(ERROR, "states", LOST)
    known = np.sum(np.median(np.linalg.eigvalsh(last), axis=0) < 0.5)
    left = dict(zip(names, np.median(np.sqrt(np.einsum("sii->si", last)), axis=0), strict=True))
    left |= {system.state_of(column): 0.0 for column in rig.measured}
    dark, weak = ([n for n in names if least < left[n] <= most] for least, most in ((0.5, np.inf), (0.2, 0.5)))
    shown = "measure more of the state, or change the inputs so that it shows"
    never, hardly = f"not determined: {', '.join(dark)}: {shown}", f"hardly determined: {', '.join(weak)}"
    return _row(
        "states",
        f"a whole log determines {known} of {len(names)} directions of the state",
        {never: (dark, dark), hardly: (weak,)},
    )


def _last_covariance(common: tuple[StateSpaceModel, Gaussian], seq: Dataset) -> Array:
    """Covariance of the last state of a filter from a start, without process noise."""
    (model, start), still = common, -100.0
    ready = prepare(common[0], seq)
    along = ekf(model, model.start, ready, TANGENT)
    quiet = jnp.full_like(model.log_q, still)
    return kalman_filter(quiet, model.log_r, start, along.affine, along.reading, ready).state.cov[-1]


def _first(data: Dataset, rows: int) -> Dataset:
    """The first rows of some sequences, from shortly before they move on."""
    at = onset(np.asarray(data.y))[:SEQUENCES, None] + np.arange(min(rows, data.t.shape[1]))
    inside, at = at < data.t.shape[1], np.minimum(at, data.t.shape[1] - 1)
    head = Dataset(*(part[np.arange(len(at))[:, None], at] for part in data))
    return head._replace(valid=head.valid & inside)


def _along(common: tuple[StateSpaceModel, AbstractSmoother, PRNGKeyArray], seq: Dataset) -> tuple[Array, ...]:
    """The parts of Along of one sequence."""
    model, smoother, key = common
    prepared, still = prepare(model, seq), jnp.zeros(len(model.system.ports))
    x, u = smoother(model, prepared, key=key).state.mean, prepared.inputs
    slopes = (model.transition, model.emission, lambda x, u: model.rate(x, u, still))
    return x, *(jax.vmap(jax.jacfwd(slope))(x, u) for slope in slopes)


def _std(values: np.ndarray) -> float:
    """Standard deviation of the finite values; 0 of none."""
    finite = values[np.isfinite(values)]
    return float(finite.std()) if finite.size else 0.0


def _row(subject: str, text: str, hints: Mapping[str, Sequence[object]]) -> CheckResult:
    """A result with its hints, of which each has one or two conditions: that of a warning, that of an error."""
    levels = {hint: sum(map(bool, holds)) for hint, holds in hints.items()}
    mark = (OK, WARNING, ERROR)[max(levels.values(), default=0)]
    return CheckResult(mark, subject, "; ".join(filter(None, (text, *(hint for hint in levels if levels[hint])))))


def _amount(rig: Rig, data: Dataset, test: Logs | None) -> Iterator[CheckResult]:
    rows, unit = data.valid.sum(axis=1), rig.time_unit
    few, long = rows.sum() < 100 or rows.max() < 20, rows.max() > max(_LONG[0] / rig.dt, _LONG[1])
    hints = {
        f"too few; record {'more' if rig.equations else 'some minutes'}": (few or rows.sum() < 1000, few),
        f"the shortest is {rows.min() * rig.dt:.2g} {unit}: leave out what is under 60 rows": (rows.min() < 60,),
        "cut them into sequences of some seconds": (long and not rig.equations,),
    }
    text = f"{counted(len(rows), 'training sequence')}, {rows.sum() * rig.dt:.3g} {unit}, {rows.sum()} rows"
    yield _row("length", text, hints)
    text = f"{counted(len(test.files) if test else 0, 'test sequence')}, none of them in train"
    yield _row("test", text, {"no prediction error will be reported": (test is None,)})


def _readings(rig: Rig, train: Logs) -> Iterator[CheckResult]:
    """Missing samples of each column, and what was masked on reading."""
    read, rows = np.isfinite(train.data.y).sum(axis=1), np.asarray(train.data.valid).sum(axis=1)
    gone, masked = np.asarray(rows[:, None] - read), {}
    for entry in train.masked:
        masked.setdefault((entry.kind, entry.column), []).append(entry)
        if entry.kind == REPEAT:
            gone[train.files.index(entry.file), rig.measured.index(entry.column)] -= entry.amount
    for name, lost in zip(rig.measured, gone.T, strict=True):
        share = lost.sum() / rows.sum()
        text = f"{name}: {100 * share:.0f} % of the samples are missing"
        text += f", most in {train.files[int(np.argmax(lost / rows))]}" if share else ""
        yield _row("missing", text, {"": (share > 0.2, share > 0.75)})
    for (kind, column), entries in masked.items():
        count, files = sum(entry.amount for entry in entries), {entry.file for entry in entries}
        text = f"{column or 'rows'}: {kind}: {count} in {len(files)} of {counted(len(rows), 'file')}, "
        text += f"most in {max(entries, key=lambda entry: entry.amount).file}"
        subject, much = "rough", count > 0.3 * rows.sum()
        if kind == REPEAT:
            kept = read[[train.files.index(file) for file in files], rig.measured.index(column)].sum()
            subject, much = "held", False
            text += f"; each reading stands in {1 + count / kept:.3g} rows, all but the first are missing samples"
        yield _row(subject, text, {"": (True, much)})


def _sampling(rig: Rig, along: Along, scales: Scales) -> Iterator[CheckResult]:
    """Samples per period of the fastest eigenvalue, and how much a velocity changes between two."""
    rate = np.asarray(along.rate)[:, ::10].reshape(-1, *along.transition.shape[-2:])
    fastest = np.max(np.abs(np.linalg.eigvals(rate[np.isfinite(rate).all(axis=(1, 2))])), initial=0.0)
    turn = float(np.max(scales.acceleration * rig.dt / scales.speed))
    period = 2 * np.pi / max(float(fastest), 1e-9)
    per = period / rig.dt
    text = f"the fastest motion of the declared model takes {period:.2g} s, {per:.0f} samples; " if period < 1e6 else ""
    text += f"a velocity changes by {100 * turn:.2g} % of its range from sample to sample"
    bad = per < 10 or turn > 0.1, per < 5 or turn > 0.3
    yield _row("sampling", text, {"sample faster, or look at the units of dt and of the parameters": bad})


def _noise(rig: Rig, model: StateSpaceModel, data: Dataset) -> Iterator[CheckResult]:
    """Noise of the readings beside that which is declared, and beside their motion."""
    rises = "the signal hardly rises above it: change the inputs more"
    rises = rises if rig.equations else "the motion hardly rises above it: move or excite more"
    for i, name in enumerate(rig.measured):
        unit, signal, declared = (
            f" {model.system.unit(name)}".rstrip(),
            np.asarray(data.y)[..., i],
            rig.noise_std.get(name),
        )
        seen = fast_reading_noise(signal)
        noisy = max(seen, declared or 0.0) > 0.3 * _std(signal)
        alone = name not in model.system.sensors  # of three axes one may sense nothing
        ratio = seen / declared if declared else 1.0
        said = f"declared {declared:.2g}{unit}" if declared else "not declared, so it is estimated"
        text = f"{seen:.2g}{unit} by the log's high frequencies, {said}"
        hints = {
            "declare more, or leave it out to have it estimated": (ratio > 3, ratio > 30),
            f"{rises}, or look at the units": (noisy, noisy and alone),
            "the log was filtered, or less is true": (ratio < 0.1,),
        }
        yield _row("noise", f"{name}: {text}", hints)


def rates(rig: Rig, data: Dataset) -> Iterator[CheckResult]:
    """Each rate against the derivative of its coordinate, where both are read."""
    for name, rate in rig.pairs():
        y, w = (np.asarray(data.y)[..., rig.measured.index(column)] for column in (name, rate))
        found = timing(y, w, rig.dt)
        if found is None:
            continue
        lag = f"{abs(found.late):.3g} {rig.time_unit} ({abs(found.late) / rig.dt:.3g} rows)"
        late, first = (rate, f"the derivative of {name}") if found.late > 0 else (name, rate)
        text = f"{rate} is the derivative of {name}, {lag} {'late' if found.late > 0 else 'early'}"
        gear = "" if rig.equations else " or gear"
        scaled = f"{rate} is {found.scale:.4g} times the derivative of {name}: correct the unit{gear} of one"
        shifted = f"{late} is {lag} later than {first}; take {late} out of [measurement] columns, or filter neither"
        hints = {scaled: found.wrong[:1], shifted: found.wrong[1:]}
        yield _row("rate", "" if any(found.wrong) else text, hints)


def torques(rig: Rig, system: AbstractSystem, data: Dataset, scales: Scales) -> Iterator[CheckResult]:
    """The inputs against gravity and inertia of the declared bodies."""
    needed = _needed(rig, system, data, scales.acceleration)
    inputs = np.moveaxis(np.asarray(data.u), -1, 0)[: len(rig.input_columns)]
    for name, joint, gear, u in zip(rig.input_columns, rig.input_joints, system.gears, inputs, strict=True):
        if rig.kinds[name] != TORQUE:
            continue
        unit = system.force_unit(joint)
        torque = abs(gear) * float(np.percentile(np.abs(u[data.valid]), 99))
        ratio = torque / needed[joint - 1]
        text = f"{name}: up to {torque:.3g} {unit}, gravity and inertia of joint {joint} need {needed[joint - 1]:.3g}"
        odd = ratio > 30 or 0 < ratio < 1e-3, ratio > 100 or 0 < ratio < 3e-4
        yield _row("torque", text, {f"look at its unit ({unit}) and at masses (kg) and lengths (m)": odd})
    yield from _at_stops(rig, data)
    for text in sentences(identifiability(rig, system, build_servos(rig))):
        yield CheckResult(WARNING, "parameters", text)
    if kept := not_identifiable(rig, system, data):
        text = "nothing drives the machine, so that its motion does not determine the scale of its masses and friction"
        held = ", ".join(f"{name} = {rig.parameters[name]} {rig.unit(name)}" for name in kept)
        yield CheckResult(WARNING, "scale", f"{text}: kept as declared is {held}, and all else is relative to that")


def _at_stops(rig: Rig, data: Dataset) -> Iterator[CheckResult]:
    """Measured joints whose readings touch an end of their range, where stops have no force in the model."""
    machine = unpacked(rig.machine) if rig.machine else None
    for joint, name in zip(machine.joints, machine.states, strict=False) if machine else ():
        if joint.range is None or name not in rig.measured:
            continue
        y, (low, high) = np.asarray(data.y)[..., rig.measured.index(name)], joint.range
        # within half a percent of its range a reading counts as at its end
        if count := int(np.sum(np.abs(y - 0.5 * (low + high)) > 0.495 * (high - low))):
            text = f"{name}: {counted(count, 'reading')} at or beyond its range of {low:.4g} to {high:.4g}"
            text += f" {rig.unit(name)}; stops have no force in the model: leave those stretches out, or let diagnose"
            yield CheckResult(WARNING, "range", f"{text} find hard_stop")


def dynamics(rig: Rig, system: AbstractSystem, data: Dataset) -> Iterator[CheckResult]:
    """Share of the torques that the declared inverse dynamics explain, and the mistakes in a log that spoil it.

    Silent where a coordinate is not read, and where neither the log as it is nor a corrected one is explained.
    """
    problem = regression(rig, system, data)
    if problem is None:
        return
    plain = problem.remains()
    explained = lambda left: ", ".join(f"{100 * (1 - share):.4g} %" for share in left) + " of the torque, by joint"  # noqa: E731
    if found := mistakes(explanations(rig, problem), plain):
        text = ", or just as well: ".join(one.text for one in found)
        text += f"; with that the declared bodies explain {explained(found[0].remains)}, as it is {explained(plain)}"
        yield _row("dynamics", text, {"": (True, any(one.ruins for one in found))})
    elif np.all(plain < UNEXPLAINED):
        text, shifted = f"declared bodies and a static friction explain {explained(plain)}", []
        for i, (name, slope) in enumerate(zip(rig.input_columns, gains(problem), strict=True)):
            text += f"; {name}: slope {slope:.3g}"
            if rig.kinds[name] == TORQUE:
                when = lag(problem, i)
                text += f", {when.rows:.2f} +- {when.std:.1g} rows late"
                shifted += [CheckResult(WARNING, "hold", f"{name}: {late(rig, when)}")] * when.counts
        yield from (CheckResult(OK, "dynamics", text), *shifted)


def late(rig: Rig, when: Lag) -> str:
    """An input that acts at another time than its hold has it, and the line to write."""
    other, between = (SMOOTH, -0.5) if rig.input_hold == HOLD else (HOLD, 0.5)
    side = f"{abs(when.rows):.2g} +- {when.std:.1g} rows {'later' if when.rows > 0 else 'earlier'}"
    text = f"torque and motion agree best if it acts {side} than `input_hold` has it ({when.rows * rig.dt:.2g} s)"
    if abs(when.rows - between) < SAME_HOLD:
        return f'{text}: write [sampling] input_hold = "{other}"'
    cause = "a late drive or bus (`diagnose` finds input_delay)" if when.rows > 0 else "late readings"
    return f"{text}: {cause}, or two clocks (`nnap-em import --shift TOPIC=SECONDS`)"


def _needed(
    rig: Rig, system: AbstractSystem, data: Dataset, acceleration: Float[np.ndarray, " dof"]
) -> Float[np.ndarray, " dof"]:
    """Largest gravity of every joint in the poses of the logs, and the force of its mean inertia there [N m, or N].

    A joint that bears nothing at zero may bear much elsewhere.  Joints that nobody reads are anywhere in a turn.
    """
    read = {i: rig.measured.index(name) for i, name in enumerate(system.coordinates) if name in rig.measured}
    seen = np.asarray(data.y)[..., [*read.values()]][np.asarray(data.valid)]
    seen = seen[np.isfinite(seen).all(axis=1)]
    q = np.where(system.angles, np.random.default_rng(0).uniform(-np.pi, np.pi, (POSES, len(system.angles))), 0.0)
    q[:, [*read]] = seen[np.linspace(0, len(seen) - 1, POSES).astype(int)] if len(seen) else 0.0
    mass, gravity = map(np.asarray, _loads(system, jnp.asarray(q)))
    return np.percentile(np.abs(gravity), 99, axis=0) + np.mean(mass, axis=0) * acceleration


@eqx.filter_jit
def _loads(system: AbstractSystem, q: Float[Array, "pose dof"]) -> tuple[Array, Array]:
    return jax.vmap(lambda q: (jnp.diag(system.mass(q)), system.bias(q, 0 * q)))(q)


def _motion(rig: Rig, model: StateSpaceModel, data: Dataset, along: Along) -> Iterator[CheckResult]:
    """Velocities that each joint visits: range, both directions, passages through rest."""
    for joint, name in enumerate(model.system.rates):
        unit = model.system.unit(name)
        v, seen = _velocity(rig, model, data, along, joint)
        inner = v[np.isfinite(v)]
        low, high = np.percentile(inner, [1, 99]) if inner.size else (0.0, 0.0)
        top = max(-low, high)
        if top <= max(3 * rig.noise_std.get(name, 0.0), 1e-9):
            text = f"hardly moves ({top:.2g} {unit}); drive it through its range"
            text = text if inner.size else "no velocity, as no sequence can be followed"
            yield CheckResult(ERROR, "motion", f"joint {joint + 1}{seen}: {text}")
            continue
        near_rest = float(np.mean(np.abs(inner) < 0.05 * top))
        covered = float(np.mean(np.histogram(inner, np.linspace(-top, top, 21))[0] >= 5))
        turns = sum(np.count_nonzero(np.diff(np.sign(row[np.abs(row) > 0.05 * top]))) for row in v)  # but for noise
        text = f"joint {joint + 1}{seen}: {low:.3g} to {high:.3g} {unit}, {100 * covered:.0f} % of that range covered, "
        text += f"{100 * near_rest:.0f} % of the time near rest, {turns} changes of direction"
        hints = {
            "it moves in one direction only: friction in the other stays unknown": (min(-low, high) < 0.2 * top,),
            "too few turns to identify Coulomb friction": (turns < 4,),
            "it rests most of the time: move more, and slowly through zero velocity": (near_rest > 0.5,),
            "many velocities are never visited: the curve is a guess there": (covered < 0.5,),
        }
        yield _row("motion", text, hints if rig.friction else {})


def _velocity(
    rig: Rig, model: StateSpaceModel, data: Dataset, along: Along, joint: int
) -> tuple[Float[np.ndarray, "seq time"], str]:
    """Velocities of a joint, NaN where there is none, and where they come from."""
    rate, position = model.system.rates[joint], model.system.coordinates[joint]
    if rate in rig.measured:
        return np.asarray(data.y)[..., rig.measured.index(rate)], ""
    if position in rig.measured:
        y = bridged(np.asarray(data.y)[..., rig.measured.index(position)])
        v = (y[:, LAG:] - y[:, :-LAG]) / (LAG * rig.dt)
        if np.isfinite(v).any():
            return v, ""
    return along.x[..., len(model.system.coordinates) + joint], " (never seen, by the declared model)"


def _observability(model: StateSpaceModel, along: Along, valid: np.ndarray) -> Iterator[CheckResult]:
    """Observability of the state from readings alone, by the Gramian sum Phi' C' R^-1 C Phi along the logs.

    [Krener & Ide 2009, "Measures of unobservability", CDC]  It is judged in units of how far each state moves.
    """
    names, dof = model.system.states, len(model.system.coordinates)
    scale = np.maximum([_std(one) for one in along.x.reshape(-1, len(names)).T], 1e-12)
    noise, grams = np.exp(0.5 * np.asarray(model.log_r))[:, None], []
    for transition, reading, ok in zip(along.transition, along.reading, valid, strict=True):
        last = int(ok.sum())
        if last >= 2 and np.isfinite(transition[:last]).all():
            gram = gramian(transition[:last], reading[:last] / noise, scale)
            grams += [gram] if np.isfinite(gram).all() else []
    if not grams:
        yield CheckResult(ERROR, "states", LOST)
        return
    seen = np.sum(np.median([np.linalg.eigvalsh(gram) for gram in grams], axis=0) > 1)
    left = dict(zip(names, np.median([undetermined(gram) for gram in grams], axis=0), strict=True))
    dark, weak = ([n for n in names if least < left[n] <= most] for least, most in ((0.5, np.inf), (0.2, 0.5)))
    shown = "move so that the hidden joint shakes the rest"
    hints = {
        f"not determined: {', '.join(dark)}: measure more of the state, or {shown}": (dark, {*dark} & {*names[dof:]}),
        f"hardly determined: {', '.join(weak)}": (weak,),
    }
    text = f"{valid.shape[1] * model.dt:.3g} s of readings determine {seen} of {len(names)} directions of the state"
    yield _row("states", text, hints)


def undetermined(gram: Float[np.ndarray, "state state"]) -> Float[np.ndarray, " state"]:
    """Standard deviation of every state after the readings over that before, sqrt(diag((I + gram)^-1))."""
    values, axes = np.linalg.eigh(gram)
    return np.sqrt(np.sum(axes**2 / (1 + np.maximum(values, 0.0)), axis=1))


def gramian(
    transition: Float[np.ndarray, "time state state"],
    reading: Float[np.ndarray, "time obs state"],
    scale: Float[np.ndarray, " state"],
) -> Float[np.ndarray, "state state"]:
    """Observability Gramian of a linear time-varying model, of the first state in units of `scale`."""
    total, phi = np.zeros((len(scale),) * 2), np.diag(scale)
    for a, c in zip(transition, reading, strict=True):
        seen = c @ phi
        total += seen.T @ seen
        phi = a @ phi
    return total
