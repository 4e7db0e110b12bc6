"""M-step of the hybrid model: EM's gradient, scaled by the information that the data really hold.

The smoother gives the score by Fisher's identity, the expectation of the complete-data score.  EM would divide
it by the complete-data information and crawl where the missing part dominates; here it is divided by the observed
information of the model linearised about the smoothed path, the sum of J'J of whitened innovations
[Louis 1982, J. R. Stat. Soc. B 44(2); Lange 1995, J. R. Stat. Soc. B 57(2)].

The friction network is tabulated at velocity nodes: torques at the nodes and the uncertain physical parameters form the
vector phi in which the likelihood is quadratic; the network is then fitted to that quadratic form by
Levenberg-Marquardt.
"""

import math
from abc import abstractmethod
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .data import Dataset, fill_missing
from .gaussian import Gaussian, spd_solve
from .kalman import TANGENT, Affine, Cubature, Filtered, Reading, Tangent, kalman_filter, linear_reading
from .model import AbstractModel, StateSpaceModel
from .smoother import Posterior, active_steps


class ParameterPrior(eqx.Module):
    """Physical parameters to be estimated, with the owner's belief; estimated in its standard deviations."""

    names: tuple[str, ...] = eqx.field(static=True)
    """Of the system, "m2", or of an effect by its place, "0.k"."""
    mean: Float[Array, " param"]
    std: Float[Array, " param"]

    def places(self, model) -> list:
        """The parameters in the model."""
        pairs = [name.rpartition(".") for name in self.names]
        return [getattr(model.effects[int(at)] if at else model.system, name) for at, _, name in pairs]

    def read(self, model) -> Float[Array, " param"]:
        """The model's values as (value - mean) / std."""
        if not self.names:
            return self.mean
        return (jnp.concatenate([jnp.ravel(a) for a in self.places(model)]) - self.mean) / self.std

    def write(self, model, z: Float[Array, " param"]):
        """The model with values mean + std z."""
        if not self.names:
            return model
        places = self.places(model)
        cuts = np.cumsum([a.size for a in places])[:-1]
        values = jnp.split(self.mean + self.std * z, cuts)
        shaped = [v.reshape(a.shape) for v, a in zip(values, places, strict=True)]
        return eqx.tree_at(self.places, model, shaped)

    def held(self, model) -> Bool[np.ndarray, " param"]:
        """Which of the numbers act as forces held over a step."""
        pairs = [name.rpartition(".") for name in self.names]
        kinds = [bool(at) and model.effects[int(at)].held for at, _, _ in pairs]
        flags = [np.full(np.size(a), k) for a, k in zip(self.places(model), kinds, strict=True)]
        return np.concatenate([np.zeros(0, bool), *flags])

    @property
    def size(self) -> int:
        """How many numbers are estimated."""
        return self.mean.shape[0]


class Quadratic(NamedTuple):
    """Log-likelihood about the present parameters: score and information of phi = (node torques, parameters)."""

    score: Float[Array, "*seq phi"]
    information: Float[Array, "*seq phi phi"]
    noise_score: Float[Array, "*seq noise"]
    """With respect to (log_q, log_r)."""
    noise_information: Float[Array, "*seq noise noise"]


def spread(
    nodes: Float[Array, "dof count"], speed: Float[Array, "node dof"], amount: Float[Array, "node dof"]
) -> Float[Array, "dof count"]:
    """Sums of `amount`, each shared by the two nodes beside its speed as linear interpolation weighs them.

    Beyond the ends the last node takes all.
    """
    count = nodes.shape[1]

    def one(nodes, v, amount):
        left = jnp.clip(jnp.searchsorted(nodes, v, side="right") - 1, 0, count - 2)
        share = jnp.clip((v - nodes[left]) / (nodes[left + 1] - nodes[left]), 0.0, 1.0) * amount
        return jnp.zeros(count, v.dtype).at[left].add(amount - share).at[left + 1].add(share)

    return jax.vmap(one, in_axes=(0, 1, 1))(nodes, speed, amount)


class Local(NamedTuple):
    """A model along a path: all that depends on its structure."""

    affine: Affine
    reading: Reading
    by_force: Float[Array, "*time state dof"]
    """Sensitivity of the next state to a force held over the step."""
    by_parameter: Float[Array, "*time state param"]
    reading_by_parameter: Float[Array, "*time obs param"]


