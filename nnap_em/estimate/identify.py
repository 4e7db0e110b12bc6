"""Identification: from a declared rig and its logs to a fitted model in one call."""

from collections.abc import Callable
from typing import NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from ..base.digits import counted
from ..errors import RigError
from ..logs.dataset import Dataset, stepped
from ..logs.read import Logs, logs_of_arrays, sequences_of
from ..machines.rig import Declared, Rig
from ..machines.units import quantities
from ..model.effects import AbstractEffect
from ..model.state_space import StateSpaceModel, with_effects
from .em import simulated
from .em.build import build, build_system
from .em.equations import infinite_rates
from .em.loop import (
    EPOCHS,
    RESTED,
    SCHEDULE,
    WIDENED,
    EMState,
    Schedule,
    e_step,
    fit,
    later_state,
    start_state,
    unsettled,
)
from .em.mstep import ScoringMStep, not_diverged
from .em.multistep import JUDGED, LEAST_FALL, errors, finish, followed, ratio
from .em.prior import ParameterPrior
from .em.readings import white_readings
from .em.stated import widened
from .identifiability import holding, not_identifiable
from .misfit import Misfit, ahead, misfit, simulating
from .smoother.gaussian import CubatureSmoother
from .smoother.posterior import AbstractSmoother
from .smoother.start import StartBank

MakeSmoother = Callable[[StartBank], AbstractSmoother]
Watch = Callable[[EMState, int, Bool[np.ndarray, " seq"]], None]


def unwatched(state: EMState, rows: int, used: Bool[np.ndarray, " seq"]) -> None:
    """The watch that does nothing."""


class Identified(NamedTuple):
    """A fitted model with what is needed to use it, to judge it and to go on fitting."""

    rig: Rig
    state: EMState
    m_step: ScoringMStep
    bank: StartBank
    """Hypotheses of the start."""
    smoother: AbstractSmoother
    """Smoother of the fit and of all that uses it: prediction, residuals and the search for missing effects."""
    discrepancy: float = 0.0
    """Size of the forces that no part of the model describes (`stated.widened`); 0 where likelihood is efficient."""
    rise: float = 0.0
    """Rise of the log-likelihood at the end of EM (`loop.unsettled`) [nat a sequence]: more epochs would go on."""
    accuracy: tuple[tuple, ...] = ()
    """Errors of predictions along the training logs, beside motion and noise: `misfit.Accuracy` of every reading."""

    @property
    def model(self) -> StateSpaceModel:
        """The model that was fitted."""
        return cast(StateSpaceModel, self.state.best)

    @property
    def converged(self) -> bool:
        """True where EM came to rest; `state.stop` is the reason for its end."""
        return self.state.stop == RESTED

    @property
    def misfit(self) -> Misfit:
        """The word on how well the fit describes the motion; random forces count once EM is at rest."""
        return misfit(self.accuracy, settled=not self.rise)

    def __str__(self) -> str:
        estimated = {name: Declared(*pair) for name, pair in parameter_table(self).items()}
        stop = f" ({self.state.stop}), {np.nanmean(self.state.top):.6g} nat a sequence" if self.state.stop else ""
        lines = [f"Identified {self.rig.name!r} after {counted(self.state.epoch, 'epoch')}{stop}"]
        lines += [f"estimated: {quantities(estimated, self.rig.unit)}"] if estimated else []
        lines += [self.misfit.text] * bool(self.misfit.text)
        return "\n  ".join([*lines, str(self.model)])


class FrictionTable(NamedTuple):
    """Friction in steady sliding with its uncertainty, over the visited velocities: the learned map."""

    velocity: Float[Array, "dof node"]
    """[rad/s]"""
    torque: Float[Array, "dof node"]
    """[N m]"""
    cov: Float[Array, "dof node node"]
    """Covariance of the torque over the nodes of a joint [N^2 m^2]."""
    units: tuple[tuple[str, str], ...]
    """Units of velocity and torque of every joint: on a slide they are m/s and N."""

    @property
    def std(self) -> Float[Array, "dof node"]:
        """Standard deviation of the torque [N m]."""
        return jnp.sqrt(jnp.diagonal(self.cov, axis1=1, axis2=2))


def begin(
    rig: Rig,
    data: Dataset,
    *,
    key: PRNGKeyArray,
    smoother: MakeSmoother = CubatureSmoother,
    effects: tuple[AbstractEffect, ...] = (),
) -> Identified:
    """The problem before the first epoch; `effects` join the model as they are, or take the place of unknown terms."""
    key_build, key_fit = jax.random.split(key)
    model, rule, bank = build(rig, data, key=key_build)
    full = with_effects(model, effects) if effects else model
    rule = eqx.tree_at(lambda m: m.log_q_prior, rule, full.log_q)
    return Identified(rig, start_state(full, rule, key=key_fit), rule, bank, smoother(bank))


