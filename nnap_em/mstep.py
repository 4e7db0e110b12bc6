"""M-step of the hybrid model: EM's gradient, scaled by the information that the data really hold.

The smoother gives the score by Fisher's identity, the expectation of the complete-data score.  EM would divide
it by the complete-data information and crawl where the missing part dominates; here it is divided by the observed
information of the model linearised about the smoothed path, the sum of J'J of whitened innovations
[Louis 1982, J. R. Stat. Soc. B 44(2); Lange 1995, J. R. Stat. Soc. B 57(2)].

The friction network is tabulated at velocity nodes: torques at the nodes and the uncertain physical parameters form the
vector phi in which the likelihood is quadratic; the network is then fitted to that quadratic form by
Levenberg-Marquardt.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .data import Dataset, fill_missing
from .friction import FrictionNetwork
from .gaussian import Gaussian
from .kalman import Affine, kalman_filter
from .smoother import Posterior, active_steps


class ParameterPrior(eqx.Module):
    """Physical parameters to be estimated, with the owner's belief."""

    names: tuple[str, ...] = eqx.field(static=True)
    mean: Float[Array, " param"]
    std: Float[Array, " param"]

    def read(self, system) -> Float[Array, " param"]:
        return jnp.stack([getattr(system, n) for n in self.names]) if self.names else self.mean

    def write(self, model, values: Float[Array, " param"]):
        if not self.names:
            return model
        return eqx.tree_at(lambda m: [getattr(m.system, n) for n in self.names], model, list(values))


class Quadratic(NamedTuple):
    """Log-likelihood about the present parameters: score and information of phi = (node torques, parameters)."""

    score: Float[Array, "*seq phi"]
    information: Float[Array, "*seq phi phi"]
    noise_score: Float[Array, "*seq noise"]
    """With respect to (log_q, log_r)."""
    noise_information: Float[Array, "*seq noise noise"]


def hats(nodes: Float[Array, " count"], v: Float[Array, ""]) -> Float[Array, " count"]:
    """Piecewise-linear weights of v among the nodes, constant beyond the ends."""
    v = jnp.clip(v, nodes[0], nodes[-1])
    left = (v - nodes[:-1]) / (nodes[1:] - nodes[:-1])
    rise = jnp.concatenate([jnp.ones(1, v.dtype), jnp.clip(left, 0.0, 1.0)])
    fall = jnp.concatenate([jnp.clip(left, 0.0, 1.0), jnp.zeros(1, v.dtype)])
    return rise - fall


