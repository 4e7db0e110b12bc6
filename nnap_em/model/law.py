"""The engineer's friction law, and how well it describes a learned curve."""

import itertools
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.linalg import solve_triangular
from scipy.optimize import least_squares


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

CALLED = ("Coulomb", "breakaway", "Stribeck velocity", "viscous", "sign smoothed over", "constant")
"""Words for PARAMETERS."""

LAW_UNITS = {True: ("N m", "N m", "rad/s", "N m s/rad", "rad/s", "N m"), False: ("N", "N", "m/s", "N s/m", "m/s", "N")}
"""Units of PARAMETERS, by whether the coordinate is an angle."""


class LawFit(NamedTuple):
    """The Stribeck law nearest to a learned curve, per joint; the columns are PARAMETERS."""

    value: Float[np.ndarray, "dof param"]
    std: Float[np.ndarray, "dof param"]
    """Numbers that the curve leaves undetermined have the standard deviation of the prior: the curve's whole range."""
    velocity: Float[np.ndarray, "dof node"]
    """[rad/s]"""
    difference: Float[np.ndarray, "dof node"]
    """Curve minus law [N m]."""
    difference_std: Float[np.ndarray, "dof node"]

    @property
    def departs(self) -> Bool[np.ndarray, "dof node"]:
        """Velocities at which the curve is not this law: more than 2 standard deviations away."""
        return np.abs(self.difference) > 2 * self.difference_std


def fit_law(
    velocity: Float[Array | np.ndarray, "dof node"],
    torque: Float[Array | np.ndarray, "dof node"],
    cov: Float[Array | np.ndarray, "dof node node"],
) -> LawFit:
    """Generalised least squares of the Stribeck law to a table of torque [N m] over velocity [rad/s], joint by joint.

        value = argmin |L^-1 (torque - law)|^2,  L L' = cov + nugget,  std by the delta method

    The nugget (a tenth of the torque's standard deviation, half a percent of its range) is what the shape of the
    learned curve itself may err where its covariance is all but singular.
    """
    joints = [_fit_joint(*map(np.asarray, table)) for table in zip(velocity, torque, cov, strict=True)]
    return LawFit(*(np.stack(column) for column in zip(*joints, strict=True)))


def curve(value: Float[np.ndarray, " param"], v: Float[np.ndarray, " node"]) -> Float[np.ndarray, " node"]:
    """Torque of the law over velocity [N m], the constant included."""
    coulomb, breakaway, stribeck, viscous, smooth, offset = value
    level = coulomb + (breakaway - coulomb) * np.exp(-((v / stribeck) ** 2))
    return offset - level * np.tanh(v / smooth) - viscous * v


def _slopes(value: Float[np.ndarray, " param"], v: Float[np.ndarray, " node"]) -> Float[np.ndarray, "node param"]:
    """Derivatives of `curve` by its parameters."""
    coulomb, breakaway, stribeck, _, smooth, _ = value
    dip, sign = np.exp(-((v / stribeck) ** 2)), np.tanh(v / smooth)
    level = coulomb + (breakaway - coulomb) * dip
    by_stribeck = -2 * (breakaway - coulomb) * dip * v**2 / stribeck**3 * sign
    by_smooth = level * (1 - sign**2) * v / smooth**2
    return np.stack([-(1 - dip) * sign, -dip * sign, by_stribeck, -v, by_smooth, np.ones_like(v)], axis=1)


