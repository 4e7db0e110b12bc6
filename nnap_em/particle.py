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
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, UInt

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
    """Log weights of p(x_k | y_{0:k}), up to a constant of each time."""
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


_FARTHEST = 1e30
"""Squared distance from the path [variances of the process noise] from which particles have run away."""
Rows = list[Float[Array, " particle"]]
"""The entries of a vector per particle: a list, because what is stacked does not fuse with what stands around it."""


def _dot(row: Float[Array, " n"] | Rows, x: Rows) -> Float[Array, " particle"]:
    s = row[0] * x[0]
    for j in range(1, len(x)):
        s = s + row[j] * x[j]
    return s


def _apply(matrix: Float[Array, "row column"], x: Rows) -> Rows:
    """matrix @ x, unrolled: it fuses with what stands around it, a batched matrix product does not."""
    return [_dot(row, x) for row in matrix]


class _Quadratic(NamedTuple):
    """linear' x - x' precision x / 2 + constant, with a leading time axis."""

    precision: Float[Array, "*time state state"]
    linear: Float[Array, "*time state"]
    constant: Float[Array, "*time"]

    def __call__(self, x: Rows) -> Float[Array, " particle"]:
        pull = [a - 0.5 * b for a, b in zip(self.linear, _apply(self.precision, x), strict=True)]
        return _dot(pull, x) + self.constant


class _Step(NamedTuple):
    """What the particles need of the potential psi at one time; the fields carry a leading time axis.

    With spread S, S S' = (V^-1 + precision)^-1 where V is the covariance of what moves the particles:
    a particle of mean m moves to N(keep m + shift, S S').
    """

    log_psi: _Quadratic
    log_ahead: _Quadratic
    """Log of the integral of N(x; m, V) psi(x), of m."""
    keep: Float[Array, "*time state state"]
    shift: Float[Array, "*time state"]
    spread: Float[Array, "*time state state"]

    def move(self, mean: Rows, noise: Rows) -> Rows:
        kept, kicked = _apply(self.keep, mean), _apply(self.spread, noise)
        return [a + b + c for a, b, c in zip(kept, self.shift, kicked, strict=True)]


def _prepare(potentials: Potentials, start: Gaussian) -> _Step:
    """The steps of all times; the first from the scaled prior, the others from noise of covariance I."""
    time, n = potentials.linear.shape
    factor, eye = lower(cholesky(start.cov)), jnp.eye(n, dtype=start.cov.dtype)
    factors = jnp.concatenate([factor[None], jnp.tile(eye[None], (time - 1, 1, 1))])

    def one(factor, precision, linear):
        spread, logdet = _twist(factor, precision)
        cov = spread @ spread.T
        keep = eye - cov @ precision
        ahead = _Quadratic(symmetric(precision @ keep), keep.T @ linear, 0.5 * linear @ cov @ linear - logdet)
        return _Step(_Quadratic(precision, linear, jnp.zeros_like(logdet)), ahead, keep, cov @ linear, spread)

    return jax.vmap(one)(factors, potentials.precision, potentials.linear)


def _threefry(key: UInt[Array, "2"], a: UInt[Array, "*counter"], b: UInt[Array, ""]) -> tuple[Array, Array]:
    """Two random words per counter (a, b): Threefry-2x32 with 20 rounds [Salmon et al. 2011, sec. 4.1].

    `jax.extend.random.threefry_2x32` unrolled, so that it fuses with the use of the words.
    """
    keys = (key[0], key[1], key[0] ^ key[1] ^ jnp.uint32(0x1BD11BDA))
    a, b = a + keys[0], b + keys[1]
    for group in range(5):
        for turn in ((13, 15, 26, 6), (17, 29, 16, 24))[group % 2]:
            a = a + b
            b = a ^ ((b << jnp.uint32(turn)) | (b >> jnp.uint32(32 - turn)))
        a, b = a + keys[(group + 1) % 3], b + keys[(group + 2) % 3] + jnp.uint32(group + 1)
    return a, b


def uniforms(
    key: PRNGKeyArray, time: Int[Array, ""], rows: int, count: int, dtype=jnp.float32
) -> Float[Array, "{rows} {count}"]:
    """Uniform numbers of one time in [0, 1), multiples of 2^-24; they do not depend on how many times there are."""
    counter = jnp.arange(rows * count, dtype=jnp.uint32).reshape(rows, count)
    word, _ = _threefry(jax.random.bits(key, (2,), jnp.uint32), counter, time.astype(jnp.uint32))
    return (word >> jnp.uint32(8)).astype(dtype) * 2**-24


