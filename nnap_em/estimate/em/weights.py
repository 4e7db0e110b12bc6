"""Network weights and parameters as one vector, fitted to a log-likelihood that is quadratic in torques at nodes."""

import dataclasses
import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .prior import ParameterPrior


class Known(NamedTuple):
    """Posterior of an earlier fit, as the prior of torques at the nodes and of its parameters."""

    mean: Float[Array, " known"]
    precision: Float[Array, "known known"]
    """Precision beside that of `ParameterPrior`."""

    def terms(self, size: int) -> tuple[Float[Array, "phi phi"], Float[Array, " phi"]]:
        """Precision, and its product with the mean, of `size` numbers, the last of which the fit did not have."""
        free = size - self.mean.shape[0]
        return jnp.pad(self.precision, (0, free)), jnp.pad(self.precision @ self.mean, (0, free))


class Weights(eqx.Module):
    """All that the M-step fits as one vector: network weights, then parameters in units of their prior."""

    prior: ParameterPrior
    nodes: Float[Array, "dof count"]
    ridge: float
    """Precision of the weights' prior; the network's output is scaled so that 1 is natural."""
    centre: Float[Array, " weight"]
    """Mean of the weights' prior: the first random features with hardly any output, so that no unit can die."""
    asymmetry: Float[Array, " port"]
    """Prior standard deviation [N m] of an offset, the even part of a friction map that all nodes share."""
    symmetry_std: Float[Array, ""] = eqx.field(default=1.0, converter=jnp.asarray)
    """Standard deviation of the even part at every node alone, in those of the offset."""
    departure: Float[Array, ""] = eqx.field(default=math.inf, converter=jnp.asarray)
    """Standard deviation at every node of the friction beside viscous, Coulomb and constant, in those of the offset."""
    least: Float[Array, " bounded"] = eqx.field(default_factory=lambda: jnp.zeros(0))
    """Smallest possible values of the first parameters, in units of their prior."""
    known: Known | None = None
    """Prior of phi from an earlier fit, in the place of those of friction maps."""

    def read(self, model) -> Float[Array, " weight"]:
        """Those of a model, as one vector."""
        return jnp.concatenate([model.unknown.weights(), self.prior.read(model)])

    def write(self, model, w: Float[Array, " weight"]):
        """A model after a step to other weights, its machine among those that can be."""
        cut = w.shape[0] - self.prior.size
        unknown = model.unknown.with_weights(w[:cut])
        written = self.prior.write(eqx.tree_at(lambda m: m.unknown, model, unknown), w[cut:])
        return eqx.tree_at(lambda m: m.system, written, written.system.reached_from(model.system))

    @eqx.filter_jit
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

    @eqx.filter_jit
    def symmetry(self, unknown, w: Float[Array, " weight"]) -> Float[Array, "phi phi"]:
        """Prior precision of phi: friction opposes motion alike in both directions, unless the data contradict.

        The even part is an offset and a part of every node, which vanishes with the odd part of the map at `w`. Where
        the prior is coarse, what departs from viscous, Coulomb and constant friction is small.
        """
        if self.known is not None:
            return self.known.terms(self.nodes.size + self.prior.size)[0]
        dof, count = self.nodes.shape
        even = 0.5 * (jnp.eye(count) + jnp.eye(count)[::-1])
        torque = self.phi(unknown, w)[: self.nodes.size].reshape(dof, count)
        odd = jnp.abs(torque - torque[:, ::-1])
        share = jnp.minimum(1.0, odd / (jnp.median(odd, axis=1, keepdims=True) + 1e-12))
        blocks = []
        for j, nodes in enumerate(self.nodes):
            inverse = jnp.linalg.inv(1.0 + self.symmetry_std**2 * jnp.diag(share[j] ** 2 + AT_REST**2))
            precision = even.T @ inverse @ even + _beside(nodes) / self.departure**2
            blocks.append(precision / self.asymmetry[j] ** 2)
        return jax.scipy.linalg.block_diag(*blocks, jnp.zeros((self.prior.size,) * 2))

    def prior_precision(self, unknown) -> Float[Array, "phi phi"]:
        """Prior precision of phi: of smooth maps as large as the one of `unknown`, with symmetry; 1 of parameters."""
        size, more = self.nodes.size, self.prior.size
        if self.known is not None:
            maps = self.known.terms(size + more)[0]
        else:  # one program for any parameters
            none = ParameterPrior((), self.prior.mean[:0], self.prior.std[:0])
            maps = jnp.pad(dataclasses.replace(self, prior=none, least=self.least[:0])._of_maps(unknown), (0, more))
        return maps + jnp.diag(jnp.concatenate([jnp.zeros(size, maps.dtype), jnp.ones(more, maps.dtype)]))

    @eqx.filter_jit
    def _of_maps(self, unknown) -> Float[Array, "phi phi"]:
        """Prior precision of the torques at the nodes, wider than the network's own prior, in which friction that rises
        steeply near rest is ten standard deviations away: Matern's covariance of order 5/2 over the nodes.
        [Rasmussen & Williams 2006, eq. 4.17; Khan, Immer, Abedi & Korzepa 2019, NeurIPS, for function space]
        """
        count, dtype = self.nodes.shape[1], self.centre.dtype
        w = unknown.weights()
        torque = self.phi(unknown, w).reshape(self.nodes.shape)
        variance = jnp.mean(torque**2, axis=1) + self.asymmetry[: len(self.nodes)] ** 2
        # Nodes over which the maps bend: 97 to 100 % of Stribeck friction near rest is then within two standard
        # deviations; with 9, of a slide 88 %
        place = jnp.arange(count, dtype=dtype) / 6.0
        apart = math.sqrt(5.0) * jnp.abs(place[:, None] - place[None])
        grain = 1e-3  # standard deviation of a torque beside that, as a share of its own: what the curve itself may err
        smooth = (1 + apart + apart**2 / 3) * jnp.exp(-apart) + grain**2 * jnp.eye(count, dtype=dtype)
        own = jnp.linalg.inv(smooth)[None] / variance[:, None, None]
        return self.symmetry(unknown, w) + jax.scipy.linalg.block_diag(*own)

    def slopes(self, unknown, w: Float[Array, " weight"]) -> Float[Array, "dof count own"]:
        """Sensitivity of the torque of every node to the weights of its joint, which no other joint has."""
        at = lambda v: jax.grad(lambda w: jnp.sum(unknown.with_weights(w)(v)))(w)  # noqa: E731
        return jnp.moveaxis(jax.vmap(at)(self.nodes.T)[:, unknown.of_joint()], 0, 1)

    def fit(
        self, unknown, w0: Float[Array, " weight"], score: Float[Array, " phi"], information, iterations: int
    ) -> Float[Array, " weight"]:
        """Levenberg-Marquardt on the quadratic log-likelihood with the priors [Nocedal & Wright 2006, sec. 10.3].

        A parameter at its smallest value stays there while the likelihood falls inwards [Bertsekas 1982, SIAM J.
        Control Optim. 20(2)]. A step solves (J'IJ + D) step = gradient, I = root' root, by the Woodbury identity: there
        are fewer nodes than weights, and J has a block for every joint.
        """
        shape, size, cut = self.nodes.shape, self.nodes.size, w0.shape[0] - self.prior.size
        phi0 = self.phi(unknown, w0)
        precision = self.precision(w0)
        middle = self.middle()
        symmetry = self.symmetry(unknown, w0)
        score = score - symmetry @ phi0
        if self.known is not None:
            score = score + self.known.terms(score.shape[0])[1]
        information = information + symmetry
        values, vectors = jnp.linalg.eigh(information)
        root = jnp.sqrt(jnp.maximum(values, 0.0))[:, None] * vectors.T
        of_torque = root[:, :size].reshape(len(root), *shape)
        blocks = jnp.einsum("fjc,fjd->jcd", of_torque, of_torque)
        least = jnp.full_like(w0, -jnp.inf)
        least = least.at[cut:].set(bounds(self.least, self.prior.size))
        own = unknown.of_joint()

        def joined(of_weights, of_parameters):
            return jnp.concatenate([jnp.zeros(cut, w0.dtype).at[own].set(of_weights), of_parameters])

        def loss(w):
            d = self.phi(unknown, w) - phi0
            return -score @ d + 0.5 * d @ information @ d + 0.5 * jnp.sum(precision * (w - middle) ** 2)

        def going(carry):
            _, _, damping, count, gain = carry
            return (count < iterations) & (damping < 1e6) & (gain > 1e-3)

        def body(carry):
            w, value, damping, count, gain = carry
            jac = self.slopes(unknown, w[:cut])

            def pulled(phi):
                """J' phi."""
                return joined(jnp.einsum("jco,jc->jo", jac, phi[:size].reshape(shape)), phi[size:])

            gradient = pulled(information @ (self.phi(unknown, w) - phi0) - score) + precision * (w - middle)
            square = joined(jnp.einsum("jco,jcd,jdo->jo", jac, blocks, jac), jnp.sum(root[:, size:] ** 2, axis=0))
            d = precision + damping * (precision + square)
            d = jnp.where((w <= least) & (gradient > 0), jnp.inf, d)
            wide = jnp.einsum("jco,jo,jdo->jcd", jac, 1 / d[own], jac)  # of J D^-1 J'
            half = jnp.einsum("fjc,jcd->fjd", of_torque, wide).reshape(len(root), size)
            half = jnp.concatenate([half, root[:, size:] / d[None, cut:]], axis=1)
            inner = jax.scipy.linalg.cho_factor(jnp.eye(len(root), dtype=root.dtype) + half @ root.T)
            newton = gradient / d
            moved = jnp.concatenate([jnp.einsum("jco,jo->jc", jac, newton[own]).ravel(), newton[cut:]])
            step = (gradient - pulled(root.T @ jax.scipy.linalg.cho_solve(inner, root @ moved))) / d
            trial = jnp.maximum(w - step, least)
            new = loss(trial)
            better = new < value
            gain = jnp.where(better, 0.7 * gain + 0.3 * (value - new), gain)
            keep = lambda a, b: jnp.where(better, a, b)  # noqa: E731
            return keep(trial, w), keep(new, value), damping * keep(0.2, 4.0), count + 1, gain

        one = jnp.ones((), w0.dtype)
        w, *_ = jax.lax.while_loop(going, body, (w0, loss(w0), 1e-3 * one, jnp.zeros((), int), one))
        return w


