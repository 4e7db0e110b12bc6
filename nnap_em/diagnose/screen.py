"""Score test of everything that the fitted model may lack, all candidates in one pass.

Every candidate is a column: how the whitened readings would move if it were there.  Friction maps, uncertain
parameters and effects already in the model are projected out, so that only what they cannot explain counts
[Rao 1948, Proc. Camb. Phil. Soc. 44; the columns by the sensitivity equations of the Kalman filter].
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..data.dataset import Dataset
from ..effects import Candidate
from ..em.local import locals_along
from ..em.multistep import read_columns
from ..em.quadratic import friction_columns, whitened_sensitivities
from ..em.weights import Weights
from ..model.state_space import StateSpaceModel
from ..numerics.gaussian import Gaussian
from ..numerics.parallel import each, turns
from ..smoother.kalman import CUBATURE, kalman_filter
from ..storage.journal import HERE, step
from .columns import candidate_columns, tracks
from .evidence import Projected, Question, Screen, Screened


class Sheet(NamedTuple):
    """Score and information of nuisance and candidate columns."""

    score: Float[np.ndarray, " column"]
    information: Float[np.ndarray, "column column"]
    nuisance: int
    """Leading columns that are projected out."""
    prior: Float[np.ndarray, "nuisance nuisance"]
    """Prior precision of the nuisance."""


def _sheet(common, one) -> tuple[Float[Array, " column"], Float[Array, "column column"]]:
    """Score and information of one sequence."""
    (log_q, log_r, start, nodes), (here, middle, found) = common, one
    dof = nodes.shape[0]
    filtered = kalman_filter(log_q, log_r, start, here.affine, here.reading, here.seq)
    moved = jnp.einsum("tsd,ctd->tsc", here.by_force, found.force)
    torque = jax.vmap(lambda v, b: friction_columns(nodes, v[None], b))(middle[:, dof:], here.by_force)
    states = jnp.concatenate([torque, here.by_parameter, moved], axis=-1)
    readings = read_columns(nodes, here, middle, found)
    states = jnp.where(here.seq.active[:, None, None], states, 0.0)
    jac = whitened_sensitivities(filtered, states, readings, here.seq.observed).reshape(-1, states.shape[-1])
    return jac.T @ filtered.innovation.ravel(), jac.T @ jac


def sheet(
    base: StateSpaceModel,
    null: StateSpaceModel,
    weights: Weights,
    candidates: Sequence[Candidate],
    path: Gaussian,
    data: Dataset,
    used: Float[np.ndarray, " seq"],
    rows: int = 0,
) -> Sheet:
    """Columns of all probes of all candidates along the smoothed path of `null`, which is `base` and its effects: the
    sum over sequences with weights `used`.  What a lost one says does not count, not even as NaN.
    """
    here = locals_along(null, weights.prior, path, data, CUBATURE)
    track = tracks(null, path, here.seq.inputs)
    base = eqx.tree_at(lambda m: m.unknown, base, null.unknown)
    along = candidate_columns(base, candidates, rows)
    common = (null.log_q, null.log_r, null.start, weights.nodes)
    nuisance = weights.nodes.size + weights.prior.size
    size = nuisance + sum(len(candidate.probes) for candidate in candidates)
    score, information = np.zeros(size), np.zeros((size, size))
    for some, (local, own) in turns(len(used), here, track):  # columns of all fill the memory
        found = map(np.asarray, each(_sheet, common, (local, own.middle, along(own)), together=1))
        for weight, its, told in zip(used[some[0] :], *found, strict=False):
            if weight > 0 and np.isfinite(its).all() and np.isfinite(told).all():
                score += weight * its
                information += weight * told
    prior = np.asarray(weights.symmetry()) + _smooth_prior(weights)
    return Sheet(score, information, nuisance, prior)


def _smooth_prior(weights: Weights) -> np.ndarray:
    """Prior precision of the nuisance: friction maps of a natural size and smoothness, parameters as declared."""
    dof, count = weights.nodes.shape
    size = 10 * np.asarray(weights.asymmetry)
    bend = np.diff(np.eye(count), 2, axis=0)
    blocks = [np.eye(count) / s**2 + bend.T @ bend / (0.3 * s) ** 2 for s in size]
    out = np.eye(dof * count + weights.prior.size)
    for j, block in enumerate(blocks):
        out[j * count : (j + 1) * count, j * count : (j + 1) * count] = block
    return out


def project(sheet: Sheet) -> Projected:
    """What the nuisance cannot say."""
    score, information = sheet.score, sheet.information
    n = sheet.nuisance
    factor = np.linalg.cholesky(information[:n, :n] + sheet.prior)
    half = np.linalg.solve(factor, information[:n, n:])
    left = np.linalg.solve(factor, score[:n])
    return Projected(score[n:] - half.T @ left, information[n:, n:] - half.T @ half)


@step(lambda *_: Projected(HERE, HERE))
def screen(
    base: StateSpaceModel,
    null: StateSpaceModel,
    weights: Weights,
    candidates: Sequence[Candidate],
    path: Gaussian,
    data: Dataset,
    used: Bool[np.ndarray, " seq"],
    rows: int,
) -> Projected:
    """The sheet of all candidates, projected: what the sequences `used` say of them."""
    return project(sheet(base, null, weights, candidates, path, data, np.asarray(used, float), rows))


def score_test(question: Question, candidates: Sequence[Candidate]) -> Screen:
    """The expected gain of every candidate over the model as it stands."""
    now = question.now
    weights = now.m_step.weights(now.model)
    asked = (candidates, question.path, question.data, question.used, question.rows)
    projected = screen(question.bare.model, now.model, weights, *asked)
    return Screen(tuple(judge(projected, candidates)), projected)


def unlike(projected: Projected, candidates: Sequence[Candidate], chosen: Candidate) -> list[float]:
    """Share of what the data say of `chosen` that each candidate could not say in its place; 0: the same model."""
    sizes = np.cumsum([0, *(len(c.probes) for c in candidates)])
    spans = [np.arange(a, b) for a, b in itertools.pairwise(sizes)]
    own = spans[next(i for i, c in enumerate(candidates) if c is chosen)]
    whole = projected.information[np.ix_(own, own)]
    out = []
    for span in spans:
        block = projected.information[np.ix_(span, span)]
        cross = projected.information[np.ix_(own, span)]
        left = whole - cross @ np.linalg.pinv(block, rcond=1e-9, hermitian=True) @ cross.T
        out.append(float(np.clip(np.trace(left) / max(np.trace(whole), 1e-300), 0.0, 1.0)))
    return out


def judge(projected: Projected, candidates: Sequence[Candidate]) -> list[Screened]:
    """The score test of every candidate.

    Raises FloatingPointError for a gain that is no number.
    """
    out, place = [], 0
    for candidate in candidates:
        here = slice(place, place + len(candidate.probes))
        place = here.stop
        block = projected.information[here, here]
        if not np.isfinite(block).all() or not np.isfinite(projected.score[here]).all():
            raise FloatingPointError(
                f"{candidate.start.name}: its effect on the readings is no number; is a column of the logs constant?"
            )
        values, vectors = np.linalg.eigh(block)
        # a unit of a probe is a typical strength: what a few of them would not show is not seen
        seen = values > max(1e-6 * values[-1], 1e-3)
        along = vectors[:, seen].T @ projected.score[here]
        weight = values[seen] + 0.01
        gain = float(0.5 * np.sum(along**2 / weight))
        out.append(Screened(candidate, vectors[:, seen] @ (along / weight), int(seen.sum()), gain, None))
    return out
