"""Particle smoother: a filter that looks ahead, and draws of whole trajectories backward through its particles.

The filter targets p(x_{0:k} | y_{0:k}) psi~_{k+1}(x_k), with any Gaussian potentials

    psi_k(x) = exp(linear_k' x - x' precision_k x / 2)          (up to a factor, which cancels)

as proposal:  x_{k+1} ~ N(f(x_k, u_k), Q) psi_{k+1} / psi~_{k+1}(x_k),  where psi~_{k+1} is the integral, and
the weight grows by g(y_k | x_k) psi~_{k+1}(x_k) / psi_k(x_k).  Weights are exact, so that the likelihood is unbiased
whatever the potentials; they decide only how many particles survive.
[Guarniero, Johansen & Lee 2017, J. Am. Stat. Assoc. 112(520), sec. 2; Heng et al. 2020, Ann. Stat. 48(5)]

Particles are held as deviations from a reference path in standard deviations of the process noise, so that Q = I and
single precision is enough.  Arrays of particles have the particle axis last.
"""

import math
from abc import abstractmethod
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from .data import Dataset, fill_missing
from .gaussian import Gaussian, cholesky, lower, symmetric
from .kalman import Filtered, Smoothed
from .smoother import AbstractSmoother, GaussianSmoother, Posterior, active_steps


class Potentials(NamedTuple):
    """log psi_k = linear_k' d - d' precision_k d / 2 with d = (x - origin_k) / sqrt(diag Q)."""

    origin: Float[Array, "time state"]
    precision: Float[Array, "time state state"]
    linear: Float[Array, "time state"]


class ParticleHistory(NamedTuple):
    """All that the filter has seen; x and f are (state - origin) / scale."""

    origin: Float[Array, "time state"]
    scale: Float[Array, " state"]
    x: Float[Array, "time state particle"]
    f: Float[Array, "time state particle"]
    """Mean of the next state, as seen from the next origin."""
    log_w: Float[Array, "time particle"]
    """Normalised weights of p(x_k | y_{0:k})."""
    log_ahead: Float[Array, "time particle"]
    """log psi~_{k+1}(f); the filter itself carries the weights exp(log_w + log_ahead)."""
    ancestors: Int[Array, "time particle"]
    """Index at k - 1 of the parent of each particle at k."""
    active: Bool[Array, " time"]
    ess: Float[Array, " time"]
    """Effective sample size of the weights carried, before any resampling."""
    loglik: Float[Array, ""]
    """Log of the unbiased estimate of p(y)."""


class Trajectories(NamedTuple):
    """Equal-weight draws of p(x_{0:T} | y)."""

    x: Float[Array, "time path state"]
    kick: Float[Array, "steps path state"]
    """Process noise x_{k+1} - f(x_k)."""


class AbstractProposal(eqx.Module):
    """How far a particle sees when it is moved."""

    @abstractmethod
    def __call__(self, model, seq: Dataset, filtered: Filtered, smoothed: Smoothed) -> Potentials:
        """Potentials about the smoothed path, from the model linearised there."""


class _Readings(NamedTuple):
    """The readings of every time as Gaussian potentials about a path."""

    precision: Float[Array, "time state state"]
    linear: Float[Array, "time state"]


def _readings(model, seq: Dataset, path: Float[Array, "time state"]) -> _Readings:
    """C'R^-1 C and C'R^-1 (y - g(path)), in units of the process noise."""
    y, observed = fill_missing(seq.y)
    weight = jnp.where(observed & seq.valid[:, None], jnp.exp(-model.log_r)[None], 0.0)
    u = model.inputs(seq)
    rows = jax.vmap(jax.jacfwd(model.emission))(path, u) * jnp.exp(0.5 * model.log_q)[None, None]
    pull = jnp.swapaxes(rows * weight[..., None], -1, -2)
    misfit = y - jax.vmap(model.emission)(path, u)
    return _Readings(pull @ rows, jnp.squeeze(pull @ misfit[..., None], -1))


class Bootstrap(AbstractProposal):
    """Blind: the transition itself [Gordon, Salmond & Smith 1993]."""

    def __call__(self, model, seq: Dataset, filtered: Filtered, smoothed: Smoothed) -> Potentials:
        path, cov = smoothed.state
        return Potentials(path, jnp.zeros_like(cov), jnp.zeros_like(path))


