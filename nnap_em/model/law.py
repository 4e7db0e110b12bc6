"""The engineer's friction law, and how well it describes a learned curve."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from jaxtyping import Array, Bool, Float


class StribeckLaw(eqx.Module):
    """Coulomb, viscous and Stribeck friction of each joint.

        tau_f(v) = -[(coulomb + (breakaway - coulomb) exp(-(v / stribeck)^2)) tanh(v / smooth) + viscous v]

    [Armstrong-Helouvry, Dupont & Canudas de Wit 1994, Automatica 30(7), sec. 2, with a smooth sign]
    """

    coulomb: Float[Array, " dof"]
    """[N m]"""
    breakaway: Float[Array, " dof"]
    """[N m]"""
    stribeck: Float[Array, " dof"]
    """[rad/s]"""
    viscous: Float[Array, " dof"]
    """[N m s/rad]"""
    smooth: Float[Array, " dof"]
    """[rad/s]"""

    def __call__(self, v: Float[Array, " dof"]) -> Float[Array, " dof"]:
        """Friction torque at joint velocities [N m]."""
        level = self.coulomb + (self.breakaway - self.coulomb) * jnp.exp(-((v / self.stribeck) ** 2))
        return -(level * jnp.tanh(v / self.smooth) + self.viscous * v)


PARAMETERS = ("coulomb", "breakaway", "stribeck", "viscous", "smooth", "offset")
"""The five of StribeckLaw, and a constant torque: half the difference of the Coulomb levels of both directions."""

UNITS = {True: ("N m", "N m", "rad/s", "N m s/rad", "rad/s", "N m"), False: ("N", "N", "m/s", "N s/m", "m/s", "N")}
"""Units of PARAMETERS, by whether the coordinate is an angle."""


class LawFit(NamedTuple):
    """The Stribeck law nearest to a learned curve, per joint; the columns are PARAMETERS."""

    value: Float[Array, "dof param"]
    std: Float[Array, "dof param"]
    """What the curve leaves undetermined has the standard deviation of the prior: the curve's whole range."""
    velocity: Float[Array, "dof node"]
    """[rad/s]"""
    difference: Float[Array, "dof node"]
    """Curve minus law [N m]."""
    difference_std: Float[Array, "dof node"]

    @property
    def departs(self) -> Bool[Array, "dof node"]:
        """Velocities at which the curve is not this law: more than 2 standard deviations away."""
        return jnp.abs(self.difference) > 2 * self.difference_std


@eqx.filter_jit
def fit_law(
    velocity: Float[Array, "dof node"], torque: Float[Array, "dof node"], cov: Float[Array, "dof node node"]
) -> LawFit:
    """Generalised least squares of the Stribeck law to a table of torque [N m] over velocity [rad/s], joint by joint.

        value = argmin |L^-1 (torque - law)|^2,  L L' = cov + nugget,  std by the delta method

    The nugget (a tenth of the torque's standard deviation, half a percent of its range) is what the shape of the
    learned curve itself may err where its covariance is all but singular.
    """
    return jax.vmap(_fit_joint)(velocity, torque, cov)


def _curve(value: Float[Array, " param"], v: Float[Array, " node"]) -> Float[Array, " node"]:
    return StribeckLaw(*value[:5, None])(v) + value[5]


def _fit_joint(v: Float[Array, " node"], torque: Float[Array, " node"], cov: Float[Array, "node node"]) -> LawFit:
    top = jnp.max(jnp.abs(v))
    scale = jnp.maximum(jnp.max(jnp.abs(torque)), 1e-9)
    wide = jnp.stack([scale, scale, top, scale / top, top, scale])
    cov = cov + jnp.diag(0.01 * jnp.diag(cov) + (0.005 * scale) ** 2)
    factor = jnp.linalg.cholesky(cov)

    def whiten(a):
        return jax.scipy.linalg.solve_triangular(factor, a, lower=True)

    def natural(z):
        """Logarithms keep the first five positive and the breakaway torque above the Coulomb torque."""
        positive = jnp.exp(z[:5])
        return wide * jnp.concatenate([positive, z[5:]]).at[1].add(positive[0])

    def residual(z, start):
        """Curve minus law, and priors so weak that they only hold what the curve does not determine."""
        value = natural(z)
        levels = jnp.stack([value[0], value[1] - value[0], value[3], value[5]]) / wide[jnp.asarray([0, 1, 3, 5])]
        return jnp.concatenate([whiten(torque - _curve(value, v)), levels, (z - start)[jnp.asarray([2, 4])] / 3.0])

    def solve(start):
        solver = optimistix.LevenbergMarquardt(rtol=1e-6, atol=1e-6)
        found = optimistix.least_squares(residual, solver, start, args=start, max_steps=200, throw=False)
        return found.value, jnp.sum(residual(found.value, start) ** 2)

    knees = jnp.log(jnp.asarray([0.02, 0.1, 0.4], v.dtype))
    levels = jnp.full(9, jnp.log(0.3), v.dtype)
    starts = jnp.stack(
        [levels, levels, jnp.repeat(knees, 3), levels, jnp.tile(knees, 3) - 1.5, jnp.zeros_like(levels)], 1
    )
    z, misfit = jax.vmap(solve)(starts)
    value = natural(z[jnp.nanargmin(misfit)])
    jac = jax.jacfwd(_curve)(value, v) * wide[None]
    white = whiten(jac)
    posterior = jnp.linalg.inv(white.T @ white + jnp.eye(6, dtype=v.dtype))
    rest = jnp.diag(cov) - jnp.sum((jac @ posterior) * jac, axis=1)
    return LawFit(
        value,
        wide * jnp.sqrt(jnp.diag(posterior)),
        v,
        torque - _curve(value, v),
        jnp.sqrt(jnp.maximum(rest, (0.005 * scale) ** 2)),
    )


def describe(fit: LawFit, names: tuple[str, ...], angles: tuple[bool, ...]) -> list[str]:
    """One sentence per joint: the numbers of the law, what the curve leaves open, and where it is another curve."""
    return [
        f"{name}: "
        + ", ".join(_terms(np.asarray(fit.value[j]), np.asarray(fit.std[j]), UNITS[angle]))
        + "; "
        + _where(fit, j, UNITS[angle][2])
        for j, (name, angle) in enumerate(zip(names, angles, strict=True))
    ]


def _terms(value: Float[np.ndarray, " param"], std: Float[np.ndarray, " param"], units: tuple[str, ...]) -> list[str]:
    words = ("Coulomb", "breakaway", "Stribeck velocity", "viscous", "sign smoothed over", "constant")
    open_ = (std > value) & (np.asarray(PARAMETERS) != "offset")
    return [
        f"{word} not determined" if o else f"{word} {v:.3g} ± {s:.1g} {unit}"
        for word, v, s, unit, o in zip(words, value, std, units, open_, strict=True)
    ]


def _where(fit: LawFit, joint: int, unit: str) -> str:
    """The runs of velocities at which the curve departs from the law, in words."""
    velocity, departs = np.asarray(fit.velocity[joint]), np.asarray(fit.departs[joint])
    if not departs.any():
        return "the curve agrees with this law within 2 standard deviations."
    edges = np.flatnonzero(np.diff(np.concatenate([[False], departs, [False]]).astype(int)))
    runs = [f"{velocity[a]:.2g} to {velocity[b - 1]:.2g}" for a, b in zip(edges[::2], edges[1::2], strict=True)]
    return f"the curve departs from this law at {', '.join(runs)} {unit}."