def local(
    model: StateSpaceModel, prior: ParameterPrior, path: Gaussian, seq: Dataset, linearise: Tangent | Cubature = TANGENT
) -> Local:
    """The model of one sequence, linearised about the Gaussians of `path`, and its sensitivities at their means."""
    value, held = prior.read(model), prior.held(model)
    free = np.flatnonzero(~held)
    still = jnp.zeros(len(model.system.coordinates), path.mean.dtype)
    u = model.inputs(seq)
    by_input = jax.jacfwd(lambda p: prior.write(model, value.at[free].set(p)).inputs(seq))(value[free])

    def tangents(x, u, slope):
        def both(force, p, u):
            now = prior.write(model, value.at[free].set(p))
            return now.transition(x, u, force), now.emission(x, u)

        def pushed(p):
            now = prior.write(model, value.at[held].set(p))
            scene = now.scene(middle, u)
            nothing = jnp.zeros(0, x.dtype)
            return sum((e.force(scene, nothing) for e in now.effects if e.held), still)

        moved, read = jax.jacfwd(both, argnums=(0, 1, 2))(still, value[free], u)
        by_parameter = jnp.zeros((x.shape[0], value.shape[0]), x.dtype)
        by_parameter = by_parameter.at[:, free].set(moved[1] + moved[2] @ slope)
        if held.any():
            middle = x + 0.5 * model.dt * model.rate(x, u, still)
            by_parameter = by_parameter.at[:, held].set(moved[0] @ jax.jacfwd(pushed)(value[held]))
        of_reading = jnp.zeros((read[1].shape[0], value.shape[0]), x.dtype).at[:, free].set(read[1] + read[2] @ slope)
        return moved[0], by_parameter, of_reading

    affine = jax.vmap(lambda state, u: linearise(model, state, u))(path, u)
    reading = jax.vmap(lambda x, u: linear_reading(model, x, u))(path.mean, u)
    return Local(affine, reading, *jax.vmap(tangents)(path.mean, u, by_input))


@eqx.filter_jit
def locals_along(
    model: StateSpaceModel, prior: ParameterPrior, path: Gaussian, data: Dataset, linearise: Tangent | Cubature
) -> Local:
    """`local` of every sequence: all of an M-step that is compiled anew for a model of another structure."""
    return jax.vmap(lambda path, seq: local(model, prior, path, seq, linearise))(path, data)


def readings_at(model: AbstractModel, posterior: Posterior, seq: Dataset) -> Float[Array, "time node obs"]:
    """The emission at the nodes of a posterior."""
    nodes = jnp.concatenate([posterior.prev, posterior.next[-1:]])
    return jax.vmap(jax.vmap(model.emission, in_axes=(0, None)))(nodes, model.inputs(seq))


@eqx.filter_jit
def _all_readings(model, posterior: Posterior, data: Dataset) -> Float[Array, "seq time node obs"]:
    return jax.vmap(lambda posterior, seq: readings_at(model, posterior, seq))(posterior, data)


def whitened_sensitivities(
    filtered: Filtered,
    columns: Float[Array, "time state column"],
    readings: Float[Array, "time obs column"],
    observed: Bool[Array, "time obs"],
) -> Float[Array, "time obs column"]:
    """Sensitivity of the whitened readings to what moves the next state by `columns` and the reading by `readings`."""

    def step(s, slices):
        matrix, rows, columns, readings, gain, log_variance, observed = slices
        out = []
        for i in range(rows.shape[0]):
            j = rows[i] @ s + readings[i]
            out.append(jnp.where(observed[i], j * jnp.exp(-0.5 * log_variance[i]), 0.0))
            s = s - gain[i][:, None] * j[None, :]
        return matrix @ s + columns, jnp.stack(out)

    f = filtered
    slices = (f.affine.matrix, f.reading.rows, columns, readings, f.gain, f.log_variance, observed)
    return jax.lax.scan(step, jnp.zeros_like(columns[0]), slices)[1]


def friction_columns(
    nodes: Float[Array, "dof count"], speed: Float[Array, "node dof"], by_force: Float[Array, "state dof"]
) -> Float[Array, "state phi"]:
    """Sensitivity of the next state to the torques at the nodes, mean over some speeds."""
    weights = spread(nodes, speed, jnp.full_like(speed, 1 / speed.shape[0]))
    return (by_force[:, :, None] * weights[None]).reshape(by_force.shape[0], -1)


