"""Readings that come in steps, before all else: they spoil the noise that the search leans on."""

import math
from typing import cast

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ..effects import Candidate
from ..effects.sensor import SensorQuantization, grid_step
from ..em.loop import EMState
from ..model.state_space import StateSpaceModel
from .context import SearchContext, extend
from .hypothesis import Evidence, Hypothesis
from .verdict import COARSE, FINEST


def quantised(context: SearchContext, hypothesis: Hypothesis) -> tuple[Hypothesis, EMState | None]:
    """Readings that come in steps larger than their noise: seen in the numbers themselves, modelled as noise.

    A fit that took the steps for motion has lost its way: it begins again where it was short.
    """
    rig, state, first = context.before.rig, None, min(context.stages)
    certain = 12.0  # gain in log-likelihood [nat] below which steps are no effect: chance exceeds it once in 10^6
    for i, channel in enumerate(rig.measured):
        y = np.asarray(context.data.y)[..., i]
        step = grid_step(y.ravel())
        model = cast(StateSpaceModel, state.best if state else hypothesis.model)
        declared, estimated = rig.noise_std.get(channel), float(jnp.exp(model.log_r[i]))
        share = step**2 / 12 / (declared**2 if declared else max(estimated - step**2 / 12, FINEST * estimated))
        gain = 0.5 * np.isfinite(y).sum() * (share - math.log1p(share))  # of the right variance over that without it
        if share < COARSE or gain < certain:
            continue
        context.log(f"  {channel} comes in steps of {step:.4g}")
        effect = SensorQuantization(step=jnp.asarray(step), channel=channel)
        spread = SensorQuantization(step=jnp.asarray(1e-3 * step), channel=channel)
        candidate = Candidate(effect, (effect,), spread)
        evidence = Evidence(float(gain))
        early = cast(StateSpaceModel, state.best if state else context.stages[first][0].best)
        hypothesis = hypothesis.refitted(early).plus(effect, candidate, evidence)
        if declared:
            log_r = hypothesis.model.log_r.at[i].set(math.log(declared**2 + step**2 / 12))
            hypothesis = hypothesis.refitted(eqx.tree_at(lambda m: m.log_r, hypothesis.model, log_r))
        state = extend(context, hypothesis, first)
    return hypothesis, state
