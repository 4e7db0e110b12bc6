"""Quick refits of a fitted model with something added, from its smoothed path on.

Each pass linearises the model about the path, smooths, and takes one M-step.  Only the linearisation is another program
for another structure, so that a new effect costs seconds.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ...base.gaussian import Gaussian
from ...base.journal import step
from ...base.parallel import each
from ...estimate.em.mstep import Core, ScoringMStep, between
from ...estimate.em.quadratic import locals_along
from ...estimate.smoother.kalman import CUBATURE, kalman_filter, linear_posterior, rts
from ...estimate.smoother.posterior import Posterior
from ...logs.dataset import Dataset
from ...model.state_space import StateSpaceModel

NOISE_HELD_PASSES = 3
"""Passes with the noise as it is."""


def _smoothed(common, one) -> tuple[Posterior, Float[Array, "time node obs"], Gaussian]:
    """Smoothed about the linearisation, the readings at its nodes, and a path that stays where nothing is known."""
    (log_q, log_r, start), ((affine, reading, seq), path) = common, one
    filtered = kalman_filter(log_q, log_r, start, affine, reading, seq)
    posterior = linear_posterior(filtered, rts(filtered))
    nodes = jnp.concatenate([posterior.prev, posterior.next[-1:]])
    read = jnp.einsum("tos,tns->tno", reading.rows, nodes) + reading.offset[:, None]
    known = jnp.isfinite(posterior.loglik) & jnp.all(jnp.isfinite(posterior.state.mean))
    return posterior, read, jax.tree.map(lambda new, old: jnp.where(known, new, old), posterior.state, path)


@step(lambda model, _, path, *__, **___: (model, path))
def refit(
    model: StateSpaceModel,
    m_step: ScoringMStep,
    path: Gaussian,
    data: Dataset,
    used: Bool[np.ndarray, " seq"],
    *,
    passes: int = 8,
) -> tuple[StateSpaceModel, Gaussian]:
    """`model` and its path after `passes` passes from `path`, fitted to the sequences `used`. Passes have the rule of
    short horizons, its noise ratios held at those of `model`. The process and reading noise stay as they are in the
    first passes, while the path finds its place: they would fit the way there, and their estimates decay slowly.
    """
    brief = eqx.tree_at(lambda r: r.log_q_prior, m_step.while_growing(), model.log_q, is_leaf=lambda leaf: leaf is None)
    still = eqx.tree_at(lambda r: r.max_log_step, brief, jnp.zeros_like(brief.max_log_step))
    core = m_step.core(model)

    def program(rule: ScoringMStep, core: Core, path: Gaussian):
        linear = locals_along(rule.whole(model, core), rule.prior, path, data, CUBATURE)
        common = core.log_q, core.log_r, core.start
        posterior, read, steady = each(_smoothed, common, (linear.filtered_from, path))
        following, _, _ = rule.advance(core, linear, posterior, read, used)
        return following, steady, posterior.loglik

    best, stride, base, goal = None, 1.0, core, core
    for count in range(passes):
        rule = brief if count >= NOISE_HELD_PASSES else still
        proposal, smoothed, loglik = program(rule, core, path)
        total = float(np.sum(np.nan_to_num(np.asarray(loglik), nan=-1e6)[used]))
        if best is None or total >= best[0] - 0.5:
            if best is None or total > best[0]:
                best = total, core, smoothed
            goal, base, stride = proposal, core, min(1.0, 2 * stride)
            path = smoothed
        else:
            stride, path = stride / 3, best[2]
        core = between(base, goal, stride)
    assert best is not None
    _, core, path = best
    return m_step.whole(model, core), path
