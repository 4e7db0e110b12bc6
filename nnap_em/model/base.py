"""Interface of a model to smoothers and EM, and a sequence as they take it: prepared once, handed on by name."""

from abc import abstractmethod
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..base.gaussian import Gaussian
from ..logs.dataset import Dataset, active_steps, fill_missing


class AbstractModel(eqx.Module):
    """All that smoothers and EM require of a model."""

    start: eqx.AbstractVar[Gaussian]
    """Prior of the state in the first row."""
    log_q: eqx.AbstractVar[Float[Array, " state"]]
    """Log of the process-noise variance per step."""
    log_r: eqx.AbstractVar[Float[Array, " obs"]]
    """Log of the measurement variance."""
    measured: eqx.AbstractVar[tuple[int, ...]]
    """Index of each channel of y among all that can be measured, states first."""
    dt: eqx.AbstractVar[float]
    """Sample interval [s]."""

    @abstractmethod
    def transition(self, x: Float[Array, " state"], u: Any) -> Float[Array, " state"]:
        """Mean of the state one sample later; `u` is a row of `inputs`."""

    @abstractmethod
    def emission(self, x: Float[Array, " state"], u: Any) -> Float[Array, " obs"]:
        """Mean of the reading; `u` is a row of `inputs`."""

    def resolved(self) -> "AbstractModel":
        """This model, integrated as finely as what it has learned requires."""
        return self

    def inputs(self, seq: Dataset) -> Any:
        """External inputs in every row: an array, or a structure of arrays, with leading axis time."""
        return jnp.asarray(seq.u)


class Prepared(NamedTuple):
    """A sequence as a filter takes it; the fields carry a leading time axis."""

    inputs: Any
    """External inputs, in the model's own form."""
    y: Float[Array, "*seq time obs"]
    """0 where there is no reading."""
    observed: Bool[Array, "*seq time obs"]
    active: Bool[Array, "*seq time"]
    """True at k where the step from k to k + 1 lies inside the data."""


def prepare(model: AbstractModel, seq: Dataset) -> Prepared:
    """One sequence as `model` sees it; what is not valid is not observed."""
    y, observed = fill_missing(seq.y)
    return Prepared(model.inputs(seq), y, observed & seq.valid[:, None], active_steps(jnp.asarray(seq.valid)))
