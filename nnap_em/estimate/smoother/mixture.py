"""Gaussian-sum filter and smoother: more than one place at a time for an angle that is not read.

A component that has become wide along such an angle is split in three; where there is no room for more, the two whose
merging changes the mixture least become one. A Rauch-Tung-Striebel pass follows every final component back to the
start; all steps are then relinearised about its path, and the likeliest path is the result.
[Alspach & Sorenson 1972, IEEE Trans. Autom. Control 17(4), for the filter; Runnalls 2007, IEEE Trans. Aerosp. Electron.
Syst. 43(3), for merging]
"""

import math
from collections.abc import Callable
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from ...base.gaussian import Gaussian, cholesky, lower
from ...model.base import AbstractModel, Prepared
from .kalman import Cubature, Filtered, Tangent, absorbed, linear_posterior, linear_reading, moved, relinearised, rts
from .posterior import AbstractSmoother, Posterior, likeliest

WIDE_STD = 0.2
"""Standard deviation of an unread angle beyond which one Gaussian does not describe it [rad].

On four real double pendulums it exceeds 0.4 rad in every recording in which the arm passed the upright position and
could be followed on two branches, and is below 0.13 rad in all others."""
NARROW = 2 / 3
"""Standard deviation of each part over that of the component that is split."""
DISTANCE = math.sqrt(3 * (1 - NARROW**2))
"""Distance of the outer parts, which weigh a sixth, in standard deviations: they have five moments of the whole."""


class Components(NamedTuple):
    """A Gaussian mixture, unnormalised."""

    state: Gaussian
    log_weight: Float[Array, " component"]
    """Log of the probability of all readings so far and this component; -inf for a place that is free."""
    source: Int[Array, " component"]
    """Place from which it came."""


class Tree(NamedTuple):
    """Mixture of every row, after splits and merges."""

    rows: Filtered
    """Each field with leading axes time and component; state and affine map after, the rest before the splits."""
    source: Int[Array, "time component"]
    """Place before the splits of a component after them."""
    log_weight: Float[Array, " component"]
    """Log weights of the last row."""


def alone(prior: Gaussian, places: int) -> tuple[Gaussian, Float[Array, " {places}"]]:
    """One component, and places that are free, with their log weights."""
    every = jax.tree.map(lambda a: jnp.broadcast_to(a, (places, *a.shape)), prior)
    return every, jnp.where(jnp.arange(places) == 0, jnp.zeros((), prior.mean.dtype), -jnp.inf)


def split(before: Components, angles: tuple[int, ...], wide: float) -> Components:
    """Two more places: the likeliest component that is wide along an angle becomes three, on its regression on that."""
    (mean, cov), log_weight, source = before
    variance = jnp.diagonal(cov, axis1=1, axis2=2)[:, jnp.asarray(angles)]
    able = (jnp.max(variance, axis=1) > wide**2) & jnp.isfinite(log_weight)
    which = jnp.argmax(jnp.where(able, log_weight, -jnp.inf))
    along = jnp.asarray(angles)[jnp.argmax(variance[which])]
    direction = cov[which, :, along] / jnp.sqrt(cov[which, along, along])
    narrow = cov[which] - (1 - NARROW**2) * direction[:, None] * direction[None, :]
    shift, side = DISTANCE * direction, 1 / 6
    centres = mean[which][None] + jnp.stack([0 * shift, -shift, shift])
    parts = Components(
        Gaussian(centres, jnp.broadcast_to(narrow, (3, *narrow.shape))),
        log_weight[which] + jnp.log(jnp.asarray([1 - 2 * side, side, side])),
        jnp.broadcast_to(source[which], 3),
    )
    whole = jax.tree.map(lambda a: a[which][None], before)
    none = jax.tree.map(lambda a: jnp.broadcast_to(a, (3, *a.shape[1:])), whole)
    none = none._replace(log_weight=jnp.concatenate([log_weight[which][None], jnp.full(2, -jnp.inf)]))
    parts = jax.tree.map(lambda a, b: jnp.where(able[which], a, b), parts, none)
    return jax.tree.map(lambda a, b: jnp.concatenate([a.at[which].set(b[0]), b[1:]]), before, parts)


def merged(before: Components) -> Components:
    """One place fewer: the pair with the least bound on the Kullback-Leibler divergence becomes one of its moments.

    B = ((w_i + w_j) log det P - w_i log det P_i - w_j log det P_j) / 2 [Runnalls 2007, eq. 16]; a free place is free.
    """
    (mean, cov), log_weight, source = before
    count = len(log_weight)
    weight = jnp.exp(log_weight - jnp.max(log_weight))
    here = weight > 0
    mean = jnp.where(here[:, None], mean, 0.0)
    cov = jnp.where(here[:, None, None], cov, jnp.eye(mean.shape[1], dtype=mean.dtype)[None])
    first, second = (jnp.asarray(a) for a in np.triu_indices(count, 1))

    def log_det(cov):
        return 2 * jnp.sum(jnp.log(jnp.diag(lower(cholesky(cov)))))

    def pair(i, j):
        total = weight[i] + weight[j]
        share = jnp.where(total > 0, weight[i] / jnp.where(total > 0, total, 1.0), 0.5)
        apart = mean[i] - mean[j]
        between = share * (1 - share) * apart[:, None] * apart[None, :]
        both = Gaussian(share * mean[i] + (1 - share) * mean[j], share * cov[i] + (1 - share) * cov[j] + between)
        return both, 0.5 * (total * log_det(both.cov) - weight[i] * volume[i] - weight[j] * volume[j])

    volume = jax.vmap(log_det)(cov)
    both, bound = jax.vmap(pair)(first, second)
    least = jnp.argmin(jnp.where(jnp.isfinite(bound), bound, jnp.inf))
    i, j = first[least], second[least]
    one = Components(
        jax.tree.map(lambda a: a[least], both),
        jnp.logaddexp(log_weight[i], log_weight[j]),
        jnp.where(log_weight[i] >= log_weight[j], source[i], source[j]),
    )
    whole = Components(Gaussian(mean, cov), log_weight, source)
    return jax.tree.map(lambda a, b: a.at[i].set(b).at[j].set(a[-1])[:-1], whole, one)


