"""The share of a squared error that each candidate removes, and the share that chance removes.

Friction, parameters and accepted effects are nuisance: all data together project them out of errors and candidates, and
only strengths are fitted without the parts left out.  Refits on every fold diverge on chaotic recordings.
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.linalg import cho_factor, cho_solve

from ...base.gaussian import Gaussian
from ...base.journal import HERE, step
from ...estimate.em.weights import friction_prior
from ...logs.dataset import Dataset
from ...model.effects import Candidate, fields
from ...model.state_space import StateSpaceModel
from .columns import blocks_of
from .keys import complexity
from .losses import BANDS, Linearised, linearise
from .smoothed import SmoothedFit
from .verdict import CHANCE, REPEATS, SURVIVES, Share, agreed, least_share, required

SHIFTS = 2
"""Placebos whose largest share is the chance level."""
MOTION_PARTS, QUARTERS, MOMENT_PARTS = 5, 4, 5
"""Parts that are left out in turn: motions, as far as there are recordings, repetitions together; parts of each motion,
where there are fewer than three; moments of all recordings: what happens at one moment of every recording is no law."""


class Rows(NamedTuple):
    """Errors and candidate columns without what the nuisance can explain; a row per error, sorted by cell."""

    error: Float[np.ndarray, " row"]
    columns: Float[np.ndarray, "row column"]
    cell: Int[np.ndarray, " row"]
    """Fold times `step` plus block."""
    step: int
    overlap: float
    """Rows that count as one."""
    survived: Float[np.ndarray, " column"]
    """Norm of every column over its norm before the projection."""


class Shares(NamedTuple):
    """Shares of all candidates at one band of horizons."""

    inside: Float[np.ndarray, " candidate"]
    left_out: Float[np.ndarray, " candidate"]
    folds: Float[np.ndarray, "candidate fold"]
    coefficients: Float[np.ndarray, " probe"]
    survived: Float[np.ndarray, " candidate"]


class Screened(NamedTuple):
    """A candidate before any refit, at the band of horizons that shows it best."""

    candidate: Candidate
    coefficients: Float[np.ndarray, " probe"]
    """Multiples of its probes."""
    share: Share
    band: int
    floor: float
    chance: float
    """Smallest share that counts at that band, and largest of any placebo that the parts left out confirm."""
    survived: float = 1.0
    """Norm of its columns that friction and parameters cannot give, over their norm [0 to 1]."""

    @property
    def ratio(self) -> float:
        """Multiple of its bar that the share reaches."""
        return self.share.least / self.bar

    @property
    def reached(self) -> bool:
        """True for an admissible share that reaches the bar of its law."""
        return self.admissible and self.share.least >= required(self.bar, complexity(self.candidate.start))

    @property
    def rank(self) -> tuple[bool, bool, float, float]:
        """Order of candidates of one kind, and of the bands of a candidate: the first band that shows it counts."""
        return self.admissible, self.reached, -float(self.band) if self.reached else 0.0, self.ratio

    @property
    def bar(self) -> float:
        """Share that a law with a name must reach."""
        return max(self.floor, CHANCE * self.chance)

    @property
    def admissible(self) -> bool:
        """True where the parts left out confirm the share, for which friction and parameters cannot stand."""
        responds = self.candidate.start.responds_to_feedback()
        return self.survived >= SURVIVES and agreed(self.share.folds, self.floor, responds=responds)

    @property
    def listed(self) -> float:
        """Share as a report lists it; 0 where the parts disagree."""
        return self.share.least if self.admissible else 0.0


def motions(state: Float[np.ndarray, "seq time state"], used: Bool[np.ndarray, " seq"]) -> Int[np.ndarray, " seq"]:
    """Number of the motion of every sequence; those that repeat a motion are no evidence of each other and share it."""
    size = np.nanmean(state[used] ** 2, axis=(0, 1)) + 1e-12
    scaled = state / np.sqrt(size)
    motion = np.arange(len(state))
    for i, j in itertools.combinations(np.flatnonzero(used), 2):
        known = np.isfinite(scaled[[i, j]]).all(axis=-1)
        both = known.all(axis=0)
        if 2 * both.sum() < known.sum(axis=1).max():  # too short a part of the longer one to be its repetition
            continue
        difference, square = np.mean((scaled[i] - scaled[j])[both] ** 2), np.mean(scaled[[i, j]][:, both] ** 2)
        if difference < REPEATS * square:
            motion[motion == motion[j]] = motion[i]
    return motion


def times(clock: Float[np.ndarray, "seq time"], data: Dataset, count: int) -> Int[np.ndarray, "seq time"]:
    """Part, of `count` equal ones, of its sequence that each moment of `clock` [s] lies in."""
    t = np.where(np.asarray(data.valid), np.asarray(data.t), np.nan)
    low, high = (of(t, axis=1, keepdims=True) for of in (np.nanmin, np.nanmax))
    return np.clip((count * (clock - low) / (high - low + 1e-12)).astype(int), 0, count - 1)


def fold_of(
    used: Bool[np.ndarray, " seq"], motion: Int[np.ndarray, " seq"], quarter: Int[np.ndarray, "seq time"]
) -> Int[np.ndarray, "seq time"]:
    """Part of every moment: neighbouring motions together, or quarters of the only ones."""
    different, first = np.unique(motion[used], return_index=True)
    order = np.zeros(used.size, int)
    for rank, i in enumerate(np.argsort(first)):
        order[motion == different[i]] = rank
    count = different.size
    if count >= 3:
        return np.repeat((order * min(MOTION_PARTS, count) // count)[:, None], quarter.shape[1], axis=1)
    return order[:, None] * QUARTERS + quarter


def parts(
    model: StateSpaceModel,
    path: Gaussian,
    data: Dataset,
    used: Bool[np.ndarray, " seq"],
    rows: Int[np.ndarray, " time"],
) -> tuple[Int[np.ndarray, "seq time"], Int[np.ndarray, "seq time"]]:
    """Fold and block of the moments at `rows` of every sequence."""
    state = np.where(np.asarray(data.valid)[..., None], np.asarray(path.mean), np.nan)
    motion = motions(state[..., : 2 * len(model.system.coordinates)], used)
    clock = np.asarray(data.t)[:, rows]
    return fold_of(used, motion, times(clock, data, QUARTERS)), times(clock, data, MOMENT_PARTS)


def spans(candidates: Sequence[Candidate]) -> list[slice]:
    """Places of the probes of every candidate among all."""
    ends = np.cumsum([0, *(len(c.probes) for c in candidates)])
    return [slice(int(a), int(b)) for a, b in itertools.pairwise(ends)]


def project(
    linearised: Linearised,
    fold: Int[np.ndarray, "seq time"],
    block: Int[np.ndarray, "seq time"],
    precision: Float[np.ndarray, "nuisance nuisance"],
    pull: Float[np.ndarray, " nuisance"],
) -> Rows:
    """Errors and candidates, 0 where one is no number, without the part that the nuisance explains under its prior."""
    step = int(block.max(initial=0)) + 1
    cell = np.broadcast_to((fold * step + block)[:, :, None], linearised.weight.shape).ravel()
    keep = np.flatnonzero((weight := linearised.weight.ravel()) > 0)
    keep = keep[np.argsort(cell[keep], kind="stable")]
    root = np.sqrt(weight[keep])
    columns = root[:, None] * linearised.columns.reshape(len(weight), -1)[keep]
    nuisance, left = columns[:, : len(pull)], np.nan_to_num(columns[:, len(pull) :], posinf=0.0, neginf=0.0)
    factor = cho_factor(nuisance.T @ nuisance + precision)
    error = root * linearised.error.ravel()[keep]
    error -= nuisance @ cho_solve(factor, nuisance.T @ error - pull)
    whole = np.linalg.norm(left, axis=0)
    left -= nuisance @ cho_solve(factor, nuisance.T @ left)
    survived = np.linalg.norm(left, axis=0) / np.maximum(whole, 1e-300)
    return Rows(error, left, cell[keep], step, linearised.overlap, survived)


def shifted(linearised: Linearised, nuisance: int, rng: np.random.Generator) -> Linearised:
    """Errors beside candidate columns of another time of their own sequence. The columns behind the first `nuisance`
    ones are rolled over the moments of each sequence, by a quarter to three quarters of them: they keep their size,
    their colour and their number, and lose their meaning. What is rolled over the end changes its sign, since a
    constant would keep its meaning.
    """
    columns = linearised.columns.copy()
    for weight, sequence in zip(linearised.weight, columns, strict=True):
        at = np.flatnonzero((weight > 0).any(axis=1))
        if len(at) < 4:  # too few weighted moments to lose their meaning: they take no part
            sequence[..., nuisance:] = 0.0
            continue
        by = rng.integers(len(at) // 4, 3 * len(at) // 4 + 1)
        moved = np.roll(sequence[at][..., nuisance:], by, axis=0)
        moved[:by] *= -1
        sequence[at, ..., nuisance:] = moved
    return linearised._replace(columns=columns)


class _Sums(NamedTuple):
    """Score and Gram matrix of candidates with equally many probes, by cell."""

    score: Float[np.ndarray, "cell candidate probe"]
    gram: Float[np.ndarray, "cell candidate probe probe"]
    ridge: Float[np.ndarray, "candidate probe"]

    def fitted(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Squared error that a fit to all cells removes, its coefficients, and its directions."""
        score, gram = self.score.sum(axis=0), self.gram.sum(axis=0)
        matrix, c = self._solved(score, gram)
        return _gone(c, score, gram), c, np.trace(np.linalg.solve(matrix, gram), axis1=1, axis2=2)

    def left_out(self, cells: Bool[np.ndarray, " cell"]) -> Float[np.ndarray, " candidate"]:
        """Squared error in some cells that a fit to the others removes."""
        _, c = self._solved(self.score[~cells].sum(axis=0), self.gram[~cells].sum(axis=0))
        return _gone(c, self.score[cells].sum(axis=0), self.gram[cells].sum(axis=0))

    def _solved(self, score, gram) -> tuple[np.ndarray, np.ndarray]:
        matrix = gram + self.ridge[:, None, :] * np.eye(size := score.shape[-1])
        jitter = 1e-9 * np.trace(matrix, axis1=1, axis2=2) / size + 1e-30
        matrix = matrix + jitter[:, None, None] * np.eye(size)
        return matrix, np.linalg.solve(matrix, score[..., None])[..., 0]


