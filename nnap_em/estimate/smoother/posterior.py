"""The one form in which every smoother gives p(x_{0:T} | y_{0:T}) of a sequence, and what a smoother is."""

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from ...base.gaussian import Gaussian
from ...model.base import AbstractModel, Prepared


class Posterior(NamedTuple):
    """The smoothing distribution: its marginals, and equal-weight nodes of p(x_k, x_{k+1} | y) for every step.

    Nodes are paths of particles or cubature points of a Gaussian: an M-step takes means of nonlinear functions over
    them; the lag-one covariance is that of `prev` and `next`.
    """

    state: Gaussian
    prev: Float[Array, "*seq steps node state"]
    next: Float[Array, "*seq steps node state"]
    kick: Float[Array, "*seq steps node state"]
    """The process noise x_{k+1} - f(x_k) of a node, as the smoother's own transition has it."""
    excess: Float[Array, "*seq steps state state"]
    """Covariance of a kick beyond the process noise, where the smoother's transition is an approximation."""
    loglik: Float[Array, "*seq"]
    """Log-likelihood of the readings: for Gaussian smoothers that of the model linearised about the smoothed path, for
    particles an estimate of that of the model itself; values of the two kinds are not compared."""
    ess: Float[Array, "*seq"]
    """Mean effective sample size of a particle smoother; infinite where nothing is sampled."""
    width: Float[Array, "*seq"] | None = None
    """Largest standard deviation of an angle given the readings so far [rad]; None where it is not reported."""


class AbstractSmoother(eqx.Module):
    """An E-step for one sequence.  `Identified` carries it: all that smooths with the fitted model uses it."""

    room: ClassVar[int] = 2**30
    """Memory [B] that smoothing may take on a device beside its results."""

    @property
    def bytes_per_row(self) -> int:
        """Memory [B] that a row of a sequence takes: of four states in 64 bits (docs/results/throughput.md)."""
        return 8192

    @abstractmethod
    def __call__(self, model: AbstractModel, seq: Prepared, *, key: PRNGKeyArray) -> Posterior:
        """Smooth `seq` under `model`; deterministic smoothers leave `key` alone."""

    def tolerant(self) -> "AbstractSmoother":
        """The same for a finished model, where no next epoch recovers a diverged sequence: slower, if it can be."""
        return self

    def second(self) -> Any:
        """The `MixtureSmoother` of sequences whose `width` is beyond its `wide`; None where there is none."""
        return None

    def tries(self) -> Sequence["AbstractSmoother"]:
        """Smoothers of one structure, one program for all, of which each sequence keeps the likeliest outcome."""
        return (self,)


def likeliest(score: Float[Array, " candidate"]) -> Int[Array, ""]:
    """Index of the largest finite score."""
    return jnp.argmax(jnp.where(jnp.isfinite(score), score, -jnp.inf))
