"""What candidates would add along the smoothed motion: force and reading of each of their probes."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..effects import AbstractEffect, Candidate, Scene
from ..em.multistep import Columns
from ..model import hooks
from ..model.state_space import Inputs, StateSpaceModel
from ..numerics.gaussian import Gaussian
from ..numerics.ode import integrate
from ..numerics.parallel import each


class Track(NamedTuple):
    """What candidates see of a fitted model along the smoothed path of a sequence, whatever its structure."""

    x: Float[Array, "*time state"]
    """(q, v) in every row."""
    middle: Float[Array, "*time state"]
    """State (q, v) in the middle of every step."""
    acceleration: Float[Array, "*time dof"]
    """In the middle of every step [rad/s^2]."""
    rate: Float[Array, "*time state"]
    """Time derivative of (q, v) in every row."""
    inputs: Inputs
    """What acts on the fitted model from outside."""


def tracks(null: StateSpaceModel, path: Gaussian, inputs: Inputs) -> Track:
    """The smoothed motion of all sequences."""
    return each(_track, null, (path.mean, inputs))


def _track(null: StateSpaceModel, one) -> Track:
    mean, inputs = one
    dof = len(null.system.coordinates)
    still = jnp.zeros(dof, mean.dtype)
    rate = jax.vmap(lambda x, u: null.rate(x, u, still))
    now = rate(mean, inputs)
    middle = mean + 0.5 * null.dt * now
    acceleration = rate(middle, inputs)[:, dof : 2 * dof]
    past = now[:, : 2 * dof].at[0].set(0.0)  # the first row has none
    return Track(mean[:, : 2 * dof], middle[:, : 2 * dof], acceleration, past, inputs)


def _columns(base: StateSpaceModel, effect: AbstractEffect, track: Track, scenes: Scene) -> Columns:
    """What `effect` adds, by its own hooks, to the machine `base` along a track."""
    alone, system, substeps = (effect,), base.system, max(effect.substeps, base.substeps)
    x = track.x
    drive = jax.vmap(system.drive)(hooks.reaching(alone, system, track.inputs.u, base.dt))
    driven = scenes._replace(drive=drive)

    def remember(m, scene):
        return integrate(lambda m: hooks.drift(alone, _scene(base, scene), m), m, base.dt, substeps), m

    memory = jnp.zeros((x.shape[0], effect.memory), x.dtype)
    if effect.memory:
        _, memory = jax.lax.scan(remember, memory[0], driven)

    def one(scene, memory, acceleration):
        return hooks.added(alone, _scene(base, scene), memory, acceleration)

    force = jax.vmap(one)(driven, memory, track.acceleration) + drive - scenes.drive

    def read(x, rate):
        read = hooks.read(alone, system.coordinates + system.rates, x, lambda delay: x - delay * rate)
        return jnp.stack([read[i] - x[i] for i in base.measured])

    return Columns(force, jax.vmap(read)(x, track.rate))


def _scene(base: StateSpaceModel, numbers: Scene) -> Scene:
    """A scene whose numbers came through a batch."""
    return numbers._replace(system=base.system, map=base.unknown)


BUNCH = 4
"""Stacks are filled up to a multiple of this, so that one more probe is no other program."""


def _groups(probes: Sequence[AbstractEffect]) -> list[tuple[list[int], AbstractEffect]]:
    """Probes of one structure stacked, so that each structure is compiled once."""
    places: dict = {}
    for i, probe in enumerate(probes):
        places.setdefault(jax.tree.structure(probe), []).append(i)

    def stack(*leaves):  # by NumPy: a stack of many small arrays would be one program for every number of them
        more = (0, -len(leaves) % BUNCH)
        whole = np.stack([np.asarray(leaf) for leaf in leaves])
        return jnp.asarray(np.pad(whole, [more] + [(0, 0)] * (whole.ndim - 1), mode="edge"))

    return [(index, jax.tree.map(stack, *(probes[i] for i in index))) for index in places.values()]


def _stack_columns(common, track: Track) -> Columns:
    """Columns of a stack of probes: the same program whatever the model has learned meanwhile, and beside what."""
    base, stack = common
    dof = len(base.system.coordinates)
    q, v = track.middle[:, :dof], track.middle[:, dof:]
    drive, friction = jax.vmap(base.system.drive)(track.inputs.u), jax.vmap(base.unknown)(v)
    scenes = Scene(None, q, v, drive, track.inputs.time, friction, None)  # type: ignore[arg-type]
    return jax.vmap(lambda e: _columns(base, e, track, scenes))(stack)


def candidate_columns(base: StateSpaceModel, candidates: Sequence[Candidate], track: Track, rows: int = 0) -> Columns:
    """What every probe of every candidate adds to `base` along the tracks of all sequences: seq column time ...

    Tracks are padded to `rows`, so that horizons share the largest program.
    """
    groups, length = _groups([probe for candidate in candidates for probe in candidate.probes]), track.x.shape[1]
    more = [(0, 0), (0, max(0, rows - length))]
    longer = lambda a: jnp.pad(a, more + [(0, 0)] * (a.ndim - 2), mode="edge")  # noqa: E731
    track, size = jax.tree.map(longer, track), sum(len(index) for index, _ in groups)
    last = track.acceleration.shape[-1], len(base.measured)
    force, reading = (np.empty((len(track.x), size, length, n), track.x.dtype) for n in last)
    for index, stack in groups:
        found = each(_stack_columns, (base, stack), track)
        for whole, own in ((force, found.force), (reading, found.reading)):
            whole[:, index] = np.asarray(own)[:, : len(index), :length]
    return Columns(jnp.asarray(force), jnp.asarray(reading))
