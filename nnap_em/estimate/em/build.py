"""First model of EM, from the declaration and the logs; every scale comes from one of the two."""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from ...base.gaussian import Gaussian
from ...errors import RigError
from ...logs.dataset import Dataset
from ...machines.rig import SMOOTH, Rig
from ...machines.systems import AbstractSystem, systems
from ...model.friction import FrictionNetwork, NoFriction
from ...model.state_space import MOST_STEPS, SUBSTEPS, StateSpaceModel
from ..smoother.start import StartBank
from .equations import build_equations
from .mstep import RESTING_OFFSET, RESTING_STEP, ScoringMStep
from .prior import declared_prior
from .readings import RESTS, at_rest, reading_noise
from .servos import LAG, build_servos, steps_of_sample, torque_along

NO_MACHINE = "the declared masses and inertias make no machine"


class Scales(NamedTuple):
    """Largest velocity [rad/s], typical acceleration [rad/s^2] and torque of gravity and drive [N m] of every joint."""

    speed: Float[np.ndarray, " dof"]
    acceleration: Float[np.ndarray, " dof"]
    torque: Float[np.ndarray, " dof"]


class Problem(NamedTuple):
    """Input of EM: the first model, the estimators of its parts, and the hypotheses of its start."""

    model: StateSpaceModel
    mstep: ScoringMStep
    bank: StartBank


def build_system(rig: Rig) -> Any:
    """The declared physics, at the mean of what is uncertain; RigError where its mass matrix is not positive."""
    values = {name: jnp.asarray(declared.mean, float) for name, declared in rig.bodies.items()}
    system = systems[rig.system].declared(values, rig.input_joints, rig.machine or rig.equations)
    if rig.equations:
        return system
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (32, len(system.coordinates)))
    if np.linalg.eigvalsh(np.asarray(_masses(system, jnp.asarray(q, float)))).min() <= 0:
        raise RigError(f"rig {rig.name!r}: {NO_MACHINE}: their kinetic energy can fall below 0; correct [model]")
    return system


@eqx.filter_jit
def _masses(system: AbstractSystem, q: Float[Array, "pose dof"]) -> Float[Array, "pose dof dof"]:
    return jax.vmap(system.mass)(q)


def derivatives(signal: Float[np.ndarray, "seq time"], order: int, dt: float) -> list[Float[np.ndarray, " reading"]]:
    """Derivatives of each sequence by differences over `LAG` rows, missing samples bridged, or over one reading where
    these are further apart.
    """
    out = []
    for y in signal:
        t, y = np.flatnonzero(np.isfinite(y)).astype(float), y[np.isfinite(y)]
        lag = max(round(LAG / float(np.median(np.diff(t)))), 1) if t.size > 1 else 1
        for _ in range(order):
            y, t = (y[lag:] - y[:-lag]) / ((t[lag:] - t[:-lag]) * dt), 0.5 * (t[lag:] + t[:-lag])
        out.append(y)
    return out


def loads(system: AbstractSystem) -> tuple[Float[np.ndarray, " dof"], Float[np.ndarray, " dof"]]:
    """Inertia of every joint at zero, and gravity with the first at a quarter turn [kg m^2 and N m, or kg and N]."""
    inertia, gravity = map(np.asarray, _loads(system))
    return inertia, np.abs(gravity)


@eqx.filter_jit
def _loads(system: AbstractSystem):
    still = jnp.zeros(len(system.coordinates))
    return jnp.diag(system.mass(still)), system.bias(still.at[0].set(jnp.pi / 2), still)


