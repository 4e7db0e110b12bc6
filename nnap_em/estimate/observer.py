"""A fitted model on the running machine: states and their covariance, one row of readings after the other.

The filter is that of `smoother/kalman.py`, or where an angle is not read the mixture of `smoother/mixture.py`. Beside
it an online estimate has a gate for outliers, an end of branches that lose, and a new start after divergence.
[Bar-Shalom, Li & Kirubarajan 2001, "Estimation with Applications to Tracking and Navigation", secs. 3.4 and 5.4]
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from ..base.gaussian import MOST_UNROLLED, Gaussian, symmetric
from ..model import hooks
from ..model.friction import FrictionNetwork
from ..model.state_space import Inputs, StateSpaceModel
from .identify import Identified
from .smoother.kalman import CUBATURE, absorbed, linear_reading, moved
from .smoother.mixture import WIDE_STD, Components, alone, merged, split

GATE = 6.0
"""Innovation beyond which a reading is an outlier [standard deviations]."""
SETTLING = 10
"""Rows after a start in which there is no gate."""
FORGET = 0.02
"""Weight of a row in the mean of squared innovations."""
DIVERGED = 9.0
"""Mean of squared innovations from which on the estimate starts anew: three standard deviations, where one is right;
fourteen rows in a row beyond the gate."""
BRANCHES = 16
"""Gaussians at most, where an angle is not read."""
BRANCH_END = 1e-7
"""Probability of a branch below which it ends."""
TWIN = 0.1
"""Distance in every state [standard deviations] below which a branch is the likeliest one."""
LARGEST_STATE = 1e6
"""Largest size of a state: beyond is no number of a machine, and sines have no digits."""

MISSING, OUTLIER, NO_INPUT, RESTARTED, AMBIGUOUS = 1, 2, 4, 8, 16
"""Bits of the flags of a row: some reading is no number; some reading was beyond the gate; an input is no number, and
the one before holds; the estimate had diverged and has started anew; more than one branch is left."""


class Observation(NamedTuple):
    """State of an observer after a row: the estimate, its test, and the memory for the next row."""

    mean: Float[Array, " state"]
    """Mean of the likeliest branch: coordinates, rates, memory of laws [rad and rad/s, or m and m/s]."""
    cov: Float[Array, "state state"]
    innovation: Float[Array, " obs"]
    """Readings minus their prediction, over the standard deviation, one at a time; 0 where there was none."""
    misfit: Float[Array, ""]
    """Mean of squared innovations over some fifty rows: 1 where the model is right."""
    weight: Float[Array, ""]
    """Probability of the likeliest branch."""
    flags: Int[Array, ""]
    """Bits of `MISSING`, `OUTLIER`, `NO_INPUT`, `RESTARTED` and `AMBIGUOUS`."""
    memory: Float[Array, " memory"]
    """Memory for the next row, `_Memory` as one array: each array of a state costs 5 us a step outside of a loop."""


class _Memory(NamedTuple):
    """State of the filter between rows: all branches with the log of their weights, 0 for the likeliest and -inf for a
    free place; memory of what lies between commands and drives, inputs that are held, what they and those of the row
    before set at the drives; readings that wait for the input of their row, else NaN; time on the clock of the logs and
    since the first row, below 0 before it [s]; rows since the last start, up to `SETTLING`."""

    branches: Gaussian
    log_weight: Float[Array, " branch"]
    commands: Any
    u: Float[Array, " column"]
    fed: Float[Array, " input"]
    past: Float[Array, " input"]
    late: Float[Array, " obs"]
    time: Float[Array, ""]
    age: Float[Array, ""]
    rows: Float[Array, ""]


class Observer(NamedTuple):
    """A filter as two pure functions, for `jax.jit`, `jax.vmap` and `jax.lax.scan`."""

    start: Callable[..., Observation]
    """`start(time=0.0)`: the prior of the first row, and its time on the clock of the logs [s]."""
    step: Callable[[Observation, Float[Array, " column"], Float[Array, " obs"]], Observation]
    """`step(state, u, y)`: `u` are the inputs held from the row before to this one, `y` its readings; NaN is none.

    In the first row `u` counts for nothing.  With a first-order hold `u` are the inputs of the row itself."""
    states: tuple[str, ...]
    """Names of the states that are coordinates and rates."""
    inputs: tuple[str, ...]
    """Columns of `u`."""
    measured: tuple[str, ...]
    """Columns of `y`."""


class _Row(NamedTuple):
    """Inputs and readings of one row, as the filter takes them: `held` over the interval before, `here` at readings."""

    first: Bool[Array, ""]
    y: Float[Array, " obs"]
    read: Bool[Array, " obs"]
    gate: Float[Array, ""]
    held: Inputs
    here: Inputs
    flags: Int[Array, ""]


def observer(fitted: Identified) -> Observer:
    """The model of a fit as an online estimator, a row every `rig.dt` seconds.

    A reading that depends on the input of its own row, an acceleration, counts one row later.

    Args:
        fitted: the model.

    Returns:
        Pure functions `start` and `step(state, u, y)`; NaN means no reading.

    Raises:
        ValueError: an effect on the command cannot be computed row by row, or the rig is written as equations.

    Example:
        >>> online = nnap_em.observer(fit)
        >>> state = online.step(online.start(), jnp.asarray(test.u[0, 0]), jnp.asarray(test.y[0, 0]))
        >>> state.mean.shape
        (2,)
    """
    rig, model = fitted.rig, fitted.model
    if rig.equations:
        raise ValueError(f"observer: rig {rig.name!r} is written as equations; this needs a machine with joints")
    return Observer(
        *functions(model, fitted.bank.angles, restart_prior(model), BRANCHES if fitted.bank.angles else 1),
        model.system.coordinates + model.system.rates,
        rig.input_columns + rig.scale_columns,
        rig.measured,
    )


def restart_prior(model: StateSpaceModel) -> Gaussian:
    """Prior of a machine in motion: anywhere in a turn, at a third of the largest rate; else ten times the first."""
    system, std = model.system, np.sqrt(np.diag(np.asarray(model.start.cov)))
    dof, unknown = len(system.coordinates), model.unknown
    place = np.where(np.asarray(system.angles[:dof]), math.pi / 2, 10 * std[:dof])
    rate = np.asarray(unknown.speed) / 3 if isinstance(unknown, FrictionNetwork) else 10 * std[dof : 2 * dof]
    wide = np.maximum(std, np.concatenate([place, rate, std[2 * dof :]]))
    return Gaussian(model.start.mean, jnp.diag(jnp.asarray(wide**2, model.log_q.dtype)))


def functions(
    model: StateSpaceModel, angles: tuple[int, ...], again: Gaussian, branches: int
) -> tuple[Callable[..., Observation], Callable[..., Observation]]:
    """`start` and `step` of a model whose `angles` may be in several places, with the prior of a new start."""
    if isinstance(model.unknown, FrictionNetwork) and model.log_q.shape[0] <= MOST_UNROLLED:
        model = dataclasses.replace(model, unknown=model.unknown.by_entry())
    commands = hooks.command_stream(model.effects, model.servos, model.system, model.rows)
    dtype, drives, dof = model.log_q.dtype, len(model.system.joints), len(model.system.coordinates)
    smooth = model.smooth
    q, r = jnp.diag(jnp.exp(model.log_q)), jnp.exp(model.log_r)
    waits = np.asarray([place >= 2 * dof and not smooth for place in model.measured])
    columns = drives + len({place for servo in model.servos or () for _, place, _ in servo.scales})
    zero = jnp.zeros((), dtype)

    nothing = jnp.zeros(len(waits), dtype)
    blank = _Memory(
        *alone(model.start, branches), commands.memory, jnp.zeros(columns, dtype), jnp.zeros(drives, dtype),
        past=jnp.zeros(drives, dtype), late=nothing + jnp.nan, time=zero, age=zero - model.dt, rows=zero,
    )  # fmt: skip
    unpacked = ravel_pytree(blank)[1]

    def start(time: float | Float[Array, ""] = 0.0) -> Observation:
        begun = blank._replace(time=jnp.asarray(time, dtype) - model.dt)
        return Observation(*model.start, nothing, zero + 1, zero + 1, jnp.asarray(0), ravel_pytree(begun)[0])

    def taken(state: _Memory, u: Float[Array, " column"], y: Float[Array, " obs"]) -> tuple[_Row, _Memory]:
        first, sound, read = state.age < -0.5 * model.dt, jnp.isfinite(u), jnp.isfinite(y)
        u = jnp.where(first & (not smooth), 0.0, jnp.where(sound, u, state.u))
        memory, fed = commands.step(state.commands, u, first if smooth else state.age < 0.5 * model.dt)
        if not smooth:
            memory, fed = jax.tree.map(lambda a, b: jnp.where(first, a, b), (state.commands, state.fed), (memory, fed))
        scale, time, age = u[drives:] if columns > drives else None, state.time + model.dt, state.age + model.dt
        held = Inputs(fed, state.fed, state.time + 0.5 * model.dt, state.age, scale)
        here = Inputs(fed, fed, time + 0.5 * model.dt, age, scale)  # `fed` stands for what is not decided yet
        if smooth:
            scaled, change = None if scale is None else state.u[drives:], fed - state.fed
            bend = jnp.where(state.age > 0.5 * model.dt, change - state.fed + state.past, 0.0)
            held = held._replace(u=state.fed, scale=scaled, course=jnp.stack([change, bend]))
            here = here._replace(before=state.fed, course=jnp.zeros((2, drives), dtype))
        gate = jnp.where(state.rows < SETTLING, jnp.inf, GATE)
        flags = _bits({MISSING: ~jnp.all(read), NO_INPUT: ~jnp.all(sound) & (smooth | ~first)})
        late, rows = jnp.where(read & waits, y, jnp.nan), jnp.minimum(state.rows + 1, SETTLING)
        after = _Memory(state.branches, state.log_weight, memory, u, fed, state.fed, late, time, age, rows)
        return _Row(first, jnp.where(read, y, 0.0), read & ~waits, gate, held, here, flags), after

    def filtered(x: Gaussian, row: _Row, late: Float[Array, " obs"]) -> tuple[Gaussian, Array, Array]:
        before = jnp.zeros_like(late), jnp.zeros_like(late)
        if waits.any():
            y, waited = jnp.nan_to_num(late), jnp.isfinite(late)
            x, *before, _ = absorbed(x, linear_reading(model, x.mean, row.held), r, y, waited, row.gate)
        _, ahead = moved(x, CUBATURE(model, x, row.held), q, ~row.first)
        now = absorbed(ahead, linear_reading(model, ahead.mean, row.here), r, row.y, row.read, row.gate)
        return now[0], before[0] + now[1], before[1] + now[2]

    def step(before: Observation, u: Float[Array, " column"], y: Float[Array, " obs"]) -> Observation:
        state = unpacked(before.memory)
        (row, after), live = taken(state, u, y), jnp.isfinite(state.log_weight)
        best = jnp.argmax(state.log_weight)
        every, innovation, log_variance = _every(
            lambda x: filtered(x, row, state.late), state.branches, best, jnp.sum(live) == 1
        )
        lost = jnp.sum(jnp.minimum(innovation**2, row.gate**2) + log_variance, axis=1)
        log_weight = jnp.where(live & jnp.isfinite(lost), state.log_weight - 0.5 * lost, -jnp.inf)
        best = jnp.argmax(log_weight)
        count = jnp.sum(row.read) + jnp.sum(jnp.isfinite(state.late))
        square = jnp.sum(jnp.minimum(innovation[best] ** 2, GATE**2)) / jnp.maximum(count, 1).astype(dtype)
        misfit = before.misfit + jnp.where(count > 0, FORGET, 0.0) * (square - before.misfit)
        known = jnp.all(jnp.abs(every.mean[best]) < LARGEST_STATE) & jnp.all(jnp.isfinite(every.cov[best]))
        sane = (misfit < DIVERGED) & known & jnp.isfinite(log_weight[best])
        innovation = jnp.where(sane, innovation[best], 0.0)

        afresh, *_ = absorbed(again, linear_reading(model, again.mean, row.here), r, row.y, row.read)
        every, log_weight = jax.tree.map(
            lambda a, b: jnp.where(sane, a, b), (every, log_weight), alone(afresh, branches)
        )
        if branches > 1:
            every, log_weight = _branched(every, log_weight, angles)
        best = jnp.argmax(log_weight)
        (mean, cov), log_weight = jax.tree.map(lambda a: a[best], every), log_weight - log_weight[best]
        outlier, ambiguous = jnp.any(innovation**2 > row.gate**2), jnp.sum(jnp.isfinite(log_weight)) > 1
        after = after._replace(branches=every, log_weight=log_weight, rows=jnp.where(sane, after.rows, 1.0))
        return Observation(
            mean, cov, innovation, jnp.where(sane, misfit, 1.0), 1 / jnp.sum(jnp.exp(log_weight)),
            row.flags + _bits({OUTLIER: outlier, RESTARTED: ~sane, AMBIGUOUS: ambiguous}), ravel_pytree(after)[0],
        )  # fmt: skip

    return start, jax.jit(step)


def _bits(flags: dict[int, Bool[Array, ""]]) -> Int[Array, ""]:
    return jnp.sum(jnp.stack([jnp.where(holds, bit, 0) for bit, holds in flags.items()]))


def _every(row: Callable, branches: Gaussian, best: Int[Array, ""], alone: Bool[Array, ""]):
    """`row` of every branch; of one only where the others are free places."""

    def one(branches):
        outcome = row(jax.tree.map(lambda a: a[best], branches))
        return jax.tree.map(lambda a: jnp.broadcast_to(a, (branches.mean.shape[0], *a.shape)), outcome)

    return one(branches) if branches.mean.shape[0] == 1 else jax.lax.cond(alone, one, jax.vmap(row), branches)


def _branched(
    every: Gaussian, log_weight: Float[Array, " branch"], angles: tuple[int, ...]
) -> tuple[Gaussian, Float[Array, " branch"]]:
    """Branches after one that has become wide is split, and without those that have lost."""
    places, log_weight = jnp.arange(len(log_weight)), log_weight - jnp.max(log_weight)
    width = jnp.max(jnp.diagonal(every.cov, axis1=1, axis2=2)[:, jnp.asarray(angles)], axis=1)

    def parted(parts: Components) -> Components:
        return merged(merged(split(parts, angles, WIDE_STD)))

    whole = Components(every, log_weight, places)
    whole = jax.lax.cond(jnp.any((width > WIDE_STD**2) & jnp.isfinite(log_weight)), parted, lambda parts: parts, whole)
    (mean, cov), log_weight, _ = whole
    best = jnp.argmax(log_weight)
    std = jnp.sqrt(jnp.diagonal(cov, axis1=1, axis2=2))
    near = lambda a: jnp.all(jnp.abs(a - a[best][None]) < TWIN * std[best][None], axis=1)  # noqa: E731
    twin = near(mean) & near(std) & (places != best)
    share = jnp.where(twin, jnp.exp(log_weight - log_weight[best]), 0.0)
    log_weight = jnp.where(twin | (log_weight < log_weight[best] + math.log(BRANCH_END)), -jnp.inf, log_weight)
    return Gaussian(mean, symmetric(cov)), log_weight.at[best].add(jnp.log1p(jnp.sum(share)))
