"""Design criterion: a cost of expected information, in units of a logarithm: one less is a factor e in a std."""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float
from scipy.optimize import root_scalar

from .information import Fit

Information = Float[np.ndarray, "*proposal phi phi"]
"""Information of some sequences together, or of each; leading axes are proposals."""


def some(tree, which):
    """Some of the proposals along the first axis of all arrays of a tree."""
    return jax.tree.map(lambda a: a[which], tree)


def after(cov: Float[np.ndarray, "phi phi"], information) -> Float[np.ndarray, "*proposal phi phi"]:
    """Covariance of phi with more information: (C^-1 + A)^-1, of a C that may be singular."""
    return np.linalg.solve(np.eye(len(cov)) + cov @ information, np.broadcast_to(cov, information.shape))


def share(fit: Fit, logs: Float[np.ndarray, "phi phi"]) -> float:
    """Share of the expected information of the `logs` of a fit that the covariance of the fit contains.

    It is one where noise is that of the model; on a real machine recordings disagree, the posterior is wider
    (`em.stated.widened`), and new logs add as much less.
    """
    before, variances = np.asarray(fit.prior_cov), np.diagonal(np.asarray(fit.cov))
    counts = variances > 1e-12 * variances.max()

    def wider(part: float) -> float:
        """Mean logarithm of the variances over those of the fit."""
        return float(np.mean(np.log(np.diagonal(after(before, part * logs))[counts] / variances[counts])))

    return 1.0 if wider(1.0) >= 0 or wider(1e-6) <= 0 else root_scalar(wider, bracket=(1e-6, 1.0)).root


class Criterion(NamedTuple):
    """Width of the friction bands, the widest first, over all velocities and once more near rest; and mean logarithm
    of the standard deviations of parameters, in those of the prior."""

    fit: Fit
    scale: Float[np.ndarray, " dof"]
    """Size of the friction map of each joint [N m]."""
    weight: Float[np.ndarray, "range dof node"]
    """Weight of velocities, in every range; their sum is 1."""
    friction: bool = True
    """True where friction is learned."""

    def cost(self, expected: Information) -> Float[np.ndarray, "*proposal"]:
        """Cost of information, of friction and parameters together."""
        variance = np.diagonal(after(np.asarray(self.fit.cov), expected), axis1=-2, axis2=-1)
        shape, size, cost = self.fit.nodes.shape, self.fit.nodes.size, np.zeros(variance.shape[:-1])
        if self.friction:
            relative = variance[..., :size].reshape(*cost.shape, *shape) / self.scale[:, None] ** 2
            mean = np.einsum("...jn,rjn->...r", relative**2, self.weight)
            cost += 0.25 * np.mean(np.log(mean + 1e-30), axis=-1)
        if variance.shape[-1] > size:
            cost += 0.5 * np.mean(np.log(np.maximum(variance[..., size:], 1e-30)), axis=-1)
        return cost