def measure_scales(rig: Rig, system: AbstractSystem, data: Dataset) -> Scales:
    """Those of the measured joints; an unseen one is given the same kinetic energy. The torque of a servo is that of
    its declared numbers at the readings, or where its joint is not read, what the accelerations need.
    """
    dof = len(system.coordinates)
    y, u = np.asarray(data.y), np.asarray(data.u)
    speed, acceleration = np.full(dof, np.nan), np.full(dof, np.nan)
    for joint in range(dof):
        position, rate = system.coordinates[joint], system.rates[joint]
        if rate in rig.measured:
            signal = y[..., rig.measured.index(rate)]
            v, a = signal[np.isfinite(signal)], np.concatenate(derivatives(signal, 1, rig.dt))
        elif position in rig.measured:
            signal = y[..., rig.measured.index(position)]
            v, a = (np.concatenate(derivatives(signal, order, rig.dt)) for order in (1, 2))
        else:
            continue
        speed[joint] = np.max(np.abs(v), initial=0.0)
        acceleration[joint] = np.sqrt(np.mean(a**2)) if a.size else 0.0
    mass, gravity = loads(system)
    for scale in (speed, acceleration):
        energy = np.nanmean(scale**2 * mass) if np.any(np.isfinite(scale)) else 1.0
        scale[np.isnan(scale)] = np.sqrt(energy / mass[np.isnan(scale)])
    drive = np.zeros(dof)
    servos, valid = build_servos(rig), np.asarray(data.valid)
    for i, joint in enumerate(rig.input_joints):
        torque, position = u[..., i], system.coordinates[joint - 1]
        if servos and servos[i].feeds_back and position not in rig.measured:
            drive[joint - 1] = mass[joint - 1] * acceleration[joint - 1]
            continue
        if servos and servos[i].feeds_back:
            q, scale = system.gears[i] * y[..., rig.measured.index(position)], u[..., len(servos) :]
            torque = torque_along(servos[i], torque, q, scale, rig.dt)
        drive[joint - 1] = abs(system.gears[i]) * np.sqrt(np.nanmean(torque[valid] ** 2))
    speed = np.maximum(speed, 1e-6)
    least = speed / (rig.dt * float(np.max(np.sum(valid, axis=1))))  # to reach the largest speed in a sequence
    return Scales(speed, np.maximum(acceleration, least), np.maximum(gravity + drive, 1e-6 + mass * acceleration * 0.1))


def start_prior(rig: Rig, system: AbstractSystem, data: Dataset, scales: Scales) -> tuple[Gaussian, tuple[bool, ...]]:
    """Prior of the first state, and which of its entries nobody declared or measured (EM learns those)."""
    y = np.asarray(data.y)
    every = []
    for i, name in enumerate(system.coordinates + system.rates):
        joint, is_rate = i % len(system.coordinates), i >= len(system.coordinates)
        if name in rig.start:
            mean, std, free = rig.start[name].mean, max(rig.start[name].std, 1e-6), False
        elif name in rig.measured:
            signal = y[..., rig.measured.index(name)]
            first = np.array([s[np.isfinite(s)][0] for s in signal if np.any(np.isfinite(s))])
            width = scales.speed[joint] * (1.0 if is_rate else 10 * rig.dt)
            mean, std, free = float(np.mean(first)), float(np.hypot(np.std(first), width)), False
        elif is_rate:
            mean, std, free = 0.0, float(scales.speed[joint]) / 3, True
        else:
            mean, std, free = 0.0, np.pi / 2 if system.angles[joint] else 1.0, True
        every.append((mean, std, free))
    means, stds, open_ = zip(*every, strict=True)
    return Gaussian(jnp.asarray(means), jnp.asarray(np.diag(np.square(stds)))), open_


def build(rig: Rig, data: Dataset, *, key: PRNGKeyArray) -> Problem:
    """The model that EM starts from: declared physics, a small random friction network, noise as large as motion."""
    system, servos = build_system(rig), build_servos(rig)
    if rig.equations:
        model, prior, learned, estimated, quiet = build_equations(rig, system, data)
        mstep = ScoringMStep(prior, jnp.zeros(0), learned, estimated, log_q_prior=model.log_q, quiet=quiet)
        return Problem(model, mstep, StartBank((1,) * len(system.states)))
    scales = measure_scales(rig, system, data)
    start, open_ = start_prior(rig, system, data, scales)
    kick = scales.acceleration * rig.dt
    declared = [rig.noise_std.get(n) for n in rig.measured]
    y = np.asarray(data.y)
    noise = [max(2 * reading_noise(y[..., i]), 1e-9) if d is None else d for i, d in enumerate(declared)]
    places = [system.readable.index(name) for name in rig.measured]
    shaken = _by_acceleration(system, scales)[places]
    unknown = NoFriction(jnp.asarray(0.1 * scales.torque))
    if rig.friction:
        speed, scale = jnp.asarray(scales.speed), jnp.asarray(0.1 * scales.torque)
        unknown = FrictionNetwork(speed, scale, key=key, resolution=300.0)
        last = unknown.mlp.layers[-1]  # the first friction is nearly none
        hushed = 0.01 * last.weight, jax.tree.map(jnp.zeros_like, last.bias)
        unknown = eqx.tree_at(lambda f: (f.mlp.layers[-1].weight, f.mlp.layers[-1].bias), unknown, hushed)
    model = StateSpaceModel(
        system=system,
        unknown=unknown,
        start=start,
        log_q=jnp.asarray(2 * np.log(np.concatenate([kick * rig.dt, kick]))),
        log_r=jnp.asarray(2 * np.log(np.hypot(noise, shaken))),
        measured=tuple(places),
        dt=rig.dt,
        substeps=min(max(SUBSTEPS, math.ceil(steps_of_sample(system, servos, data, rig.dt))), MOST_STEPS),
        servos=servos or None,
        smooth=rig.input_hold == SMOOTH,
    )
    prior = declared_prior(rig.parameters)
    estimated = tuple(d is None or bool(s) for d, s in zip(declared, shaken, strict=True))
    least = (jnp.asarray([system.least(name) for name in prior.names], float) - prior.mean) / prior.std
    rests = max((at_rest(y[..., i]) for i, name in enumerate(rig.measured) if name in system.coordinates), default=0.0)
    coarse = RESTING_OFFSET if rests > RESTS else math.inf
    drive = scales.torque - loads(system)[1]  # of a joint without one, gravity and coupling stand for it
    drive = np.where(drive > 1e-3 * scales.torque, drive, scales.torque)
    reach = np.where(rests > RESTS, RESTING_STEP * drive, math.inf)
    options = {"coarse": coarse, "reach": reach, "log_q_prior": model.log_q, "least": least}
    mstep = ScoringMStep(prior, unknown.weights(), open_, estimated, **options)
    return Problem(model, mstep, start_bank(model, read_at_start(rig, system, data, scales), rig, system))