def normals(key: PRNGKeyArray, time: Int[Array, ""], rows: int, count: int, dtype=jnp.float32) -> Rows:
    """Standard normal numbers of one time, in single precision by the method of Box & Muller [1958].

    The angle is half a turn, t in [-pi/2, pi/2] with sin t and cos t as Taylor series good to 4e-6, and a sign.
    """
    if dtype != jnp.float32:
        return list(jax.random.normal(jax.random.fold_in(key, time), (rows, count), dtype))
    words = jax.random.bits(key, (2,), jnp.uint32)

    def two_rows(_, pair):
        a, b = _threefry(words, pair * count + jnp.arange(count, dtype=jnp.uint32), time.astype(jnp.uint32))
        radius = jnp.sqrt(-2 * jnp.log((a.astype(dtype) + 0.5) * 2**-32))
        t = jax.lax.bitcast_convert_type(b, jnp.int32).astype(dtype) * (math.pi * 2**-32)
        z = t * t
        sine = t * (1 + z * (-1 / 6 + z * (1 / 120 + z * (-1 / 5040 + z / 362880))))
        cosine = 1 + z * (-1 / 2 + z * (1 / 24 + z * (-1 / 720 + z * (1 / 40320 - z / 3628800))))
        return None, (radius * sine, jnp.where(b & jnp.uint32(1), radius, -radius) * cosine)

    # a loop, or XLA would draw the numbers anew wherever they are used
    _, drawn = jax.lax.scan(two_rows, None, jnp.arange((rows + 1) // 2, dtype=jnp.uint32))
    return [row for pair in zip(*drawn, strict=True) for row in pair][:rows]


def _cumsum(x: Float[Array, "*batch n"], block: int = 32) -> Float[Array, "*batch n"]:
    """`jnp.cumsum` along the last axis as triangular matrix products, within blocks and over them: faster."""
    n = x.shape[-1]
    padded = jnp.pad(x, [(0, 0)] * (x.ndim - 1) + [(0, -n % block)])
    within = _before(padded.reshape(*x.shape[:-1], -1, block), 0)
    total = within + _before(within[..., -1], 1)[..., None]
    return total.reshape(padded.shape)[..., :n]


def _before(x: Float[Array, "*batch n"], k: int) -> Float[Array, "*batch n"]:
    """Sums of x over all places up to k before each."""
    square = jnp.ones((x.shape[-1], x.shape[-1]), x.dtype)
    return jnp.matmul(x, jnp.triu(square, k), precision=jax.lax.Precision.HIGHEST)


def systematic(log_w: Float[Array, " particle"], offset: Float[Array, ""], count: int) -> Int[Array, " {count}"]:
    """Sorted indices of `count` draws by one uniform `offset` [Kitagawa 1996]."""
    return _sweep(_cumsum(jnp.exp(log_w - jnp.max(log_w))), offset, count)


def _sweep(reach: Float[Array, " particle"], offset: Float[Array, ""], count: int) -> Int[Array, " {count}"]:
    """Where (j + offset) / count of the total falls among the cumulative weights, for each j."""
    before = jnp.ceil(reach * (count / reach[-1]) - offset).astype(jnp.int32)  # draws among the particles up to here
    drops = jnp.zeros(count + 1, reach.dtype).at[jnp.clip(before, 0, count)].add(1, mode="promise_in_bounds")
    return jnp.minimum(_cumsum(drops[:count]).astype(jnp.int32), reach.shape[0] - 1)


def _cast(tree, dtype):
    return jax.tree.map(lambda a: a.astype(dtype) if eqx.is_inexact_array(a) else a, tree)


def _where(condition: Bool[Array, ""], change: Callable, value):
    """change(value) where the condition holds, or else value.

    Unlike `lax.cond` it costs nothing under `vmap` where no element of the batch needs the change.
    """
    return jax.lax.while_loop(lambda c: c[0], lambda c: (jnp.zeros_like(c[0]), change(c[1])), (condition, value))[1]


def particle_filter(
    model, potentials: Potentials, seq: Dataset, *, num_particles: int, key: PRNGKeyArray, dtype=jnp.float32
) -> ParticleHistory:
    """Filter one sequence; resamples (systematically) where the effective sample size is below half.

    A particle that has run away, 1e15 standard deviations off or no number, has weight 0 and stands at the origin.
    Where none is left, all begin there anew, and the likelihood is 0.
    """
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
    size, flat = jnp.asarray(num_particles, dtype), jnp.full(num_particles, -math.log(num_particles), dtype)
    everyone = jnp.arange(num_particles, dtype=jnp.int32)
    states, readings = scale.shape[0], y.shape[1]

    def log_g(x, u, y, observed):
        g = jax.vmap(model.emission, in_axes=(1, None), out_axes=1)(x, u)
        terms = [-0.5 * ((y[i] - g[i]) ** 2 / r[i] + model.log_r[i] + math.log(2 * math.pi)) for i in range(readings)]
        return sum((jnp.where(observed[i], terms[i], 0.0) for i in range(readings)), jnp.zeros((), dtype))

    def step(carry, slices):
        f, log_w, ess = carry
        time, offset, arrive, leave, origin, origin_next, u, y, observed, now, following = slices

        def resample(old):
            f, log_w, _ = old
            ancestors = systematic(log_w, offset, num_particles)
            return [row[ancestors] for row in f], flat, ancestors

        f, log_w, ancestors = _where(arrive & (ess < 0.5 * size), resample, (f, log_w, everyone))
        noise = normals(key_noise, time, states, num_particles, dtype)
        x = [jnp.where(arrive, a, b) for a, b in zip(now.move(f, noise), f, strict=True)]
        state = jnp.stack([origin[i] + scale_[i] * x[i] for i in range(states)])
        f = jax.vmap(model.transition, in_axes=(1, None), out_axes=1)(state, u)
        f = [jnp.where(leave, (f[i] - origin_next[i]) / scale_[i], x[i]) for i in range(states)]
        log_ahead = jnp.where(leave, following.log_ahead(f), 0.0)
        grown = log_w + log_g(state, u, y, observed) - now.log_psi(x) + log_ahead
        alive = jnp.isfinite(grown) & (_dot(f, f) < _FARTHEST)
        some = jnp.any(alive)
        grown = jnp.where(alive, grown, jnp.where(some, -jnp.inf, flat))  # where all are dead, all begin anew
        x, f = ([jnp.where(alive, row, 0.0) for row in rows] for rows in (x, f))
        log_ahead = jnp.where(alive, log_ahead, 0.0)
        top = jnp.max(grown)
        w = jnp.exp(grown - top)
        mass = jnp.sum(w)
        total = top + jnp.log(mass)
        log_w = jnp.where(arrive, grown - total, log_w)
        ess = jnp.where(arrive, mass**2 / jnp.sum(w**2), ess)
        out = (jnp.stack(x), jnp.stack(f), log_w - log_ahead, log_ahead, ancestors, ess)
        return (f, log_w, ess), (*out, jnp.where(some, jnp.where(arrive, total, 0.0), -jnp.inf).astype(exact))

    mean = [jnp.full(num_particles, m, dtype) for m in start.mean.astype(dtype)]
    log_ahead = jax.tree.map(lambda a: a[0], steps).log_ahead(mean)
    later = jax.tree.map(lambda a: jnp.concatenate([a[1:], a[-1:]]), (origin, steps))
    observed = observed & seq.valid[:, None]
    # Drawn time by time: the numbers of a time do not depend on how many follow.
    times = jnp.arange(y.shape[0], dtype=jnp.int32)
    offset = jax.random.uniform(key_offset, y.shape[:1], dtype)
    _, (x, f, log_w, ahead, ancestors, ess, total) = jax.lax.scan(
        step,
        (mean, flat, size),
        (times, offset, arrive, leave, origin, later[0], u, y, observed, steps, later[1]),
    )
    loglik = jnp.sum(total) + log_ahead[0].astype(exact)
    return ParticleHistory(origin.astype(exact), scale, x, f, log_w, ahead, ancestors, leave, ess, loglik)


def _exp2(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """2^x, in single precision to 4e-6 and at least 2^-126: a Taylor series times a power of two."""
    if x.dtype != jnp.float32:
        return jnp.exp2(x)
    x = jnp.maximum(x, -126.0)
    whole = jnp.round(x)
    z = (x - whole) * math.log(2)
    power = 1 + z * (1 + z * (1 / 2 + z * (1 / 6 + z * (1 / 24 + z / 120))))
    shift = whole.astype(jnp.int32) << 23
    return jax.lax.bitcast_convert_type(jax.lax.bitcast_convert_type(power, jnp.int32) + shift, jnp.float32)


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
        centre = jnp.mean(x_next, axis=1, keepdims=True)  # or the squares below would cancel
        f = f - centre
        x_next = (x_next - centre) / math.log(2)  # from here on logarithms are to base 2
        level = jnp.maximum((log_w - 0.5 * jnp.sum(f**2, axis=0)) / math.log(2), -1e30)
        level = jnp.pad(level, (0, spare), constant_values=-1e30).reshape(-1, self.block)
        f = jnp.pad(f, ((0, 0), (0, spare))).reshape(f.shape[0], -1, self.block)

        def weigh(_, particles):
            f, level = particles
            for i in range(f.shape[0]):
                level = level + f[i][:, None] * x_next[i][None]
            top = jnp.max(level, axis=0)
            return None, (top, jnp.sum(_exp2(level - top[None]), axis=0))

        _, (tops, sums) = jax.lax.scan(weigh, None, (jnp.swapaxes(f, 0, 1), level[:, :, None]))
        top = jnp.max(tops, axis=0)
        reach = _before((sums * _exp2(tops - top[None])).T, 0).T
        target = uniform[0] * reach[-1]
        outer = jnp.minimum(jnp.sum(reach <= target[None], axis=0), reach.shape[0] - 1)
        before = jnp.take_along_axis(jnp.pad(reach, ((1, 0), (0, 0))), outer[None], axis=0)[0]
        within = level[outer] - top[:, None]
        for i in range(f.shape[0]):
            within = within + f[i][outer] * x_next[i][:, None]
        within = _before(_exp2(within), 0)
        rest = jnp.minimum(target - before, within[:, -1] * (1 - jnp.finfo(target.dtype).eps))
        inner = jnp.sum(within <= rest[:, None], axis=1)
        return (outer * self.block + inner).astype(jnp.int32)


class MetropolisBackward(AbstractBackward):
    """A few independent Metropolis steps from the genealogical parent [Bunch & Godsill 2013; Dau & Chopin 2023].

    O(N) per step.  Candidates come from the weights that the filter carries, so that only the transition density and
    psi~ are left in the ratio.  A candidate is a random entry of a systematic draw that is made anew for each step:
    each path sees independent draws from the weights, without a search per path.
    """

    steps: int = eqx.field(static=True, default=4)

    @property
    def draws(self) -> int:
        return 2 * self.steps

    def __call__(self, x_next, f, log_w, log_ahead, parent, uniform):
        choose, accept = jnp.split(uniform, 2)
        carried = log_w + log_ahead
        reach = _cumsum(jnp.exp(carried - jnp.max(carried)))
        paths = parent.shape[0]

        def score(index):
            e = [x_next[i] - f[i][index] for i in range(f.shape[0])]
            return -0.5 * _dot(e, e) - log_ahead[index]

        def step(now, uniform):
            index, value = now
            choose, accept = uniform
            place = choose * paths
            whole = jnp.floor(place)
            draws = _sweep(reach, place[0] - whole[0], paths)
            candidate = draws[jnp.minimum(whole.astype(jnp.int32), paths - 1)]
            proposed = score(candidate)
            better = jnp.log(accept) < proposed - value
            return (jnp.where(better, candidate, index), jnp.where(better, proposed, value)), None

        (index, _), _ = jax.lax.scan(step, (parent, score(parent)), (choose, accept))
        return index


def ffbs(history: ParticleHistory, backward: AbstractBackward, *, num_paths: int, key: PRNGKeyArray) -> Trajectories:
    """Draw trajectories backward through the particles of a filter."""
    key_last, key_steps = jax.random.split(key)
    dtype, exact = history.x.dtype, history.origin.dtype
    last = systematic(history.log_w[-1], jax.random.uniform(key_last, (), dtype), num_paths)

    def step(carry, slices):
        index, x_next = carry
        time, active, x, f, log_w, log_ahead, ancestors = slices
        uniform = uniforms(key_steps, time, backward.draws, num_paths, dtype)
        chosen = backward(x_next, f, log_w, log_ahead, ancestors[index], uniform)
        index = jnp.where(active, chosen, index)  # nothing is resampled on arrival in the padding
        here = x[:, index]
        return (index, here), (here, x_next - f[:, index])

    h = history
    times = jnp.arange(h.x.shape[0] - 1, dtype=jnp.int32)
    end = h.x[-1][:, last]
    before = jax.tree.map(lambda a: a[:-1], (h.active, h.x, h.f, h.log_w, h.log_ahead))
    _, (x, kick) = jax.lax.scan(step, (last, end), (times, *before, h.ancestors[1:]), reverse=True)
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

    @property
    def bytes_per_row(self) -> int:
        return self.guide.bytes_per_row + 64 * self.num_particles + 128 * self.num_paths  # measured: docs/throughput.md

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
