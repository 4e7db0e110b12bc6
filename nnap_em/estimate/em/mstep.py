"""M-step of the hybrid model: EM's gradient, scaled by the information that the data really hold.

The smoother gives the score by Fisher's identity.  EM would divide it by the complete-data information and crawl where
the missing part dominates; here it is divided by the observed information of the model linearised about the smoothed
path, the sum of J'J of whitened innovations, for torques at velocity nodes and parameters, phi, to whose quadratic form
the network is then fitted. [Louis 1982, J. R. Stat. Soc. B 44(2); Lange 1995, J. R. Stat. Soc. B 57(2)]
"""

import math
from abc import abstractmethod
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float

from ...base.gaussian import Gaussian
from ...base.parallel import each, few_sizes, on_default_device
from ...logs.dataset import Dataset
from ...model.base import AbstractModel
from ...model.state_space import StateSpaceModel
from ..smoother.kalman import Cubature, Tangent, kalman_filter
from ..smoother.posterior import Posterior
from .prior import ParameterPrior
from .quadratic import Local, Quadratic, locals_along, quadratic, readings_at
from .weights import Known, Weights, bounds


class MStepInfo(NamedTuple):
    """Results of an M-step for diagnosis and reuse."""

    hessian: Float[Array, "phi phi"]
    """Posterior precision of phi, at the model that was given (zero for M-steps that know none)."""
    used: Bool[Array | np.ndarray, " seq"]
    """Sequences that took part."""


class Core(NamedTuple):
    """Parts of a model that an M-step changes."""

    unknown: Any
    """The friction map."""
    w: Float[Array, " weight"]
    """Network weights, then parameters in units of their prior."""
    log_q: Float[Array, " state"]
    log_r: Float[Array, " obs"]
    start: Gaussian


def between(origin: Any, target: Any, share: float) -> Any:
    """A model, or a part of one, a share of the way from `origin` to `target`."""
    return _between(*on_default_device((origin, target, jnp.asarray(share, jnp.result_type(float)))))


@eqx.filter_jit
def _between(origin, target, share):
    way = lambda a, b: a + share.astype(a.dtype) * (b - a) if eqx.is_inexact_array(a) else a  # noqa: E731
    return jax.tree.map(way, origin, target)


class AbstractMStep(eqx.Module):
    """A rule for the next model, given the posterior of every sequence."""

    @abstractmethod
    def __call__(self, model, posterior: Posterior, data: Dataset) -> tuple[AbstractModel, MStepInfo]:
        """The next model."""

    def loglik(self, model, path: Gaussian, data: Dataset) -> Float[Array, " seq"]:
        """Log-likelihood of the readings by a model linearised about a path of every sequence; NaN: not known."""
        return jnp.full(len(data.t), jnp.nan)

    @abstractmethod
    def while_growing(self) -> "AbstractMStep":
        """The rule while the horizon still grows."""

    def stages(self) -> "tuple[AbstractMStep, ...]":
        """Rules in the order of their use, the last this one: the first while the horizon grows."""
        return (self,)

    @abstractmethod
    def no_hessian(self, model) -> Float[Array, "phi phi"]:
        """`MStepInfo.hessian` before the first epoch."""


def not_diverged(posterior: Posterior, data: Dataset) -> Bool[Array | np.ndarray, " seq"]:
    """Sequences that have not diverged: log-likelihood per reading not far below the median of all."""
    loglik, y, valid = posterior.loglik, data.y, data.valid
    xp: Any = jnp if any(isinstance(a, Tracer) for a in (loglik, y, valid)) else np
    loglik, y, valid = map(xp.asarray, (loglik, y, valid))
    mean = loglik / xp.maximum(xp.sum(~xp.isnan(y) & valid[..., None], axis=(1, 2)).astype(loglik.dtype), 1.0)
    finite = xp.isfinite(mean)
    if xp is np and not finite.any():
        return finite
    middle = xp.nanmedian(xp.where(finite, mean, xp.nan))
    spread = 1.48 * xp.nanmedian(xp.where(finite, xp.abs(mean - middle), xp.nan))
    return finite & (xp.where(finite, mean, 0.0) >= middle - xp.maximum(0.5, 5 * spread))


def _quadratic(common, one) -> Quadratic:
    (log_q, log_r, start, nodes), (linear, posterior, read) = common, one
    return quadratic(log_q, log_r, start, linear, nodes, posterior, read)


def _loglik(common, one) -> Float[Array, ""]:
    return kalman_filter(*common, *one).loglik