def _by_acceleration(system: AbstractSystem, scales: Scales) -> Float[np.ndarray, " readable"]:
    """Change of a reading by accelerations as large as those in the logs: the first uncertainty of forces."""
    dof = len(system.coordinates)
    still, out = jnp.zeros(dof), np.zeros(len(system.readable))
    if system.sensors:
        q = jnp.asarray(np.random.default_rng(0).uniform(-np.pi, np.pi, (32, dof)), float)
        sensed = lambda a, q: jnp.stack(system.senses(q, still, tuple(a)))  # noqa: E731
        slope = np.asarray(jax.jit(jax.vmap(jax.jacfwd(sensed), (None, 0)))(still, q))
        out[2 * dof :] = np.sqrt(np.mean(np.sum((slope * scales.acceleration) ** 2, axis=-1), axis=0))
    return out


MOVED = 0.1
"""Standard deviation of an angle at the start, and its motion before its first reading, from which on one hypothesis
is not enough [rad]."""
RATE_STARTS, ALL_STARTS = 25, 325
"""Hypotheses of the rates of joints that are read, and of all states, at most: two rows of readings determine such a
rate as well, and n joints would have 5^n of them."""


def read_at_start(rig: Rig, system: AbstractSystem, data: Dataset, scales: Scales) -> tuple[str, ...]:
    """Measured states, but not angles whose first reading in a sequence is so late that they may have moved `MOVED`."""
    rows = np.sum(np.asarray(data.valid), axis=1)
    out = []
    for i, name in enumerate(rig.measured):
        read = np.isfinite(np.asarray(data.y)[..., i])
        late = rig.dt * np.max(np.where(read.any(axis=1), read.argmax(axis=1), rows))
        joint = system.coordinates.index(name) if name in system.coordinates else None
        if joint is None or not system.angles[joint] or scales.speed[joint] * late <= MOVED:
            out.append(name)
    return tuple(out)


def start_bank(model: StateSpaceModel, read: tuple[str, ...], rig: Rig, system: AbstractSystem) -> StartBank:
    """Hypotheses for each state that is not `read` at the start and that the prior leaves wide, within the bounds of
    `RATE_STARTS` and `ALL_STARTS`.
    """
    spread = np.sqrt(np.diag(np.asarray(model.start.cov)))
    dof = len(system.coordinates)
    measured = [dof + joint for joint, name in enumerate(system.coordinates) if name in rig.measured]

    def hypotheses(known: tuple[str, ...]) -> list[int]:
        counts = []
        for i, name in enumerate(system.coordinates + system.rates):
            wide = spread[i] * (0.2 if i >= dof else 1.0) > MOVED
            counts.append((5 if i >= dof else 13) if wide and name not in known and system.angles[i % dof] else 1)
        if math.prod(counts[i] for i in measured) > RATE_STARTS or math.prod(counts) > ALL_STARTS:
            counts = [1 if i in measured else count for i, count in enumerate(counts)]
        return counts

    counts = hypotheses(read)
    if math.prod(counts) > ALL_STARTS:
        counts = hypotheses(rig.measured)
    angles = tuple(j for j, is_angle in enumerate(system.angles) if is_angle)
    unread = any(system.coordinates[j] not in rig.measured for j in angles)
    return StartBank(tuple(counts), angles if unread else ())