class Guided(AbstractProposal):
    """Sees the reading of the arriving time: the optimal proposal of one step for a linear emission [Doucet 2000]."""

    def __call__(self, model, seq: Dataset, filtered: Filtered, smoothed: Smoothed) -> Potentials:
        path = smoothed.state.mean
        return Potentials(path, *_readings(model, seq, path))


class Lookahead(AbstractProposal):
    """Sees all readings to come: psi_k = p(y_{k:T} | x_k)^temper of the model linearised about the smoothed path.

    On a linear system at temper = 1 every weight is equal.
    """

    temper: float = eqx.field(static=True, default=0.98)
    """Below 1 the potentials are wider than the linearised ones, for heavier tails of the proposal."""

    def __call__(self, model, seq: Dataset, filtered: Filtered, smoothed: Smoothed) -> Potentials:
        path, scale = smoothed.state.mean, jnp.exp(0.5 * model.log_q)
        active = active_steps(jnp.asarray(seq.valid))
        affine = filtered.affine
        following = jnp.concatenate([path[1:], path[-1:]])
        miss = (jnp.squeeze(affine.matrix @ path[..., None], -1) + affine.offset - following) / scale[None]
        matrix = affine.matrix * scale[None, None] / scale[None, :, None]
        noise = affine.noise / (scale[:, None] * scale[None])[None] + jnp.eye(scale.shape[0], dtype=scale.dtype)[None]

        def step(later, slices):
            active, matrix, miss, noise, reading = slices
            spread, _ = _twist(lower(cholesky(noise)), later.precision)
            seen = spread @ (spread.T @ later.precision)
            ahead = symmetric(later.precision - later.precision @ seen)  # (precision^-1 + noise)^-1
            linear = matrix.T @ (later.linear - seen.T @ later.linear - ahead @ miss)
            now = _Readings(
                reading.precision + jnp.where(active, symmetric(matrix.T @ ahead @ matrix), 0.0),
                reading.linear + jnp.where(active, linear, 0.0),
            )
            return now, now

        readings = _readings(model, seq, path)
        blank = jax.tree.map(lambda a: jnp.zeros_like(a[0]), readings)
        _, (precision, linear) = jax.lax.scan(step, blank, (active, matrix, miss, noise, readings), reverse=True)
        return Potentials(path, self.temper * precision, self.temper * linear)


def _twist(
    factor: Float[Array, "state state"], precision: Float[Array, "state state"]
) -> tuple[Float[Array, "state state"], Float[Array, ""]]:
    """S with S S' = ((L L')^-1 + precision)^-1, and log det(I + L' precision L) / 2, for a lower factor L."""
    n = factor.shape[0]
    rows = cholesky(jnp.eye(n, dtype=factor.dtype) + factor.T @ precision @ factor)
    inverse = jnp.eye(n, dtype=factor.dtype)
    solved: list = []
    for i in range(n):
        row = inverse[i]
        for m in range(i):
            row = row - rows[i][m] * solved[m]
        solved.append(row / rows[i][i])
    logdet = jnp.log(rows[0][0])
    for i in range(1, n):
        logdet = logdet + jnp.log(rows[i][i])
    return factor @ jnp.stack(solved).T, logdet


def _apply(matrix: Float[Array, "row column"], x: Float[Array, "column particle"]) -> Float[Array, "row particle"]:
    """matrix @ x, unrolled: it fuses with what stands around it, a batched matrix product does not."""
    rows = []
    for i in range(matrix.shape[0]):
        s = matrix[i, 0] * x[0]
        for j in range(1, matrix.shape[1]):
            s = s + matrix[i, j] * x[j]
        rows.append(s)
    return jnp.stack(rows)


class _Step(NamedTuple):
    """What the particles need of the potential at one time; the fields carry a leading time axis."""

    precision: Float[Array, "*time state state"]
    linear: Float[Array, "*time state"]
    spread: Float[Array, "*time state state"]
    logdet: Float[Array, "*time"]

    def log_psi(self, x: Float[Array, "state particle"]) -> Float[Array, " particle"]:
        return jnp.sum(x * (self.linear[:, None] - 0.5 * _apply(self.precision, x)), axis=0)

    def look(
        self, mean: Float[Array, "state particle"]
    ) -> tuple[Float[Array, " particle"], Float[Array, "state particle"]]:
        """Log of the integral of N(x; mean, L L') psi(x), and the pull S'(linear - precision mean)."""
        drop = _apply(self.precision, mean)
        pull = _apply(self.spread.T, self.linear[:, None] - drop)
        log_ahead = jnp.sum(mean * (self.linear[:, None] - 0.5 * drop) + 0.5 * pull**2, axis=0)
        return log_ahead - self.logdet, pull


