"""A fit as the prior of further logs: its numbers, friction, noise and laws in the place of what rig.toml declares."""

import dataclasses
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from ..errors import DataError
from ..logs.dataset import Dataset
from ..machines.machine import unpacked
from ..machines.rig import Rig
from ..model.state_space import StateSpaceModel
from .em.loop import EPOCHS, later_state
from .em.mstep import ScoringMStep
from .em.weights import Known
from .identify import Identified, MakeSmoother, Watch, begin, identify, unwatched
from .smoother.gaussian import CubatureSmoother

OF_LOGS = ("name", "start", "limits", "ranges", "file")
"""Keys of a rig that belong to its logs; all others are those of the fit."""


def differences(fit: Rig, rig: Rig) -> list[str]:
    """Declarations of two rigs that differ, key by key; those of the logs alone are left out.

    Raises DataError where the rigs are not of one machine, and for equations.
    """
    if fit.equations or rig.equations:
        raise DataError(f"rig {rig.name!r} is written as equations; start from a fit of a machine with joints")
    old, new = _declared(fit), _declared(rig)
    lines = {
        key: f"{key} is {_text(old.get(key))} in the fit and {_text(new.get(key))} here"
        for key in {**old, **new}
        if old.get(key) != new.get(key)
    }
    # keys that must be the same, or the fit is of another machine
    same = ("system", "friction", "input_columns", "input_joints", "dt", "measured", "machine")
    if foreign := [line for key, line in lines.items() if key in same]:
        raise DataError(f"rig {rig.name!r} is not that of the fit: {'; '.join(foreign)}")
    return list(lines.values())


def _declared(rig: Rig) -> dict[str, Any]:
    """Declarations by their keys; of a machine file what it holds, wherever it is."""
    out: dict[str, Any] = {}
    for name in (field.name for field in dataclasses.fields(rig) if field.name not in OF_LOGS):
        value = getattr(rig, name)
        value = str(unpacked(value)._replace(file="")) if name == "machine" and value else value
        out |= {f"{key} of {name}": one for key, one in value.items()} if isinstance(value, dict) else {name: value}
    return out


def _text(value) -> str:
    text = "not declared" if value is None else str(value)
    return text if len(text) < 60 else "another"


def known(
    fit: Identified,
    rig: Rig,
    data: Dataset,
    *,
    key: PRNGKeyArray,
    smoother: MakeSmoother = CubatureSmoother,
    hold: float = 1.0,
) -> Identified:
    """The problem of fitting `data` from the posterior of `fit`, whose standard deviations are multiplied by `hold`.

    Friction, numbers and laws start at their values there, with the covariance that the fit states; both noises start
    there, too, and are free.  The first states are those of `data`.
    Raises DataError where the rigs are not of one machine, and for equations.
    """
    differences(fit.rig, rig)
    rig = dataclasses.replace(fit.rig, **{name: getattr(rig, name) for name in OF_LOGS})
    begun = begin(rig, data, key=key, smoother=smoother, effects=fit.model.effects)
    model = eqx.tree_at(lambda m: m.start, fit.model, begun.model.start)
    rule = _rule(fit, begun.m_step, hold)
    return begun._replace(rig=rig, state=later_state(model, rule, key=begun.state.key), m_step=rule)


def _rule(fit: Identified, begun: ScoringMStep, hold: float) -> ScoringMStep:
    """The rule of the fit with its posterior as prior."""
    old, model = fit.m_step, fit.model
    weights = old.weights(model)
    w = weights.read(model)
    cut = w.shape[0] - old.prior.size
    own = np.concatenate([np.zeros(weights.nodes.size), np.ones(old.prior.size)])
    mean = jnp.where(own == 1, 0.0, weights.phi(model.unknown, w))
    precision = jnp.asarray(fit.state.hessian) / hold**2 - jnp.diag(jnp.asarray(own))
    return dataclasses.replace(
        old,
        prior=eqx.tree_at(lambda p: p.mean, old.prior, old.prior.mean + old.prior.std * w[cut:]),
        centre=w[:cut],
        learn_start=begun.learn_start,
        learn_r=begun.learn_r,
        coarse=np.inf,
        reach=jnp.full_like(begun.reach, np.inf),
        log_q_prior=model.log_q,
        least=old.least - w[cut:][: old.least.shape[0]],
        known=Known(mean, precision),
    )


def unheld(rule: ScoringMStep, model: StateSpaceModel, hold: float) -> ScoringMStep:
    """The rule of `known` with the posterior as the fit states it."""
    assert rule.known is not None
    own = jnp.diag(jnp.where(jnp.arange(rule.known.mean.shape[0]) < rule.weights(model).nodes.size, 0.0, 1.0))
    precision = hold**2 * (rule.known.precision + own) - own
    return eqx.tree_at(lambda r: r.known.precision, rule, precision)


def forgotten(fit: Identified) -> Identified:
    """The fit with the posterior that it began from only in its own."""
    rule = eqx.tree_at(lambda r: r.known, fit.m_step, None, is_leaf=lambda leaf: leaf is None)
    return fit._replace(m_step=rule)


def identify_from(
    fit: Identified,
    rig: Rig,
    data: Dataset,
    *,
    key: PRNGKeyArray,
    smoother: MakeSmoother = CubatureSmoother,
    epochs: int = EPOCHS,
    watch: Watch = unwatched,
) -> Identified:
    """Identify with the posterior of an earlier fit as the prior, in the place of what a rig declares.

    Args:
        fit: the earlier fit.
        rig: of the new logs.
        data: sequences to fit.
        key: random key of the start.
        smoother: makes the smoother.
        epochs: of EM, at most.
        watch: called after every epoch with its state, the number of rows seen and the sequences used.

    Returns:
        The fit of the new logs.

    Raises:
        DataError: the rigs are not of one machine, or one is written as equations.
        FitError: no sequence can be followed.

    Example:
        >>> nnap_em.identify_from(fit, rig, test, key=key, epochs=2).rig == rig
        True
    """
    start = known(fit, rig, data, key=key, smoother=smoother)
    return forgotten(identify(rig, data, key=key, epochs=epochs, start=start, watch=watch))
