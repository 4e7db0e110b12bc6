"""Gaussian smoothers: filter and RTS passes from the likeliest start, relinearised about their own path."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from ...model.base import AbstractModel, Prepared
from .kalman import Cubature, Filtered, Smoothed, Tangent, ekf, linear_posterior, relinearised, rts
from .mixture import MixtureSmoother
from .posterior import AbstractSmoother, Posterior, likeliest
from .start import StartBank


class GaussianSmoother(AbstractSmoother):
    """Gaussian filter and RTS smoother, from the likeliest of a bank of starts, relinearised about itself."""

    bank: StartBank
    linearise: Tangent | Cubature
    window: int = eqx.field(static=True, default=60)
    """Samples over which the hypotheses compete."""
    iterations: int = eqx.field(static=True, default=1)
    """Relinearisations about the smoothed path: Gauss-Newton steps on the path."""
    inflations: Float[Array, " pass"] = eqx.field(default=(1.0,), converter=jnp.asarray)
    """Process noise of each first pass, which decides only where the second one linearises, over that of the model: a
    looser filter follows where a tight one diverges."""
    branching: bool = eqx.field(static=True, default=True)
    """False: one Gaussian only, also where an angle that is not read is wide."""

    def tolerant(self) -> "GaussianSmoother":
        """The smoother with looser first passes."""
        return dataclasses.replace(self, inflations=(1.0, 10.0, 100.0))

    def second(self) -> MixtureSmoother | None:
        """The mixture, where an angle is not read and more than one branch is to be followed."""
        return MixtureSmoother(self.bank.angles, self.linearise) if self.branching and self.bank.angles else None

    def tries(self) -> "list[GaussianSmoother]":
        """One for each of the first passes."""
        passes = jnp.split(self.inflations, len(self.inflations))
        # One program, with `second` or without
        return [dataclasses.replace(self, inflations=one, branching=False) for one in passes]

    def path(self, model, seq: Prepared) -> tuple[Filtered, Smoothed]:
        """Filtered and smoothed states of the last iteration."""
        return self.tracked(model, seq)[:2]

    def tracked(self, model, seq: Prepared) -> tuple[Filtered, Smoothed, Float[Array, ""]]:
        """Filtered and smoothed states of the last iteration from the likeliest start, by the likeliest of the first
        passes, and `width` of the first of these.
        """
        start = self.bank.likeliest(model, seq, self.linearise, self.window)

        def again(_, latest):
            filtered = relinearised(model, latest[1].state, seq, self.linearise)
            return filtered, rts(filtered)

        def follow(looser):
            first = ekf(eqx.tree_at(lambda m: m.log_q, model, model.log_q + looser), start, seq, self.linearise)
            return *jax.lax.fori_loop(0, self.iterations, again, (first, rts(first))), self.width(first, seq)

        *paths, width = jax.vmap(follow)(jnp.log(self.inflations.astype(seq.y.dtype)))
        best = likeliest(paths[0].loglik)
        return *jax.tree.map(lambda a: a[best], paths), width[0]

    def width(self, filtered: Filtered, seq: Prepared) -> Float[Array, ""]:
        """Largest standard deviation of the angles given the readings so far [rad], 0 where they need no mixture; rows
        in which the bank still decides do not count, but for those before the first reading.
        """
        if not self.bank.angles:
            return jnp.zeros_like(filtered.loglik)
        variance = jnp.max(jnp.diagonal(filtered.state.cov, axis1=1, axis2=2)[:, jnp.asarray(self.bank.angles)], axis=1)
        decided = 0 if self.bank.offsets.shape[0] == 1 else self.window
        unread = jnp.cumsum(jnp.any(seq.observed, axis=1)) == 0
        counts = unread | (jnp.arange(variance.shape[0]) >= decided)
        return jnp.sqrt(jnp.max(jnp.where(counts, variance, 0.0)))

    def __call__(self, model: AbstractModel, seq: Prepared, *, key: PRNGKeyArray | None = None) -> Posterior:
        """Smooth one sequence; it draws nothing."""
        return linear_posterior(*self.tracked(model, seq))


def ExtendedKalmanSmoother(bank: StartBank, **options) -> GaussianSmoother:
    """The extended Kalman (tangent) filter with RTS smoother.

    Args:
        bank: hypotheses of the start, `fit.bank`.
        **options: of `GaussianSmoother`.

    Returns:
        The smoother.

    Example:
        >>> fit = nnap_em.identify(rig, train, key=key, epochs=2, smoother=nnap_em.estimate.ExtendedKalmanSmoother)
    """
    return GaussianSmoother(bank, Tangent(), **options)


def CubatureSmoother(bank: StartBank, **options) -> GaussianSmoother:
    """The cubature (sigma-point) filter with RTS smoother.

    Args:
        bank: hypotheses of the start, `fit.bank`.
        **options: of `GaussianSmoother`.

    Returns:
        The smoother.

    Example:
        >>> smoother = nnap_em.estimate.CubatureSmoother(fit.bank)
    """
    return GaussianSmoother(bank, Cubature(), **options)