def _prepare(potentials: Potentials, start: Gaussian) -> _Step:
    """Proposal spreads of all times; the first from the factor of the scaled prior, the others from I."""
    time, n = potentials.linear.shape
    factor = lower(cholesky(start.cov))
    factors = jnp.concatenate([factor[None], jnp.tile(jnp.eye(n, dtype=factor.dtype)[None], (time - 1, 1, 1))])
    spread, logdet = jax.vmap(_twist)(factors, potentials.precision)
    return _Step(potentials.precision, potentials.linear, spread, logdet)


def systematic(log_w: Float[Array, " particle"], offset: Float[Array, ""], count: int) -> Int[Array, " {count}"]:
    """Sorted indices of `count` draws by one uniform `offset` [Kitagawa 1996]."""
    reach = jnp.cumsum(jnp.exp(log_w - jnp.max(log_w)))
    before = jnp.ceil(reach / reach[-1] * count - offset).astype(jnp.int32)  # draws among the particles up to here
    drops = jnp.zeros(count, jnp.int32).at[before].add(1, mode="drop")
    return jnp.minimum(jnp.cumsum(drops), log_w.shape[0] - 1)


def _cast(tree, dtype):
    return jax.tree.map(lambda a: a.astype(dtype) if eqx.is_inexact_array(a) else a, tree)


def particle_filter(
    model, potentials: Potentials, seq: Dataset, *, num_particles: int, key: PRNGKeyArray, dtype=jnp.float32
) -> ParticleHistory:
    """Filter one sequence; resamples (systematically) where the effective sample size is below half."""
    key_offset, key_noise = jax.random.split(key)
    exact = model.log_q.dtype
    y, observed = fill_missing(seq.y)
    leave = active_steps(jnp.asarray(seq.valid))
    arrive = jnp.concatenate([jnp.ones(1, bool), leave[:-1]])
    origin = potentials.origin.astype(dtype)
    scale = jnp.exp(0.5 * model.log_q)
    start = Gaussian(
        (model.start.mean - origin[0].astype(exact)) / scale, model.start.cov / (scale[:, None] * scale[None, :])
    )
    steps = _cast(_prepare(potentials, start), dtype)
    model, scale_, u, y = _cast((model, scale, model.inputs(seq), y), dtype)
    r = jnp.exp(model.log_r)
    size = jnp.asarray(num_particles, dtype)

    def log_g(x, u, y, observed):
        e = y[:, None] - jax.vmap(model.emission, in_axes=(1, None), out_axes=1)(x, u)
        terms = -0.5 * (e**2 / r[:, None] + model.log_r[:, None] + math.log(2 * math.pi))
        return jnp.sum(jnp.where(observed[:, None], terms, 0.0), axis=0)

    def step(carry, slices):
        x, f, pull, log_w, ess = carry
        offset, noise, arrive, leave, origin, origin_next, u, y, observed, now, following = slices
        resample = arrive & (ess < 0.5 * size)
        ancestors = jnp.where(
            resample,
            systematic(log_w, offset, num_particles),
            jnp.arange(num_particles, dtype=jnp.int32),
        )
        moved = f[:, ancestors] + _apply(now.spread, pull[:, ancestors] + noise)
        x = jnp.where(arrive, moved, x)
        state = origin[:, None] + scale_[:, None] * x
        f = jax.vmap(model.transition, in_axes=(1, None), out_axes=1)(state, u)
        f = jnp.where(leave, (f - origin_next[:, None]) / scale_[:, None], x)
        log_ahead, pull = following.look(f)
        log_ahead = jnp.where(leave, log_ahead, 0.0)
        filtered = jnp.where(resample, -jnp.log(size), log_w) + log_g(state, u, y, observed) - now.log_psi(x)
        grown = filtered + log_ahead
        total = jax.nn.logsumexp(grown)
        log_w = jnp.where(arrive, grown - total, log_w)
        ess = 1 / jnp.sum(jnp.exp(2 * log_w))
        filtered = log_w - log_ahead
        filtered = filtered - jax.nn.logsumexp(filtered)
        out = (x, f, filtered, log_ahead, ancestors, ess, jnp.where(arrive, total, 0.0).astype(exact))
        return (x, f, pull, log_w, ess), out

    mean = jnp.tile(start.mean.astype(dtype)[:, None], (1, num_particles))
    log_ahead, pull = jax.tree.map(lambda a: a[0], steps).look(mean)
    flat = jnp.full(num_particles, -math.log(num_particles), dtype)
    later = jax.tree.map(lambda a: jnp.concatenate([a[1:], a[-1:]]), (origin, steps))
    observed = observed & seq.valid[:, None]
    # Drawn at once, time first: the numbers of a time do not depend on how many follow.
    offset = jax.random.uniform(key_offset, y.shape[:1], dtype)
    noise = jax.random.normal(key_noise, (y.shape[0], *mean.shape), dtype)
    _, (x, f, log_w, ahead, ancestors, ess, total) = jax.lax.scan(
        step,
        (mean, mean, pull, flat, size),
        (offset, noise, arrive, leave, origin, later[0], u, y, observed, steps, later[1]),
    )
    loglik = jnp.sum(total) + log_ahead[0].astype(exact)
    return ParticleHistory(origin.astype(exact), scale, x, f, log_w, ahead, ancestors, leave, ess, loglik)