def expand(
    model: StateSpaceModel,
    prior: ParameterPrior,
    nodes: Float[Array, "dof count"],
    posterior: Posterior,
    seq: Dataset,
    linearise: Tangent | Cubature = TANGENT,
) -> Quadratic:
    """The log-likelihood of one sequence to second order."""
    here = local(model, prior, posterior.state, seq, linearise)
    read = readings_at(model, posterior, seq)
    return quadratic(model.log_q, model.log_r, model.start, here, nodes, posterior, read, seq)


def quadratic(
    log_q: Float[Array, " state"],
    log_r: Float[Array, " obs"],
    start: Gaussian,
    here: Local,
    nodes: Float[Array, "dof count"],
    posterior: Posterior,
    read: Float[Array, "time node obs"],
    seq: Dataset,
) -> Quadratic:
    """`expand` from the local model alone: the same program for every structure of the same size."""
    y, observed = fill_missing(seq.y)
    observed = observed & seq.valid[:, None]
    active = active_steps(jnp.asarray(seq.valid))
    dof = nodes.shape[0]
    q, r = jnp.exp(log_q), jnp.exp(log_r)

    def columns(prev, following, kick, excess, by_force, by_parameter):
        """Mean sensitivity of x_{k+1} to phi, and expected score, over the nodes of one step."""
        speed = 0.5 * (prev + following - kick)[:, dof : 2 * dof]  # half the kick would count as signal
        sensitivity = friction_columns(nodes, speed, by_force)
        push = spd_solve(jnp.diag(q) + excess, kick.T).T
        pull = push @ by_force  # node dof
        score = spread(nodes, speed, pull / speed.shape[0]).ravel()
        score = jnp.concatenate([score, jnp.mean(push, axis=0) @ by_parameter])
        expected = jnp.diag(spd_solve(jnp.diag(q) + excess, jnp.eye(q.shape[0], dtype=q.dtype)))
        square = 0.5 * q * (jnp.mean(push**2, axis=0) - expected)
        return jnp.concatenate([sensitivity, by_parameter], axis=1), score, square

    sensitivity, score, square = jax.vmap(columns)(
        posterior.prev, posterior.next, posterior.kick, posterior.excess, here.by_force[:-1], here.by_parameter[:-1]
    )
    inside = active[:-1]
    score = jnp.sum(jnp.where(inside[:, None], score, 0.0), axis=0)
    score_q = jnp.sum(jnp.where(inside[:, None], square, 0.0), axis=0)
    miss = y[:, None] - read
    misfit = jnp.mean(miss**2, axis=1)
    score_r = 0.5 * jnp.sum(jnp.where(observed, misfit / r[None] - 1.0, 0.0), axis=0)
    weighed = jnp.where(observed, jnp.mean(miss, axis=1) / r[None], 0.0)
    params = here.by_parameter.shape[-1]
    of_readings = jnp.einsum("to,top->p", weighed, here.reading_by_parameter)
    score = score + jnp.concatenate([jnp.zeros(score.shape[0] - params, score.dtype), of_readings])

    def noise_filter(log_q, log_r):
        filtered = kalman_filter(log_q, log_r, start, here.affine, here.reading, y, observed, active)
        return (filtered.innovation, filtered.log_variance), filtered

    (jac_e, jac_s), filtered = jax.jacfwd(noise_filter, argnums=(0, 1), has_aux=True)(log_q, log_r)
    jac_e, jac_s = (jnp.concatenate(j, axis=-1).reshape(-1, q.shape[0] + r.shape[0]) for j in (jac_e, jac_s))
    jac_e = jac_e + 0.5 * filtered.innovation.reshape(-1, 1) * jac_s
    noise_information = jac_e.T @ jac_e + 0.5 * jac_s.T @ jac_s

    padded = jnp.concatenate([jnp.where(inside[:, None, None], sensitivity, 0.0), jnp.zeros_like(sensitivity[:1])])
    of_torque = jnp.zeros((*misfit.shape, sensitivity.shape[-1] - params), misfit.dtype)
    readings = jnp.concatenate([of_torque, here.reading_by_parameter], axis=-1)
    jac = whitened_sensitivities(filtered, padded, readings, observed)
    jac = jac.reshape(-1, jac.shape[-1])
    return Quadratic(score, jac.T @ jac, jnp.concatenate([score_q, score_r]), noise_information)


