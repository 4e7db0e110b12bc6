"""What the data cannot tell apart: how much of one effect another would explain, by the overlap of sensitivities."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .augment import proposals, surroundings
from .data import Dataset
from .effects import Candidate, fields
from .gaussian import Gaussian
from .identify import Identified
from .screen import Sheet, sheet


class Standing(NamedTuple):
    """How firmly an effect stands in a fitted model."""

    alone: float
    """Log-likelihood that would be lost without it [nat]."""
    instead: tuple[tuple[Candidate, float], ...]
    """Alternatives, and what would be lost with each in its place [nat]; least first."""


def standings(
    before: Identified, after: Identified, chosen: tuple[Candidate, ...], path: Gaussian, data: Dataset, used
) -> list[Standing]:
    """Of every effect of `after`, in its order, to second order of the likelihood.

    The loss of an effect with strengths s is s' I s / 2, where I is their information once all other parameters, and
    the alternative, have explained what they can [Wald 1943].
    """
    candidates = [c for c in proposals(surroundings(after.rig, after.model, data, path)) if _named(c)]
    weights = after.m_step.weights(after.model)
    table = sheet(before.model, after.model, weights, candidates, path, data)
    prior = after.m_step.prior
    z, none, strong = np.asarray(prior.read(after.model)), np.zeros(prior.size), np.zeros(prior.size, bool)
    place = prior.size - sum(_flat(c.start).size for c in chosen)
    places = []
    for candidate in chosen:
        start = _flat(candidate.start)
        here = slice(place, place + start.size)
        none[here] = (start - np.asarray(prior.mean)[here]) / np.asarray(prior.std)[here]
        strong[here] = np.any([_flat(probe) != start for probe in candidate.probes], axis=0)
        places.append(here)
        place = here.stop
    out = []
    first = table.nuisance - prior.size
    for effect, here in zip(after.model.effects, places, strict=True):
        own = first + here.start + np.flatnonzero(strong[here])
        away = (z - none)[own - first]
        others = _without(table, used, own)
        instead = []
        column = 0
        for candidate in candidates:
            span = np.arange(column, column + len(candidate.probes))
            column += len(candidate.probes)
            start = candidate.start
            if (start.name, start.joint, start.channel) != (effect.name, effect.joint, effect.channel):
                instead.append((candidate, _loss(others, own, span, away)))
        best: dict = {}
        for candidate, loss in sorted(instead, key=lambda pair: pair[1]):
            best.setdefault((candidate.start.name, candidate.start.joint, candidate.start.channel), (candidate, loss))
        out.append(Standing(_loss(others, own, np.zeros(0, int), away), tuple(best.values())))
    return out


class _Left(NamedTuple):
    """Information of the own and of the candidate columns once the other parameters have explained what they can."""

    own: Float[np.ndarray, "own own"]
    cross: Float[np.ndarray, "own column"]
    candidates: Float[np.ndarray, "column column"]


def _without(table: Sheet, used, own) -> _Left:
    known = np.asarray(used, bool) & np.isfinite(table.information).all(axis=(1, 2))
    information = np.sum(table.information[known], axis=0)
    n = table.nuisance
    rest = np.setdiff1d(np.arange(n), own)
    columns = np.arange(n, information.shape[0])
    asked = np.concatenate([own, columns])
    factor = np.linalg.cholesky(information[np.ix_(rest, rest)] + table.prior[np.ix_(rest, rest)])
    half = np.linalg.solve(factor, information[np.ix_(rest, asked)])
    left = information[np.ix_(asked, asked)] - half.T @ half
    k = own.size
    return _Left(left[:k, :k], left[:k, k:], left[k:, k:])


def _loss(left: _Left, own, span, away) -> float:
    information = left.own
    if span.size:
        block = np.linalg.pinv(left.candidates[np.ix_(span, span)], rcond=1e-9, hermitian=True)
        information = information - left.cross[:, span] @ block @ left.cross[:, span].T
    return float(max(0.0, 0.5 * away @ information @ away))


def _flat(effect) -> np.ndarray:
    return np.concatenate([np.ravel(getattr(effect, name)) for name in fields(effect)])


def _named(candidate: Candidate) -> bool:
    return candidate.start.name != "unknown_function"
