"""Score test of everything that the fitted model may lack, all candidates in one pass.

Every candidate is a column: how the whitened readings would move if it were there.  Friction maps, uncertain parameters and
effects already in the model are projected out, so that only what they cannot explain counts
[Rao 1948, Proc. Camb. Phil. Soc. 44; the columns by the sensitivity equations of the Kalman filter].
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .data import Dataset, fill_missing
from .effects import AbstractEffect, Candidate
from .gaussian import Gaussian
from .kalman import TANGENT, kalman_filter
from .model import StateSpaceModel, with_effects
from .mstep import Weights, friction_columns, local, whitened_sensitivities
from .ode import integrate
from .smoother import active_steps


class Columns(NamedTuple):
    """What a probe adds along a path."""

    force: Float[Array, "time dof"]
    """Generalised force held over the step [N m]."""
    reading: Float[Array, "time obs"]


class Sheet(NamedTuple):
    """Score and information of nuisance and candidate columns, of every sequence."""

    score: Float[np.ndarray, "seq column"]
    information: Float[np.ndarray, "seq column column"]
    nuisance: int
    """Leading columns that are projected out."""
    prior: Float[np.ndarray, "nuisance nuisance"]
    """Prior precision of the nuisance."""


class Verdict(NamedTuple):
    """What the score test says of one candidate."""

    gain: float
    """Expected gain of the log-likelihood [nat]."""
    rank: int
    """Directions that the data see."""
    coefficients: Float[np.ndarray, " probe"]
    """Multiples of the probes."""


def columns(null: StateSpaceModel, effect: AbstractEffect, path: Float[Array, "time state"], seq: Dataset) -> Columns:
    """Force and reading that `effect` adds to `null` along a path, as the middle of every step sees it."""
    dof = len(null.system.coordinates)
    full = with_effects(null, (*null.effects, effect))
    u, v = null.inputs(seq), full.inputs(seq)
    still = jnp.zeros(dof, path.dtype)
    middle = path + 0.5 * null.dt * jax.vmap(lambda x, u: null.rate(x, u, still))(path, u)
    memory = jnp.zeros((path.shape[0], effect.memory), path.dtype)
    if effect.memory:

        def step(m, slices):
            x, u = slices
            rest = lambda m: full.rate(jnp.concatenate([x, m]), u, still)[x.shape[0] :]  # noqa: E731
            return integrate(rest, m, null.dt, full.steps), m

        _, memory = jax.lax.scan(step, memory[0], (middle, v))

    def one(x, m, now, u, v):
        change = (full.rate(jnp.concatenate([x, m]), v, still) - jnp.pad(null.rate(x, u, still), (0, m.shape[0])))
        read = full.emission(jnp.concatenate([now, m]), v) - null.emission(now, u)
        return Columns(null.system.mass(x[:dof]) @ change[dof : 2 * dof], read)

    return jax.vmap(one)(middle, memory, path, u, v)


def _groups(probes: Sequence[AbstractEffect]) -> list[tuple[list[int], AbstractEffect]]:
    """Probes of one structure stacked, so that each structure is compiled once."""
    places: dict = {}
    for i, probe in enumerate(probes):
        places.setdefault(jax.tree.structure(probe), []).append(i)
    stack = lambda *leaves: jnp.stack(leaves)  # noqa: E731
    return [(index, jax.tree.map(stack, *(probes[i] for i in index))) for index in places.values()]


@eqx.filter_jit
def _sheet(null: StateSpaceModel, weights: Weights, stacks, path: Gaussian, data: Dataset):
    dof = len(null.system.coordinates)

    def one(path: Gaussian, seq: Dataset):
        y, observed = fill_missing(seq.y)
        observed = observed & seq.valid[:, None]
        active = active_steps(jnp.asarray(seq.valid))
        here = local(null, weights.prior, path, seq, TANGENT)
        filtered = kalman_filter(
            null.log_q, null.log_r, null.start, here.affine, here.reading, y, observed, active
        )
        found = [jax.vmap(lambda e: columns(null, e, path.mean, seq))(stack) for stack in stacks]
        force = jnp.concatenate([f.force for f in found])
        reading = jnp.concatenate([f.reading for f in found])
        moved = jnp.einsum("tsd,ctd->tsc", here.by_force, force)
        speed = 0.5 * (path.mean[1:] + path.mean[:-1])[:, dof : 2 * dof]
        speed = jnp.concatenate([speed, speed[-1:]])
        torque, _ = jax.vmap(lambda v, b: friction_columns(weights.nodes, v[None], b))(speed, here.by_force)
        of_torque = jnp.zeros((*y.shape, torque.shape[-1]), y.dtype)
        states = jnp.concatenate([torque, here.by_parameter, moved], axis=-1)
        readings = jnp.concatenate(
            [of_torque, here.reading_by_parameter, jnp.moveaxis(reading, 0, -1)], axis=-1
        )
        states = jnp.where(active[:, None, None], states, 0.0)
        jac = whitened_sensitivities(filtered, states, readings, observed).reshape(-1, states.shape[-1])
        return jac.T @ filtered.innovation.ravel(), jac.T @ jac

    return jax.lax.map(lambda args: one(*args), (path, data))


def sheet(
    null: StateSpaceModel, weights: Weights, candidates: Sequence[Candidate], path: Gaussian, data: Dataset
) -> Sheet:
    """Columns of all probes of all candidates, along the smoothed path of `null`."""
    probes = [probe for candidate in candidates for probe in candidate.probes]
    groups = _groups(probes)
    score, information = (np.asarray(a) for a in _sheet(null, weights, [g for _, g in groups], path, data))
    nuisance = score.shape[1] - len(probes)
    order = np.argsort([i for index, _ in groups for i in index])
    take = np.concatenate([np.arange(nuisance), nuisance + order])
    prior = np.asarray(weights.symmetry()) + _smooth_prior(weights)
    return Sheet(score[:, take], information[:, take][:, :, take], nuisance, prior)


def _smooth_prior(weights: Weights) -> np.ndarray:
    """Prior precision of the nuisance: friction maps of a natural size and smoothness, parameters as declared."""
    dof, count = weights.nodes.shape
    size = 10 * np.asarray(weights.asymmetry)
    bend = np.diff(np.eye(count), 2, axis=0)
    blocks = [np.eye(count) / s**2 + bend.T @ bend / (0.3 * s) ** 2 for s in size]
    out = np.eye(dof * count + len(weights.prior.names))
    for j, block in enumerate(blocks):
        out[j * count : (j + 1) * count, j * count : (j + 1) * count] = block
    return out


def judge(sheet: Sheet, candidates: Sequence[Candidate], used: Float[np.ndarray, " seq"]) -> list[Verdict]:
    """The score test of every candidate over the sequences with weight `used`."""
    score = np.einsum("s,sc->c", used, sheet.score)
    information = np.einsum("s,scd->cd", used, sheet.information)
    n = sheet.nuisance
    factor = np.linalg.cholesky(information[:n, :n] + sheet.prior)
    half = np.linalg.solve(factor, information[:n, n:])
    left = np.linalg.solve(factor, score[:n])
    score = score[n:] - half.T @ left
    information = information[n:, n:] - half.T @ half
    out, place = [], 0
    for candidate in candidates:
        here = slice(place, place + len(candidate.probes))
        place = here.stop
        values, vectors = np.linalg.eigh(information[here, here])
        # a unit of a probe is a typical strength: what a few of them would not show is not seen
        seen = values > max(1e-6 * values[-1], 1e-3)
        along = vectors[:, seen].T @ score[here]
        weight = values[seen] + 0.01
        out.append(Verdict(float(0.5 * np.sum(along**2 / weight)), int(seen.sum()), vectors[:, seen] @ (along / weight)))
    return out