class Weights(eqx.Module):
    """All that the M-step fits as one vector: network weights, then parameters in units of their prior."""

    prior: ParameterPrior
    nodes: Float[Array, "dof count"]
    ridge: float
    """Precision of the weights' prior; the network's output is scaled so that 1 is natural."""
    centre: Float[Array, " weight"]
    """Mean of the weights' prior: the first random features with hardly any output, so that no unit can die."""
    asymmetry: Float[Array, " dof"]
    """Prior standard deviation [N m] of the even part of a friction map, its mean over the nodes."""

    def read(self, model) -> Float[Array, " weight"]:
        return jnp.concatenate([model.unknown.weights(), self.prior.read(model)])

    def write(self, model, w: Float[Array, " weight"]):
        cut = w.shape[0] - self.prior.size
        unknown = model.unknown.with_weights(w[:cut])
        return self.prior.write(eqx.tree_at(lambda m: m.unknown, model, unknown), w[cut:])

    def phi(self, unknown, w: Float[Array, " weight"]) -> Float[Array, " phi"]:
        """The vector in which the likelihood is quadratic."""
        cut = w.shape[0] - self.prior.size
        return jnp.concatenate([jax.vmap(unknown.with_weights(w[:cut]))(self.nodes.T).T.ravel(), w[cut:]])

    def precision(self, w: Float[Array, " weight"]) -> Float[Array, " weight"]:
        """Prior precision of the weights."""
        cut = w.shape[0] - self.prior.size
        return jnp.concatenate([jnp.full(cut, self.ridge, w.dtype), jnp.ones_like(w[cut:])])

    def middle(self) -> Float[Array, " weight"]:
        """Prior mean of the weights."""
        return jnp.concatenate([self.centre, jnp.zeros(self.prior.size, self.centre.dtype)])

    def symmetry(self) -> Float[Array, "phi phi"]:
        """Prior precision of phi: friction opposes motion alike in both directions, unless the data say otherwise."""
        dof, count = self.nodes.shape
        even = 0.5 * (jnp.eye(count) + jnp.eye(count)[::-1]) / math.sqrt(count)
        blocks = [even.T @ even / self.asymmetry[j] ** 2 for j in range(dof)]
        return jax.scipy.linalg.block_diag(*blocks, jnp.zeros((self.prior.size,) * 2))

    def jacobian(self, unknown, w: Float[Array, " weight"]) -> Float[Array, "phi weight"]:
        """Sensitivity of phi to the weights."""
        return jax.jacfwd(lambda w: self.phi(unknown, w))(w)

    def hessian(self, unknown, w: Float[Array, " weight"], information: Float[Array, "phi phi"]):
        """Posterior precision of the weights, and the sensitivity of phi to them."""
        jac = self.jacobian(unknown, w)
        return jac.T @ information @ jac + jnp.diag(self.precision(w)), jac

    def fit(
        self,
        unknown,
        w0: Float[Array, " weight"],
        score: Float[Array, " phi"],
        information: Float[Array, "phi phi"],
        iterations: int,
    ) -> Float[Array, " weight"]:
        """Levenberg-Marquardt on the quadratic log-likelihood with the priors [Nocedal & Wright 2006, sec. 10.3]."""
        phi0 = self.phi(unknown, w0)
        precision = self.precision(w0)
        middle = self.middle()
        symmetry = self.symmetry()
        score = score - symmetry @ phi0
        information = information + symmetry

        def loss(w):
            d = self.phi(unknown, w) - phi0
            return -score @ d + 0.5 * d @ information @ d + 0.5 * jnp.sum(precision * (w - middle) ** 2)

        def going(carry):
            _, _, damping, count, gain = carry
            return (count < iterations) & (damping < 1e6) & (gain > 1e-3)

        def body(carry):
            w, value, damping, count, gain = carry
            hessian, jac = self.hessian(unknown, w, information)
            gradient = jac.T @ (information @ (self.phi(unknown, w) - phi0) - score) + precision * (w - middle)
            factor = jax.scipy.linalg.cho_factor(hessian + damping * jnp.diag(jnp.diag(hessian)))
            trial = w - jax.scipy.linalg.cho_solve(factor, gradient)
            new = loss(trial)
            better = new < value
            gain = jnp.where(better, 0.7 * gain + 0.3 * (value - new), gain)
            keep = lambda a, b: jnp.where(better, a, b)  # noqa: E731
            return keep(trial, w), keep(new, value), damping * keep(0.2, 4.0), count + 1, gain

        one = jnp.ones((), w0.dtype)
        w, *_ = jax.lax.while_loop(going, body, (w0, loss(w0), 1e-3 * one, jnp.zeros((), int), one))
        return w


