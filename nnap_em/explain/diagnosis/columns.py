"""Columns of candidates along the smoothed motion: force and reading of each of their probes."""

import itertools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...base.gaussian import Gaussian
from ...base.ode import integrate
from ...base.parallel import each
from ...estimate.em.multistep import Columns
from ...logs.dataset import whole_step
from ...model import hooks
from ...model.effects import AbstractEffect, Candidate, OperatingPoint
from ...model.state_space import Inputs, StateSpaceModel

Blocks = Sequence[Sequence[Candidate]]


class Track(NamedTuple):
    """The fitted model along the smoothed path of a sequence, in a form that does not depend on its structure."""

    middle: Float[Array, "*time state"]
    acceleration: Float[Array, "*time dof"]
    """State (q, v) and acceleration [rad/s^2] in the middle of every step."""
    drive: Float[Array, "*time dof"]
    """Generalised force of the inputs over every step [N m]."""
    friction: Float[Array, "*time dof"]
    """Torque of the learned map in the middle of every step [N m]."""
    true: Float[Array, "*time readable"]
    rate: Float[Array, "*time readable"]
    """Readings of sensors without a fault in every row, and their time derivative."""
    inputs: Inputs


def tracks(null: StateSpaceModel, path: Gaussian, inputs: Inputs) -> Track:
    """The smoothed motion of all sequences."""
    return each(_track, null, (path.mean, inputs))


def _track(null: StateSpaceModel, one) -> Track:
    mean, inputs = one
    dof = len(null.system.coordinates)
    still = jnp.zeros(dof, mean.dtype)
    rate = jax.vmap(lambda x, u: null.rate(x, u, still))
    rates = rate(mean, inputs)
    middle = mean + 0.5 * null.dt * rates
    between = inputs.at(0.5)
    acceleration = rate(middle, between)[:, dof : 2 * dof]
    along = lambda x, rate, u: jax.jvp(lambda x: null.true(x, u), (x,), (rate,))  # noqa: E731
    true, past = jax.vmap(along)(mean, rates, inputs)
    past = past.at[0].set(0.0)  # the first row has none
    drive = jax.vmap(lambda x, u: null.scene(x, u).drive)(middle, between)
    friction = jax.vmap(null.unknown)(middle[:, dof : 2 * dof])
    return Track(middle[:, : 2 * dof], acceleration, drive, friction, true, past, inputs)


def _columns(base: StateSpaceModel, effect: AbstractEffect, track: Track, scenes: OperatingPoint) -> Columns:
    """Columns that `effect` adds, by its own hooks, to the machine `base` along a track."""
    alone, system, substeps = (effect,), base.system, max(effect.substeps, base.substeps)
    drive, plain = (base.driving(laws, track.middle, track.inputs) for laws in (alone, ()))
    driven, whole = scenes._replace(drive=drive), {"system": system, "map": base.unknown}  # no numbers for a batch

    def remember(m, scene):
        return integrate(lambda m: hooks.drift(alone, scene._replace(**whole), m), m, base.dt, substeps), m

    memory = jnp.zeros((track.middle.shape[0], effect.memory), track.middle.dtype)
    if effect.memory:
        _, memory = jax.lax.scan(remember, memory[0], driven)

    one = lambda scene, *rest: hooks.added(alone, scene._replace(**whole), *rest)  # noqa: E731
    force = jax.vmap(one)(driven, memory, track.acceleration) + drive - plain

    def read(true, rate):
        read = hooks.read(alone, system.readable, true, lambda delay: true - delay * rate)
        return jnp.stack([read[i] - true[i] for i in base.measured])

    return Columns(force, jax.vmap(read)(track.true, track.rate))


COLUMNS_AT_ONCE = 1024
"""Columns that are computed and propagated at once: some 100 MB a sequence of a six-axis arm."""


