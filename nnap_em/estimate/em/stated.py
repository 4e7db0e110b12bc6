"""Reported covariance of a fit whose noise is not that of the model.

A likelihood is then overconfident: recordings disagree by more than it allows, and all of them share forces
that no part of the model describes, which stand in every recording alike and bend the estimates the same way.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from ...base.gaussian import Gaussian
from ...base.parallel import each
from ...logs.dataset import Dataset
from ...model.state_space import StateSpaceModel
from ..smoother.kalman import kalman_filter, rts
from .mstep import ScoringMStep
from .multistep import Columns, Linear, followed, linear, sensitivities
from .quadratic import locals_along
from .weights import Weights


def widened(
    model: StateSpaceModel,
    m_step: ScoringMStep,
    path: Gaussian,
    data: Dataset,
    used: Bool[np.ndarray, " seq"],
    hessian: Float[Array, "phi phi"],
    *,
    key: PRNGKeyArray,
) -> tuple[Float[Array, "phi phi"], float]:
    """Posterior precision reduced by the disagreement of recordings and by model discrepancy; the size of the latter,
    in the units of `discrepancy_columns`.

        H = P + (L^-1 + V)^-1,   V = A^-1 (n / (n - 1) sum_s g_s g_s' + tau^2 sum_k b_k b_k') A^-1

    with P the precision of the prior, P + L = `hessian`, g_s the multi-step score of recording s, or of blocks of a
    single one, A its information with that of the prior, b_k the score of the k-th of many smooth random forces, and
    tau their size. [Huber 1967, Proc. 5th Berkeley Symp. 1, 221; Liang & Zeger 1986, Biometrika 73, 13; Muller 2013,
    Econometrica 81, 1805; Kennedy & O'Hagan 2001, J. R. Stat. Soc. B 63, 425; Rahimi & Recht 2007, NIPS]
    """
    weights = m_step.weights(model)
    other = discrepancy_columns(model, weights, path, data, used, key=key)
    along = followed(model, m_step.prior, path, data)
    one = linear(along, weights, used, lambda indices: jax.tree.map(lambda a: a[indices], other))
    prior = np.asarray(weights.prior_precision(model.unknown))
    own, shared = np.split(one.information()[: len(prior)], [len(prior)], axis=1)
    information = prior + own
    scores = clustered(one.scores()[used, :, : len(prior)], one.overlap)
    scores = scores - scores.mean(axis=0)
    count = len(scores)
    force = size(one, information)
    sources = np.concatenate([math.sqrt(count / max(count - 1, 1)) * scores.T, force * shared], axis=1)
    strength, turn = np.linalg.eigh(np.asarray(hessian) - prior)
    half = turn * np.sqrt(np.maximum(strength, 0.0))  # L = half half'
    across = half.T @ np.linalg.solve(information, sources)
    return jnp.asarray(prior + half @ np.linalg.solve(np.eye(len(half)) + across @ across.T, half.T)), force


def of_states(
    model: StateSpaceModel, m_step: ScoringMStep, path: Gaussian, data: Dataset, phi, force: float, *, key: PRNGKeyArray
) -> Float[Array, "seq time state state"]:
    """Covariance that smoothed states have beyond the smoother's own: by friction and parameters, of which `phi` (draw,
    phi) are deviations drawn from the posterior, and by unmodelled forces of size `force`, linear about its path.
    """
    key_columns, key_kicks = jax.random.split(key)
    weights = m_step.weights(model)
    other = discrepancy_columns(model, weights, path, data, np.ones(len(data.t), bool), key=key_columns)
    kicks = force * jax.random.normal(key_kicks, (phi.shape[0], other.force.shape[1]), phi.dtype)
    linear = locals_along(model, m_step.prior, path, data, m_step.linearise)
    common = model.log_q, model.log_r, model.start, weights.nodes, jnp.concatenate([phi, kicks], axis=1)
    return each(_moved, common, (linear, path.mean, other))


def _moved(common, one) -> Float[Array, "time state state"]:
    """Change of one sequence."""
    (log_q, log_r, start, nodes, draws), (linear, mean, columns) = common, one
    pushed, read = sensitivities(nodes, linear, mean, columns)
    still = start._replace(mean=jnp.zeros_like(start.mean))
    seq = linear.seq._replace(y=jnp.zeros_like(linear.seq.y))

    def response(draw):
        affine, reading = (a._replace(offset=b @ draw) for a, b in ((linear.affine, pushed), (linear.reading, read)))
        return rts(kalman_filter(log_q, log_r, still, affine, reading, seq)).state.mean

    moved = jax.lax.map(response, draws)
    return jnp.einsum("kti,ktj->tij", moved, moved) / draws.shape[0]


def discrepancy_columns(
    model: StateSpaceModel, weights: Weights, path: Gaussian, data: Dataset, used: np.ndarray, *, key: PRNGKeyArray
) -> Columns:
    """Random smooth forces of state and input at every joint, as large as friction that is not the same both ways, by
    the sequences `used`: draws of a Gaussian process whose length is a standard deviation of each signal.
    """
    dof, states = len(model.system.ports), len(model.system.states)
    known = np.asarray(data.valid) & used[:, None]
    u = np.nan_to_num(np.asarray(data.u)[..., : len(model.system.drives)])
    signals = np.concatenate([np.asarray(path.mean)[..., :states], u], axis=-1)
    spread = np.nanstd(signals[known], axis=0)
    unit = (signals - np.nanmean(signals[known], axis=0)) / np.where(spread > 0, spread, 1.0)
    turned, shifted = jax.random.split(key)
    features = 48  # random functions of the state at every joint; twice as many gave the same within a tenth
    slope = jax.random.normal(turned, (unit.shape[-1], dof * features), unit.dtype)
    phase = jax.random.uniform(shifted, (1, 1, dof * features), unit.dtype, maxval=2 * math.pi)
    value = math.sqrt(2 / features) * np.cos(unit @ np.asarray(slope) + np.asarray(phase))
    acts = np.repeat(np.diag(weights.asymmetry), features, axis=0)
    force = np.moveaxis(value, -1, 1)[..., None] * acts[None, :, None]
    return Columns(force, np.zeros((*force.shape[:3], data.y.shape[-1]), force.dtype))


def size(one: Linear, information: Float[np.ndarray, "phi phi"]) -> float:
    """Standard deviation tau of the strengths of the columns behind those of phi, at its largest likelihood.

    error = estimated x + tau other z + noise, with z standard normal, the size of the noise free, x projected out as
    far as the prior lets it; zero where no such force explains errors.
    """
    root = np.sqrt(one.weight)
    columns, error = (root[..., None] * one.columns).reshape(root.size, -1), (root * one.error).ravel()
    estimated, other = np.split(columns, [len(information)], axis=1)
    other, error = (a - estimated @ np.linalg.solve(information, estimated.T @ a) for a in (other, error))
    strength, turn = np.linalg.eigh(other.T @ other)
    strength, along, whole = np.maximum(strength, 0.0), (turn.T @ (other.T @ error)) ** 2, float(error @ error)
    if whole == 0.0 or not strength.any():
        return 0.0
    rows = float(np.sum((root > 0) / one.overlap[:, None]))  # did they not overlap
    # variance of what such forces add over that of the rest, where it is known best
    ratios = np.concatenate([[0.0], np.geomspace(1e-3, 1e5, 49)])[:, None] / strength[-1]
    noise = np.maximum(whole - np.sum(along * ratios / (1 + ratios * strength), axis=1), 1e-12 * whole) / rows
    best = np.argmin(0.5 * rows * np.log(noise) + 0.5 * np.sum(np.log1p(ratios * strength), axis=1))
    return math.sqrt(float(ratios[best, 0] * noise[best]))


def clustered(
    scores: Float[np.ndarray, "seq start phi"], overlap: Float[np.ndarray, " horizon"]
) -> Float[np.ndarray, "cluster phi"]:
    """Scores of every recording, or of the blocks of a single one, each of four horizons: errors correlate over one."""
    if len(scores) > 1:
        return scores.sum(axis=1)
    return np.add.reduceat(scores[0], np.arange(0, scores.shape[1], max(1, round(4 * float(overlap[-1])))))