def _gone(c, score, gram) -> Float[np.ndarray, " candidate"]:
    return 2 * np.sum(c * score, axis=1) - np.einsum("mk,mkl,ml->m", c, gram, c)


def _sums(rows: Rows, places: Int[np.ndarray, "candidate probe"], ridge) -> _Sums:
    edges = [0, *(np.flatnonzero(np.diff(rows.cell)) + 1), len(rows.cell)]
    columns, scores, grams = np.ascontiguousarray(rows.columns.T), [], []
    for cell in itertools.starmap(slice, itertools.pairwise(edges)):
        x = columns[:, cell][places]  # candidate probe row
        scores.append(x @ rows.error[cell])
        grams.append(x @ np.swapaxes(x, 1, 2))
    return _Sums(np.stack(scores), np.stack(grams), ridge)


def shares(rows: Rows, candidates: Sequence[Candidate], timed: Sequence[bool]) -> Shares:
    """Shares of all candidates. Every fold of motions is left out in turn and, unless a law is `timed`, every block of
    time; the smaller share counts. A fold whose error rises is compared with an average one, if that holds more.
    """
    cells, first = np.unique(rows.cell, return_index=True)
    square = np.add.reduceat(rows.error**2, first)
    total, fold, block = square.sum(), cells // rows.step, cells % rows.step
    held = np.array([square[fold == f].sum() for f in np.unique(fold)] or [0.0])
    where, sizes = spans(candidates), np.array([len(c.probes) for c in candidates])
    once = {id(c): _ridge(c) for c in {id(c): c for c in candidates}.values()}
    ridge = [once[id(c)] for c in candidates]
    inside, left_out = np.zeros((2, len(candidates)))
    survived = np.array([rows.survived[span].max(initial=0.0) for span in where])
    folds, coefficients = np.zeros((len(candidates), len(held))), np.zeros(where[-1].stop)
    for size in np.unique(sizes) if len(held) > 1 else ():  # of one fold nothing can be left out
        indices = np.flatnonzero(sizes == size)
        places = np.array([np.arange(where[int(i)].start, where[int(i)].stop) for i in indices])
        sums = _sums(rows, places, np.array([ridge[int(i)] for i in indices]))
        gone, coefficients[places], directions = sums.fitted()
        count = np.maximum(len(rows.error) / rows.overlap, directions + 2)
        inside[indices] = 1 - (1 - gone / total) * (count - 1) / (count - directions - 1)
        out = np.stack([sums.left_out(fold == f) for f in np.unique(fold)], axis=1)
        folds[indices] = out / np.where(out < 0, np.maximum(held, held.mean()), held)
        moments = sum(sums.left_out(block == b) for b in np.unique(block))
        least = np.where(np.asarray(timed)[indices], np.inf, moments)
        left_out[indices] = np.minimum(out.sum(axis=1), least) / total
    return Shares(inside, left_out, folds, coefficients, survived)


