"""Quick refits of a fitted model with something added, from its smoothed path on.

Each pass linearises the model about the path, smooths, and takes one M-step.  Only the linearisation knows the
structure of the model; the rest is one compiled program for all of them, so that a new effect costs seconds.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .data import Dataset, fill_missing
from .gaussian import Gaussian
from .kalman import CUBATURE, kalman_filter, rts
from .model import StateSpaceModel
from .mstep import Core, Local, ParameterPrior, ScoringMStep, local, quadratic
from .smoother import Posterior, active_steps, pair_nodes

BLOCK = 4
"""The number of parameters is padded to a multiple of this, for fewer programs."""


class Trial(NamedTuple):
    """A model after some passes."""

    model: StateSpaceModel
    m_step: ScoringMStep
    path: Gaussian
    loglik: Float[np.ndarray, " seq"]
    hessian: Float[Array, "weight weight"]
    """Posterior precision of network weights and parameters."""


@eqx.filter_jit
def _locals(model: StateSpaceModel, prior: ParameterPrior, path: Gaussian, data: Dataset) -> Local:
    return jax.vmap(lambda path, seq: local(model, prior, path, seq, CUBATURE))(path, data)


@eqx.filter_jit
def _pass(rule: ScoringMStep, core: Core, here: Local, path: Gaussian, data: Dataset, used: Bool[Array, " seq"]):
    weights = rule.weights(core)

    def one(here: Local, seq: Dataset):
        y, observed = fill_missing(seq.y)
        observed = observed & seq.valid[:, None]
        active = active_steps(jnp.asarray(seq.valid))
        filtered = kalman_filter(core.log_q, core.log_r, core.start, here.affine, here.reading, y, observed, active)
        smoothed = rts(filtered)
        prev, following = pair_nodes(smoothed)
        affine = jax.tree.map(lambda a: a[:-1, None], here.affine)
        kick = following - (jnp.squeeze(affine.matrix @ prev[..., None], -1) + affine.offset)
        endless = jnp.full_like(filtered.loglik, jnp.inf)
        posterior = Posterior(smoothed.state, prev, following, kick, here.affine.noise[:-1], filtered.loglik, endless)
        nodes = jnp.concatenate([prev, following[-1:]])
        read = jnp.einsum("tos,tns->tno", here.reading.rows, nodes) + here.reading.offset[:, None]
        about = quadratic(core.log_q, core.log_r, core.start, here, weights.nodes, posterior, read, seq)
        return about, smoothed.state, filtered.loglik

    each, state, loglik = jax.vmap(one)(here, data)
    fine = used & jnp.isfinite(loglik) & jnp.all(jnp.isfinite(each.information), axis=(1, 2))
    fine = fine & jnp.all(jnp.isfinite(each.score), axis=1) & jnp.all(jnp.isfinite(each.noise_score), axis=1)
    pick = lambda a: jnp.where(fine.reshape(-1, *[1] * (a.ndim - 1)), a, 0.0)  # noqa: E731
    total = jax.tree.map(lambda a: jnp.sum(pick(a), axis=0), each)
    first = jax.tree.map(lambda a: pick(a[:, 0]), state)
    following, hessian = rule.advance(core, weights, total, first, fine)
    known = jnp.isfinite(loglik) & jnp.all(jnp.isfinite(state.mean), axis=(1, 2))  # those left out of the fit too
    steady = jax.tree.map(lambda new, old: jnp.where(known.reshape(-1, *[1] * (new.ndim - 1)), new, old), state, path)
    return following, steady, loglik, hessian


def _anonymous(rule: ScoringMStep) -> tuple[ScoringMStep, int]:
    """`rule` without the names of its parameters, and how many it was padded with."""
    count = rule.prior.size
    pad = -count % BLOCK
    mean, std = jnp.pad(rule.prior.mean, (0, pad)), jnp.pad(rule.prior.std, (0, pad), constant_values=1.0)
    names = tuple(str(i) for i in range(count + pad))
    return eqx.tree_at(lambda r: r.prior, rule, ParameterPrior(names, mean, std)), pad


def refit(
    model: StateSpaceModel,
    m_step: ScoringMStep,
    path: Gaussian,
    data: Dataset,
    used: Bool[np.ndarray, " seq"],
    *,
    passes: int = 5,
    noise: bool = True,
) -> Trial:
    """`model` after `passes` passes from `path`, fitted to the sequences `used`; the likelihood is of all of them.

    Without `noise` the process and reading noise stay as they are.
    """
    rule, pad = _anonymous(m_step)
    rule = eqx.tree_at(lambda r: r.stride, rule, jnp.asarray(rule.stride if noise else 0.0))
    weights = m_step.weights(model)

    def program(core: Core, model, path):
        here = _locals(model, m_step.prior, path, data)
        widen = lambda a: jnp.pad(a, [(0, 0)] * (a.ndim - 1) + [(0, pad)])  # noqa: E731
        here = here._replace(
            by_parameter=widen(here.by_parameter), reading_by_parameter=widen(here.reading_by_parameter)
        )
        return _pass(rule, core, here, path, data, jnp.asarray(used))

    def whole(core: Core):
        w = core.w[: core.w.shape[0] - pad] if pad else core.w
        return eqx.tree_at(lambda m: (m.log_q, m.log_r, m.start), weights.write(model, w), core[2:])

    core = Core(model.unknown, jnp.pad(weights.read(model), (0, pad)), model.log_q, model.log_r, model.start)
    best, stride, here, goal = None, 1.0, core, core
    for _ in range(passes):
        proposal, smoothed, loglik, hessian = program(core, whole(core), path)
        total = float(np.sum(np.nan_to_num(np.asarray(loglik), nan=-1e6)[used]))
        if best is None or total >= best[0] - 0.5:
            if best is None or total > best[0]:
                best = (total, core, np.asarray(loglik), hessian, smoothed)
            goal, here, stride = proposal, core, min(1.0, 2 * stride)
            path = smoothed
        else:
            stride, path = stride / 3, best[4]
        way = lambda a, b, s=stride: a + s * (b - a) if eqx.is_inexact_array(a) else a  # noqa: E731
        core = jax.tree.map(way, here, goal)
    assert best is not None
    _, core, loglik, hessian, path = best
    kept = hessian.shape[0] - pad
    return Trial(whole(core), m_step, path, loglik, hessian[:kept, :kept])
