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
import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from ..data.dataset import Dataset
from ..effects import Candidate, flat
from ..em.multistep import Forks, forks, starts, weighed
from ..em.shape import friction_prior
from ..em.weights import Weights
from ..model.state_space import Inputs, StateSpaceModel
from ..numerics.gaussian import Gaussian
from ..numerics.parallel import each
from ..storage.journal import HERE, step
from .columns import candidate_columns, tracks
from .evidence import Projected, Question, Screen, Screened, Share

FOLDS = 5
"""Parts that are left out in turn, as far as there are recordings."""
BLOCKS = 5
"""The same for pieces of time: what happens at one moment of every recording is no law."""
REPEATS = 0.2
"""Mean square difference of two recordings, over their mean square, below which they are one motion: real repetitions
differ by up to .13, others by .25 and more."""


class Rows(NamedTuple):
    """Errors and candidate columns once the nuisance has taken what it can, weighed; a row per error."""

    error: Float[np.ndarray, " row"]
    columns: Float[np.ndarray, "row column"]
    fold: Int[np.ndarray, " row"]
    """By motion."""
    block: Int[np.ndarray, " row"]
    """By time since the start of a recording."""
    overlap: float
    """Rows that count as one."""
    nuisance: Float[np.ndarray, " nuisance"]
    """What was taken: change of node torques and of parameters in units of their prior."""


def motions(
    state: Float[np.ndarray, "seq time state"], used: Bool[np.ndarray, " seq"], recording: Int[np.ndarray, " seq"]
) -> Int[np.ndarray, " seq"]:
    """A number for every motion: recordings that repeat it are no evidence of each other, and share it; so do the
    pieces of a recording.
    """
    size = np.nanmean(state[used] ** 2, axis=(0, 1)) + 1e-12
    scaled = state / np.sqrt(size)
    motion = recording.copy()
    for i, j in itertools.combinations(np.flatnonzero(used), 2):
        apart, own = np.nanmean((scaled[i] - scaled[j]) ** 2), np.nanmean(scaled[[i, j]] ** 2)
        if apart < REPEATS * own:
            motion[motion == motion[j]] = motion[i]
    return motion


def times(
    clock: Float[np.ndarray, "seq start"], data: Dataset, recording: Int[np.ndarray, " seq"], count: int
) -> Int[np.ndarray, "seq start"]:
    """Which of `count` equal times of its recording every fork belongs to."""
    t = np.where(np.asarray(data.valid), np.asarray(data.t), np.nan)
    low, high = (np.array([of(t[recording == r]) for r in recording])[:, None] for of in (np.nanmin, np.nanmax))
    return np.clip((count * (clock - low) / (high - low + 1e-12)).astype(int), 0, count - 1)


