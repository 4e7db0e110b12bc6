"""Candidates of a search: every effect of the catalogue that this machine could have, and where its fit starts."""

from collections.abc import Collection, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...base.gaussian import Gaussian
from ...base.parallel import each
from ...estimate.em.build import measure_scales
from ...logs.dataset import Dataset
from ...machines.rig import Rig
from ...model.effects import AbstractEffect, Candidate, SearchScales, catalogue, flat, free_form
from ...model.effects.base import KNEE
from ...model.state_space import StateSpaceModel, with_effects
from .keys import key_of


def surroundings(
    rig: Rig, model: StateSpaceModel, data: Dataset, path: Gaussian, rows: int, *, change: bool = False
) -> SearchScales:
    """Sizes on the smoothed paths and in the logs, of which `data` is a part: a whole sequence has `rows`. `change`:
    candidates are what may have changed since the fit of `model`, too.
    """
    free = {name: float(d.mean) for name, d in rig.bodies.items() if d.std > 0}
    moved = tuple((name, rig.unit(name), abs(value) or 1.0) for name, value in free.items())
    scales, dof = measure_scales(rig, model.system, data), len(model.system.coordinates)
    y, valid = np.asarray(data.y), np.asarray(data.valid)
    mean, clock = np.asarray(path.mean)[valid & np.isfinite(np.asarray(path.mean)).all(-1)], np.asarray(data.t)[valid]
    low, high = np.percentile(mean[:, :dof], [0.5, 99.5], axis=0)
    drive = np.nan_to_num(np.asarray(each(_drives, with_effects(model, ()), (path.mean, data))))
    drive = np.max(np.abs(np.where(valid[..., None], drive, 0.0)), axis=(0, 1), initial=0.0)
    fast = np.percentile(rate := np.abs(mean[:, dof : 2 * dof]), 99.5, axis=0)
    moving, speed = np.where(rate >= KNEE * fast, mean[:, :dof], np.nan), fast + 1e-9
    ends = jnp.asarray(np.outer([1.0, 0.4, -0.4, -1.0], speed))
    ahead, slow, back, fast_back = np.asarray(_torques(model.unknown, ends))
    # what rises between 0.4 and 1 of the top speed, on both sides, is not dry friction any more: the viscous slope
    viscous = np.maximum(0.0, -((ahead - fast_back) - (slow - back)) / (1.2 * speed))
    ending = float(clock.max()) + rig.dt * (rows - int(valid.sum(axis=1).max()))
    return SearchScales(
        model.system, scales.torque, speed, viscous, low, high, drive[[joint - 1 for joint in model.system.joints]],
        rig.measured, np.asarray([np.nanstd(y[..., i]) + 1e-9 for i in range(y.shape[-1])]), rig.dt,
        (float(clock.min()), float(clock.max())), ending, rig.clock == "session", rig.friction, rig.input_columns,
        moved=moved if change else None, width=np.ptp(np.nanpercentile(moving, [5.0, 95.0], axis=0), axis=0),
        dry=np.maximum(0.5 * np.abs(slow - back) - 0.4 * viscous * speed, 0.01 * scales.torque),
    )  # fmt: skip


def _drives(plain: StateSpaceModel, one) -> Float[Array, "time dof"]:
    """Generalised force of the inputs along the smoothed path of one sequence [N m, or N]."""
    x, seq = one
    return plain.driving((), x, plain.inputs(seq))


@eqx.filter_jit
def _torques(unknown, v: Float[Array, "node dof"]) -> Float[Array, "node dof"]:
    return jax.vmap(unknown)(v)


def proposals(
    around: SearchScales,
    known: Sequence[AbstractEffect] = (),
    kinds: Collection[type[AbstractEffect]] = catalogue.values(),
) -> list[Candidate]:
    """Everything of some kinds that this machine could have, and other forms of what is `known` to be there. A law of
    no size is left out, such as another centre of mass as a share of one that is declared on the axis.
    """
    every = [candidate for kind in kinds for candidate in kind.candidates(around) if np.all(flat(candidate.prior_std))]
    keys = {key_of(candidate.start) for candidate in every}
    free = (form for law in known if law.named for form in free_form(law, around))
    every += [form for form in free if key_of(form.start) not in keys]
    return every + [form for law in known for form in law.richer(around)]


def seeded(candidate: Candidate, coefficients: Float[np.ndarray, " probe"]) -> AbstractEffect:
    """The effect where the score test puts it; where it is not linear, a probe itself."""
    if not candidate.start.linear:
        return candidate.probes[0]

    def combine(start, *probes):
        start, *probes = map(np.asarray, (start, *probes))
        far = sum(float(c) * (p - start) for c, p in zip(coefficients, probes, strict=True))
        return jnp.asarray(start + far, start.dtype)

    return jax.tree.map(combine, candidate.start, *candidate.probes)
