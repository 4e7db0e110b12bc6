"""One quantity from several fits: a joint test that it is the same in all of them, and one pooled answer."""

from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.stats
from jaxtyping import Float

LEAST_VARIANCE = 1e-2
"""Smallest variance of a direction that a joint test uses, in the mean variance of its numbers [1].

Contrasts between neighbouring nodes of a curve are stated to be far surer than the nodes, because the network that
draws the curve is smooth: that is a property of the network, not of the logs."""


class JointTest(NamedTuple):
    """A test that a quantity is the same in all fits."""

    statistic: float
    """Wald statistic, which is chi-square with `freedom` degrees of freedom where nothing changed."""
    freedom: int
    p_value: float
    """Chance of such a statistic where nothing changed."""


class Pooled(NamedTuple):
    """One answer from several fits."""

    value: Float[np.ndarray, " number"]
    std: Float[np.ndarray, " number"]


def joint_test(value: Float[np.ndarray, "fit number"], cov: Float[np.ndarray, "fit number number"]) -> JointTest:
    """Wald test that all numbers are the same in all fits, whose errors are independent.

        Q = z' U diag(1 / lambda) U' z,   z = D^-1/2 H x,   U diag(lambda) U' = D^-1/2 S D^-1/2,   D = diag(S)

    with H the orthonormal contrasts between fits, x the stacked numbers and S the covariance of H x. Directions of
    which lambda is below `LEAST_VARIANCE` are left out, and Q is chi-square with as many degrees of freedom as are
    left. [Cochran 1954, Biometrics 10, 101, for one number; Andrews 1987, Econometric Theory 3, 348, for Wald tests
    with a generalised inverse]
    """
    contrasts = np.asarray(scipy.linalg.helmert(len(value)))
    differences = (contrasts @ value).ravel()
    spread = np.einsum("ai,bi,imn->ambn", contrasts, contrasts, cov).reshape(differences.size, differences.size)
    scale = np.sqrt(np.maximum(np.diag(spread), 0.0))
    known = scale > 0
    variance, turn = np.linalg.eigh(spread[np.ix_(known, known)] / np.outer(scale[known], scale[known]))
    determined = variance >= LEAST_VARIANCE
    along = turn.T @ (differences[known] / scale[known])
    statistic, freedom = float(np.sum(along[determined] ** 2 / variance[determined])), int(determined.sum())
    return JointTest(statistic, freedom, float(scipy.stats.chi2.sf(statistic, freedom)) if freedom else 1.0)


def apart(value: Float[np.ndarray, "fit number"], std: Float[np.ndarray, "fit number"]) -> Float[np.ndarray, " number"]:
    """Difference of each number between fits, of two |a - b| / (s_a^2 + s_b^2)^1/2 [standard deviations].

    sqrt(sum_i w_i (x_i - x)^2),   w = 1 / s^2,   x the mean weighted by w     [Cochran 1954, Biometrics 10, 101]
    """
    weight = 1 / std**2
    return np.sqrt(np.sum(weight * (value - np.sum(weight * value, axis=0) / weight.sum(axis=0)) ** 2, axis=0))


def pool(
    value: Float[np.ndarray, "fit number"],
    std: Float[np.ndarray, "fit number"],
    prior_std: float = np.inf,
    test: JointTest | None = None,
) -> Pooled:
    """Mean of each number by itself, weighted by 1 / s^2.

    A prior of standard deviation `prior_std`, which every fit has in its posterior, is taken out of each and counts
    once in the result. Where the fits differ by more than they state, the standard deviation is widened by
    (Q / freedom)^1/2 of their `test` [Birge 1932, Phys. Rev. 40, 207].
    """
    shared = 1 / prior_std**2
    weight = np.maximum(1 / std**2 - shared, 1e-9 / std**2)
    total = weight.sum(axis=0)
    widened = 1.0 if test is None else np.sqrt(max(1.0, test.statistic / max(test.freedom, 1)))
    return Pooled(np.sum(weight * value, axis=0) / total, widened / np.sqrt(total + shared))
