"""Hypotheses of the start: a hidden angle known to half a radian makes the first second curved or split."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...base.gaussian import Gaussian
from ...model.base import Prepared
from .kalman import ekf
from .posterior import likeliest


class StartBank(eqx.Module):
    """The prior of the start cut into narrow Gaussians on a grid of its wide directions.

    An extended filter from each hypothesis finds the branch, and the likelihood picks it.  States that the model has
    beyond those of the bank, the memory of effects, stay as they are.
    """

    offsets: Float[Array, "hypothesis state"]
    """Centres, in standard deviations of the prior."""
    shrink: Float[Array, " state"]
    """Standard deviation of a hypothesis over that of the prior."""

    angles: tuple[int, ...] = eqx.field(static=True, default=())
    """Places of all angles where one of them is not read: what becomes wide there is cut later, too."""

    def __init__(self, counts: tuple[int, ...], angles: tuple[int, ...] = ()):
        """`counts` hypotheses along each state (1: as it is)."""
        self.angles = angles
        outermost = 2.5  # outermost hypotheses, in standard deviations of the prior
        lines = [np.linspace(-outermost, outermost, n) if n > 1 else np.zeros(1) for n in counts]
        grid = np.stack([a.ravel() for a in np.meshgrid(*lines, indexing="ij")], axis=-1)
        self.offsets = jnp.asarray(grid, float)
        self.shrink = jnp.asarray([1.2 * outermost / (n - 1) if n > 1 else 1.0 for n in counts], float)

    def padded(self, states: int) -> "StartBank":
        """This bank for a state with more entries, which it leaves as they are."""
        extra = states - self.shrink.shape[0]
        wide = jnp.pad(self.offsets, ((0, 0), (0, extra)))
        narrow = jnp.pad(self.shrink, (0, extra), constant_values=1.0)
        return eqx.tree_at(lambda b: (b.offsets, b.shrink), self, (wide, narrow))

    def hypotheses(self, start: Gaussian) -> tuple[Gaussian, Float[Array, " hypothesis"]]:
        """The hypotheses and their log weights, unnormalised."""
        bank, spread = self.padded(start.mean.shape[0]), jnp.sqrt(jnp.diag(start.cov))
        means = start.mean[None] + bank.offsets * spread[None]
        cov = start.cov * jnp.outer(bank.shrink, bank.shrink)
        return Gaussian(means, jnp.tile(cov[None], (means.shape[0], 1, 1))), -0.5 * jnp.sum(self.offsets**2, axis=-1)

    def likeliest(self, model, seq: Prepared, linearise: Callable, window: int) -> Gaussian:
        """The hypothesis that the prior and the first `window` samples make likeliest."""
        starts, log_weight = self.hypotheses(model.start)
        if log_weight.shape[0] > 1:
            head = jax.tree.map(lambda a: a[:window], seq)
            log_weight = jax.vmap(lambda start: ekf(model, start, head, linearise).loglik)(starts) + log_weight
        best = likeliest(log_weight)
        return jax.tree.map(lambda a: a[best], starts)