def fold_of(
    used: Bool[np.ndarray, " seq"], motion: Int[np.ndarray, " seq"], quarter: Int[np.ndarray, "seq start"]
) -> Int[np.ndarray, "seq start"]:
    """The part that every fork belongs to: neighbouring motions together, or quarters of the only ones."""
    different, first = np.unique(motion[used], return_index=True)
    order = np.zeros(used.size, int)
    for rank, i in enumerate(np.argsort(first)):
        order[motion == different[i]] = rank
    count = different.size
    if count >= 3:
        return np.repeat((order * min(FOLDS, count) // count)[:, None], quarter.shape[1], axis=1)
    return order[:, None] * 4 + quarter


def project(
    found: Forks,
    model: StateSpaceModel,
    weights: Weights,
    used: Bool[np.ndarray, " seq"],
    part: Int[np.ndarray, "seq start"],
    time: Int[np.ndarray, "seq start"],
) -> Rows:
    """Errors and candidates without what friction, parameters and the effects in the model can say of them.

    `part` and `time` are those which every fork belongs to.
    """
    weight = weighed(found, used)
    keep = weight > 0
    fold = np.broadcast_to(part[:, :, None, None], keep.shape)[keep]
    block = np.broadcast_to(time[:, :, None, None], keep.shape)[keep]
    root = np.sqrt(weight[keep])
    error, columns = root * found.error[keep], root[:, None] * found.columns[keep]
    count = weights.nodes.size + weights.prior.size
    nuisance, own = columns[:, :count].astype(float), columns[:, count:]
    precision, pull = friction_prior(model, weights)
    factor = np.linalg.cholesky(nuisance.T @ nuisance + precision)
    solve = lambda a: np.linalg.solve(factor.T, np.linalg.solve(factor, a))  # noqa: E731
    taken = solve(nuisance.T @ error - pull)
    rest = own - nuisance @ solve(nuisance.T @ own)
    return Rows(error - nuisance @ taken, rest, fold, block, float(np.mean(found.overlap)), taken)


class Removed(NamedTuple):
    """The shares of all candidates as arrays, and what else a report asks of them."""

    inside: Float[np.ndarray, " candidate"]
    left_out: Float[np.ndarray, " candidate"]
    folds: Float[np.ndarray, "candidate fold"]
    directions: Float[np.ndarray, " candidate"]
    coefficients: Float[np.ndarray, " probe"]
    members: Bool[np.ndarray, "fold seq"]
    projected: Projected


def spans(candidates: Sequence[Candidate]) -> list[slice]:
    """Where the probes of every candidate stand among all."""
    ends = np.cumsum([0, *(len(c.probes) for c in candidates)])
    return [slice(int(a), int(b)) for a, b in itertools.pairwise(ends)]


_FORM = Removed(HERE, HERE, HERE, HERE, HERE, HERE, Projected(HERE, HERE))


@step(lambda *_: _FORM)
def removed(
    base: StateSpaceModel,
    model: StateSpaceModel,
    weights: Weights,
    candidates: Sequence[Candidate],
    path: Gaussian,
    data: Dataset,
    used: Bool[np.ndarray, " seq"],
    recording: Int[np.ndarray, " seq"],
) -> Removed:
    """Shares of the multi-step errors of `model`, which is `base` and its effects, that every candidate removes."""
    found = _forked(base, model, weights, candidates, path, data)
    return _removed(found, model, weights, candidates, path, data, used, recording)


SHIFTS = 2
"""Placebos of which the largest share counts: each takes another screen of all candidates."""
SHIFTABLE = 8
"""Starts of a sequence below which a shift would leave its columns where they are."""


@step(lambda *_: (_FORM,) * SHIFTS)
def placebos(
    base: StateSpaceModel,
    model: StateSpaceModel,
    weights: Weights,
    candidates: Sequence[Candidate],
    path: Gaussian,
    data: Dataset,
    used: Bool[np.ndarray, " seq"],
    recording: Int[np.ndarray, " seq"],
) -> tuple[Removed, ...]:
    """The same as `removed` for candidates that have lost their meaning: chance can do as much on these data.

    The seed of the shifts is fixed, so that the same data give the same level.
    """
    found, rng = _forked(base, model, weights, candidates, path, data), np.random.default_rng(0)
    count = weights.nodes.size + weights.prior.size
    moved = (shifted(found, count, rng) for _ in range(SHIFTS))
    return tuple(_removed(one, model, weights, candidates, path, data, used, recording) for one in moved)


def shifted(found: Forks, nuisance: int, rng: np.random.Generator) -> Forks:
    """Errors beside candidate columns of another time of their own sequence.

    The columns behind the first `nuisance` ones are rolled over the starts of each sequence, by a quarter to three
    quarters of them: they keep their size, their colour and their number.
    """
    columns = found.columns.copy()
    for error, own in zip(found.error, columns, strict=True):
        count = int(np.isfinite(error).any(axis=(1, 2)).sum())
        if count >= SHIFTABLE:
            by = rng.integers(count // 4, 3 * count // 4 + 1)
            own[:count, ..., nuisance:] = np.roll(own[:count, ..., nuisance:], by, axis=0)
    return found._replace(columns=columns)


def _forked(base, model, weights, candidates, path, data) -> Forks:
    """Multi-step errors with the columns of all candidates."""
    track = tracks(model, path, each(_inputs, model, data))
    along = candidate_columns(eqx.tree_at(lambda m: m.unknown, base, model.unknown), candidates)
    track = jax.tree.map(np.asarray, track)
    return forks(model, weights, path, data, lambda some: along(jax.tree.map(lambda a: a[some], track)))


def _removed(found: Forks, model, weights, candidates, path, data, used, recording) -> Removed:
    part, clock = parts(model, path, data, used, recording), _clock(model, data)
    rows = project(found, model, weights, used, part, times(clock, data, recording, BLOCKS))
    timed = ["time" in c.start.signals(model.system) for c in candidates]
    told = [
        share(rows, here, _ridge(c), at_any_time=not clock)
        for c, here, clock in zip(candidates, spans(candidates), timed, strict=True)
    ]
    inside, left_out, folds, directions, coefficients = zip(*told, strict=True)
    columns = rows.columns / np.sqrt(rows.overlap)
    projected = Projected(columns.T @ (rows.error / np.sqrt(rows.overlap)), columns.T @ columns)
    return Removed(
        np.asarray(inside), np.asarray(left_out), np.stack(folds), np.asarray(directions), np.concatenate(coefficients),
        members(part, used), projected,
    )  # fmt: skip


def parts(
    model: StateSpaceModel,
    path: Gaussian,
    data: Dataset,
    used: Bool[np.ndarray, " seq"],
    recording: Int[np.ndarray, " seq"],
) -> Int[np.ndarray, "seq start"]:
    """The part that is left out with every fork, in turn."""
    state = np.where(np.asarray(data.valid)[..., None], np.asarray(path.mean), np.nan)
    motion = motions(state[..., : 2 * len(model.system.coordinates)], used, recording)
    return fold_of(used, motion, times(_clock(model, data), data, recording, 4))


def members(part: Int[np.ndarray, "seq start"], used: Bool[np.ndarray, " seq"]) -> Bool[np.ndarray, "fold seq"]:
    """Sequences that each part holds, or pieces of."""
    return np.array([(part == f).any(axis=1) & used for f in np.unique(part[used])]).reshape(-1, used.size)


def _clock(model: StateSpaceModel, data: Dataset) -> Float[np.ndarray, "seq start"]:
    return np.asarray(data.t)[:, starts(model, data)]


def _inputs(model: StateSpaceModel, seq: Dataset) -> Inputs:
    return model.inputs(seq)


def share_test(question: Question, candidates: Sequence[Candidate]) -> Screen:
    """The share of the multi-step error that every candidate removes."""
    return _screen(removed(*_asked(question, candidates)), question, candidates)


def chance_test(question: Question, candidates: Sequence[Candidate]) -> list[Screen]:
    """The same screen of every placebo."""
    return [_screen(one, question, candidates) for one in placebos(*_asked(question, candidates))]


def _asked(question: Question, candidates: Sequence[Candidate]) -> tuple:
    now = question.now
    weights = now.m_step.weights(now.model)
    about = (question.path, question.data, question.used, question.recording)
    return question.bare.model, now.model, weights, candidates, *about


def _screen(shares: Removed, question: Question, candidates: Sequence[Candidate]) -> Screen:
    screened = tuple(
        Screened(
            candidate,
            shares.coefficients[here],
            round(float(shares.directions[i])),
            math.nan,
            Share(float(shares.inside[i]), float(shares.left_out[i]), tuple(shares.folds[i].tolist()), question.left),
        )
        for i, (candidate, here) in enumerate(zip(candidates, spans(candidates), strict=True))
    )
    return Screen(screened, shares.projected, shares.members)


def _ridge(candidate: Candidate) -> Float[np.ndarray, " probe"]:
    """Prior precision of the multiples of the probes."""
    start, spread = np.asarray(flat(candidate.start)), np.asarray(flat(candidate.spread))
    steps = [(np.asarray(flat(probe)) - start) / spread for probe in candidate.probes]
    return np.array([np.sum(step**2) for step in steps]) if candidate.start.linear else np.zeros(len(steps))


def share(rows: Rows, here: slice, ridge: Float[np.ndarray, " probe"], *, at_any_time: bool = True):
    """Share inside, on what is left out, on every fold, directions and coefficients of some columns together.

    Where the error of a fold rises, it is by a share of what it holds, or of what folds hold on average.
    With `at_any_time`, what is left out is every block of time as well, and the smaller share counts.
    """
    e, x = rows.error, rows.columns[:, here].astype(float)
    parts = [rows.fold == f for f in np.unique(rows.fold)]
    if len(parts) < 2:  # too short to leave anything out
        return 0.0, 0.0, np.zeros(1), 0.0, np.zeros(x.shape[1])
    size, total = x.shape[1], np.sum(e**2)

    def fitted(gram, score):
        a = gram + np.diag(ridge)
        a = a + (1e-9 * np.trace(a) / size + 1e-30) * np.eye(size)
        return np.linalg.solve(a, score), a

    def gone(c, gram, score):
        return 2 * c @ score - c @ gram @ c

    gram, score = x.T @ x, x.T @ e
    c, a = fitted(gram, score)
    directions = float(np.trace(np.linalg.solve(a, gram)))
    count = max(len(e) / rows.overlap, directions + 2)
    inside = 1 - (1 - gone(c, gram, score) / total) * (count - 1) / (count - directions - 1)

    def without(part):
        own, its = x[part].T @ x[part], x[part].T @ e[part]
        return gone(fitted(gram - own, score - its)[0], own, its)

    out = np.array([without(p) for p in parts])
    sums = [out.sum()]
    if at_any_time:
        sums.append(sum(without(rows.block == b) for b in np.unique(rows.block)))
    held = np.array([np.sum(e[p] ** 2) for p in parts])  # a part with hardly any error has little to say against a law
    folds = out / np.where(out < 0, np.maximum(held, held.mean()), held)
    return float(inside), float(min(sums) / total), folds, directions, c