def _stack(probes: Sequence[AbstractEffect]) -> tuple[AbstractEffect, AbstractEffect]:
    """Probes of one structure stacked, and the axis of the stack in every leaf, None where all are the same: what a
    basis shares is then computed once.  By NumPy: a stack of arrays would be one program for every number of them.
    """
    flat, structure = [jax.tree.leaves(probe) for probe in probes], jax.tree.structure(probes[0])
    stacked = [np.stack([np.asarray(leaf) for leaf in leaves]) for leaves in zip(*flat, strict=True)]
    constants = [bool((a == a[0]).all()) for a in stacked]
    if all(constants):  # one probe, or one given twice
        constants = [False] * len(constants)
    bunch = 4  # stacks are filled up to a multiple of this and to a whole step, so that one more probe is no program
    more = -(-whole_step(len(probes)) // bunch) * bunch - len(probes)
    pad = lambda a: np.pad(a, [(0, more)] + [(0, 0)] * (a.ndim - 1), mode="edge")  # noqa: E731
    leaves = [np.asarray(a[0]) if constant else pad(a) for a, constant in zip(stacked, constants, strict=True)]
    axes = [None if constant else 0 for constant in constants]
    return jax.tree.unflatten(structure, leaves), jax.tree.unflatten(structure, axes)


def _stack_columns(common, track: Track) -> list[Columns]:
    """Columns of some stacks of probes: the same program whatever the model has learned meanwhile, and beside what."""
    base, stacks = common
    dof = len(base.system.coordinates)
    q, v = track.middle[:, :dof], track.middle[:, dof:]
    scenes = OperatingPoint(None, q, v, track.drive, track.inputs.time, track.friction, None)  # type: ignore[arg-type]
    one = lambda e: _columns(base, e, track, scenes)  # noqa: E731
    return [jax.vmap(one, in_axes=(axes,))(stack) for stack, axes in stacks]


def blocks_of(candidates: Sequence[Candidate]) -> Blocks:
    """Candidates in blocks of about COLUMNS_AT_ONCE columns: those of all at six joints would be gigabytes."""
    ends = itertools.accumulate(len(candidate.probes) for candidate in candidates)
    numbered = zip((end // COLUMNS_AT_ONCE for end in ends), candidates, strict=True)
    return [[one for _, one in same] for _, same in itertools.groupby(numbered, lambda pair: pair[0])]


def candidate_columns(
    base: StateSpaceModel, candidates: Sequence[Candidate], size: int = 0, rows: int = 0
) -> Callable[[Track], Columns]:
    """Columns that the probes of all candidates add to `base` along the tracks of some sequences: seq column time ...
    They are padded by columns of 0 to `size`. Tracks are padded to `rows` meanwhile: one program for all lengths.
    """
    places, groups = {}, {}
    probes = [probe for candidate in candidates for probe in candidate.probes]
    for i, probe in enumerate(probes):
        places.setdefault(jax.tree.structure(probe), []).append(i)
    for index in places.values():
        groups.setdefault(type(probes[index[0]]), []).append((index, _stack([probes[i] for i in index])))
    size = max(size, len(probes))

    def along(track: Track) -> Columns:
        length, middle = track.middle.shape[1], track.middle
        longer = lambda a: np.pad(a, [(0, 0), (0, max(0, rows - length)), *[(0, 0)] * (a.ndim - 2)], mode="edge")  # noqa: E731
        padded = jax.tree.map(longer, track)
        last = track.acceleration.shape[-1], len(base.measured)
        force, reading = (np.zeros((len(middle), size, length, n), middle.dtype) for n in last)
        for group in groups.values():  # a program for every class
            every = each(_stack_columns, (base, [stack for _, stack in group]), padded)
            for (index, _), columns in zip(group, every, strict=True):
                for full, values in ((force, columns.force), (reading, columns.reading)):
                    full[:, index] = np.asarray(values)[:, : len(index), :length]
        return Columns(force, reading)

    return along