class AbstractBackward(eqx.Module):
    """Draws the particle that a trajectory passes through at k, given where it is at k + 1."""

    @property
    @abstractmethod
    def draws(self) -> int:
        """Uniform numbers needed for one step of one path."""

    @abstractmethod
    def __call__(
        self,
        x_next: Float[Array, "state path"],
        f: Float[Array, "state particle"],
        log_w: Float[Array, " particle"],
        log_ahead: Float[Array, " particle"],
        parent: Int[Array, " path"],
        uniform: Float[Array, "draw path"],
    ) -> Int[Array, " path"]:
        """Indices with probability proportional to exp(log_w) N(x_next; f, I); `parent` is the genealogical one."""


class ExactBackward(AbstractBackward):
    """Forward filtering, backward sampling: all particles are weighed for each path [Godsill, Doucet & West 2004]."""

    block: int = eqx.field(static=True, default=32)
    """Particles per block of the two-level inverse distribution function."""

    @property
    def draws(self) -> int:
        return 1

    def __call__(self, x_next, f, log_w, log_ahead, parent, uniform):
        spare = -log_w.shape[0] % self.block
        centre = jnp.mean(f, axis=1, keepdims=True)  # or the squares below would cancel
        x_next, f = x_next - centre, f - centre
        logits = jnp.pad(log_w - 0.5 * jnp.sum(f**2, axis=0), (0, spare), constant_values=-jnp.inf)[None, :]
        f = jnp.pad(f, ((0, 0), (0, spare)))
        for i in range(f.shape[0]):
            logits = logits + x_next[i][:, None] * f[i][None, :]
        paths = x_next.shape[1]
        w = jnp.exp(logits - jnp.max(logits, axis=1, keepdims=True)).reshape(paths, -1, self.block)
        reach = jnp.cumsum(jnp.sum(w, axis=2), axis=1)
        level = uniform[0] * reach[:, -1]
        outer = jnp.minimum(jnp.sum(reach <= level[:, None], axis=1), reach.shape[1] - 1)
        chosen = jnp.take_along_axis(w, outer[:, None, None], axis=1)[:, 0]
        before = jnp.where(outer > 0, jnp.take_along_axis(reach, jnp.maximum(outer - 1, 0)[:, None], axis=1)[:, 0], 0.0)
        within = jnp.cumsum(chosen, axis=1)
        rest = jnp.minimum(level - before, within[:, -1] * (1 - jnp.finfo(level.dtype).eps))
        inner = jnp.sum(within <= rest[:, None], axis=1)
        return (outer * self.block + inner).astype(jnp.int32)


