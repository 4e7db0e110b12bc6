"""A hypothesis along its smoothed paths, of which every loss is taken."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from ...base.gaussian import Gaussian
from ...base.ode import integrate
from ...base.parallel import each
from ...estimate.em.loop import e_step
from ...estimate.em.mstep import ScoringMStep, not_diverged
from ...estimate.em.multistep import errors, followed
from ...estimate.em.recorded import Risen, left_out, level, risen
from ...estimate.identify import Identified
from ...estimate.smoother.posterior import AbstractSmoother
from ...logs.dataset import Dataset
from ...model.state_space import StateSpaceModel
from .hypothesis import Hypothesis, declared


class SmoothedFit(NamedTuple):
    """A fitted hypothesis beside the model without its laws, and its smoothed paths."""

    declared: StateSpaceModel
    hypothesis: Hypothesis
    path: Gaussian
    data: Dataset
    used: Bool[np.ndarray, " seq"]
    """Sequences that the smoother follows."""
    rows: int
    """Rows of the longest recording, of which `data` may be a part."""

    @property
    def model(self) -> StateSpaceModel:
        """Model of the hypothesis."""
        return self.hypothesis.model

    @property
    def m_step(self) -> ScoringMStep:
        """M-step that fits it."""
        return self.hypothesis.m_step


def along(fitted: Identified, data: Dataset, smoother: AbstractSmoother) -> SmoothedFit:
    """A fit as it is along some recordings."""
    hypothesis, posterior = declared(fitted), e_step(fitted.model, data, smoother, key=fitted.state.key)
    used = np.asarray(not_diverged(posterior, data))
    return SmoothedFit(fitted.model, hypothesis, posterior.state, data, used, data.t.shape[1])


def risen_since(own: SmoothedFit, now: SmoothedFit) -> Risen:
    """Test of whether the errors of a fit are larger on new recordings than on its own, each left out."""
    out = left_out(own.model, own.m_step, own.path, own.data, own.used)
    scale = np.nanmedian(np.abs(out), axis=(0, 1)) * 1.4826 + 1e-12  # larger errors than twice this weigh less
    new = errors(followed(now.model, now.m_step.prior, now.path, now.data))
    return risen(level(out, scale), level(new, scale))


def extended(model: StateSpaceModel, path: Gaussian, data: Dataset) -> Gaussian:
    """`path` of the model without its last effects, with the memory that these would have along it."""
    return each(_extended, model, (path, data)) if model.start.mean.shape[0] > path.mean.shape[-1] else path


def _extended(model: StateSpaceModel, one) -> Gaussian:
    (mean, cov), seq = one
    width, states = mean.shape[-1], model.start.mean.shape[0]
    still = jnp.zeros(len(model.system.coordinates), mean.dtype)

    def step(m, slices):
        x, u = slices
        memory_rate = lambda m, part=0.0: model.rate(jnp.concatenate([x, m]), u.at(part), still)[width:]  # noqa: E731
        return integrate(memory_rate, m, model.dt, model.steps, timed=model.smooth), m

    _, memory = jax.lax.scan(step, model.start.mean[width:], (mean, model.inputs(seq)))
    wide = jnp.zeros((mean.shape[0], states, states), cov.dtype)
    wide = wide.at[:, :width, :width].set(cov).at[:, width:, width:].set(model.start.cov[width:, width:])
    return Gaussian(jnp.concatenate([mean, memory], axis=1), wide)