def _ridge(candidate: Candidate) -> Float[np.ndarray, " probe"]:
    """Prior precision of the multiples of the probes; 0 for a law that is not linear."""
    if not candidate.start.linear:
        return np.zeros(len(candidate.probes))
    flat = lambda effect: np.concatenate([np.ravel(getattr(effect, name)) for name in fields(effect)])  # noqa: E731
    start, spread, *probes = map(flat, (candidate.start, candidate.prior_std, *candidate.probes))
    return np.array([np.sum(((probe - start) / spread) ** 2) for probe in probes])


@step(lambda *_: ((Shares(*5 * [HERE]),) * (1 + SHIFTS),) * len(BANDS))
def _bands(fit: SmoothedFit, candidates: Sequence[Candidate]) -> tuple[tuple[Shares, ...], ...]:
    """Shares of the candidates and of each placebo, by band; the same data give the same placebos."""
    blocks, out = blocks_of(candidates), []
    prior = friction_prior(fit.model, fit.m_step.weights(fit.model))
    for some, bands in zip(blocks, linearise(fit, blocks), strict=True):
        out.append([_band(fit, some, *prior, linearised) for linearised in bands])
    return tuple(jax.tree.map(lambda *some: np.concatenate(some), *band) for band in zip(*out, strict=True))


