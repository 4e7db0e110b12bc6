"""Draws of whole trajectories backward through the particles of a filter."""

import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from ....base.elementary import exp2
from ....base.random import uniforms
from .filter import ParticleHistory, systematic, upto


class Trajectories(NamedTuple):
    """Equal-weight draws of p(x_{0:T} | y)."""

    x: Float[Array, "time path state"]
    kick: Float[Array, "steps path state"]
    """Process noise x_{k+1} - f(x_k)."""


class ExactBackward(eqx.Module):
    """Draws the particle that a trajectory passes through at k, given where it is at k + 1: all particles are weighed
    for each path [Godsill, Doucet & West 2004, forward filtering, backward sampling].
    """

    block: int = eqx.field(static=True, default=32)
    """Particles per block of the two-level inverse distribution function."""

    def __call__(
        self, x_next: Float[Array, "state path"], f: Float[Array, "state particle"], log_w, uniform
    ) -> Int[Array, " path"]:
        """Indices with probability proportional to exp(log_w) N(x_next; f, I), by a uniform number for each path."""
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
            return None, (top, jnp.sum(exp2(level - top[None]), axis=0))

        _, (tops, sums) = jax.lax.scan(weigh, None, (jnp.swapaxes(f, 0, 1), level[:, :, None]))
        top = jnp.max(tops, axis=0)
        reach = upto((sums * exp2(tops - top[None])).T, 0).T
        target = uniform * reach[-1]
        outer = jnp.minimum(jnp.sum(reach <= target[None], axis=0), reach.shape[0] - 1)
        before = jnp.take_along_axis(jnp.pad(reach, ((1, 0), (0, 0))), outer[None], axis=0)[0]
        within = level[outer] - top[:, None]
        for i in range(f.shape[0]):
            within = within + f[i][outer] * x_next[i][:, None]
        within = upto(exp2(within), 0)
        remainder = jnp.minimum(target - before, within[:, -1] * (1 - jnp.finfo(target.dtype).eps))
        inner = jnp.sum(within <= remainder[:, None], axis=1)
        return (outer * self.block + inner).astype(jnp.int32)


def ffbs(history: ParticleHistory, backward: ExactBackward, *, num_paths: int, key: PRNGKeyArray) -> Trajectories:
    """Draw trajectories backward through the particles of a filter."""
    key_last, key_steps = jax.random.split(key)
    dtype, exact = history.x.dtype, history.origin.dtype
    last = systematic(history.log_w[-1], jax.random.uniform(key_last, (), dtype), num_paths)

    def step(carry, slices):
        index, x_next = carry
        time, active, x, f, log_w = slices
        chosen = backward(x_next, f, log_w, uniforms(key_steps, time, 1, num_paths, dtype)[0])
        index = jnp.where(active, chosen, index)  # nothing is resampled on arrival in the padding
        state = x[:, index]
        return (index, state), (state, x_next - f[:, index])

    h = history
    times = jnp.arange(h.x.shape[0] - 1, dtype=jnp.int32)
    end = h.x[-1][:, last]
    before = jax.tree.map(lambda a: a[:-1], (h.active, h.x, h.f, h.log_w))
    _, (x, kick) = jax.lax.scan(step, (last, end), (times, *before), reverse=True)
    x = jnp.swapaxes(jnp.concatenate([x, end[None]]), 1, 2).astype(exact)
    kick = jnp.swapaxes(kick, 1, 2).astype(exact)
    return Trajectories(h.origin[:, None] + h.scale[None, None] * x, h.scale[None, None] * kick)
