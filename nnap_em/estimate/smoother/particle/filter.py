"""Particle filter that looks ahead: it targets p(x_{0:k} | y_{0:k}) psi~_{k+1}(x_k), with any Gaussian potentials

    psi_k(x) = exp(linear_k' x - x' precision_k x / 2)          (up to a factor, which cancels)

as proposal, and exact weights (docs/how/smoother.md). Particles are deviations from a reference path in standard
deviations of the process noise, so that Q = I and single precision is enough; their axis is the last of arrays.
[Guarniero, Johansen & Lee 2017, J. Am. Stat. Assoc. 112(520), sec. 2; Heng et al. 2020, Ann. Stat. 48(5)]
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from ....base.gaussian import Gaussian
from ....base.random import normals
from ....model.base import Prepared
from .potentials import Potentials, dot, moves


class ParticleHistory(NamedTuple):
    """All that the filter has seen; x and f are (state - origin) / scale."""

    origin: Float[Array, "time state"]
    scale: Float[Array, " state"]
    x: Float[Array, "time state particle"]
    f: Float[Array, "time state particle"]
    """Mean of the next state, as seen from the next origin."""
    log_w: Float[Array, "time particle"]
    """Log weights of p(x_k | y_{0:k}), up to a constant of each time."""
    ancestors: Int[Array, "time particle"]
    """Index at k - 1 of the parent of each particle at k."""
    active: Bool[Array, " time"]
    ess: Float[Array, " time"]
    """Effective sample size of the weights carried, before any resampling."""
    loglik: Float[Array, ""]
    """Log of the unbiased estimate of p(y)."""


def _cast(tree, dtype):
    return jax.tree.map(lambda a: a.astype(dtype) if eqx.is_inexact_array(a) else a, tree)


def _where(condition: Bool[Array, ""], change: Callable, value):
    """change(value) where the condition holds: under `vmap`, unlike `lax.cond`, only where an element needs it."""
    return jax.lax.while_loop(lambda c: c[0], lambda c: (jnp.zeros_like(c[0]), change(c[1])), (condition, value))[1]


def particle_filter(
    model, potentials: Potentials, seq: Prepared, *, num_particles: int, key: PRNGKeyArray, dtype=jnp.float32
) -> ParticleHistory:
    """Filter one sequence; resamples (systematically) where the effective sample size is below half.

    A particle that has run away, 1e15 standard deviations off or no number, has weight 0 and stands at the origin.
    Where none is left, all begin there anew, and the likelihood is 0.
    """
    key_offset, key_noise = jax.random.split(key)
    exact = model.log_q.dtype
    leave = seq.active
    arrive = jnp.concatenate([jnp.ones(1, bool), leave[:-1]])
    origin = potentials.origin.astype(dtype)
    scale = jnp.exp(0.5 * model.log_q)
    mean, cov = model.start
    start = Gaussian((mean - origin[0].astype(exact)) / scale, cov / (scale[:, None] * scale[None, :]))
    steps = _cast(moves(potentials, start), dtype)
    model, scale_, u, y = _cast((model, scale, seq.inputs, seq.y), dtype)
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
        time, offset, arrive, leave, origin, origin_next, u, y, observed, present, following = slices

        def resample(old):
            f, log_w, _ = old
            ancestors = systematic(log_w, offset, num_particles)
            return [row[ancestors] for row in f], flat, ancestors

        f, log_w, ancestors = _where(arrive & (ess < 0.5 * size), resample, (f, log_w, everyone))
        noise = normals(key_noise, time, states, num_particles, dtype)
        x = [jnp.where(arrive, a, b) for a, b in zip(present.move(f, noise), f, strict=True)]
        state = jnp.stack([origin[i] + scale_[i] * x[i] for i in range(states)])
        f = jax.vmap(model.transition, in_axes=(1, None), out_axes=1)(state, u)
        f = [jnp.where(leave, (f[i] - origin_next[i]) / scale_[i], x[i]) for i in range(states)]
        log_ahead = jnp.where(leave, following.log_ahead(f), 0.0)
        grown = log_w + log_g(state, u, y, observed) - present.log_psi(x) + log_ahead
        # Squared distance from the path [variances of the process noise] from which particles have run away
        alive = jnp.isfinite(grown) & (dot(f, f) < 1e30)
        any_alive = jnp.any(alive)
        grown = jnp.where(alive, grown, jnp.where(any_alive, -jnp.inf, flat))  # where all are dead, all begin anew
        x, f = ([jnp.where(alive, row, 0.0) for row in rows] for rows in (x, f))
        log_ahead = jnp.where(alive, log_ahead, 0.0)
        top = jnp.max(grown)
        w = jnp.exp(grown - top)
        mass = jnp.sum(w)
        total = top + jnp.log(mass)
        log_w = jnp.where(arrive, grown - total, log_w)
        ess = jnp.where(arrive, mass**2 / jnp.sum(w**2), ess)
        out = (jnp.stack(x), jnp.stack(f), log_w - log_ahead, ancestors, ess)
        return (f, log_w, ess), (*out, jnp.where(any_alive, jnp.where(arrive, total, 0.0), -jnp.inf).astype(exact))

    mean = [jnp.full(num_particles, m, dtype) for m in start.mean.astype(dtype)]
    log_ahead = jax.tree.map(lambda a: a[0], steps).log_ahead(mean)
    later = jax.tree.map(lambda a: jnp.concatenate([a[1:], a[-1:]]), (origin, steps))
    # Drawn time by time: the numbers of a time do not depend on how many follow.
    times = jnp.arange(y.shape[0], dtype=jnp.int32)
    offset = jax.random.uniform(key_offset, y.shape[:1], dtype)
    slices = times, offset, arrive, leave, origin, later[0], u, y, seq.observed, steps, later[1]
    _, (x, f, log_w, ancestors, ess, total) = jax.lax.scan(step, (mean, flat, size), slices)
    loglik = jnp.sum(total) + log_ahead[0].astype(exact)
    return ParticleHistory(origin.astype(exact), scale, x, f, log_w, ancestors, leave, ess, loglik)


def cumsum(x: Float[Array, "*batch n"], block: int = 32) -> Float[Array, "*batch n"]:
    """`jnp.cumsum` along the last axis as triangular matrix products, within blocks and over them: faster."""
    n = x.shape[-1]
    padded = jnp.pad(x, [(0, 0)] * (x.ndim - 1) + [(0, -n % block)])
    within = upto(padded.reshape(*x.shape[:-1], -1, block), 0)
    total = within + upto(within[..., -1], 1)[..., None]
    return total.reshape(padded.shape)[..., :n]


def upto(x: Float[Array, "*batch n"], k: int) -> Float[Array, "*batch n"]:
    """Sums of x over all places up to k before each."""
    square = jnp.ones((x.shape[-1], x.shape[-1]), x.dtype)
    return jnp.matmul(x, jnp.triu(square, k), precision=jax.lax.Precision.HIGHEST)


def systematic(log_w: Float[Array, " particle"], offset: Float[Array, ""], count: int) -> Int[Array, " {count}"]:
    """Sorted indices of `count` draws by one uniform `offset` [Kitagawa 1996]."""
    reach = cumsum(jnp.exp(log_w - jnp.max(log_w)))
    before = jnp.ceil(reach * (count / reach[-1]) - offset).astype(jnp.int32)  # draws among the particles up to here
    drops = jnp.zeros(count + 1, reach.dtype).at[jnp.clip(before, 0, count)].add(1, mode="promise_in_bounds")
    return jnp.minimum(cumsum(drops[:count]).astype(jnp.int32), reach.shape[0] - 1)