def mixture_filter(
    model, start: Gaussian, log_weight: Float[Array, " component"], seq: Prepared, linearise: Callable, angles
) -> Tree:
    """Gaussian-sum filter with as many places as `start` has components, of which one at most is split in a row."""
    q, r, places = jnp.diag(jnp.exp(model.log_q)), jnp.exp(model.log_r), jnp.arange(len(log_weight))

    def step(carry, slices):
        predicted, log_weight = carry
        y, observed, active, u = slices
        reading = jax.vmap(lambda mean: linear_reading(model, mean, u))(predicted.mean)
        state, whitened, log_variance, gain = jax.vmap(lambda x, c: absorbed(x, c, r, y, observed))(predicted, reading)
        log_weight = log_weight - 0.5 * jnp.sum(whitened**2 + log_variance, axis=1)
        log_weight = jnp.where(jnp.isfinite(log_weight), log_weight, -jnp.inf)
        here = merged(merged(split(Components(state, log_weight, places), angles, WIDE_STD)))
        affine = jax.vmap(lambda x: linearise(model, x, u))(here.state)
        affine, following = jax.vmap(lambda x, a: moved(x, a, q, active))(here.state, affine)
        row = Filtered(here.state, predicted, whitened, log_variance, gain, affine, reading, here.log_weight)
        return (following, here.log_weight), (row, here.source)

    slices = seq.y, seq.observed, seq.active, seq.inputs
    (_, log_weight), (rows, source) = jax.lax.scan(step, (start, log_weight), slices)
    return Tree(rows, source, log_weight)


def branch(tree: Tree, last: Int[Array, ""]) -> Filtered:
    """Filtered states along the ancestors of the component that is at place `last` in the end."""

    def back(place, slices):
        rows, source = slices
        before = source[place]
        after = jax.tree.map(lambda a: a[place], rows)
        row = jax.tree.map(lambda a: a[before], rows)
        return before, row._replace(state=after.state, affine=after.affine, loglik=after.loglik)

    _, rows = jax.lax.scan(back, last, (tree.rows, tree.source), reverse=True)
    return rows._replace(loglik=rows.loglik[-1])


class MixtureSmoother(AbstractSmoother):
    """Gaussian-sum filter, smoothed along the ancestors of every final component: the likeliest path."""

    wide: ClassVar[float] = WIDE_STD
    """Largest `Posterior.width` that is left to one Gaussian [rad]."""
    angles: tuple[int, ...] = eqx.field(static=True)
    """Places of the angles in which paths differ."""
    linearise: Tangent | Cubature
    iterations: int = eqx.field(static=True, default=4)
    """Relinearisations about a smoothed path; one more, about the last path, gives its likelihood. After the first,
    that of a diverged path of a double pendulum was 27 nats above that of the right one, after the second 60 below."""
    components: int = eqx.field(static=True, default=16)
    """Gaussians of a mixture at most: with 12, one of twenty starts with both angles unknown was not found."""

    @property
    def bytes_per_row(self) -> int:
        """Memory [B] that a row takes."""
        return 8192 * self.components

    def paths(
        self, model: AbstractModel, seq: Prepared, first: Gaussian | None = None, kept: Gaussian | None = None
    ) -> tuple[Posterior, Float[Array, " path"]]:
        """The posterior along the ancestors of every final component, or about `kept` alone, and about `first`, its
        likelihood -inf where there is none; with it the likelihoods about the paths that these began from.
        """
        if kept is None:
            tree = mixture_filter(model, *alone(model.start, self.components), seq, self.linearise, self.angles)
            ends = jnp.arange(self.components)
            paths = jax.vmap(lambda last: rts(branch(tree, last)).state)(ends)
            followed = jnp.isfinite(tree.log_weight)
        else:
            paths, followed = jax.tree.map(lambda a: a[None], kept), jnp.ones(1, bool)
        if first is not None:
            paths = jax.tree.map(lambda a, b: jnp.concatenate([a, b[None]]), paths, first)
            followed = jnp.append(followed, True)
        every, before = jax.vmap(lambda path: self._about(model, seq, path))(paths)
        return every._replace(loglik=jnp.where(followed, every.loglik, -jnp.inf)), before

    def _about(self, model: AbstractModel, seq: Prepared, path: Gaussian) -> tuple[Posterior, Float[Array, ""]]:
        """The posterior relinearised about a path, and the likelihood of the model linearised about that itself."""

        def once(path: Gaussian):
            filtered = relinearised(model, path, seq, self.linearise)
            return filtered, rts(filtered)

        def again(last, _):
            both = once(last[1].state)
            return both, both[0].loglik

        filtered, smoothed = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), jax.eval_shape(once, path))
        begin = filtered, smoothed._replace(state=path)
        last, loglik = jax.lax.scan(again, begin, None, length=self.iterations + 1)
        return linear_posterior(*last), loglik[0]

    def __call__(self, model: AbstractModel, seq: Prepared, *, key: PRNGKeyArray | None = None) -> Posterior:
        """Smooth one sequence; it draws nothing."""
        paths, _ = self.paths(model, seq)
        return jax.tree.map(lambda a: a[likeliest(paths.loglik)], paths)
