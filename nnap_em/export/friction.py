"""Friction of a joint in the form that simulators and controllers have: Coulomb, Stribeck, viscous, constant."""

import itertools
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy.optimize
from jaxtyping import Float

from ..fit.identify import Identified, friction_table
from ..systems import AbstractSystem
from ..systems.tree import KNEE, Tree

REPORTED_MISS = 0.1
"""Share of a learned curve beyond which the part that its form misses is reported [1]."""
SIMPLER = 0.005
"""Least share of a learned curve that a dip or a constant must explain to be written [1]."""
EXPLAINED_PER_STD = 0.3
"""Least share that it must explain, over the standard deviation of the curve relative to the curve [1]."""
SMOOTH = (0.0, 0.003, 0.01, 0.02, 0.04, 0.08)
"""Widths of the sign at zero velocity that are tried, as shares of the largest velocity."""
DIPS = tuple(np.geomspace(0.01, 0.5, 12))
"""Stribeck velocities that are tried, as shares of the largest velocity."""
CURVE_VELOCITIES = 160
"""Velocities at which a learned curve is read."""


class FrictionForm(NamedTuple):
    """Friction that opposes motion, and a constant torque.

        tau(v) = offset - (coulomb + (breakaway - coulomb) exp(-(v / stribeck)^2)) tanh(v / smooth) - viscous v

    [Armstrong-Helouvry, Dupont & Canudas de Wit 1994, Automatica 30(7), sec. 2]
    """

    coulomb: float = 0.0
    """[N m or N]"""
    breakaway: float = 0.0
    """[N m or N]; the Coulomb torque where there is no dip."""
    stribeck: float = 1.0
    """[rad/s or m/s]"""
    viscous: float = 0.0
    """[N m s/rad or N s/m]"""
    offset: float = 0.0
    """[N m or N]"""
    smooth: float = 0.0
    """Velocity over which the sign changes; 0 at once [rad/s or m/s]."""
    fastest: float = 0.0
    """Largest velocity of the curve [rad/s or m/s]."""
    missed: float = 0.0
    """Root mean square of the rest of the curve, over that of the curve [1]."""

    def torque(self, v: Float[np.ndarray, " node"]) -> Float[np.ndarray, " node"]:
        """Torque at velocities [N m or N]."""
        level = self.coulomb + (self.breakaway - self.coulomb) * np.exp(-((v / self.stribeck) ** 2))
        return self.offset - level * _sign(v, self.smooth) - self.viscous * v


def friction_form(
    v: Float[np.ndarray, " node"], torque: Float[np.ndarray, " node"], std: Float[np.ndarray, " node"]
) -> FrictionForm:
    """Form nearest to a curve of friction torque [N m] over velocity [rad/s] of standard deviation `std` [N m].

    Weighted least squares with coefficients that never push, for a grid of dips and smooth signs. A dip or a constant
    is kept only where it explains more than `SIMPLER` of the curve, and more than a part of its uncertainty.
    """
    top = float(np.max(np.abs(v)))
    weight = 1 / np.maximum(std, 0.05 * np.max(np.abs(torque), initial=1e-300))
    dips = [0.0, *(top * dip for dip in DIPS)]
    fits: dict[tuple[bool, bool], FrictionForm] = {}
    for smooth, dip, constant in itertools.product([top * share for share in SMOOTH], dips, (False, True)):
        form = _fit(v, torque, weight, smooth, dip, constant)
        kind = constant, bool(dip > 0)
        if kind not in fits or form.missed < fits[kind].missed:
            fits[kind] = form
    fits = {kind: _finer(v, torque, weight, form, *kind) for kind, form in fits.items()}
    least = min(form.missed for form in fits.values())
    bar = max(SIMPLER, EXPLAINED_PER_STD * float(np.sqrt(np.mean(std**2) / max(np.mean(torque**2), 1e-300))))
    order = sorted(fits, key=sum)  # fewer terms first
    return next(fits[kind] for kind in order if fits[kind].missed <= least + bar)


def friction_forms(fitted: Identified) -> list[FrictionForm]:
    """Friction of every joint: learned, or that of the file where none is learned."""
    system = fitted.model.system
    if not fitted.rig.friction:
        return declared_friction(system)
    velocity = even_nodes(fitted)
    table = friction_table(fitted, jnp.asarray(velocity))
    joints = zip(velocity, np.asarray(table.torque), np.asarray(table.std), strict=True)
    return [friction_form(*joint) for joint in joints]


def declared_friction(system: AbstractSystem) -> list[FrictionForm]:
    """Friction that the file of a machine has; none of a machine without a file."""
    if not isinstance(system, Tree):
        return [FrictionForm()] * len(system.coordinates)
    return [FrictionForm(j.dry, j.dry, 1.0, j.damping, 0.0, KNEE) for j in system.machine.joints]


def even_nodes(fitted: Identified) -> Float[np.ndarray, "dof node"]:
    """Velocities over the visited range of every joint, evenly apart; the nodes of a fit crowd about rest [rad/s]."""
    nodes = np.asarray(fitted.m_step.weights(fitted.model).nodes)
    return np.linspace(-1.0, 1.0, CURVE_VELOCITIES)[None] * np.max(np.abs(nodes), axis=1)[:, None]


def _sign(v: Float[np.ndarray, " node"], smooth: float) -> Float[np.ndarray, " node"]:
    return np.tanh(v / smooth) if smooth else np.sign(v)


def _fit(
    v: Float[np.ndarray, " node"],
    torque: Float[np.ndarray, " node"],
    weight: Float[np.ndarray, " node"],
    smooth: float,
    dip: float,
    constant: bool,
) -> FrictionForm:
    """Coefficients of one place of the grid."""
    sign = _sign(v, smooth)
    columns = [sign, v]
    columns += [sign * np.exp(-((v / dip) ** 2))] if dip else []
    columns += [np.ones_like(v), -np.ones_like(v)] if constant else []
    basis = np.stack(columns, axis=1)
    coefficients, _ = scipy.optimize.nnls(basis * weight[:, None], -torque * weight)
    residual = torque + basis @ coefficients
    share = np.sqrt(np.average(residual**2, weights=weight) / max(np.average(torque**2, weights=weight), 1e-300))
    offset = coefficients[-1] - coefficients[-2] if constant else 0.0
    breakaway = coefficients[0] + (coefficients[2] if dip else 0.0)
    top = np.max(np.abs(v))
    return FrictionForm(
        *map(float, (coefficients[0], breakaway, dip or 1.0, coefficients[1], offset, smooth, top, share))
    )


def _finer(
    v: Float[np.ndarray, " node"],
    torque: Float[np.ndarray, " node"],
    weight: Float[np.ndarray, " node"],
    form: FrictionForm,
    constant: bool,
    dips: bool,
) -> FrictionForm:
    """Form between the places of the grid."""
    start = np.log([max(form.smooth, 1e-4 * form.fastest), form.stribeck][: 1 + dips])

    def at(z: Float[np.ndarray, " place"]) -> FrictionForm:
        smooth, *dip = map(float, np.exp(z))
        return _fit(v, torque, weight, smooth, dip[0] if dip else 0.0, constant)

    best = scipy.optimize.minimize(lambda z: at(z).missed, start, method="Nelder-Mead", options={"maxiter": 60}).x
    return min(form, at(best), key=lambda one: one.missed)