def identify(
    rig: Rig,
    data: Dataset | Logs,
    *,
    key: PRNGKeyArray,
    smoother: MakeSmoother | None = None,
    epochs: int = EPOCHS,
    schedule: Schedule = SCHEDULE,
    start: Identified | None = None,
    watch: Watch = unwatched,
) -> Identified:
    """Fit the declared unknowns of a rig to logs by Expectation-Maximisation: friction, uncertain parameters, noise.

    [Vantilborgh, Lefebvre & Crevecoeur, the paper that this library implements, algorithm 1]

    Args:
        rig: what is declared.
        data: sequences to fit.
        key: random key of the start.
        smoother: makes the smoother, such as `nnap_em.estimate.ParticleSmoother`; without it that of `start`, or the
            cubature smoother.
        epochs: of EM, at most.
        schedule: the growing horizon.
        start: a fit to go on from.
        watch: called after every epoch with its state, the rows seen and the sequences used.

    Returns:
        The fitted model with what is needed to use it, to judge it and to go on; `print` shows a table.

    Raises:
        DataError: arrays are not of the rig: other columns, another interval, a row without an input.
        FitError: no sequence can be followed.

    Example:
        >>> fit = nnap_em.identify(rig, train, key=key, epochs=3)
        >>> fit.model.log_r.shape  # one measured column
        (1,)
    """
    logs = logs_of_arrays(data, rig)
    data = stepped(sequences_of(logs, rig))
    if rig.equations and (infinite := infinite_rates(rig, build_system(rig), logs)):
        raise RigError(f"rig {rig.name!r}: {infinite}")
    if start is None:
        rig = holding(rig, not_identifiable(rig, build_system(rig), data))
    fitted = begin(rig, data, key=key) if start is None else start
    fitted = fitted if smoother is None else fitted._replace(smoother=smoother(fitted.bank))
    state = fit(fitted.state, data, fitted.smoother, fitted.m_step, epochs=epochs, schedule=schedule, watch=watch)
    fitted = fitted._replace(state=state)
    rise = unsettled(fitted.state, schedule, int(np.max(np.sum(np.asarray(data.valid), axis=1))))
    return finished(fitted._replace(rise=rise), data)


PARTS_LEFT_OUT = 2
"""Parts of the sequences that are left out in turn to see whether multi-step errors should be fitted."""


def finished(fitted: Identified, data: Dataset) -> Identified:
    """`fitted`, its numbers finished on multi-step errors where that predicts sequences left out better.

    Where it does not, or there is one sequence alone, and the noise of the readings is that of the model, one-step
    likelihood is efficient, and its curvature is its precision.  Equations are always fitted to errors over their
    horizon of use.
    """
    data = jax.device_put(data)
    if fitted.model.system.simulated:
        return _simulating(fitted, data)
    posterior = e_step(fitted.model, data, fitted.smoother.tolerant(), key=fitted.state.key)
    path, used = posterior.state, np.asarray(not_diverged(posterior, data))
    parts = PARTS_LEFT_OUT if used.sum() >= PARTS_LEFT_OUT else 0
    part = np.where(used, np.cumsum(used) % PARTS_LEFT_OUT, -1)
    before, falls = errors(along := followed(fitted.model, fitted.m_step.prior, path, data), JUDGED), []
    for out in range(parts):
        trial = finish(fitted.model, fitted.m_step, path, data, used & (part != out), shaped=True)
        falls.append(ratio(before, errors(trial, JUDGED), part == out))
    if falls and np.mean(falls) < 1 - LEAST_FALL:
        along = finish(fitted.model, fitted.m_step, path, data, used, shaped=True)
        model, before = along.model, errors(along, JUDGED)
        posterior = e_step(model, data, fitted.smoother.tolerant(), key=fitted.state.key, kept=path)
        _, info = fitted.m_step(model, posterior, data)  # a curvature belongs to the weights at which it was taken
        top = np.where(np.asarray(info.used), np.asarray(posterior.loglik), np.nan)
        fitted = fitted._replace(state=fitted.state._replace(best=model, hessian=info.hessian, top=top))
    elif white_readings(data, fitted.model):
        return fitted._replace(accuracy=ahead(fitted.rig, along.model, before, data))
    problem = fitted.model, fitted.m_step, path, data, used, fitted.state.hessian
    hessian, discrepancy = widened(*problem, key=jax.random.fold_in(fitted.state.key, WIDENED))
    state, errs = fitted.state._replace(hessian=hessian), ahead(fitted.rig, along.model, before, data)
    return fitted._replace(state=state, discrepancy=discrepancy, accuracy=errs)


def _simulating(fitted: Identified, data: Dataset) -> Identified:
    """Equations whose parameters are those of the smallest errors over the horizon of use, with noise by EM.

    Likelihood alone trades long for short predictions: process noise of a hidden state stands for all that is slow.
    """
    prior, model = fitted.m_step.prior, fitted.model
    begin = simulated.filtered(model, data)  # one prior of the starts for all that are compared
    scale = simulated.scale_of(simulated.simulated(model, prior, data, begin))
    declared = prior.write(model, jnp.zeros_like(prior.mean))
    fits = [simulated.fit(one, prior, data, scale=scale, begin=begin) for one in (declared, model)]
    best = max(fits, key=lambda of: simulated.log_posterior(of, scale, of.observed))
    kept = fitted_to_horizon(fitted._replace(state=fitted.state._replace(best=best.model)), data)
    both = [simulated.fit(one.model, _nothing(prior), data, scale=scale, begin=begin) for one in (fitted, kept)]
    costs = [simulated.cost(of.error, scale, of.observed) for of in both]
    if costs[0] < costs[1]:
        own = simulated.simulated(model, prior, data, begin)
        kept = fitted._replace(state=fitted.state._replace(hessian=jnp.asarray(simulated.precision(own))))
    return kept


