"""First model of EM of a plant that is written as equations: scales by its states along the readings."""

import dataclasses
import math
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.optimize import least_squares

from ...base.digits import counted
from ...base.gaussian import Gaussian
from ...base.parallel import each
from ...logs.dataset import Dataset
from ...logs.noise import fast_reading_noise
from ...logs.read import Logs
from ...machines.rig import SMOOTH, Rig
from ...machines.systems.equations import Equations
from ...model.effects.equations import NODES, UnknownTerm
from ...model.friction import NoFriction
from ...model.state_space import MOST_STEPS, StateSpaceModel, with_effects
from .prior import ParameterPrior, declared_prior
from .simulated import filter_path


class Motion(NamedTuple):
    """States along the readings, by which scales are measured."""

    x: Float[np.ndarray, "row state"]
    u: Float[np.ndarray, "row input"]
    rate: Float[np.ndarray, "row state"]
    """Derivatives of the equations there [1/s]."""
    fastest: float
    """Largest eigenvalue of the linearised equations [1/s]."""
    slowest: float
    """Longest time constant [s]; infinite where nothing decays."""
    growth: float = 0.0
    """Rate at which neighbouring trajectories leave each other, in the states `unstable` [1/s]; 0 where they do not."""
    unstable: tuple[str, ...] = ()
    kept: tuple[str, ...] = ()
    """States that keep a change of their start: integrators."""
    slope: Any = 0.0
    """Root mean square of the slopes of the states themselves, over a twentieth of a recording [1/s]."""

    @property
    def size(self) -> Float[np.ndarray, " state"]:
        """Root mean square of the rates, by the equations or the states; a thousandth of the largest at least."""
        size = np.sqrt(np.mean(self.rate**2, axis=0)) if len(self.rate) else np.ones(self.x.shape[1])
        size = np.maximum(size, self.slope)
        return np.maximum(size, 1e-3 * size.max() + 1e-12)


@eqx.filter_jit
def _rates(system: Equations, x: Float[Array, "row state"], u: Float[Array, "row input"]):
    """Derivatives and their Jacobians."""
    still = jnp.zeros(len(system.ports))
    rate = lambda x, u: jnp.stack(system.slopes(x, x[:0], u, still))  # noqa: E731
    return jax.vmap(rate)(x, u), jax.vmap(jax.jacfwd(rate))(x, u)


def resting(system: Equations, known: dict[int, float], u: Float[np.ndarray, " input"]) -> Float[np.ndarray, " state"]:
    """State of the least sum of squared rates at inputs `u`, with some states as they are `known`; from 1, or 1."""
    x = np.array([known.get(i, 1.0) for i in range(len(system.states))])
    free = [i for i in range(len(x)) if i not in known]

    def rates(z: np.ndarray) -> list[np.ndarray]:
        x[free] = z
        return [np.asarray(a)[0] for a in _rates(system, jnp.asarray(x[None], float), jnp.asarray(u[None], float))]

    if free and all(np.isfinite(part).all() for part in rates(x[free])):
        jac = lambda z: rates(z)[1][:, free]  # noqa: E731
        x[free] = least_squares(lambda z: rates(z)[0], x[free], cast(Any, jac), x_scale="jac", max_nfev=100).x
    return x


def start_prior(rig: Rig, system: Equations, data: Dataset) -> tuple[Gaussian, tuple[bool, ...]]:
    """Prior of the first state, and which of its entries nobody declared or read (EM learns those)."""
    y, u = np.asarray(data.y), np.asarray(data.u)[np.asarray(data.valid)]
    columns = {system.state_of(name): i for i, name in enumerate(rig.measured)}
    known = {i: float(np.nanmean(y[..., columns[name]])) for i, name in enumerate(system.states) if name in columns}
    known |= {i: rig.start[name].mean for i, name in enumerate(system.states) if name in rig.start and i not in known}
    rest = resting(system, known, u.mean(axis=0))
    pairs = []
    for i, name in enumerate(system.states):
        if name in rig.start:
            mean, std = rig.start[name].mean, max(rig.start[name].std, 1e-9)
        elif name in columns:
            signal = y[..., columns[name]]
            first = np.array([s[np.isfinite(s)][0] for s in signal if np.any(np.isfinite(s))])
            mean, std = float(first.mean()), float(np.hypot(first.std(), 0.3 * np.nanstd(signal)) + 1e-9)
        else:
            mean, std = float(rest[i]), 0.5 * abs(float(rest[i])) + 1e-9
            std = std if std > 1e-6 else 1.0
        pairs.append((mean, std))
    means, stds = np.transpose(pairs)
    learned = tuple(name not in rig.start and name not in columns for name in system.states)
    return Gaussian(jnp.asarray(means, float), jnp.asarray(np.diag(np.square(stds)), float)), learned


