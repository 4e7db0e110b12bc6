"""Backward draws by a few Metropolis steps, whose cost does not grow with the number of particles."""

import equinox as eqx
import jax
import jax.numpy as jnp

from .backward import AbstractBackward
from .potentials import dot
from .resampling import cumsum, sweep


class MetropolisBackward(AbstractBackward):
    """A few independent Metropolis steps from the genealogical parent [Bunch & Godsill 2013; Dau & Chopin 2023].

    O(N) per step.  Candidates come from the weights that the filter carries, so that only the transition density and
    psi~ are left in the ratio.  A candidate is a random entry of a systematic draw that is made anew for each step:
    each path sees independent draws from the weights, without a search per path.
    """

    steps: int = eqx.field(static=True, default=4)

    @property
    def draws(self) -> int:
        """Two for every step."""
        return 2 * self.steps

    def __call__(self, x_next, f, log_w, log_ahead, parent, uniform):
        """Indices after the steps, from the parent on."""
        choose, accept = jnp.split(uniform, 2)
        carried = log_w + log_ahead
        reach = cumsum(jnp.exp(carried - jnp.max(carried)))
        paths = parent.shape[0]

        def score(index):
            e = [x_next[i] - f[i][index] for i in range(f.shape[0])]
            return -0.5 * dot(e, e) - log_ahead[index]

        def step(carry, uniform):
            index, value = carry
            choose, accept = uniform
            place = choose * paths
            whole = jnp.floor(place)
            draws = sweep(reach, place[0] - whole[0], paths)
            candidate = draws[jnp.minimum(whole.astype(jnp.int32), paths - 1)]
            proposed = score(candidate)
            better = jnp.log(accept) < proposed - value
            return (jnp.where(better, candidate, index), jnp.where(better, proposed, value)), None

        (index, _), _ = jax.lax.scan(step, (parent, score(parent)), (choose, accept))
        return index