def _widened(prior: ParameterPrior, w, linear: Local, path: Gaussian, pad: int):
    """Parameters, and sensitivities to them, with `pad` more that do nothing, nameless here; and the first states."""
    widen = lambda a: np.pad(np.asarray(a), [(0, 0)] * (a.ndim - 1) + [(0, pad)])  # noqa: E731
    mean, std = widen(prior.mean), np.pad(np.asarray(prior.std), (0, pad), constant_values=1.0)
    wide = ParameterPrior(tuple(map(str, range(mean.shape[0]))), jnp.asarray(mean), jnp.asarray(std))
    moved = widen(linear.by_parameter), widen(linear.reading_by_parameter)
    return wide, jnp.asarray(widen(w)), moved, jax.tree.map(lambda a: np.asarray(a)[:, 0], path)


def _lengthened(every: Any) -> Any:
    """Arrays of all sequences, zero for more of them: one program for many numbers of sequences."""
    size = few_sizes(len(jax.tree.leaves(every)[0]))
    return jax.tree.map(lambda a: np.pad(np.asarray(a), [(0, size - len(a))] + [(0, 0)] * (a.ndim - 1)), every)


@eqx.filter_jit
def _noise_floor(linear: Local, log_q: Float[Array, " state"], log_r: Float[Array, " obs"]) -> Float[Array, " obs"]:
    """`log_r` where it is no less than the mean effect of the kicks of a step, as accelerations, on a reading."""
    assert linear.reading_by_force is not None
    dof = linear.by_force.shape[-1]
    kick = jnp.swapaxes(linear.by_force[..., dof : 2 * dof, :], -1, -2)  # of a unit force on every joint
    response = jnp.linalg.solve(kick, jnp.swapaxes(linear.reading_by_force, -1, -2))  # dof obs: of a unit kick
    known = linear.seq.active[..., None] & jnp.all(jnp.isfinite(response), axis=-2)
    square = jnp.einsum("stdo,d->sto", response**2, jnp.exp(log_q[dof : 2 * dof]))
    count = jnp.sum(known, axis=(0, 1), dtype=square.dtype)
    mean = jnp.sum(jnp.where(known, square, 0.0), axis=(0, 1)) / jnp.maximum(count, 1.0)
    return jnp.maximum(log_r, jnp.log(mean))


@eqx.filter_jit
def _advance(rule: "ScoringMStep", core: Core, terms: Quadratic, first: Gaussian, loglik, used):
    weights = rule.weights(core)
    used = used & jnp.isfinite(loglik) & jnp.all(jnp.isfinite(terms.information), axis=(1, 2))
    used = used & jnp.all(jnp.isfinite(terms.score), axis=1) & jnp.all(jnp.isfinite(terms.noise_score), axis=1)
    pick = lambda a: jnp.where(used.reshape(-1, *[1] * (a.ndim - 1)), a, 0.0)  # noqa: E731
    total = jax.tree.map(lambda a: jnp.sum(pick(a), axis=0), terms)
    first = jax.tree.map(pick, first)
    near = jnp.repeat(jnp.broadcast_to(rule.reach, weights.nodes.shape[:1]) ** -2.0, weights.nodes.shape[1])
    near = jnp.diag(jnp.concatenate([near, jnp.zeros(weights.prior.size, near.dtype)]))
    w = weights.fit(core.unknown, core.w, total.score, total.information + near, rule.iterations)
    present = core.unknown.with_weights(core.w[: core.w.shape[0] - weights.prior.size])
    hessian = total.information + weights.prior_precision(present)
    hessian = hessian + 100 * jnp.finfo(hessian.dtype).eps * jnp.diag(jnp.diag(hessian))  # definite, also rounded
    log_q, log_r = rule.noise(core, total, weights.nodes.shape[0])
    return Core(core.unknown, w, log_q, log_r, rule.first(core.start, first, used)), hessian, used


RESTING_STEP = 0.1
"""Standard deviation of the change of a node's torque in one M-step on logs that rest, in the torque of the drive; by
the slope of the map, which alone is determined there, friction would become a peak that no later step leaves."""
RESTING_OFFSET = 0.1
"""`ScoringMStep.coarse` of logs that rest [standard deviations of an offset of friction]."""
RELEASES = (1.0, 10.0, 100.0)
"""Widths while the horizon grows, and then until the likelihood rests with each, in `ScoringMStep.coarse`."""