def motion(model: StateSpaceModel, data: Dataset) -> Motion:
    """States that the filter of a model has along the readings; where it runs away, its finite part."""
    path, step, _ = (np.asarray(a) for a in each(filter_path, model, jax.device_put(data)))
    valid, count = np.asarray(data.valid), len(model.system.states)
    seen = _along(model.system, path[valid], np.asarray(data.u)[valid])
    width = np.std(seen.x[:, :count], axis=0) if len(seen.x) else np.ones(count)
    width = np.where(width > 0, width, 1.0)
    rows = np.sum(valid, axis=1)
    long = (rows >= np.median(rows)) & np.isfinite(path).all(axis=(1, 2))  # as long as half of the sequences are
    step = step[long, : int(np.median(rows)) - 1, :count, :count] * width / width[:, None]
    lag = max(1, int(np.median(rows)) // 20)
    change = np.where(valid[:, lag:, None], path[:, lag:, :count] - path[:, :-lag, :count], np.nan) / (lag * model.dt)
    slope = np.ma.filled(np.ma.mean(np.ma.masked_invalid(change) ** 2, axis=(0, 1)), 0.0) ** 0.5
    return seen._replace(slope=slope, **_modes(model.system.states, step, model.dt))


def _modes(states: tuple[str, ...], step: Float[np.ndarray, "seq time state state"], dt: float) -> dict[str, Any]:
    """Growth, unstable states and integrators by the products of the Jacobians of all steps.

        Phi_k = A_{k-1} ... A_0,   growth = (log |Phi_n| - log |Phi_{n/2}|) / (n/2 dt)

    the largest Lyapunov exponent; an integrator has 1 on the diagonal of Phi_k over the second half.
    [Benettin et al. 1980, Meccanica 15(1), 9]
    """
    half, none = step.shape[1] // 2, np.zeros(len(step))
    if not len(step) or not half:
        return {}
    unit, log, middle, held = np.broadcast_to(np.eye(len(states)), step[:, 0].shape), none, none, []
    for k in range(2 * half):
        unit = step[:, k] @ unit
        norm = np.maximum(np.linalg.norm(unit, axis=(1, 2)), 1e-300)
        unit, log = unit / norm[:, None, None], log + np.log(norm)
        middle = log if k == half - 1 else middle
        held += [np.exp(np.minimum(log, 50.0))[:, None] * np.einsum("sii->si", unit)] if k >= half else []
    # Growth over half a recording [e-folds] from which on a mode is unstable: four integrators in series have 2
    grown, least = float(np.mean(log - middle)), 2.0
    kept = np.abs(np.mean(held, axis=(0, 1)) - 1) < 0.05  # a time constant of twenty recordings counts as none
    if grown < least:
        return {"kept": tuple(name for name, keeps in zip(states, kept, strict=True) if keeps)}
    share = np.mean(np.linalg.svd(unit)[0][:, :, 0] ** 2, axis=0)  # of each state, in its motion
    named = tuple(name for name, part in zip(states, share, strict=True) if part > 0.5 / len(states))
    return {"growth": grown / (half * dt), "unstable": named}


def _along(system: Equations, x: Float[np.ndarray, "row state"], u: Float[np.ndarray, "row input"]) -> Motion:
    """The equations at some states and inputs, those left out where they are not finite."""
    inside = np.isfinite(x).all(axis=-1)
    x, u = x[inside], u[inside]
    rate, slope = (np.asarray(a) for a in _rates(system, jnp.asarray(x), jnp.asarray(u, float)))
    sound = np.isfinite(rate).all(axis=-1) & np.isfinite(slope).all(axis=(1, 2))
    values = np.linalg.eigvals(slope[sound]) if sound.any() else np.zeros((1, 1))
    decay = np.median(np.max(np.where(values.real < 0, values.real, -np.inf), axis=1))
    slowest = -1 / float(decay) if np.isfinite(decay) else math.inf
    return Motion(x[sound], u[sound], rate[sound], float(np.percentile(np.abs(values), 99)), slowest)


def pace_of(rig: Rig, seen: Motion, rows: int) -> float:
    """The declared horizon, or eight slowest time constants, with integrators without end, a third of a recording at
    most; where equations are unstable the time in which errors grow e-fold [s]; of two digits: programs are shared.
    """
    slowest = math.inf if seen.kept else seen.slowest
    pace = rig.horizon or min(8.0 * slowest, rows * rig.dt / 3)
    if seen.growth and not rig.horizon:
        return float(f"{max(min(pace, 1 / seen.growth), 4 * rig.dt):.2g}")
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
    system: Equations, seen: Motion, names: tuple[str, ...], port: str, signals: tuple[str, ...], low, high, label=""
) -> UnknownTerm:
    """An unknown term at a port, zero, of signals from `low` to `high`: its basis is orthogonal to the slopes of all
    rates by the parameters.
    """
    count = NODES[len(signals)] ** len(signals)
    plain = UnknownTerm(jnp.zeros(count), np.eye(count), low, high, channel=port, reads=signals, label=label)
    every = (*system.states, *system.inputs)
    index = np.asarray([every.index(name) for name in signals])
    x, u = jnp.asarray(seen.x), jnp.asarray(seen.u)
    moved, slopes = _directions(system, plain, names, system.ports.index(port), index, x, u)
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


