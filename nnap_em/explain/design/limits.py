"""Limits of the machine: as declared, else the range of its logs."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from ...errors import DesignError
from ...logs.dataset import Dataset
from ...machines.limits import Range
from ...machines.rig import Rig
from ...machines.systems import AbstractSystem


class Limits(NamedTuple):
    """Lowest and highest values allowed on the machine."""

    low: Float[np.ndarray, " input"]
    """Inputs [N m, or N]."""
    high: Float[np.ndarray, " input"]
    rate: Float[np.ndarray, " input"]
    """Largest change of an input [N m/s]."""
    lowest: Float[np.ndarray, " readable"]
    """Coordinates and rates [rad, rad/s]."""
    highest: Float[np.ndarray, " readable"]
    first: Float[np.ndarray, " readable"]
    """A sequence may begin at any state from here ..."""
    last: Float[np.ndarray, " readable"]
    """... to here."""


def limits_of(
    rig: Rig,
    system: AbstractSystem,
    data: Dataset,
    path: Float[np.ndarray, "seq time state"],
    used: Bool[np.ndarray, " seq"],
) -> Limits:
    """Limits as `rig` declares them, else as far as `data` and the smoothed `path` of the sequences `used` went.

    A sequence begins at rest: where nothing else is declared with all coordinates 0, if the machine was there and stays
    there, else where the logs begin on average.
    Raises DesignError where there is no input, or a start is out of the limits.
    """
    if not rig.input_columns:
        raise DesignError(f"rig {rig.name!r} has no input: there is nothing to design; declare its drive in [input]")
    names, dof = system.coordinates + system.rates, len(system.coordinates)
    valid, mean = np.asarray(data.valid), path[..., : 2 * dof]
    u = np.asarray(data.u)[..., : len(rig.input_columns)]
    reached = mean[valid & used[:, None] & np.isfinite(mean).all(axis=-1)]
    change = np.abs(np.diff(u, axis=1))[valid[:, 1:] & valid[:, :-1]] / rig.dt
    bounds = rig.limits
    inputs = _bounds(rig.input_columns, bounds.values, u[valid].min(axis=0), u[valid].max(axis=0))
    rate = _bounds(rig.input_columns, bounds.rate, -change.max(axis=0), change.max(axis=0))[1]
    outer = 0.1  # percent of the rows on either side that may be a slip of the smoother
    low, high = _bounds(names, bounds.values, *np.percentile(reached, [outer, 100 - outer], axis=0))
    still, begun = jnp.zeros(dof), mean[used, 0]
    stays = bool(jnp.all(jnp.abs(system.bias(still, still)) < 1e-9))
    rest = np.zeros(2 * dof)
    if not (stays and np.all((low[:dof] <= 0) & (high[:dof] >= 0))):
        rest[:dof] = begun[np.isfinite(begun).all(axis=-1), :dof].mean(axis=0)
    first, last = _bounds(names, bounds.start, rest, rest)
    for name, a, b, lo, hi in zip(names, first, last, low, high, strict=True):
        if a < lo or b > hi:
            raise DesignError(
                f"a sequence would begin at {name} = {a:.4g} to {b:.4g}, out of the limits {lo:.4g} to {hi:.4g}; write "
                f"another {name} in [limits.start] of rig.toml, or wider limits in [limits]"
            )
    for name, a, b in zip(rig.input_columns, *inputs, strict=True):
        if a >= b:
            raise DesignError(f"the input {name} never moved, and no limit is declared; write {name} = 0.3 in [limits]")
    return Limits(*inputs, rate, low, high, first, last)


def _bounds(names: Sequence[str], declared: Mapping[str, Range], low, high) -> tuple[np.ndarray, np.ndarray]:
    pairs = [declared.get(name, (lo, hi)) for name, lo, hi in zip(names, low, high, strict=True)]
    return tuple(np.array(pairs, float).T)  # type: ignore[return-value]