class MStepInfo(NamedTuple):
    """What an M-step lets one see and reuse."""

    hessian: Float[Array, "weight weight"]
    """Posterior precision of the weights, at those of the model that was given (zero for M-steps that know none)."""
    used: Bool[Array, " seq"]
    """Sequences that took part."""


class Core(NamedTuple):
    """What an M-step changes, whatever else the model is made of."""

    unknown: Any
    """The friction map."""
    w: Float[Array, " weight"]
    """Network weights, then parameters in units of their prior."""
    log_q: Float[Array, " state"]
    log_r: Float[Array, " obs"]
    start: Gaussian


class AbstractMStep(eqx.Module):
    """A rule for the next model, given the posterior of every sequence."""

    @abstractmethod
    def __call__(self, model, posterior: Posterior, data: Dataset) -> tuple[AbstractModel, MStepInfo]:
        """The next model."""

    @abstractmethod
    def early(self) -> "AbstractMStep":
        """The rule while the horizon still grows."""

    @abstractmethod
    def no_hessian(self, model) -> Float[Array, "weight weight"]:
        """`MStepInfo.hessian` before the first epoch."""


@eqx.filter_jit
def kept(posterior: Posterior, data: Dataset) -> Bool[Array, " seq"]:
    """Sequences whose track is not lost: log-likelihood per reading not far below the median of all."""
    _, observed = fill_missing(data.y)
    count = jnp.sum(observed & data.valid[..., None], axis=(1, 2)).astype(posterior.loglik.dtype)
    mean = posterior.loglik / jnp.maximum(count, 1.0)
    finite = jnp.isfinite(mean)
    middle = jnp.nanmedian(jnp.where(finite, mean, jnp.nan))
    spread = 1.48 * jnp.nanmedian(jnp.where(finite, jnp.abs(mean - middle), jnp.nan))
    return finite & (mean >= middle - jnp.maximum(0.5, 5 * spread))


BLOCK = 4
"""The number of parameters is padded to a multiple of this, for fewer programs."""


