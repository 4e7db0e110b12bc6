"""Innovations of a fitted model, and the generalised force that it lacks, at smoothed states.

[Sarkka & Svensson 2023, "Bayesian Filtering and Smoothing", 2nd ed.; Bar-Shalom, Li & Kirubarajan 2001, "Estimation
with Applications to Tracking and Navigation", section 5.4]
"""

from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ...base.parallel import each
from ...estimate.em.mstep import not_diverged
from ...estimate.identify import Identified
from ...estimate.predict import posterior_of
from ...estimate.smoother.kalman import CUBATURE, relinearised
from ...logs.dataset import Dataset, stepped
from ...machines.units import force_unit, joint_called, state_unit
from ...model import hooks
from ...model.base import prepare
from ...model.state_space import with_effects


class Names(NamedTuple):
    """Names and units of the columns of a `Residual`."""

    coordinates: tuple[str, ...]
    rates: tuple[str, ...]
    rotary: tuple[bool, ...]
    """True where a coordinate is an angle [rad]; False: a position [m]."""
    inputs: tuple[str, ...]
    joints: tuple[int, ...]
    """Joint (counted from 1) that each input drives."""
    measured: tuple[str, ...]
    sensors: Mapping[str, str] = {}
    units: Mapping[str, str] = {}
    """Units of what reads no state, or of equations of all that can be read; and of equations."""

    def unit(self, name: str) -> str:
        """SI unit of a state, a sensor, an input or `time`."""
        known = {"time": "s", **self.sensors, **self.units}
        if name in known:
            return known[name]
        if name in self.inputs:
            return self.force_unit(self.joints[self.inputs.index(name)])
        place = (self.coordinates + self.rates).index(name)
        dof = len(self.coordinates)
        return state_unit(self.rotary[place % dof], rate=place >= dof)

    def joint(self, joint: int) -> str:
        """Name of a joint, counted from 1, for a reader."""
        return joint_called(self.coordinates, joint)

    def force_unit(self, joint: int) -> str:
        """Unit of the generalised force at a joint, counted from 1."""
        return force_unit(self.rotary[joint - 1])


class Residual(NamedTuple):
    """Innovations, missing force and states of every sequence, in the coordinates that `Names` names."""

    innovation: Float[np.ndarray, "seq time obs"]
    """Reading minus its one-step prediction, over the standard deviation of that; NaN where not measured."""
    force: Float[np.ndarray, "seq time port"]
    force_std: Float[np.ndarray, "seq time port"]
    """Generalised force that the model lacks between a row and the next [N m, or N], of equations the missing rate of
    every state, and its standard deviation given all readings; NaN behind the last row."""
    partial_force: Float[np.ndarray, "seq time port"]
    """The force that the model without its effects lacks, on the paths smoothed with them: the component-plus-residual
    of a regression.  The paths of a model that lacks much are wrong themselves.
    [Larsen & McCleary 1972, Technometrics 14, 781]"""
    partial_force_std: Float[np.ndarray, "seq time port"]
    state: Float[np.ndarray, "seq time state"]
    predicted: Float[np.ndarray, "seq time state"]
    """Coordinates and rates, smoothed, and predicted from the rows before."""
    u: Float[np.ndarray, "seq time input"]
    """Generalised forces of the inputs at their joints, with the effects of the model [N m, or N]."""
    t: Float[np.ndarray, "seq time"]
    """[s]"""
    valid: Bool[np.ndarray, "seq time"]
    used: Bool[np.ndarray, " seq"]
    """False for a diverged sequence, which takes part in no test and no figure."""

    def without_effects(self) -> "Residual":
        """The residual with `partial_force` as its force."""
        return self._replace(force=self.partial_force, force_std=self.partial_force_std)

    def followed(self) -> "Residual":
        """The residual of the sequences that did not diverge."""
        return Residual(*(part[self.used] for part in self))


def names_of(fitted: Identified) -> Names:
    """Names of the columns of `residual(fitted, ...)`."""
    system, rig = fitted.model.system, fitted.rig
    if rig.equations:
        units = {name: system.unit(name) for name in (*system.readable, *rig.input_columns, "time")}
        sensors = {name: units[name] for name in system.readable}
        return Names((), (), (), rig.input_columns, (), rig.measured, sensors, units)
    return Names(
        system.coordinates, system.rates, tuple(system.angles), rig.input_columns, tuple(system.joints), rig.measured,
        system.sensors,
    )  # fmt: skip


def _left(common, one) -> tuple[Float[Array, "time column"], ...]:
    """The fields of a `Residual` that come from smoothing, of one sequence."""
    model, (seq, posterior) = common, one
    plain, prepared = with_effects(model, ()), prepare(model, seq)
    dof, states = len(model.system.coordinates), len(model.system.states)
    pushed = slice(dof, states)  # rates; of equations, which have no coordinates, all states
    filtered = relinearised(model, posterior.state, prepared, CUBATURE)

    def force(system, x, change):
        nodes = system.push_of(x[:dof], change) / model.dt
        return jnp.mean(nodes, axis=0), jnp.std(nodes, axis=0)

    def both(x, kick, u, command):
        change = kick[:, pushed]
        remaining = force(hooks.machine(model.effects, model.system, u.time), x, change)
        if not model.effects:
            return *remaining, *remaining
        # change of the rates by the effects over one sample
        by_effects = model.transition(x, u)[pushed] - plain.transition(x[:states], command)[dof:]
        return *remaining, *force(model.system, x, change + by_effects[None])

    steps = jax.tree.map(lambda a: a[:-1], (posterior.state.mean, prepared.inputs, plain.inputs(seq)))
    forces = jax.vmap(both)(steps[0], posterior.kick, *steps[1:])
    last = jnp.full((1, states - dof), jnp.nan, seq.y.dtype)
    forces = [jnp.concatenate([jnp.where(seq.valid[1:, None], a, jnp.nan), last]) for a in forces]
    innovation = jnp.where(prepared.observed, filtered.innovation, jnp.nan)
    state, predicted = (g.mean[:, :states] for g in (posterior.state, filtered.predicted))
    return innovation, *forces, state, predicted, prepared.inputs.u


def residual(fitted: Identified, data: Dataset) -> Residual:
    """Innovations, and the generalised force that the model lacks, by the smoother of the fit.

        r_k = M(q_k) (v_{k+1} - v(x_k, u_k)) / dt,  its mean and standard deviation given all readings [N m, or N]

    v(x, u) is the model's own rate one sample later.  The smoother draws r towards 0 as far as the process noise is
    small: a slow force comes out whole, single kicks do not.  Innovations are those of the Kalman filter of the model
    linearised about the smoothed distribution by cubature, whichever smoother gave that.
    """
    rows, data = data.t.shape[1], jax.device_put(stepped(data))
    posterior = posterior_of(fitted, data)
    outcome = map(np.asarray, each(_left, fitted.model, (data, posterior)))
    innovation, force, std, partial_force, partial_force_std, state, predicted, u = outcome
    t, valid = np.asarray(data.t), np.asarray(data.valid)
    used = np.asarray(not_diverged(posterior, data)) & np.isfinite(np.where(valid[..., None], state, 0.0)).all((1, 2))
    left = Residual(innovation, force, std, partial_force, partial_force_std, state, predicted, u, t, valid, used)
    return left._replace(**{name: getattr(left, name)[:, :rows] for name in Residual._fields if name != "used"})