class ScoringMStep(AbstractMStep):
    """Fisher scoring of the marginal likelihood for the hybrid model: weights, parameters, noise and start."""

    prior: ParameterPrior
    centre: Float[Array, " weight"]
    """Mean of the prior of the network's weights."""
    learn_start: tuple[bool, ...] = eqx.field(static=True)
    learn_r: tuple[bool, ...] = eqx.field(static=True)
    nodes: int = eqx.field(static=True, default=41)
    ridge: float = 1.0
    iterations: int = eqx.field(static=True, default=200)
    max_log_step: Float[Array, ""] = eqx.field(default=1.5, converter=jnp.asarray)
    """Largest change of a log variance in one step."""
    ratio_precision: Float[Array, ""] = eqx.field(default=30.0, converter=jnp.asarray)
    """Precision with which the ratios of the joints' process noises are held to those of the first model; without it,
    the noise of an unmeasured joint grows until its states are free."""
    linearise: Tangent | Cubature = Cubature()
    symmetry_std: Float[Array, ""] = eqx.field(default=6.4, converter=jnp.asarray)
    """`Weights.symmetry_std`: loose, but while the horizon grows, over which few samples are near zero velocity."""
    departure: Float[Array, ""] = eqx.field(default=math.inf, converter=jnp.asarray)
    """`Weights.departure`: free."""
    coarse: Float[Array, ""] = eqx.field(default=math.inf, converter=jnp.asarray)
    """The same while the horizon grows; finite where logs rest, which then do not determine more."""
    reach: Float[Array, "*dof"] = eqx.field(default=math.inf, converter=jnp.asarray)
    """Standard deviation of the change of a node's torque in one M-step [N m]; infinite but on logs that rest."""
    log_q_prior: Float[Array, " state"] | None = None
    """Log variances of the process noise of the first model."""
    least: Float[Array, " bounded"] = eqx.field(default_factory=lambda: jnp.zeros(0))
    """`Weights.least`, of the declared parameters."""
    quiet: Float[Array, " obs"] | None = None
    """Smallest log variances of the readings, by the logs alone; None: any."""
    known: Known | None = None
    """`Weights.known`."""

    def weights(self, model) -> Weights:
        """Estimated vector: weights of the network and parameters."""
        nodes, offset = model.unknown.nodes(self.nodes), 0.1 * model.unknown.scale
        own = self.symmetry_std, self.departure, self.least, self.known
        return Weights(self.prior, nodes, self.ridge, self.centre, offset, *own)

    def while_growing(self) -> "ScoringMStep":
        """The rule for short horizons: ratio of the process noises nearly fixed, friction nearly odd in velocity."""
        return eqx.tree_at(lambda m: (m.ratio_precision, m.symmetry_std), self, (jnp.asarray(1e4), jnp.asarray(1.0)))

    def stages(self) -> tuple["ScoringMStep", ...]:
        """Friction near a viscous, a Coulomb and a constant part, and released in steps, if it begins `coarse`."""
        if not math.isfinite(float(self.coarse)):
            return (self,)
        widths = (self.coarse * factor for factor in RELEASES)
        return (*(eqx.tree_at(lambda m: m.departure, self, width) for width in widths), self)

    def no_hessian(self, model) -> Float[Array, "phi phi"]:
        """Prior precision of the torques at the nodes and the parameters."""
        return self.weights(model).prior_precision(model.unknown)

    def __call__(self, model, posterior: Posterior, data: Dataset) -> tuple[StateSpaceModel, MStepInfo]:
        """One step of Fisher scoring."""
        linear = locals_along(model, self.prior, posterior.state, data, self.linearise)
        read = each(readings_at, model, (posterior, linear.seq))
        core = self.core(model)
        core, hessian, used = self.advance(core, linear, posterior, read, not_diverged(posterior, data))
        return self.whole(model, core), MStepInfo(hessian, used)

    def loglik(self, model, path: Gaussian, data: Dataset) -> Float[Array, " seq"]:
        """Log-likelihood of the readings by a model linearised about a path of every sequence, as in a step."""
        linear = locals_along(model, self.prior, path, data, self.linearise)
        return each(_loglik, (model.log_q, model.log_r, model.start), linear.filtered_from)

    def core(self, model) -> Core:
        """Parts of a model that a step changes."""
        return Core(model.unknown, self.weights(model).read(model), model.log_q, model.log_r, model.start)

    def whole(self, model, core: Core) -> StateSpaceModel:
        """`model` with the parts that a step changes."""
        fitted = self.weights(model).write(model, core.w)
        return eqx.tree_at(lambda m: (m.log_q, m.log_r, m.start), fitted, core[2:])

    def advance(
        self, core: Core, linear: Local, posterior: Posterior, read: Float[Array, "seq time node obs"], used
    ) -> tuple[Core, Float[Array, "phi phi"], Bool[np.ndarray, " seq"]]:
        """The step itself, the posterior precision where it began, and which of the sequences `used` could be.

        One program for models of every structure: parameters are nameless, and padded to a multiple of eight.
        """
        pad = 8 * max(1, -(-self.prior.size // 8)) - self.prior.size
        prior, w, (of_state, of_reading), first = _widened(self.prior, core.w, linear, posterior.state, pad)
        rule = eqx.tree_at(lambda r: (r.prior, r.least), self, (prior, bounds(self.least, prior.size)))
        linear = linear._replace(by_parameter=of_state, reading_by_parameter=of_reading)  # pyrefly: ignore[bad-argument-type]
        common = (core.log_q, core.log_r, core.start, rule.weights(core).nodes)
        terms = each(_quadratic, common, (linear, posterior, read))
        every = _lengthened((terms, first, posterior.loglik, used))
        core, hessian, took_part = _advance(*on_default_device((rule, core._replace(w=w), *every)))
        if linear.reading_by_force is not None:
            core = core._replace(log_r=_noise_floor(linear, core.log_q, core.log_r))
        took_part, size = np.asarray(took_part)[: len(used)], hessian.shape[0] - pad
        return core._replace(w=core.w[: core.w.shape[0] - pad]), hessian[:size, :size], took_part

    def noise(self, model: Core, total: Quadratic, dof: int) -> tuple[Float[Array, " state"], Float[Array, " obs"]]:
        """Log variances of process and reading noise after the step."""
        info, states = total.noise_information, len(self.learn_start)
        learn = jnp.asarray([i < states for i in range(model.log_q.shape[0])] + list(self.learn_r))
        info = jnp.where(learn[:, None] & learn[None, :], info, 0.0)
        info = info + jnp.diag(jnp.where(learn, 1e-3 * jnp.diag(info) + 1e-3, 1.0))
        n = model.log_q.shape[0]
        hold = jnp.zeros_like(info).at[:states, :states].set(self._hold(dof))
        assert self.log_q_prior is not None
        off = jnp.zeros_like(total.noise_score).at[:n].set(model.log_q - self.log_q_prior)
        score = jnp.where(learn, total.noise_score, 0.0) - hold @ off
        step = jnp.linalg.solve(info + hold, score)
        if self.quiet is not None:  # those that would fall below go as far as that, the others as that lets them
            down = jnp.where(learn, jnp.concatenate([model.log_q - jnp.inf, self.quiet - model.log_r]), -jnp.inf)
            low = step < down
            fixed, matrix = jnp.where(low, down, 0.0), jnp.where(low[:, None] | low[None], 0.0, info + hold)
            rest = jnp.where(low, 0.0, score - (info + hold) @ fixed)
            step = fixed + jnp.linalg.solve(matrix + jnp.diag(low.astype(score.dtype)), rest)
        step = step * jnp.minimum(1.0, self.max_log_step / jnp.max(jnp.abs(step)))
        return model.log_q + step[:n], model.log_r + step[n:]

    def _hold(self, dof: int) -> Float[Array, "state state"]:
        """Prior precision of the log process noises: kicks act on rates and reach angles over one step."""
        if not dof:
            return self.ratio_precision * (jnp.eye(count := len(self.learn_start)) - 1 / count)
        rate = jnp.eye(dof)
        angle = jnp.concatenate([rate, -rate], axis=1)
        ratio = jnp.concatenate([jnp.zeros((dof, dof)), rate - 1 / dof], axis=1)
        return 1e4 * angle.T @ angle + self.ratio_precision * ratio.T @ ratio

    def first(self, start: Gaussian, first: Gaussian, used: Bool[Array, " seq"]) -> Gaussian:
        """EM's own update of the entries that nobody declared [paper, eq. 11]."""
        learn = jnp.asarray(self.learn_start + (False,) * (start.mean.shape[0] - len(self.learn_start)))
        count = jnp.maximum(jnp.sum(used), 1).astype(start.mean.dtype)
        mean = jnp.where(learn, jnp.sum(first.mean, axis=0) / count, start.mean)
        square = jnp.where(used[:, None], (first.mean - mean[None]) ** 2, 0.0)
        total = jnp.sum(square + jnp.diagonal(first.cov, axis1=1, axis2=2), axis=0) + jnp.diag(start.cov)
        return Gaussian(mean, jnp.diag(jnp.where(learn, total / (count + 1), jnp.diag(start.cov))))
