"""First model of EM of a plant that is written as equations: scales by its own simulation with the declared numbers."""

import dataclasses
import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..data.dataset import Dataset
from ..data.rig import SMOOTH, Rig
from ..effects.equations import NODES, UnknownTerm
from ..model.friction import NoFriction
from ..model.state_space import MOST_STEPS, Inputs, StateSpaceModel, with_effects
from ..numerics.gaussian import Gaussian
from ..systems.equations import Equations
from .prior import ParameterPrior
from .readings import reading_noise


class Motion(NamedTuple):
    """A free simulation of the declared equations, by which scales are measured."""

    x: Float[np.ndarray, "row state"]
    u: Float[np.ndarray, "row input"]
    rate: Float[np.ndarray, "row state"]
    """Derivatives along it [1/s]."""
    fastest: float
    """Largest eigenvalue of the linearised equations [1/s]."""
    slowest: float
    """Longest time constant [s]; infinite where nothing decays."""


@eqx.filter_jit
def _rates(system: Equations, x: Float[Array, "row state"], u: Float[Array, "row input"]):
    """Derivatives and their Jacobians."""
    still = jnp.zeros(len(system.ports))
    rate = lambda x, u: jnp.stack(system.slopes(x, x[:0], u, still))  # noqa: E731
    return jax.vmap(rate)(x, u), jax.vmap(jax.jacfwd(rate))(x, u)


def resting(system: Equations, known: dict[int, float], u: Float[np.ndarray, " input"]) -> Float[np.ndarray, " state"]:
    """State in which the equations are nearest to rest at inputs `u`, with some states as they are `known`.

    Damped Gauss-Newton steps on all rates from 1, or from the known value.
    """
    x = np.array([known.get(i, 1.0) for i in range(len(system.states))])
    free = [i for i in range(len(x)) if i not in known]
    damping, error = 1e-3, math.inf

    def rates(x: np.ndarray) -> list[np.ndarray]:
        return [np.asarray(a)[0] for a in _rates(system, jnp.asarray(x[None], float), jnp.asarray(u[None], float))]

    for _ in range(40 if free else 0):
        rate, slope = rates(x)
        if not np.isfinite(rate).all():
            break
        error, part = float(rate @ rate), slope[:, free]
        gram = part.T @ part
        step = np.linalg.lstsq(gram + damping * (np.diag(np.diag(gram)) + 1e-12 * np.eye(len(free))), part.T @ rate)[0]
        trial = x.copy()
        trial[free] -= step
        after = rates(trial)[0]
        better = np.isfinite(after).all() and after @ after < error
        x, damping = (trial, 0.3 * damping) if better else (x, 10 * damping)
        if damping > 1e9:
            break
    return x


def start_prior(rig: Rig, system: Equations, data: Dataset) -> tuple[Gaussian, tuple[bool, ...]]:
    """Prior of the first state, and which of its entries nobody declared or read (EM learns those)."""
    y, u = np.asarray(data.y), np.asarray(data.u)[np.asarray(data.valid)]
    columns = {system.state_of(name): i for i, name in enumerate(rig.measured)}
    known = {i: float(np.nanmean(y[..., columns[name]])) for i, name in enumerate(system.states) if name in columns}
    known |= {i: rig.start[name].mean for i, name in enumerate(system.states) if name in rig.start and i not in known}
    rest = resting(system, known, u.mean(axis=0))
    means, stds, learned = [], [], []
    # Standard deviation of the start of a state that nobody declares or reads, in its size where the equations rest
    hidden = 0.5
    for i, name in enumerate(system.states):
        read = name in columns
        if name in rig.start:
            mean, std = rig.start[name].mean, max(rig.start[name].std, 1e-9)
        elif read:
            signal = y[..., columns[name]]
            first = np.array([s[np.isfinite(s)][0] for s in signal if np.any(np.isfinite(s))])
            mean, std = float(first.mean()), float(np.hypot(first.std(), 0.3 * np.nanstd(signal)) + 1e-9)
        else:
            mean, std = float(rest[i]), hidden * abs(float(rest[i])) + 1e-9
            std = std if std > 1e-6 else 1.0
        means.append(mean)
        stds.append(std)
        learned.append(name not in rig.start and not read)
    return Gaussian(jnp.asarray(means, float), jnp.asarray(np.diag(np.square(stds)), float)), tuple(learned)