def _band(fit: SmoothedFit, candidates, precision, pull, linearised: Linearised) -> tuple[Shares, ...]:
    count, timed = 1 + SHIFTS, ["time" in c.start.signals(fit.model.system) for c in candidates]
    fold, block = parts(fit.model, fit.path, fit.data, fit.used, linearised.rows)
    rng, size = np.random.default_rng(0), spans(candidates)[-1].stop
    linearised = linearised._replace(columns=linearised.columns[..., : len(pull) + size])
    moved = [shifted(linearised, len(pull), rng).columns[..., len(pull) :] for _ in range(SHIFTS)]
    columns = np.concatenate([linearised.columns, *moved], axis=-1)
    rows = project(linearised._replace(columns=columns), fold, block, precision, pull)
    every = shares(rows, [*candidates] * count, timed * count)
    return tuple(Shares(*some) for some in zip(*(np.split(a, count) for a in every), strict=True))


def screen(fit: SmoothedFit, candidates: Sequence[Candidate]) -> tuple[Screened, ...]:
    """Every candidate at the first band of horizons that shows it, else at that of the largest multiple of its bar.
    Bands are in the order of what they prove: errors soon after a start show more of what else a model lacks.
    """
    removed = [evidence.removed for evidence in fit.hypothesis.evidence if evidence is not None]
    out, floor = [], least_share([share for share in removed if math.isfinite(share)])
    for number, (real, *moved) in enumerate(_bands(fit, candidates)):
        placebos = [s for one in moved for s in _screened(one, candidates, number, floor, 0.0)]
        chance = max([0.0, *(s.listed for s in placebos)])
        out.append(_screened(real, candidates, number, floor, chance))
    return tuple(max(same, key=lambda s: s.rank) for same in zip(*out, strict=True))


def _screened(
    shares: Shares, candidates: Sequence[Candidate], band: int, floor: float, chance: float
) -> Iterator[Screened]:
    for i, (candidate, span) in enumerate(zip(candidates, spans(candidates), strict=True)):
        share = Share(float(shares.inside[i]), float(shares.left_out[i]), tuple(shares.folds[i].tolist()))
        yield Screened(candidate, shares.coefficients[span], share, band, floor, chance, float(shares.survived[i]))