@eqx.filter_jit
def _advance(rule: "ScoringMStep", core: Core, here: Local, posterior: Posterior, read, data: Dataset, used):
    weights = rule.weights(core)

    def one(here, posterior, read, seq):
        return quadratic(core.log_q, core.log_r, core.start, here, weights.nodes, posterior, read, seq)

    each = jax.vmap(one)(here, posterior, read, data)
    used = used & jnp.isfinite(posterior.loglik) & jnp.all(jnp.isfinite(each.information), axis=(1, 2))
    used = used & jnp.all(jnp.isfinite(each.score), axis=1) & jnp.all(jnp.isfinite(each.noise_score), axis=1)
    pick = lambda a: jnp.where(used.reshape(-1, *[1] * (a.ndim - 1)), a, 0.0)  # noqa: E731
    total = jax.tree.map(lambda a: jnp.sum(pick(a), axis=0), each)
    first = jax.tree.map(lambda a: pick(a[:, 0]), posterior.state)
    w = weights.fit(core.unknown, core.w, total.score, total.information, rule.iterations)
    hessian, _ = weights.hessian(core.unknown, core.w, total.information + weights.symmetry())
    log_q, log_r = rule.noise(core, total, weights.nodes.shape[0])
    return Core(core.unknown, w, log_q, log_r, rule.first(core.start, first, used)), hessian, used


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
    stride: Float[Array, ""] = eqx.field(default=1.5, converter=jnp.asarray)
    """Largest change of a log variance in one step."""
    tie: Float[Array, ""] = eqx.field(default=30.0, converter=jnp.asarray)
    """Precision with which the ratios of the joints' process noises are held to those of the first model.

    A wrong model would blame the joint that nobody sees: its noise grows until its motion means nothing.
    """
    linearise: Tangent | Cubature = Cubature()
    shape: Float[Array, " state"] | None = None
    """Log variances of the process noise of the first model."""

    def weights(self, model) -> Weights:
        return Weights(self.prior, model.unknown.nodes(self.nodes), self.ridge, self.centre, 0.1 * model.unknown.scale)

    def early(self) -> "ScoringMStep":
        return eqx.tree_at(lambda m: m.tie, self, jnp.asarray(1e4))

    def no_hessian(self, model) -> Float[Array, "weight weight"]:
        w = self.weights(model).read(model)
        return jnp.zeros((w.shape[0], w.shape[0]), w.dtype)

    def __call__(self, model, posterior: Posterior, data: Dataset) -> tuple[StateSpaceModel, MStepInfo]:
        here = locals_along(model, self.prior, posterior.state, data, self.linearise)
        read = _all_readings(model, posterior, data)
        core = self.core(model)
        core, hessian, used = self.advance(core, here, posterior, read, data, kept(posterior, data))
        return self.whole(model, core), MStepInfo(hessian, used)

    def core(self, model) -> Core:
        """What a step changes of a model."""
        return Core(model.unknown, self.weights(model).read(model), model.log_q, model.log_r, model.start)

    def whole(self, model, core: Core) -> StateSpaceModel:
        """`model` with what a step has changed."""
        fitted = self.weights(model).write(model, core.w)
        return eqx.tree_at(lambda m: (m.log_q, m.log_r, m.start), fitted, core[2:])

    def advance(
        self,
        core: Core,
        here: Local,
        posterior: Posterior,
        read: Float[Array, "seq time node obs"],
        data: Dataset,
        used: Bool[Array, " seq"],
    ) -> tuple[Core, Float[Array, "weight weight"], Bool[Array, " seq"]]:
        """The step itself: one program for models of every structure; parameters are nameless here.

        With it the posterior precision where it began, and which of the sequences `used` could be.
        """
        count = self.prior.size
        pad = -count % BLOCK
        names = tuple(map(str, range(count + pad)))
        mean, std = jnp.pad(self.prior.mean, (0, pad)), jnp.pad(self.prior.std, (0, pad), constant_values=1.0)
        rule = eqx.tree_at(lambda r: r.prior, self, ParameterPrior(names, mean, std))
        widen = lambda a: jnp.pad(a, [(0, 0)] * (a.ndim - 1) + [(0, pad)])  # noqa: E731
        here = here._replace(
            by_parameter=widen(here.by_parameter), reading_by_parameter=widen(here.reading_by_parameter)
        )
        core, hessian, used = _advance(rule, core._replace(w=widen(core.w)), here, posterior, read, data, used)
        wide = core.w.shape[0] - pad
        return core._replace(w=core.w[:wide]), hessian[:wide, :wide], used

    def noise(self, model: Core, total: Quadratic, dof: int) -> tuple[Float[Array, " state"], Float[Array, " obs"]]:
        """Log variances of process and reading noise after the step."""
        info = total.noise_information
        learn = jnp.asarray([i < 2 * dof for i in range(model.log_q.shape[0])] + list(self.learn_r))
        info = jnp.where(learn[:, None] & learn[None, :], info, 0.0)
        info = info + jnp.diag(jnp.where(learn, 1e-3 * jnp.diag(info) + 1e-3, 1.0))
        n = model.log_q.shape[0]
        hold = jnp.zeros_like(info).at[: 2 * dof, : 2 * dof].set(self._hold(dof))
        assert self.shape is not None
        off = jnp.zeros_like(total.noise_score).at[:n].set(model.log_q - self.shape)
        step = jnp.linalg.solve(info + hold, jnp.where(learn, total.noise_score, 0.0) - hold @ off)
        step = step * jnp.minimum(1.0, self.stride / jnp.max(jnp.abs(step)))
        return model.log_q + step[:n], model.log_r + step[n:]

    def _hold(self, dof: int) -> Float[Array, "state state"]:
        """Prior precision of the log process noises: kicks act on rates, and reach angles over one step."""
        rate = jnp.eye(dof)
        angle = jnp.concatenate([rate, -rate], axis=1)
        ratio = jnp.concatenate([jnp.zeros((dof, dof)), rate - 1 / dof], axis=1)
        return 1e4 * angle.T @ angle + self.tie * ratio.T @ ratio

    def first(self, start: Gaussian, first: Gaussian, used: Bool[Array, " seq"]) -> Gaussian:
        """EM's own update of the entries that nobody declared [paper, eq. 11]."""
        learn = jnp.asarray(self.learn_start + (False,) * (start.mean.shape[0] - len(self.learn_start)))
        count = jnp.maximum(jnp.sum(used), 1).astype(start.mean.dtype)
        mean = jnp.where(learn, jnp.sum(first.mean, axis=0) / count, start.mean)
        square = jnp.where(used[:, None], (first.mean - mean[None]) ** 2, 0.0)
        variance = (jnp.sum(square + jnp.diagonal(first.cov, axis1=1, axis2=2), axis=0) + jnp.diag(start.cov)) / (
            count + 1
        )
        return Gaussian(mean, jnp.diag(jnp.where(learn, variance, jnp.diag(start.cov))))
