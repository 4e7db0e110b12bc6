"""Other paths of a joint that is not read, where the readings leave more than one."""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from ..data.dataset import Dataset
from ..em.loop import beyond, e_step
from ..model.base import AbstractModel, prepare
from ..numerics.parallel import each
from ..smoother.posterior import AbstractSmoother

BRANCH_DISTANCE = 1.0
"""Largest distance of two paths in an angle beyond which they are two branches [rad].

Paths of one branch, linearised about different starts, differ by up to 0.5 rad on machines; those of an arm that is
folded and one that is stretched by 3.
"""


class Branch(NamedTuple):
    """A path of a sequence beside the smoothed one."""

    sequence: int
    weight: float
    """Its probability, by the likelihood of the model linearised about each path."""
    mean: Float[np.ndarray, "time state"]
    """Smoothed states along it."""
    angle: int
    """Place of the angle in which it differs most."""
    rows: tuple[int, int]
    """First and last row in which that angle differs by more than half of `BRANCH_DISTANCE`."""


def branches(
    model: AbstractModel, data: Dataset, smoother: AbstractSmoother, *, key: PRNGKeyArray
) -> tuple[Branch, ...]:
    """Paths that the readings leave possible beside those of `e_step`, the likelier first in each sequence.

    A weight is no better than the model: where not all forces of a machine are modelled, it is overconfident.

    Args:
        model: such as `fit.model`.
        data: sequences.
        smoother: such as `fit.smoother`.
        key: random key of a smoother that draws.

    Returns:
        One for each other path, with its weight.

    Example:
        >>> nnap_em.smoothers.branches(fit.model, test, fit.smoother, key=key)
        ()
    """
    first, second = e_step(model, data, smoother, key=key), smoother.second()
    if second is None:
        return ()
    out = []
    for sequence in beyond(first, second):
        batch = jax.tree.map(lambda a, s=sequence: a[s : s + 1], (data, first.state))
        mean, loglik = (np.asarray(a[0]) for a in each(_paths, (model, second), batch))
        angles = mean[:, : int(np.sum(data.valid[sequence])), list(second.angles)]
        smoothed = np.asarray(first.state.mean[sequence])[: angles.shape[1], list(second.angles)]
        for i, share in zip(*modes(loglik, angles), strict=True):
            gap = distance(angles[i], smoothed)
            most = int(np.argmax(gap.max(axis=0)))
            rows = np.flatnonzero(gap[:, most] > BRANCH_DISTANCE / 2)
            if share >= 0.01 and gap.max() > BRANCH_DISTANCE:
                span = int(rows[0]), int(rows[-1])
                out.append(Branch(int(sequence), float(share), mean[i], second.angles[most], span))
    return tuple(out)


def modes(
    loglik: Float[np.ndarray, " path"], angles: Float[np.ndarray, "path time angle"]
) -> tuple[Int[np.ndarray, " mode"], Float[np.ndarray, " mode"]]:
    """The likeliest path of each branch, in the order of likelihood, and the probabilities of the branches."""
    chosen: list[int] = []
    for i in np.argsort(-loglik, kind="stable"):
        if np.isfinite(loglik[i]) and all(np.max(distance(angles[i], angles[j])) > BRANCH_DISTANCE for j in chosen):
            chosen.append(int(i))
    weight = np.exp(loglik[chosen] - np.max(loglik[chosen]))
    return np.asarray(chosen), weight / weight.sum()


def distance(a: Float[np.ndarray, "time angle"], b: Float[np.ndarray, "time angle"]) -> Float[np.ndarray, "time angle"]:
    """Distance of two paths, whole turns aside [rad]."""
    return np.abs((a - b + np.pi) % (2 * np.pi) - np.pi)


def _paths(common, one) -> tuple[Float[Array, "path time state"], Float[Array, " path"]]:
    """Means of the paths of one sequence, and their log-likelihoods."""
    (model, second), (seq, first) = common, one
    paths, _ = second.paths(model, prepare(model, seq), first)
    return paths.state.mean, paths.loglik