class MetropolisBackward(AbstractBackward):
    """A few independent Metropolis steps from the genealogical parent [Bunch & Godsill 2013; Dau & Chopin 2023].

    O(N) per step.  Candidates come from the weights that the filter carries, so that only the transition density and
    psi~ are left in the ratio.
    """

    steps: int = eqx.field(static=True, default=4)

    @property
    def draws(self) -> int:
        return 2 * self.steps

    def __call__(self, x_next, f, log_w, log_ahead, parent, uniform):
        choose, accept = jnp.split(uniform, 2)
        carried = log_w + log_ahead
        reach = jnp.cumsum(jnp.exp(carried - jnp.max(carried)))
        candidates = jnp.searchsorted(reach, (choose * reach[-1]).ravel(), side="right")
        candidates = jnp.minimum(candidates, f.shape[1] - 1).astype(jnp.int32).reshape(choose.shape)

        def score(index):
            return -0.5 * jnp.sum((x_next - f[:, index]) ** 2, axis=0) - log_ahead[index]

        index, value = parent, score(parent)
        for i in range(self.steps):
            proposed = score(candidates[i])
            better = jnp.log(accept[i]) < proposed - value
            index = jnp.where(better, candidates[i], index)
            value = jnp.where(better, proposed, value)
        return index


def ffbs(history: ParticleHistory, backward: AbstractBackward, *, num_paths: int, key: PRNGKeyArray) -> Trajectories:
    """Draw trajectories backward through the particles of a filter."""
    key_last, key_steps = jax.random.split(key)
    dtype, exact = history.x.dtype, history.origin.dtype
    last = systematic(history.log_w[-1], jax.random.uniform(key_last, (), dtype), num_paths)

    def step(carry, slices):
        index, x_next = carry
        uniform, active, x, f, log_w, log_ahead, ancestors = slices
        parent = ancestors[index]
        index = jnp.where(active, backward(x_next, f, log_w, log_ahead, parent, uniform), parent)
        here = x[:, index]
        return (index, here), (here, x_next - f[:, index])

    h = history
    uniform = jax.random.uniform(key_steps, (h.x.shape[0] - 1, backward.draws, num_paths), dtype)
    end = h.x[-1][:, last]
    before = jax.tree.map(lambda a: a[:-1], (h.active, h.x, h.f, h.log_w, h.log_ahead))
    _, (x, kick) = jax.lax.scan(step, (last, end), (uniform, *before, h.ancestors[1:]), reverse=True)
    x = jnp.swapaxes(jnp.concatenate([x, end[None]]), 1, 2).astype(exact)
    kick = jnp.swapaxes(kick, 1, 2).astype(exact)
    return Trajectories(h.origin[:, None] + h.scale[None, None] * x, h.scale[None, None] * kick)


class ParticleSmoother(AbstractSmoother):
    """Draws of p(x_{0:T} | y) through a particle filter guided by a Gaussian smoother."""

    guide: GaussianSmoother
    proposal: AbstractProposal = Lookahead()
    backward: AbstractBackward = ExactBackward()
    num_particles: int = eqx.field(static=True, default=300)
    num_paths: int = eqx.field(static=True, default=100)
    dtype: type = eqx.field(static=True, default=jnp.float32)
    """Of the particles; Gaussians and results keep the precision of the model."""

    def history(self, model, seq: Dataset, *, key: PRNGKeyArray) -> ParticleHistory:
        """The filter alone, with its effective sample size."""
        potentials = self.proposal(model, seq, *self.guide.path(model, seq))
        return particle_filter(model, potentials, seq, num_particles=self.num_particles, key=key, dtype=self.dtype)

    def __call__(self, model, seq: Dataset, *, key: PRNGKeyArray) -> Posterior:
        key_filter, key_paths = jax.random.split(key)
        history = self.history(model, seq, key=key_filter)
        x, kick = ffbs(history, self.backward, num_paths=self.num_paths, key=key_paths)
        mean = jnp.mean(x, axis=1)
        e = x - mean[:, None]
        cov = jnp.swapaxes(e, 1, 2) @ e / jnp.asarray(self.num_paths, e.dtype)
        inside = jnp.concatenate([jnp.ones(1, bool), history.active[:-1]])
        ess = jnp.mean(history.ess, where=inside).astype(history.loglik.dtype)
        return Posterior(Gaussian(mean, cov), x[:-1], x[1:], kick, jnp.zeros_like(cov[1:]), history.loglik, ess)