def bounds(least: Float[Array, " bounded"], size: int) -> Float[Array, " param"]:
    """Smallest values of `size` parameters, of which the first have the bounds `least`."""
    return jnp.concatenate([least, jnp.full(size, -jnp.inf, least.dtype)])[:size]


AT_REST = 0.03
"""Even part at a node where the odd part is zero, in those of the other nodes: hardly any, without a singular prior."""
COULOMB = 0.01
"""Share of the largest velocity over which the Coulomb friction of a coarse map changes its sign."""
VISCOUS = 0.1
"""Precision of viscous friction in that of what is none of the three: slow rows determine none, and a slope read from
them would make fast sequences diverge (0.02 to 0.2 keep them, 0 loses one of six)."""


def _beside(nodes: Float[Array, " count"]) -> Float[Array, "count count"]:
    """Projection off constant and Coulomb friction, and nearly off viscous."""
    top = jnp.max(jnp.abs(nodes))
    kinds = jnp.stack([jnp.ones_like(nodes), jnp.tanh(nodes / (COULOMB * top)), nodes / top], axis=1)
    base = jnp.linalg.qr(kinds)[0]
    free = jnp.asarray([1.0, 1.0, 1.0 - VISCOUS], nodes.dtype)[None, : base.shape[1]]
    return jnp.eye(nodes.shape[0], dtype=nodes.dtype) - (base * free) @ base.T