def _scaled(model: StateSpaceModel, seen: Motion) -> StateSpaceModel:
    """The model with process noise as large as motion over a step, and as many steps as its fastest mode requires."""
    scale = np.append(seen.size, np.full(len(model.system.ports) - len(seen.size), seen.size.max()))
    stretch = 0.5  # integration step in fastest time constants, of which the classical Runge-Kutta method bears 2.8
    return dataclasses.replace(
        model,
        unknown=NoFriction(jnp.asarray(scale, float), jointless=True),
        log_q=jnp.asarray(2 * np.log(seen.size * model.dt), float),
        substeps=min(max(1, 2 ** math.ceil(math.log2(max(seen.fastest * model.dt / stretch, 1.0)))), MOST_STEPS),
    )


def infinite_rates(rig: Rig, system: Equations, logs: Logs) -> str:
    """Rates that are not finite in some rows, in the state of the start: files, rows, inputs that are 0; or nothing."""
    u, valid = np.asarray(logs.data.u, float), np.asarray(logs.data.valid)
    x = np.asarray(start_prior(rig, system, logs.data)[0].mean)
    rates = lambda u: np.asarray(_rates(system, jnp.tile(x, (len(u), 1)), jnp.asarray(u))[0])  # noqa: E731
    here, bad = np.zeros_like(valid), ~np.isfinite(rates(u[valid]))
    here[valid] = bad.any(axis=1)
    places = [(file, np.flatnonzero(rows)) for file, rows in zip(logs.files, here, strict=True) if rows.any()]
    if not places:
        return ""
    named = [f"{file}, {counted(len(rows), 'row')} from {rows[0] + 1} to {rows[-1] + 1}" for file, rows in places[:3]]
    named += [f"{len(places) - 3} more"] if len(places) > 3 else []
    mends = []
    for i, name in enumerate(rig.input_columns):
        floor = float(f"{0.05 * np.abs(u[valid][:, i]).max():.1g}")  # a twentieth of what the formula was meant for
        other = np.where(np.arange(u.shape[-1]) == i, floor, u[here])
        if not u[here][:, i].any() and np.isfinite(rates(other)).all():
            signed = f"where({name} < 0, min({name}, -{floor:g}), max({name}, {floor:g}))"
            mend = f"max({name}, {floor:g})" if u[valid][:, i].min() >= 0 else signed
            mends.append(f"{name} is 0 there: write {mend} for {name} in the formulas, or leave these rows out")
    state = ", ".join(f"{name} = {value:.3g}" for name, value in zip(system.states, x, strict=True))
    infinite = ", ".join(name for name, some in zip(system.states, np.any(bad, axis=0), strict=True) if some)
    mend = " or ".join(mends) or f"look at the formulas with the inputs of these rows and {state}"
    return f"the rates of {infinite} are infinite or no number in {'; '.join(named)}; {mend}"


def build_equations(rig: Rig, system: Equations, data: Dataset):
    """Model that EM starts from, with noise as large as motion over a step; the prior of its parameters, entries of the
    start and readings whose noise is learned, and the log of the variance of the readings' noise in the logs.
    """
    start, learned = start_prior(rig, system, data)
    count, ports = len(system.states), len(system.ports)
    noise = [rig.noise_std.get(n) for n in rig.measured]
    least = [max(fast_reading_noise(np.asarray(data.y)[..., i]), 1e-9) for i in range(len(rig.measured))]
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
    u, mean = np.asarray(data.u)[np.asarray(data.valid)], np.asarray(start.mean)
    variance = np.diag(np.asarray(start.cov))
    unit = np.random.default_rng(0).standard_normal((len(u), count))
    seen = _along(system, mean + unit * np.sqrt(variance), u)  # states as the start may be, for the noise of the filter
    for _ in range(2):  # then as they are, the second time by the noise of the first
        seen = motion(_scaled(model, seen), data)
        far = np.mean((seen.x - mean) ** 2, axis=0) if len(seen.x) else variance
        start = Gaussian(start.mean, jnp.asarray(np.diag(np.where(learned, np.maximum(variance, far), variance))))
        model = dataclasses.replace(model, start=start)
    model = _scaled(model, seen)
    rows = int(np.max(np.sum(np.asarray(data.valid), axis=1)))
    prior = declared_prior(rig.parameters)
    model = dataclasses.replace(model, pace=pace_of(rig, seen, rows))
    scale = np.asarray(cast(Any, model.unknown).scale)
    terms = unknown_terms(system, seen, prior.names)
    for place, term in enumerate(terms):  # as large as what moves the port
        size = np.full(term.weights.shape, scale[system.ports.index(str(term.channel))])
        names = (*prior.names, f"{place}.weights")
        prior = ParameterPrior(names, jnp.append(prior.mean, 0 * size), jnp.append(prior.std, jnp.asarray(size)))
    model = with_effects(model, terms)
    quiet = jnp.asarray(2 * np.log(least), float)
    return model, prior, learned, tuple(n is None for n in noise), quiet