def motion(model: StateSpaceModel, data: Dataset) -> Motion:
    """Simulation of all sequences from the mean of the start; where it runs away, its finite part."""
    valid = np.asarray(data.valid)
    x = np.asarray(_simulated(model, jnp.asarray(data.u, float)))
    inside = valid & np.isfinite(x).all(axis=-1)
    x, u = x[inside], np.asarray(data.u)[inside]
    rate, slope = (np.asarray(a) for a in _rates(model.system, jnp.asarray(x), jnp.asarray(u, float)))
    sound = np.isfinite(rate).all(axis=-1) & np.isfinite(slope).all(axis=(1, 2))
    values = np.linalg.eigvals(slope[sound]) if sound.any() else np.zeros((1, 1))
    decay = np.median(np.max(np.where(values.real < 0, values.real, -np.inf), axis=1))
    slowest = -1 / float(decay) if np.isfinite(decay) else math.inf
    return Motion(x[sound], u[sound], rate[sound], float(np.percentile(np.abs(values), 99)), slowest)


@eqx.filter_jit
def _simulated(model: StateSpaceModel, u: Float[Array, "seq time input"]) -> Float[Array, "seq time state"]:
    step = lambda x, row: (model.transition(x, Inputs.held(row)), x)  # noqa: E731
    return jax.vmap(lambda u: jax.lax.scan(step, model.start.mean, u)[1])(u)


def pace_of(rig: Rig, slowest: float, rows: int) -> float:
    """The declared horizon, or some time constants, as far as the recordings are long [s]; of two digits: programs are
    shared.
    """
    # Time in which horizons are counted, in slowest time constants: half of that later a start has no effect any more,
    # and errors are those of a free simulation
    constants = 8.0
    horizon_share = 1 / 3  # longest such time, as a share of a recording: a prediction needs a start before it
    pace = rig.horizon or min(constants * slowest, horizon_share * rows * rig.dt)
    return float(f"{max(pace, 8 * rig.dt):.2g}")


def unknown_terms(system: Equations, seen: Motion, names: tuple[str, ...]) -> tuple[UnknownTerm, ...]:
    """The declared unknown terms, zero, free of what a change of the parameters `names` does along the motion."""
    of, out, every = system.of, [], (*system.states, *system.inputs)
    places = [(name, name, signals) for name, signals in of.terms.items()]
    places += [(name, state, signals) for name, (state, signals) in of.enters.items()]
    values = np.concatenate([seen.x, seen.u], axis=1)
    for label, port, signals in places:
        low, high = (f(values[:, [every.index(name) for name in signals]], axis=0) for f in (np.min, np.max))
        out.append(free_term(system, seen, names, port, signals, low, np.maximum(high, low + 1e-9), label))
    return tuple(out)


def free_term(
    system: Equations,
    seen: Motion,
    names: tuple[str, ...],
    port: str,
    signals: tuple[str, ...],
    low: Float[np.ndarray, " axis"],
    high: Float[np.ndarray, " axis"],
    label: str = "",
) -> UnknownTerm:
    """An unknown term at a port, zero: its basis is orthogonal to the slopes of all rates by the parameters."""
    count = NODES[len(signals)] ** len(signals)
    plain = UnknownTerm(jnp.zeros(count), np.eye(count), low, high, channel=port, reads=signals, label=label)
    every = (*system.states, *system.inputs)
    index = np.asarray([every.index(name) for name in signals])
    moved, slopes = _directions(
        system, plain, names, system.ports.index(port), index, jnp.asarray(seen.x), jnp.asarray(seen.u)
    )
    overlap = np.einsum("rsp,rsn->pn", np.asarray(slopes), np.asarray(moved))
    size = np.linalg.norm(overlap, axis=1, keepdims=True)
    _, strength, axes = np.linalg.svd(overlap / np.where(size > 0, size, 1.0))
    rank = int(np.sum(strength > 1e-9 * max(float(strength.max(initial=0.0)), 1e-300)))
    basis = axes[rank:]
    return UnknownTerm(jnp.zeros(len(basis)), basis, low, high, channel=port, reads=signals, label=label)


