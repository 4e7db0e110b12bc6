"""The particle smoother: a filter guided by a Gaussian smoother, and trajectories drawn backward through it."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from ....base.gaussian import Gaussian
from ....model.base import Prepared
from ..gaussian import CubatureSmoother, GaussianSmoother
from ..posterior import AbstractSmoother, Posterior
from ..start import StartBank
from .backward import ExactBackward, ffbs
from .filter import ParticleHistory, particle_filter
from .potentials import Bootstrap, Guided, Lookahead


class ParticleSmoother(AbstractSmoother):
    """Draws of p(x_{0:T} | y) through a particle filter guided by a Gaussian smoother."""

    guide: GaussianSmoother
    proposal: Bootstrap | Guided | Lookahead = Lookahead()
    backward: ExactBackward = ExactBackward()
    num_particles: int = eqx.field(static=True, default=300)
    num_paths: int = eqx.field(static=True, default=100)
    dtype: str = eqx.field(static=True, default="float32", converter=lambda dtype: jnp.dtype(dtype).name)
    """Type of the particles; Gaussians and results keep the precision of the model."""

    @property
    def bytes_per_row(self) -> int:
        """Memory [B] that a row takes, measured for docs/results/throughput.md."""
        return self.guide.bytes_per_row + 64 * self.num_particles + 128 * self.num_paths

    def tolerant(self) -> "ParticleSmoother":
        """The smoother with a guide whose first passes are looser."""
        return dataclasses.replace(self, guide=self.guide.tolerant())

    def history(self, model, seq: Prepared, *, key: PRNGKeyArray) -> ParticleHistory:
        """The filter alone, with its effective sample size."""
        potentials = self.proposal(model, seq, *self.guide.path(model, seq))
        size, dtype = self.num_particles, jnp.dtype(self.dtype)
        return particle_filter(model, potentials, seq, num_particles=size, key=key, dtype=dtype)

    def __call__(self, model, seq: Prepared, *, key: PRNGKeyArray) -> Posterior:
        """Draw paths of one sequence."""
        key_filter, key_paths = jax.random.split(key)
        history = self.history(model, seq, key=key_filter)
        x, kick = ffbs(history, self.backward, num_paths=self.num_paths, key=key_paths)
        mean = jnp.mean(x, axis=1)
        e = x - mean[:, None]
        cov = jnp.swapaxes(e, 1, 2) @ e / jnp.asarray(self.num_paths, e.dtype)
        inside = jnp.concatenate([jnp.ones(1, bool), history.active[:-1]])
        ess = jnp.mean(history.ess, where=inside).astype(history.loglik.dtype)
        return Posterior(Gaussian(mean, cov), x[:-1], x[1:], kick, jnp.zeros_like(cov[1:]), history.loglik, ess)


def banked(bank: StartBank, **options) -> ParticleSmoother:
    """The particle smoother behind the cubature smoother, which picks the start."""
    return ParticleSmoother(CubatureSmoother(bank), **options)