def nearest(
    v: Float[np.ndarray, " node"],
    torque: Float[np.ndarray, " node"],
    whitener: Float[np.ndarray, "node node"],
    *,
    dip: bool = True,
    constant: bool = True,
) -> Float[np.ndarray, " param"]:
    """PARAMETERS of the law nearest to a curve: argmin |whitener (torque - law)|^2, and a weak prior.

    Without `dip` the breakaway torque is the Coulomb torque, without `constant` the constant torque is 0.
    """
    wide, free = _range(v, torque), np.array([True, dip, dip, True, True, constant])
    # priors so weak that they only hold what the curve does not determine
    levels = np.array([[1, 0, 0, 0, 0, 0], [-1, 1, 0, 0, 0, 0], [0, 0, 0, 1, 0, 0], [0, 0, 0, 0, 0, 1]])
    levels, times = levels / wide[[0, 1, 3, 5], None], np.eye(6)[[2, 4]] / 3.0

    def natural(z, start):
        """Parameters and their derivatives by `z`: logarithms keep the first five and their differences positive."""
        full = start.copy()
        full[free] = z
        factors = np.diag(wide * np.concatenate([np.exp(full[:5]), [1.0]]))
        factors[1, 0] = factors[0, 0]
        value = wide * np.concatenate([np.exp(full[:5]), full[5:]])
        value[1] += value[0]
        return full, value, factors

    def residual(z, start):
        full, value, _ = natural(z, start)
        return np.concatenate([whitener @ (torque - curve(value, v)), levels @ value, times @ (full - start)])

    def jacobian(z, start):
        _, value, factors = natural(z, start)
        return np.concatenate([-whitener @ _slopes(value, v) @ factors, levels @ factors, times])[:, free]

    fits = []
    for knee, sharpness in itertools.product(np.log([0.02, 0.1, 0.4]) if dip else [0.0], np.log([0.02, 0.1, 0.4])):
        no_dip = -200.0  # its logarithm
        start = np.array([np.log(0.3), np.log(0.3) if dip else no_dip, knee, np.log(0.3), sharpness - 1.5, 0.0])
        with np.errstate(over="ignore"):  # a step too far: the next one is shorter
            fit = least_squares(residual, start[free], jacobian, method="lm", xtol=1e-8, args=(start,))  # type: ignore
        fits.append((fit.cost, natural(fit.x, start)[1]))
    return min(fits, key=lambda fit: fit[0])[1]


def _range(v: Float[np.ndarray, " node"], torque: Float[np.ndarray, " node"]) -> Float[np.ndarray, " param"]:
    """Sizes of the parameters by the range of a curve."""
    top, scale = np.max(np.abs(v)), max(float(np.max(np.abs(torque))), 1e-9)
    return np.array([scale, scale, top, scale / top, top, scale])


def _fit_joint(
    v: Float[np.ndarray, " node"], torque: Float[np.ndarray, " node"], cov: Float[np.ndarray, "node node"]
) -> LawFit:
    wide = _range(v, torque)
    cov = cov + np.diag(0.01 * np.diag(cov) + (0.005 * wide[0]) ** 2)
    whitener = solve_triangular(np.linalg.cholesky(cov), np.eye(len(v)), lower=True)
    value = nearest(v, torque, whitener)
    jac = _slopes(value, v) * wide
    white = whitener @ jac
    posterior = np.linalg.inv(white.T @ white + np.eye(6))
    unexplained = np.diag(cov) - np.sum((jac @ posterior) * jac, axis=1)
    std = wide * np.sqrt(np.diag(posterior))
    return LawFit(value, std, v, torque - curve(value, v), np.sqrt(np.maximum(unexplained, (0.005 * wide[0]) ** 2)))


def describe(fit: LawFit, names: tuple[str, ...], angles: tuple[bool, ...]) -> list[str]:
    """One sentence per joint: the numbers of the law, what the curve leaves open, and where it is another curve."""
    return [
        f"{name}: "
        + ", ".join(_terms(np.asarray(fit.value[j]), np.asarray(fit.std[j]), LAW_UNITS[angle]))
        + "; "
        + _where(fit, j, LAW_UNITS[angle][2])
        for j, (name, angle) in enumerate(zip(names, angles, strict=True))
    ]


def _terms(value: Float[np.ndarray, " param"], std: Float[np.ndarray, " param"], units: tuple[str, ...]) -> list[str]:
    open_ = (std > value) & (np.asarray(PARAMETERS) != "offset")
    return [
        f"{word} not determined" if o else f"{word} {v:.3g} ± {s:.1g} {unit}"
        for word, v, s, unit, o in zip(CALLED, value, std, units, open_, strict=True)
    ]


def _where(fit: LawFit, joint: int, unit: str) -> str:
    """The runs of velocities at which the curve departs from the law, in words."""
    velocity, departs = np.asarray(fit.velocity[joint]), np.asarray(fit.departs[joint])
    if not departs.any():
        return "the curve agrees with this law within 2 standard deviations."
    edges = np.flatnonzero(np.diff(np.concatenate([[False], departs, [False]]).astype(int)))
    runs = [f"{velocity[a]:.2g} to {velocity[b - 1]:.2g}" for a, b in zip(edges[::2], edges[1::2], strict=True)]
    return f"the curve departs from this law at {', '.join(runs)} {unit}."