def expand(model, prior: ParameterPrior, nodes: Float[Array, "dof count"], posterior: Posterior, seq: Dataset) -> Quadratic:
    """The log-likelihood of one sequence to second order."""
    y, observed = fill_missing(seq.y)
    observed = observed & seq.valid[:, None]
    active = active_steps(seq.valid)
    dof, count = nodes.shape
    path = posterior.state.mean
    value = prior.read(model.system)
    q, r = jnp.exp(model.log_q), jnp.exp(model.log_r)

    def tangents(x, u):
        zero = jnp.zeros(dof, x.dtype)
        fx, ff, fp = jax.jacfwd(
            lambda x, force, p: prior.write(model, p).transition(x, u, force), argnums=(0, 1, 2)
        )(x, zero, value)
        f = model.transition(x, u)
        return Affine(fx, f - fx @ x), ff, fp

    affine, by_force, by_parameter = jax.vmap(tangents)(path, seq.u)

    def columns(prev, following, kick, by_force, by_parameter):
        """Mean sensitivity of x_{k+1} to phi, and expected score, over the nodes of one step."""
        speed = 0.5 * (prev + following)[:, dof:]
        weights = jax.vmap(jax.vmap(hats), in_axes=(None, 0))(nodes, speed)  # node dof count
        pull = (kick / q[None]) @ by_force  # node dof
        score = jnp.mean(pull[:, :, None] * weights, axis=0).ravel()
        score = jnp.concatenate([score, jnp.mean(kick / q[None], axis=0) @ by_parameter])
        sensitivity = (by_force[:, :, None] * jnp.mean(weights, axis=0)[None]).reshape(kick.shape[1], -1)
        return jnp.concatenate([sensitivity, by_parameter], axis=1), score, jnp.mean(kick**2, axis=0)

    sensitivity, score, square = jax.vmap(columns)(
        posterior.prev, posterior.next, posterior.kick, by_force[:-1], by_parameter[:-1]
    )
    inside = active[:-1]
    score = jnp.sum(jnp.where(inside[:, None], score, 0.0), axis=0)
    score_q = 0.5 * jnp.sum(jnp.where(inside[:, None], square / q[None] - 1.0, 0.0), axis=0)
    read = jax.vmap(model.emission)
    nodes_now = jnp.concatenate([posterior.prev, posterior.next[-1:]])
    misfit = jnp.mean((y[:, None] - jax.vmap(read)(nodes_now)) ** 2, axis=1)
    score_r = 0.5 * jnp.sum(jnp.where(observed, misfit / r[None] - 1.0, 0.0), axis=0)

    def noise_filter(log_q, log_r):
        noisy = eqx.tree_at(lambda m: (m.log_q, m.log_r), model, (log_q, log_r))
        filtered = kalman_filter(noisy, model.start, affine, y, observed, active)
        return (filtered.innovation, filtered.log_variance), filtered

    (jac_e, jac_s), filtered = jax.jacfwd(noise_filter, argnums=(0, 1), has_aux=True)(model.log_q, model.log_r)
    jac_e, jac_s = (jnp.concatenate(j, axis=-1).reshape(-1, q.shape[0] + r.shape[0]) for j in (jac_e, jac_s))
    jac_e = jac_e + 0.5 * filtered.innovation.reshape(-1, 1) * jac_s
    noise_information = jac_e.T @ jac_e + 0.5 * jac_s.T @ jac_s

    rows = jax.jacfwd(model.emission)(path[0])

    def step(s, slices):
        matrix, columns, gain, log_variance, observed = slices
        out = []
        for i in range(rows.shape[0]):
            j = rows[i] @ s
            out.append(jnp.where(observed[i], j * jnp.exp(-0.5 * log_variance[i]), 0.0))
            s = s - gain[i][:, None] * j[None, :]
        return matrix @ s + columns, jnp.stack(out)

    padded = jnp.concatenate([jnp.where(inside[:, None, None], sensitivity, 0.0), jnp.zeros_like(sensitivity[:1])])
    _, jac = jax.lax.scan(
        step,
        jnp.zeros_like(sensitivity[0]),
        (filtered.affine.matrix, padded, filtered.gain, filtered.log_variance, observed),
    )
    jac = jac.reshape(-1, jac.shape[-1])
    return Quadratic(score, jac.T @ jac, jnp.concatenate([score_q, score_r]), noise_information)


def fit_quadratic(
    model, prior: ParameterPrior, nodes: Float[Array, "dof count"], total: Quadratic, ridge: float, iterations: int = 40
):
    """Network weights and parameters that maximise the quadratic log-likelihood with their priors."""
    arrays, static = eqx.partition(model.unknown.mlp, eqx.is_inexact_array)
    flat, unravel = jax.flatten_util.ravel_pytree(arrays)
    w0 = jnp.concatenate([flat, prior.read(model.system)])
    n = flat.shape[0]
    centre = jnp.concatenate([jnp.zeros_like(flat), prior.mean])
    precision = jnp.concatenate([jnp.full_like(flat, ridge), prior.std**-2])

    def phi(w):
        unknown = eqx.tree_at(lambda f: f.mlp, model.unknown, eqx.combine(unravel(w[:n]), static))
        return jnp.concatenate([jax.vmap(unknown)(nodes.T).T.ravel(), w[n:]])

    phi0 = phi(w0)

    def loss(w):
        d = phi(w) - phi0
        return -total.score @ d + 0.5 * d @ total.information @ d + 0.5 * jnp.sum(precision * (w - centre) ** 2)

    def body(_, carry):
        w, value, damping = carry
        jac = jax.jacfwd(phi)(w)
        gradient = jac.T @ (total.information @ (phi(w) - phi0) - total.score) + precision * (w - centre)
        hessian = jac.T @ total.information @ jac + jnp.diag(precision)
        hessian = hessian + damping * jnp.diag(jnp.diag(hessian))
        trial = w - jnp.linalg.solve(hessian, gradient)
        new = loss(trial)
        better = new < value
        return (
            jnp.where(better, trial, w),
            jnp.where(better, new, value),
            jnp.where(better, damping * 0.2, damping * 4.0),
        )

    w, _, _ = jax.lax.fori_loop(0, iterations, body, (w0, loss(w0), jnp.asarray(1e-3, w0.dtype)))
    fitted = eqx.tree_at(lambda m: m.unknown.mlp, model, eqx.combine(unravel(w[:n]), static))
    return prior.write(fitted, w[n:])