def _nothing(prior: ParameterPrior) -> ParameterPrior:
    """Prior of no parameters: starts or noise alone are fitted."""
    return ParameterPrior((), prior.mean[:0], prior.std[:0])


def fitted_to_horizon(fitted: Identified, data: Dataset) -> Identified:
    """Equations with noise by EM at their parameters, then parameters by errors over the horizon of use."""
    prior, data = fitted.m_step.prior, jax.device_put(data)
    rule = eqx.tree_at(lambda rule: rule.prior, fitted.m_step, _nothing(prior))
    begun = later_state(fitted.model, rule, key=fitted.state.key)
    longest = int(np.max(np.sum(np.asarray(data.valid), axis=1)))
    most = 12  # epochs of EM for noise alone
    state = fit(begun, data, fitted.smoother, rule, epochs=most, schedule=Schedule(first=longest))
    best = simulated.fit(cast(StateSpaceModel, state.best), prior, data)
    hessian = jnp.asarray(simulated.precision(best))
    state = fitted.state._replace(best=best.model, model=best.model, proposal=best.model, hessian=hessian)
    return fitted._replace(state=state, accuracy=simulating(fitted.rig, best.model, best.error, data))


def phi_samples(fitted: Identified, count: int, *, key: PRNGKeyArray) -> Float[Array, "sample phi"]:
    """Deviations of node torques [N m] and parameters from the mode, drawn from their posterior (Laplace)."""
    precision = fitted.state.hessian
    unit = jax.random.normal(key, (precision.shape[0], count), precision.dtype)
    return jax.scipy.linalg.solve_triangular(jnp.linalg.cholesky(precision).T, unit, lower=False).T


def nodes_between(
    low: Float[np.ndarray, " dof"], high: Float[np.ndarray, " dof"], count: int
) -> Float[np.ndarray, "dof node"]:
    """Velocities from `low` to `high` of each joint, dense near rest, where friction bends."""
    knee = np.maximum(0.01 * np.maximum(np.abs(low), np.abs(high)), 1e-12)
    return (knee * np.sinh(np.linspace(np.arcsinh(low / knee), np.arcsinh(high / knee), count))).T


def friction_table(fitted: Identified, velocity: Float[Array, "dof node"]) -> FrictionTable:
    """Friction in steady sliding, and its covariance (Laplace).

    Args:
        fitted: the model.
        velocity: rates of each joint (joint, node) [rad/s, or m/s]; of one joint `v[None]`.

    Returns:
        Torque (joint, node) [N m, or N] and its covariance over the nodes of a joint; `.std` is its square root.

    Example:
        >>> nnap_em.friction_table(fit, jnp.linspace(-0.2, 0.2, 5)[None]).std.shape
        (1, 5)
    """
    model, nodes = fitted.model, fitted.m_step.weights(fitted.model).nodes
    units = tuple((model.system.unit(rate), model.system.force_unit(j)) for j, rate in enumerate(model.system.rates, 1))
    return FrictionTable(velocity, *_friction(nodes, model.unknown, fitted.state.hessian, velocity), units)


@eqx.filter_jit
def _friction(nodes, unknown, precision, velocity):
    """Torque at `velocity`, and its covariance: that of the nodes beside it."""
    dof, count = nodes.shape
    cov = jnp.linalg.inv(precision)[: nodes.size, : nodes.size].reshape(dof, count, dof, count)
    between = jax.vmap(lambda nodes, v: jax.vmap(lambda e: jnp.interp(v, nodes, e))(jnp.eye(count, dtype=v.dtype)).T)
    share = between(nodes, velocity)
    return jax.vmap(unknown)(velocity.T).T, jnp.einsum("jan,jnjm,jbm->jab", share, cov, share)


def parameter_table(fitted: Identified) -> dict[str, tuple[float, float]]:
    """Estimated physical parameters with their standard deviations.

    Args:
        fitted: the model.

    Returns:
        (value, standard deviation) by name, in the unit of `rig.toml`; empty where all are trusted.

    Example:
        >>> list(nnap_em.parameter_table(fit))
        ['m']
    """
    prior = fitted.m_step.prior
    if not prior.names:
        return {}
    cov = jnp.linalg.inv(fitted.state.hessian)[-prior.size :, -prior.size :]
    std = prior.std * jnp.sqrt(jnp.diag(cov))
    value = prior.mean + prior.std * prior.read(fitted.model)
    return {n: (float(v), float(s)) for n, v, s in zip(prior.declared, value, std, strict=False)}
