"""The posterior of a model that was linearised about a path."""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..numerics.gaussian import cholesky, lower, product
from .kalman import Affine, Filtered, Smoothed
from .posterior import Posterior


def linear_posterior(filtered: Filtered, smoothed: Smoothed) -> Posterior:
    """The posterior of a model that was linearised about a path."""
    mean, cov = smoothed.state
    affine = jax.tree.map(lambda a: a[:-1], filtered.affine)
    nodes = jax.vmap(_pair_nodes)(mean[:-1], cov[:-1], smoothed.gain, mean[1:], cov[1:], affine)
    endless = jnp.full_like(filtered.loglik, jnp.inf)
    return Posterior(smoothed.state, *nodes, affine.noise, filtered.loglik, endless)


def _pair_nodes(
    mean, cov, gain, mean_next, cov_next, affine: Affine
) -> tuple[Float[Array, "node state"], Float[Array, "node state"], Float[Array, "node state"]]:
    """Cubature nodes of the Gaussian p(x_k, x_{k+1} | y) and their kicks.

    x_{k+1} = m_{k+1} + L z, x_k = m_k + G L z + C w with L L' the covariance of x_{k+1}, C C' that of x_k beyond it.
    The 2 n points of (z, w) lie on its axes in opposite pairs, so that nodes are columns of these factors.
    """
    n = mean.shape[0]
    reach = math.sqrt(2 * n)
    left = cov - product(product(gain, cov_next), gain.T)
    later = reach * lower(cholesky(cov_next)).T
    alone = reach * lower(cholesky(left + 1e-14 * jnp.eye(n, dtype=mean.dtype))).T
    before = jnp.concatenate([product(later, gain.T), alone])
    after = jnp.concatenate([later, jnp.zeros_like(alone)])
    kick = mean_next - product(affine.matrix, mean) - affine.offset
    centres_and_axes = (mean, before), (mean_next, after), (kick, after - product(before, affine.matrix.T))
    prev, following, kicks = (jnp.concatenate([at[None] + axes, at[None] - axes]) for at, axes in centres_and_axes)
    return prev, following, kicks
