"""A model with what was added to it: every addition is one record of law, prior and evidence."""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...estimate.em.mstep import ScoringMStep
from ...estimate.em.prior import ParameterPrior
from ...estimate.identify import Identified
from ...model.effects import AbstractEffect, Candidate, fields, flat
from ...model.state_space import StateSpaceModel, with_effects
from .keys import Key


class Evidence(NamedTuple):
    """Evidence for an added effect."""

    gain: float = math.nan
    """Log-likelihood over the model without it [nat], of a law that was read off; NaN of others."""
    equivalent: tuple[Key, ...] = ()
    """Effects that the data cannot distinguish from it."""
    share: float = math.nan
    """Share of the multi-step error that it removes on recordings left out of its fit; of a law read off NaN."""
    chance: float = math.nan
    """Largest such share of any law whose columns are shifted in time."""
    parts: tuple[int, ...] = ()
    """Number of parts left out on which the error fell, and of all."""
    removed: float = math.nan
    """Share of the squared error that its refit removed where it was found."""
    candidate: Candidate | None = None
    """Candidate that was fitted; None for a law that was read off."""


class Addition(NamedTuple):
    """An effect in the model, with the prior of its parameters."""

    effect: AbstractEffect
    mean: Float[Array, " param"]
    std: Float[Array, " param"]
    evidence: Evidence | None = None


class Hypothesis(NamedTuple):
    """A model, the rule that fits it, and why its effects are in it."""

    model: StateSpaceModel
    m_step: ScoringMStep
    evidence: tuple[Evidence | None, ...] = ()

    @property
    def additions(self) -> tuple[Addition, ...]:
        """The effects of the model, each with all that belongs to it."""
        prior = self.m_step.prior
        entries = zip(self.model.effects, blocks(self.model, self.m_step), self.evidence, strict=True)
        return tuple(Addition(effect, prior.mean[of], prior.std[of], evidence) for effect, of, evidence in entries)

    def having(self, additions: tuple[Addition, ...]) -> "Hypothesis":
        """The same declared model with other additions."""
        prior = self.m_step.prior
        declared = prior.size - sum(a.mean.shape[0] for a in self.additions)
        added = [f"{i}.{name}" for i, a in enumerate(additions) for name in fields(a.effect)]
        mean = jnp.concatenate([prior.mean[:declared], *(a.mean for a in additions)])
        std = jnp.concatenate([prior.std[:declared], *(a.std for a in additions)])
        joined = ParameterPrior((*prior.declared, *added), mean, std)
        model, first = with_effects(self.model, tuple(a.effect for a in additions)), self.m_step.log_q_prior
        own = 2 * len(model.system.coordinates)  # noise of a memory has no ratio to hold
        shape = model.log_q if first is None else model.log_q.at[:own].set(first[:own])
        fields_of, is_none = lambda m: (m.prior, m.log_q_prior), lambda leaf: leaf is None
        rule = eqx.tree_at(fields_of, self.m_step, (joined, shape), is_leaf=is_none)
        return Hypothesis(model, rule, tuple(a.evidence for a in additions))

    def plus(self, effect: AbstractEffect, candidate: Candidate, evidence: Evidence | None = None) -> "Hypothesis":
        """The hypothesis with one effect more, behind the others."""
        centre = candidate.start if effect.linear else effect
        return self.having((*self.additions, Addition(effect, flat(centre), flat(candidate.prior_std), evidence)))

    def without(self, place: int) -> "Hypothesis":
        """The hypothesis without the effect at `place`."""
        return self.having(tuple(a for i, a in enumerate(self.additions) if i != place))

    def refitted(self, model: StateSpaceModel) -> "Hypothesis":
        """The same with other numbers in the model."""
        return self._replace(model=model)


def declared(fitted: Identified) -> Hypothesis:
    """A fit, of whose laws a search keeps all."""
    return Hypothesis(fitted.model, fitted.m_step, (None,) * len(fitted.model.effects))


def blocks(model: StateSpaceModel, of: Any) -> list[slice]:
    """Slice of the parameters of every effect among all that are estimated, whose prior `of` has."""
    sizes = [flat(effect).size for effect in model.effects]
    ends = np.cumsum(sizes) + of.prior.size - sum(sizes)
    return [slice(int(end - size), int(end)) for end, size in zip(ends, sizes, strict=True)]


def covariances(model: StateSpaceModel, of: Any, hessian) -> list[Float[np.ndarray, "param param"]]:
    """Covariance of the parameters of every effect, all else integrated out (Laplace); `of` has their prior."""
    cov, prior = np.linalg.inv(np.asarray(hessian)), of.prior
    cut, std = cov.shape[0] - prior.size, np.asarray(prior.std)
    cov = cov[cut:, cut:] * np.outer(std, std)
    return [cov[block, block] for block in blocks(model, of)]
