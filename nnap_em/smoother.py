"""E-steps: p(x_{0:T} | y_{0:T}) of one sequence, in the one form that the M-step takes."""

from abc import abstractmethod
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from .data import Dataset, fill_missing
from .gaussian import Gaussian, cholesky, cubature, lower, product
from .kalman import Cubature, Filtered, Smoothed, Tangent, ekf, kalman_filter, linear_reading, rts
from .model import AbstractModel


class Posterior(NamedTuple):
    """The smoothing distribution: its marginals, and equal-weight nodes of p(x_k, x_{k+1} | y) for every step."""

    state: Gaussian
    prev: Float[Array, "*seq steps node state"]
    next: Float[Array, "*seq steps node state"]
    kick: Float[Array, "*seq steps node state"]
    """The process noise x_{k+1} - f(x_k) of a node, as the smoother's own transition has it."""
    excess: Float[Array, "*seq steps state state"]
    """Covariance of a kick beyond the process noise, where the smoother's transition is an approximation."""
    loglik: Float[Array, "*seq"]
    ess: Float[Array, "*seq"]
    """Mean effective sample size of a particle smoother; infinite where nothing is sampled."""


class AbstractSmoother(eqx.Module):
    """An E-step for one sequence."""

    @abstractmethod
    def __call__(self, model: AbstractModel, seq: Dataset, *, key: PRNGKeyArray) -> Posterior:
        """Smooth `seq` under `model`; deterministic smoothers leave `key` alone."""


def active_steps(valid: Bool[Array, " time"]) -> Bool[Array, " time"]:
    """True at k where the step from k to k + 1 lies inside the data."""
    return jnp.concatenate([valid[1:], jnp.zeros(1, bool)])


class StartBank(eqx.Module):
    """Hypotheses of the start: the prior cut into narrow Gaussians on a grid of its wide directions.

    A hidden angle known to half a radian makes the posterior of the first second curved or split; an extended
    filter from each hypothesis finds the branch, and the likelihood picks it.
    """

    offsets: Float[Array, "hypothesis state"]
    """Centres, in standard deviations of the prior."""
    shrink: Float[Array, " state"]
    """Standard deviation of a hypothesis over that of the prior."""

    def __init__(self, counts: tuple[int, ...], dtype=float, reach: float = 2.5):
        """`counts` hypotheses along each state (1: as it is)."""
        lines = [jnp.linspace(-reach, reach, n, dtype=dtype) if n > 1 else jnp.zeros(1, dtype) for n in counts]
        self.offsets = jnp.stack([a.ravel() for a in jnp.meshgrid(*lines, indexing="ij")], axis=-1)
        self.shrink = jnp.asarray([1.2 * reach / (n - 1) if n > 1 else 1.0 for n in counts], dtype)

    def padded(self, states: int) -> "StartBank":
        """This bank for a state with more entries, which it leaves as they are."""
        extra = states - self.shrink.shape[0]
        wide = jnp.pad(self.offsets, ((0, 0), (0, extra)))
        narrow = jnp.pad(self.shrink, (0, extra), constant_values=1.0)
        return eqx.tree_at(lambda b: (b.offsets, b.shrink), self, (wide, narrow))

    def hypotheses(self, start: Gaussian) -> tuple[Gaussian, Float[Array, " hypothesis"]]:
        """The hypotheses and their log weights, unnormalised."""
        spread = jnp.sqrt(jnp.diag(start.cov))
        means = start.mean[None] + self.offsets * spread[None]
        cov = start.cov * jnp.outer(self.shrink, self.shrink)
        return Gaussian(means, jnp.tile(cov[None], (means.shape[0], 1, 1))), -0.5 * jnp.sum(self.offsets**2, axis=-1)


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

    def path(self, model, seq: Dataset) -> tuple[Filtered, Smoothed]:
        """Filtered and smoothed states of the last iteration."""
        y, observed = fill_missing(seq.y)
        observed = observed & seq.valid[:, None]
        u, active = model.inputs(seq), active_steps(jnp.asarray(seq.valid))
        start = self.likeliest(model, u, y, observed, active)

        def follow(inflation):
            loose = eqx.tree_at(lambda m: m.log_q, model, model.log_q + inflation)
            filtered = ekf(loose, start, u, y, observed, active, self.linearise)

            def again(_, now):
                return self.relinearise(model, now[1].state, seq)

            return jax.lax.fori_loop(0, self.iterations, again, (filtered, rts(filtered)))

        tracks = jax.vmap(follow)(jnp.log(jnp.asarray(self.inflations, y.dtype)))
        loglik = tracks[0].loglik
        best = jnp.argmax(jnp.where(jnp.isfinite(loglik), loglik, -jnp.inf))
        return jax.tree.map(lambda a: a[best], tracks)

    def likeliest(self, model, u, y, observed, active) -> Gaussian:
        """The start of the bank that the first samples speak for."""
        starts, log_weight = self.bank.hypotheses(model.start)
        if log_weight.shape[0] == 1:
            return jax.tree.map(lambda a: a[0], starts)
        head = self.window

        def loglik_from(start):
            return ekf(model, start, u[:head], y[:head], observed[:head], active[:head], self.linearise).loglik

        score = jax.vmap(loglik_from)(starts) + log_weight
        best = jnp.argmax(jnp.where(jnp.isfinite(score), score, -jnp.inf))
        return jax.tree.map(lambda a: a[best], starts)

    def relinearise(self, model, path: Gaussian, seq: Dataset) -> tuple[Filtered, Smoothed]:
        """One pass of the iterated smoother: all steps linearised about `path` at once [Bell 1994]."""
        y, observed = fill_missing(seq.y)
        u = model.inputs(seq)
        affine = jax.vmap(lambda state, u: self.linearise(model, state, u))(path, u)
        reading = jax.vmap(lambda x, u: linear_reading(model, x, u))(path.mean, u)
        active = active_steps(jnp.asarray(seq.valid))
        observed = observed & seq.valid[:, None]
        filtered = kalman_filter(model.log_q, model.log_r, model.start, affine, reading, y, observed, active)
        return filtered, rts(filtered)

    def __call__(self, model: AbstractModel, seq: Dataset, *, key: PRNGKeyArray | None = None) -> Posterior:
        return linear_posterior(*self.path(model, seq))


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
