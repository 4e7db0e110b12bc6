"""What share of the multi-step error each candidate removes, on all recordings and on those left out of its fit.

Friction, parameters and the effects in the model are nuisance: they are projected out of errors and candidates by all
recordings together, and only the candidate's own strengths are fitted without the recordings left out.  A nuisance
fitted anew in every fold blows up on chaotic recordings, and refuses true effects.
"""

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int

from ..data.dataset import Dataset
from ..effects import Candidate, flat
from ..em.multistep import Forks, forks, weighed
from ..em.weights import Weights
from ..model.state_space import Inputs, StateSpaceModel
from ..numerics.gaussian import Gaussian
from ..numerics.parallel import each
from ..storage.journal import HERE, step
from .evidence import Projected, Question, Screen, Screened, Share
from .screen import candidate_columns, tracks

FOLDS = 5
"""Parts that are left out in turn, as far as there are recordings."""
SHAPE = 0.1
"""Rms of a friction map beside the span of known laws, over that of the map; .03 to .3 gave the same answers."""
KNEES = (0.003, 0.01, 0.03, 0.1, 0.3)
"""Knees of the Coulomb and Stribeck laws that friction is free in, over the largest speed."""


class Rows(NamedTuple):
    """Errors and candidate columns once the nuisance has taken what it can, weighed; a row per error."""

    error: Float[np.ndarray, " row"]
    columns: Float[np.ndarray, "row column"]
    fold: Int[np.ndarray, " row"]
    overlap: float
    """Rows that count as one."""
    nuisance: Float[np.ndarray, " nuisance"]
    """What was taken: change of node torques and of parameters in units of their prior."""


def friction_prior(model: StateSpaceModel, weights: Weights) -> tuple[np.ndarray, np.ndarray]:
    """Precision and pull of the nuisance: the total map free in the span of known laws, the rest small.

    A prior on its size would bind strong Coulomb friction; one on its change would leave half an effect inside the map.
    """
    nodes, size = np.asarray(weights.nodes), weights.nodes.size + weights.prior.size
    value = np.asarray(weights.phi(model.unknown, weights.read(model)))
    precision, pull = np.zeros((size, size)), np.zeros(size)
    count = nodes.shape[1]
    for j, v in enumerate(nodes):
        here = slice(j * count, (j + 1) * count)
        top = np.abs(v).max()
        laws = np.stack([v / top, *(np.tanh(v / (r * top)) for r in KNEES)], axis=1)
        basis = np.linalg.svd(laws, full_matrices=False)[0]
        beside = (np.eye(count) - basis @ basis.T) / (SHAPE * np.sqrt(np.mean(value[here] ** 2)) + 1e-12) ** 2
        precision[here, here] = beside + 1e-12 * np.eye(count)
        pull[here] = beside @ value[here]
    own = slice(nodes.size, size)
    precision[own, own] = np.eye(weights.prior.size)
    pull[own] = value[own]
    return precision, pull


