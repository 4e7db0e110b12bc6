"""Expected information of a sequence, by the sensitivities that the fit itself uses."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...base.gaussian import Gaussian
from ...base.parallel import each
from ...estimate.em.prior import ParameterPrior
from ...estimate.em.quadratic import Local, friction_columns, local, reading_columns, whitened_sensitivities
from ...estimate.identify import Identified
from ...estimate.smoother.kalman import CUBATURE, TANGENT, Filtered, kalman_filter, linear_reading, rts
from ...logs.dataset import Dataset
from ...model.base import prepare
from ...model.state_space import StateSpaceModel


class Fit(NamedTuple):
    """A model and what is known of it: of phi = (torques at velocity nodes, parameters)."""

    model: StateSpaceModel
    prior: ParameterPrior
    nodes: Float[Array, "dof node"]
    cov: Float[Array, "phi phi"]
    """Posterior covariance of phi (Laplace)."""
    prior_cov: Float[Array, "phi phi"]
    """Covariance before any log."""


def known(fitted: Identified) -> Fit:
    """Knowledge after a fit."""
    weights = fitted.m_step.weights(fitted.model)
    cov, before = map(jnp.linalg.inv, (fitted.state.hessian, weights.prior_precision(fitted.model.unknown)))
    return Fit(fitted.model, fitted.m_step.prior, weights.nodes, cov, before)


def information(
    fit: Fit, seq: Dataset, x: Float[Array, "proposal recorded time state"]
) -> Float[np.ndarray, "proposal phi phi"]:
    """Expected information of phi in sequences, the mean over some motions."""
    return np.asarray(each(_information, fit, (seq, x)))


def _information(fit: Fit, one) -> Float[Array, "phi phi"]:
    seq, motions = one

    def along(x):
        linear, filtered, path = linearised(fit, seq, x)
        readings = reading_columns(fit.nodes, _speeds(path, fit.nodes.shape[0]), linear)
        jac = whitened_sensitivities(filtered, columns_of(fit, linear, path), readings, linear.seq.observed)
        jac = jac.reshape(-1, jac.shape[-1])  # of the whitened readings to phi
        return jac.T @ jac

    return jnp.mean(jax.vmap(along)(motions), axis=0)


def linearised(fit: Fit, seq: Dataset, x: Float[Array, "time state"]) -> tuple[Local, Filtered, Gaussian]:
    """The model along a motion, as wide as it will be known from its readings, and the filter there.

    Near rest a friction map bends within that width: a tangent would see more of it than a fit then does.
    """
    model, start = fit.model, Gaussian(x[0], fit.model.start.cov)
    thin = Gaussian(x, jnp.zeros((*x.shape, x.shape[-1])))
    tangents = jax.vmap(lambda state, u: TANGENT(model, state, u))(thin, model.inputs(seq))
    readings = jax.vmap(lambda x, u: linear_reading(model, x, u))(x, model.inputs(seq))
    cov = rts(kalman_filter(model.log_q, model.log_r, start, tangents, readings, prepare(model, seq))).state.cov
    path = Gaussian(x, cov)
    linear = local(model, fit.prior, path, seq, CUBATURE)
    return linear, kalman_filter(model.log_q, model.log_r, start, linear.affine, linear.reading, linear.seq), path


def _speeds(path: Gaussian, dof: int) -> Float[Array, "time point dof"]:
    v = path.mean[:, None, dof : 2 * dof]
    std = jnp.sqrt(jnp.maximum(jnp.diagonal(path.cov, axis1=1, axis2=2), 0.0))[:, None, dof : 2 * dof]
    points = jnp.asarray(
        (-math.sqrt(1.5), 0.0, math.sqrt(1.5)), v.dtype
    )  # of a normal distribution's mean and variance
    return v + std * points[None, :, None]


def columns_of(fit: Fit, linear: Local, path: Gaussian) -> Float[Array, "time state phi"]:
    """Sensitivity of the next state to phi; friction acts at all speeds that the path may have."""
    speeds = _speeds(path, fit.nodes.shape[0])
    torque = jax.vmap(lambda v, b: friction_columns(fit.nodes, v, b))(speeds, linear.by_force)
    return jnp.where(linear.seq.active[:, None, None], jnp.concatenate([torque, linear.by_parameter], axis=-1), 0.0)
