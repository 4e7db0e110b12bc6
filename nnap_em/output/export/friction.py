"""Friction of a joint in the form that simulators and controllers have: Coulomb, Stribeck, viscous, constant."""

import itertools
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...estimate.identify import Identified, friction_table
from ...machines.systems.tree import Tree
from ...model.law import curve, nearest

REPORTED_MISS = 0.1
"""Share of a learned curve beyond which the part that its form misses is reported [1]."""


class FrictionForm(NamedTuple):
    """Friction that opposes motion, as `StribeckLaw` has it, and a constant torque [N m, N m s/rad, or N, N s/m]."""

    coulomb: float = 0.0
    breakaway: float = 0.0
    """The Coulomb torque where there is no dip."""
    viscous: float = 0.0
    offset: float = 0.0
    missed: float = 0.0
    """Root mean square of the rest of the curve, over that of the curve [1]."""


def friction_form(
    v: Float[np.ndarray, " node"], torque: Float[np.ndarray, " node"], std: Float[np.ndarray, " node"]
) -> FrictionForm:
    """Form nearest to a curve of friction torque [N m] over velocity [rad/s] of standard deviation `std` [N m].

    A dip or a constant is kept only where it explains more than 0.005 of the curve, and more than a part of its
    uncertainty; a dip narrower than the sign is none, as its breakaway torque is never reached.
    """
    if not np.any(torque):
        return FrictionForm()
    top, largest = np.max(np.abs(v)), np.max(np.abs(torque))
    weight, fits = 1 / np.maximum(std, 0.05 * largest), []
    for constant, dip in itertools.product((False, True), repeat=2):  # fewer terms first
        # 1e4: weight of the curve over the prior of the law; a millionth of the largest torque is none
        value = nearest(v, torque, np.diag(1e4 * weight), dip=dip, constant=constant)
        value[[0, 1, 3]] *= value[[0, 1, 3]] * [1.0, 1.0, top] > 1e-6 * largest
        coulomb, breakaway, stribeck, viscous, smooth, offset = value.tolist()
        if not dip or stribeck > smooth:
            left, whole = (np.average(part**2, weights=weight) for part in (torque - curve(value, v), torque))
            fits.append(FrictionForm(coulomb, breakaway, viscous, offset, float(np.sqrt(left / whole))))
    # Least share of the curve that a term must explain, at least a part of the curve's relative uncertainty [1]
    bar = max(0.005, 0.3 * float(np.sqrt(np.mean(std**2) / np.mean(torque**2))))
    return next(form for form in fits if form.missed <= min(each.missed for each in fits) + bar)


def friction_forms(fitted: Identified) -> list[FrictionForm]:
    """Friction of every joint: learned, or that of the file where none is learned."""
    system = fitted.model.system
    if not fitted.rig.friction:
        joints = system.machine.joints if isinstance(system, Tree) else ()
        forms = [FrictionForm(j.dry, j.dry, j.damping) for j in joints]
        return forms or [FrictionForm()] * len(system.coordinates)
    nodes = np.asarray(fitted.m_step.weights(fitted.model).nodes)
    curve_velocities = 160  # velocities at which a learned curve is read
    velocity = np.linspace(-1.0, 1.0, curve_velocities)[None] * np.max(np.abs(nodes), axis=1)[:, None]
    table = friction_table(fitted, jnp.asarray(velocity))
    return [friction_form(*joint) for joint in zip(velocity, *map(np.asarray, (table.torque, table.std)), strict=True)]