@eqx.filter_jit
def _directions(system: Equations, term: UnknownTerm, names: tuple[str, ...], port: int, index, x, u):
    """Change of all rates by the basis functions of a term, and by the parameters, along a motion."""
    still = jnp.zeros(len(system.ports))

    def one(x, u):
        rate = lambda push: jnp.stack(system.slopes(x, x[:0], u, push))  # noqa: E731
        by_push = jax.jacfwd(rate)(still)[:, port]

        def by_values(values):
            changed = system.with_parameters(dict(zip(names, values, strict=True)))
            return jnp.stack(changed.slopes(x, x[:0], u, still))

        slopes = jax.jacfwd(by_values)(jnp.stack([system.values[name] for name in names])) if names else still[:0]
        slopes = slopes if names else jnp.zeros((x.shape[0], 0))
        return by_push[:, None] * term.grid(jnp.concatenate([x, u])[index])[None], slopes

    return jax.vmap(one)(x, u)


def build_equations(rig: Rig, system: Equations, data: Dataset):
    """Model that EM starts from, with noise as large as motion over a step; the prior of its parameters, entries of the
    start and readings whose noise is learned, and the log of the variance of the readings' noise in the logs.
    """
    start, learned = start_prior(rig, system, data)
    count, ports = len(system.states), len(system.ports)
    noise = [rig.noise_std.get(n) for n in rig.measured]
    least = [max(reading_noise(np.asarray(data.y)[..., i]), 1e-9) for i in range(len(rig.measured))]
    model = StateSpaceModel(
        system=system,
        unknown=NoFriction(jnp.ones(ports), jointless=True),
        start=start,
        log_q=jnp.zeros(count),
        log_r=jnp.asarray([2 * math.log(n or 2 * s) for n, s in zip(noise, least, strict=True)], float),
        measured=tuple(system.readable.index(name) for name in rig.measured),
        dt=rig.dt,
        smooth=rig.input_hold == SMOOTH,
    )
    seen = motion(model, data)
    size = np.sqrt(np.mean(seen.rate**2, axis=0)) if len(seen.rate) else np.ones(count)
    size = np.maximum(size, 1e-3 * size.max() + 1e-12)
    rows = int(np.max(np.sum(np.asarray(data.valid), axis=1)))
    scale = np.concatenate([size, np.full(ports - count, size.max())])
    free = tuple(n for n, d in rig.parameters.items() if d.std > 0)
    pairs = np.array([(rig.parameters[n].mean, rig.parameters[n].std) for n in free]).reshape(-1, 2)
    prior = ParameterPrior(free, jnp.asarray(pairs[:, 0], float), jnp.asarray(pairs[:, 1], float))
    stretch = 0.5  # integration step in fastest time constants, of which the classical Runge-Kutta method bears 2.8
    model = dataclasses.replace(
        model,
        unknown=NoFriction(jnp.asarray(scale, float), jointless=True),
        log_q=jnp.asarray(2 * np.log(size * rig.dt), float),
        substeps=min(max(1, 2 ** math.ceil(math.log2(max(seen.fastest * rig.dt / stretch, 1.0)))), MOST_STEPS),
        pace=pace_of(rig, seen.slowest, rows),
    )
    terms = unknown_terms(system, seen, free)
    for place, term in enumerate(terms):  # as large as what moves the port
        size = np.full(term.weights.shape, scale[system.ports.index(str(term.channel))])
        names = (*prior.names, f"{place}.weights")
        prior = ParameterPrior(names, jnp.append(prior.mean, 0 * size), jnp.append(prior.std, jnp.asarray(size)))
    model = with_effects(model, terms)
    quiet = jnp.asarray(2 * np.log(least), float)
    return model, prior, learned, tuple(n is None for n in noise), quiet