def friction_prior(model, weights: Weights) -> tuple[np.ndarray, np.ndarray]:
    """Precision and pull of phi: the map free in the span of known laws, the rest small, parameters as declared."""
    nodes, size = np.asarray(weights.nodes), weights.nodes.size + weights.prior.size
    value = np.asarray(weights.phi(model.unknown, weights.read(model)))
    if weights.known is not None:
        precision, goal = weights.prior_precision(model.unknown), weights.known.terms(size)[1]
        return np.asarray(precision), np.asarray(precision @ value - goal)
    precision, pull = np.zeros((size, size)), np.zeros(size)
    count = nodes.shape[1]
    rest = 0.1  # rms of a map beside the span of known laws, over that of the map; 0.03 to 0.3 gave the same answers
    knees = (0.003, 0.01, 0.03, 0.1, 0.3)  # of the Coulomb and Stribeck laws in that span, over the largest speed
    for j, v in enumerate(nodes):
        joint = slice(j * count, (j + 1) * count)
        top = np.abs(v).max()
        laws = np.stack([v / top, *(np.tanh(v / (r * top)) for r in knees)], axis=1)
        others = np.linalg.svd(laws)[0][:, laws.shape[1] :]  # what no sum of known laws can be
        beside = others @ others.T / (rest * np.sqrt(np.mean(value[joint] ** 2)) + 1e-12) ** 2
        precision[joint, joint] = beside + (1e-9 * np.trace(beside) / count + 1e-12) * np.eye(count)
        pull[joint] = beside @ value[joint]
    parameters = slice(nodes.size, size)
    precision[parameters, parameters] = np.eye(weights.prior.size)
    pull[parameters] = value[parameters]
    return precision, pull
