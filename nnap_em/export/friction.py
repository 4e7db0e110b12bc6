"""Friction of a joint in the form that simulators and controllers have: Coulomb, Stribeck, viscous, constant."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..fit.identify import Identified, friction_table
from ..model.law import curve, nearest
from ..systems.tree import KNEE, Tree

REPORTED_MISS = 0.1
"""Share of a learned curve beyond which the part that its form misses is reported [1]."""


class FrictionForm(NamedTuple):
    """Friction that opposes motion, and a constant torque [N m, rad/s, or N, m/s].

        tau(v) = offset - (coulomb + (breakaway - coulomb) exp(-(v / stribeck)^2)) tanh(v / smooth) - viscous v

    [Armstrong-Helouvry, Dupont & Canudas de Wit 1994, Automatica 30(7), sec. 2]
    """

    coulomb: float = 0.0
    breakaway: float = 0.0
    """The Coulomb torque where there is no dip."""
    stribeck: float = 1.0
    viscous: float = 0.0
    offset: float = 0.0
    smooth: float = 0.0
    """Velocity over which the sign changes."""
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
    weight = 1 / np.maximum(std, 0.05 * np.max(np.abs(torque), initial=1e-300))
    kinds = ((False, False), (False, True), (True, False), (True, True))  # constant, dip: fewer terms first
    fits = [(form, dip) for constant, dip in kinds for form in [_form(v, torque, weight, constant, dip)]]
    fits = [form for form, dip in fits if not dip or form.stribeck > form.smooth]
    # Least share of the curve that a term must explain, at least a part of the curve's relative uncertainty [1]
    bar = max(0.005, 0.3 * float(np.sqrt(np.mean(std**2) / max(np.mean(torque**2), 1e-300))))
    return next(form for form in fits if form.missed <= min(each.missed for each in fits) + bar)


def friction_forms(fitted: Identified) -> list[FrictionForm]:
    """Friction of every joint: learned, or that of the file where none is learned."""
    system = fitted.model.system
    if not fitted.rig.friction:
        joints = system.machine.joints if isinstance(system, Tree) else ()
        forms = [FrictionForm(j.dry, j.dry, 1.0, j.damping, 0.0, KNEE) for j in joints]
        return forms or [FrictionForm()] * len(system.coordinates)
    nodes = np.asarray(fitted.m_step.weights(fitted.model).nodes)
    curve_velocities = 160  # velocities at which a learned curve is read
    velocity = np.linspace(-1.0, 1.0, curve_velocities)[None] * np.max(np.abs(nodes), axis=1)[:, None]
    table = friction_table(fitted, jnp.asarray(velocity))
    return [friction_form(*joint) for joint in zip(velocity, *map(np.asarray, (table.torque, table.std)), strict=True)]


def _form(
    v: Float[np.ndarray, " node"],
    torque: Float[np.ndarray, " node"],
    weight: Float[np.ndarray, " node"],
    constant: bool,
    dip: bool,
) -> FrictionForm:
    """Nearest form with or without a constant and a dip."""
    # Weight of the curve over the prior of the law, and of its largest torque over one that is none [1]
    curve_weight = 1e3
    top, least = float(np.max(np.abs(v))), max(np.max(np.abs(torque)), 1e-9) / curve_weight**2
    value = nearest(v, torque, np.diag(curve_weight * weight), dip=dip, constant=constant)
    torques, bars = value * [1.0, 1.0, 1.0, top, 1.0, 1.0], [least, least, 0.0, least, 0.0, -np.inf]
    value = np.where(torques < bars, 0.0, value)
    coulomb, breakaway, stribeck, viscous, smooth, offset = value.tolist()
    residual = torque - curve(value, v)
    share = np.sqrt(np.average(residual**2, weights=weight) / max(np.average(torque**2, weights=weight), 1e-300))
    return FrictionForm(coulomb, breakaway, stribeck if dip else 1.0, viscous, offset, smooth, float(share))
