"""The posterior of a model that was linearised about a path."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..numerics.gaussian import cholesky, cubature, lower, product
from .kalman import Filtered, Smoothed
from .posterior import Posterior


def linear_posterior(filtered: Filtered, smoothed: Smoothed) -> Posterior:
    """The posterior of a model that was linearised about a path."""
    prev, following = pair_nodes(smoothed)
    endless = jnp.full_like(filtered.loglik, jnp.inf)
    affine = jax.tree.map(lambda a: a[:-1, None], filtered.affine)
    kick = following - (jnp.sum(affine.matrix * prev[..., None, :], axis=-1) + affine.offset)
    return Posterior(smoothed.state, prev, following, kick, filtered.affine.noise[:-1], filtered.loglik, endless)


def pair_nodes(smoothed: Smoothed) -> tuple[Float[Array, "steps node state"], Float[Array, "steps node state"]]:
    """Cubature nodes of the Gaussian p(x_k, x_{k+1} | y) of every step."""

    def one(mean, cov, gain, mean_next, cov_next):
        n = mean.shape[0]
        unit = cubature(2 * n, mean.dtype)
        later = lower(cholesky(cov_next))
        left = cov - product(product(gain, cov_next), gain.T)
        factor = lower(cholesky(left + 1e-14 * jnp.eye(n, dtype=mean.dtype)))
        spread_next = product(unit[:, :n], later.T)
        following = mean_next[None] + spread_next
        return mean[None] + product(spread_next, gain.T) + product(unit[:, n:], factor.T), following

    mean, cov = smoothed.state
    return jax.vmap(one)(mean[:-1], cov[:-1], smoothed.gain, mean[1:], cov[1:])
