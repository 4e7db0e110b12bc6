"""Gaussian smoothers: filter and RTS passes from the likeliest start, relinearised about their own path."""

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from ..model.base import AbstractModel, Prepared
from ..numerics.gaussian import Gaussian, cholesky, cubature, lower, product
from .kalman import Cubature, Filtered, Smoothed, Tangent, ekf, relinearised, rts
from .posterior import AbstractSmoother, Posterior, likeliest
from .start import StartBank


class GaussianSmoother(AbstractSmoother):
    """Gaussian filter and RTS smoother, from the likeliest of a bank of starts, relinearised about itself."""

    bank: StartBank
    linearise: Tangent | Cubature
    window: int = eqx.field(static=True, default=60)
    """Samples over which the hypotheses compete."""
    iterations: int = eqx.field(static=True, default=1)
    """Relinearisations about the smoothed path."""
    inflations: tuple[float, ...] = eqx.field(static=True, default=(1.0,))
    """Process noise of the first pass over that of the model: a looser filter keeps a track that a tight one loses."""

    @property
    def bytes_per_row(self) -> int:
        """Memory [B] that a row takes."""
        return 8192  # measured for four states in 64 bits (docs/results/throughput.md)

    def tolerant(self) -> "GaussianSmoother":
        """The smoother with looser first passes."""
        return dataclasses.replace(self, inflations=(1.0, 10.0, 100.0))

    def tries(self) -> "list[_Loosened]":
        """One for each of the first passes."""
        once = dataclasses.replace(self, inflations=(1.0,))
        return [_Loosened(once, jnp.asarray(math.log(factor), float)) for factor in self.inflations]

    def path(self, model, seq: Prepared) -> tuple[Filtered, Smoothed]:
        """Filtered and smoothed states of the last iteration."""
        start = self.likeliest(model, seq)
        looser = jnp.log(jnp.asarray(self.inflations, seq.y.dtype))
        tracks = jax.vmap(lambda looser: self.follow(model, seq, start, looser))(looser)
        best = likeliest(tracks[0].loglik)
        return jax.tree.map(lambda a: a[best], tracks)

    def follow(self, model, seq: Prepared, start: Gaussian, looser: Float[Array, ""]) -> tuple[Filtered, Smoothed]:
        """Smoothing from one start, the log of the process noise of the first pass `looser` than that of the model."""
        filtered = ekf(eqx.tree_at(lambda m: m.log_q, model, model.log_q + looser), start, seq, self.linearise)

        def again(_, now):
            filtered = relinearised(model, now[1].state, seq, self.linearise)
            return filtered, rts(filtered)

        return jax.lax.fori_loop(0, self.iterations, again, (filtered, rts(filtered)))

    def likeliest(self, model, seq: Prepared) -> Gaussian:
        """The start of the bank that the first samples make likeliest."""
        starts, log_weight = self.bank.hypotheses(model.start)
        if log_weight.shape[0] == 1:
            return jax.tree.map(lambda a: a[0], starts)
        head = jax.tree.map(lambda a: a[: self.window], seq)
        loglik = jax.vmap(lambda start: ekf(model, start, head, self.linearise).loglik)
        best = likeliest(loglik(starts) + log_weight)
        return jax.tree.map(lambda a: a[best], starts)

    def __call__(self, model: AbstractModel, seq: Prepared, *, key: PRNGKeyArray | None = None) -> Posterior:
        """Smooth one sequence; it draws nothing."""
        return linear_posterior(*self.path(model, seq))


class _Loosened(AbstractSmoother):
    """One try of a Gaussian smoother; how loose it is is no part of the program."""

    smoother: GaussianSmoother
    looser: Float[Array, ""]

    @property
    def bytes_per_row(self) -> int:
        """Memory [B] that a row takes."""
        return self.smoother.bytes_per_row

    def __call__(self, model: AbstractModel, seq: Prepared, *, key: PRNGKeyArray | None = None) -> Posterior:
        """Smooth one sequence; it draws nothing."""
        start = self.smoother.likeliest(model, seq)
        return linear_posterior(*self.smoother.follow(model, seq, start, self.looser))


def ExtendedKalmanSmoother(bank: StartBank, **options) -> GaussianSmoother:
    """The extended Kalman (tangent) filter with RTS smoother."""
    return GaussianSmoother(bank, Tangent(), **options)


def CubatureSmoother(bank: StartBank, **options) -> GaussianSmoother:
    """The cubature (sigma-point) filter with RTS smoother."""
    return GaussianSmoother(bank, Cubature(), **options)


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
        rest = lower(cholesky(left + 1e-14 * jnp.eye(n, dtype=mean.dtype)))
        spread_next = product(unit[:, :n], later.T)
        following = mean_next[None] + spread_next
        return mean[None] + product(spread_next, gain.T) + product(unit[:, n:], rest.T), following

    mean, cov = smoothed.state
    return jax.vmap(one)(mean[:-1], cov[:-1], smoothed.gain, mean[1:], cov[1:])