def fold_of(used: Bool[np.ndarray, " seq"], starts: int) -> Int[np.ndarray, "seq start"]:
    """The part that every fork belongs to: neighbouring recordings together, or pieces of the only ones."""
    count = int(used.sum())
    order = np.where(used, np.cumsum(used) - 1, 0)
    if count >= 3:
        return np.repeat((order * min(FOLDS, count) // count)[:, None], starts, axis=1)
    pieces = np.arange(starts) * 4 // starts
    return order[:, None] * 4 + pieces[None, :]


def project(found: Forks, model: StateSpaceModel, weights: Weights, used: Bool[np.ndarray, " seq"]) -> Rows:
    """Errors and candidates without what friction, parameters and the effects in the model can say of them."""
    weight = weighed(found, used)
    keep = weight > 0
    fold = np.broadcast_to(fold_of(used, keep.shape[1])[:, :, None, None], keep.shape)[keep]
    root = np.sqrt(weight[keep])
    error, columns = root * found.error[keep], root[:, None] * found.columns[keep]
    count = weights.nodes.size + weights.prior.size
    nuisance, own = columns[:, :count].astype(float), columns[:, count:]
    precision, pull = friction_prior(model, weights)
    factor = np.linalg.cholesky(nuisance.T @ nuisance + precision)
    solve = lambda a: np.linalg.solve(factor.T, np.linalg.solve(factor, a))  # noqa: E731
    taken = solve(nuisance.T @ error - pull)
    rest = own - nuisance @ solve(nuisance.T @ own)
    return Rows(error - nuisance @ taken, rest, fold, float(np.mean(found.overlap)), taken)


class Removed(NamedTuple):
    """The shares of all candidates as arrays, and what else a report asks of them."""

    inside: Float[np.ndarray, " candidate"]
    left_out: Float[np.ndarray, " candidate"]
    folds: Float[np.ndarray, "candidate fold"]
    directions: Float[np.ndarray, " candidate"]
    coefficients: Float[np.ndarray, " probe"]
    projected: Projected


def spans(candidates: Sequence[Candidate]) -> list[slice]:
    """Where the probes of every candidate stand among all."""
    ends = np.cumsum([0, *(len(c.probes) for c in candidates)])
    return [slice(int(a), int(b)) for a, b in itertools.pairwise(ends)]


@step(lambda *_: Removed(HERE, HERE, HERE, HERE, HERE, Projected(HERE, HERE)))
def removed(
    base: StateSpaceModel,
    model: StateSpaceModel,
    weights: Weights,
    candidates: Sequence[Candidate],
    path: Gaussian,
    data: Dataset,
    used: Bool[np.ndarray, " seq"],
) -> Removed:
    """What every candidate removes of the multi-step errors of `model`, which is `base` and its effects."""
    track = tracks(model, path, each(_inputs, model, data))
    extra = candidate_columns(eqx.tree_at(lambda m: m.unknown, base, model.unknown), candidates, track)
    rows = project(forks(model, weights, path, data, extra), model, weights, used)
    told = [share(rows, here, _ridge(c)) for c, here in zip(candidates, spans(candidates), strict=True)]
    inside, left_out, folds, directions, coefficients = zip(*told, strict=True)
    columns = rows.columns / np.sqrt(rows.overlap)
    projected = Projected(columns.T @ (rows.error / np.sqrt(rows.overlap)), columns.T @ columns)
    return Removed(
        np.asarray(inside), np.asarray(left_out), np.stack(folds), np.asarray(directions), np.concatenate(coefficients),
        projected,
    )  # fmt: skip


def _inputs(model: StateSpaceModel, seq: Dataset) -> Inputs:
    return model.inputs(seq)


def share_test(question: Question, candidates: Sequence[Candidate]) -> Screen:
    """The share of the multi-step error that every candidate removes."""
    now = question.now
    weights = now.m_step.weights(now.model)
    told = removed(question.bare.model, now.model, weights, candidates, question.path, question.data, question.used)
    screened = tuple(
        Screened(
            candidate,
            told.coefficients[here],
            round(float(told.directions[i])),
            math.nan,
            Share(float(told.inside[i]), float(told.left_out[i]), tuple(told.folds[i].tolist())),
        )
        for i, (candidate, here) in enumerate(zip(candidates, spans(candidates), strict=True))
    )
    return Screen(screened, told.projected)


def _ridge(candidate: Candidate) -> Float[np.ndarray, " probe"]:
    """Prior precision of the multiples of the probes."""
    start, spread = np.asarray(flat(candidate.start)), np.asarray(flat(candidate.spread))
    steps = [(np.asarray(flat(probe)) - start) / spread for probe in candidate.probes]
    return np.array([np.sum(step**2) for step in steps]) if candidate.start.linear else np.zeros(len(steps))


def share(rows: Rows, here: slice, ridge: Float[np.ndarray, " probe"]):
    """Share inside, on what is left out, on every fold, directions and coefficients of some columns together."""
    e, x, fold = rows.error, rows.columns[:, here].astype(float), rows.fold
    parts = [fold == f for f in np.unique(fold)]
    if len(parts) < 2:  # too short to leave anything out
        return 0.0, 0.0, np.zeros(1), 0.0, np.zeros(x.shape[1])
    gram, score = np.stack([x[p].T @ x[p] for p in parts]), np.stack([x[p].T @ e[p] for p in parts])
    whole = np.array([np.sum(e[p] ** 2) for p in parts])
    size = x.shape[1]

    def fitted(keep):
        a = gram[keep].sum(0) + np.diag(ridge)
        a = a + (1e-9 * np.trace(a) / size + 1e-30) * np.eye(size)
        return np.linalg.solve(a, score[keep].sum(0)), a

    def gone(c, f):
        return 2 * c @ score[f] - c @ gram[f] @ c

    every = np.arange(len(parts))
    c, a = fitted(every)
    directions = float(np.trace(np.linalg.solve(a, gram.sum(0))))
    count = max(len(e) / rows.overlap, directions + 2)
    raw = sum(gone(c, f) for f in every) / whole.sum()
    inside = 1 - (1 - raw) * (count - 1) / (count - directions - 1)
    left_out = np.array([gone(fitted(every[every != f])[0], f) for f in every])
    return float(inside), float(left_out.sum() / whole.sum()), left_out / whole, directions, c
