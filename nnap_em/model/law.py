"""The engineer's friction law, and how well it describes a learned curve."""

import itertools
from collections.abc import Callable
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

    Levels are in N m, velocities in rad/s, viscous friction in N m s/rad. [Armstrong-Helouvry, Dupont & Canudas de Wit
    1994, Automatica 30(7), sec. 2, with a smooth sign]
    """

    coulomb: Float[Array, " dof"]
    breakaway: Float[Array, " dof"]
    stribeck: Float[Array, " dof"]
    viscous: Float[Array, " dof"]
    smooth: Float[Array, " dof"]

    def __call__(self, v: Float[Array, " dof"]) -> Float[Array, " dof"]:
        """Friction torque at joint velocities [N m]."""
        level = self.coulomb + (self.breakaway - self.coulomb) * jnp.exp(-((v / self.stribeck) ** 2))
        return -(level * jnp.tanh(v / self.smooth) + self.viscous * v)


PARAMETERS = ("coulomb", "breakaway", "stribeck", "viscous", "smooth", "offset")
"""The five of StribeckLaw, and a constant torque: half the difference of the Coulomb levels of both directions."""

SHAPE = np.isin(PARAMETERS, ("breakaway", "stribeck", "smooth"))
"""Those that are the shape of friction near rest."""

CALLED = ("Coulomb", "breakaway", "Stribeck velocity", "viscous", "sign smoothed over", "constant")
"""Words for PARAMETERS."""

LAW_UNITS = {True: ("N m", "N m", "rad/s", "N m s/rad", "rad/s", "N m"), False: ("N", "N", "m/s", "N s/m", "m/s", "N")}
"""Units of PARAMETERS, by whether the coordinate is an angle."""


CROSSED = 2
"""Multiple of the Stribeck velocity, and of that over which the sign changes, from which on a change of velocity in one
row passes all of its range: they and the breakaway torque are then not stated.

Of 46 sets of logs of a slide and a pendulum 40 breakaway torques would be stated, 31 of them within two standard
deviations, the worst 11 away; with this 29 are, 24 within.
"""


class LawFit(NamedTuple):
    """The Stribeck law nearest to a learned curve, per joint; the columns are PARAMETERS."""

    value: Float[np.ndarray, "dof param"]
    std: Float[np.ndarray, "dof param"]
    """Half the distance from the value within which 95 % of the posterior lies; where the curve leaves a number
    undetermined, that of the prior: the curve's whole range."""
    velocity: Float[np.ndarray, "dof node"]
    """[rad/s]"""
    difference: Float[np.ndarray, "dof node"]
    """Curve minus law [N m]."""
    difference_std: Float[np.ndarray, "dof node"]
    passed: Float[np.ndarray, " dof"]
    """Speed that is less than a row from rest [rad/s]; 0: none."""

    @property
    def departs(self) -> Bool[np.ndarray, "dof node"]:
        """Velocities at which the curve is not this law: more than 2 standard deviations away."""
        return np.abs(self.difference) > 2 * self.difference_std


def fit_law(
    velocity: Float[Array | np.ndarray, "dof node"],
    torque: Float[Array | np.ndarray, "dof node"],
    cov: Float[Array | np.ndarray, "dof node node"],
    passed: Float[np.ndarray, " dof"] | None = None,
) -> LawFit:
    """Generalised least squares of the Stribeck law to a table of torque [N m] over velocity [rad/s], joint by joint.

        value = argmin |L^-1 (torque - law)|^2,  L L' = cov + nugget,  std by draws from the posterior

    The nugget (a tenth of the torque's standard deviation, half a percent of its range) is what the shape of the
    learned curve itself may err where its covariance is all but singular. NaN is what rows cross (`CROSSED`), by the
    speed that is `passed` in one.
    """
    passed = np.zeros(len(velocity)) if passed is None else passed
    joints = [_fit_joint(*map(np.asarray, table)) for table in zip(velocity, torque, cov, passed, strict=True)]
    return LawFit(*(np.stack(column) for column in zip(*joints, strict=True)))


def passed(velocity: Float[np.ndarray, "row dof"], nodes: Float[np.ndarray, "dof node"]) -> Float[np.ndarray, " dof"]:
    """Largest speed of the `nodes` of each joint that is less than a row from rest: of the rows that pass it most
    change the velocity by more [rad/s]; 0: none.
    """
    out = np.zeros(len(nodes))
    for joint, (v, speeds) in enumerate(zip(velocity.T, np.abs(nodes), strict=True)):
        low, high = np.sort([v[:-1], v[1:]], axis=0)
        for speed in np.unique(speeds):
            across = ((low < speed) & (speed < high)) | ((low < -speed) & (-speed < high))
            if across.any() and np.median((high - low)[across]) > speed:
                out[joint] = speed
    return out


def curve(value: Float[np.ndarray, "param ..."], v: Float[np.ndarray, " node"]) -> Float[np.ndarray, "... node"]:
    """Torque of the law over velocity [N m], the constant included; of several laws with axes (param, law, 1)."""
    coulomb, breakaway, stribeck, viscous, smooth, offset = value
    level = coulomb + (breakaway - coulomb) * np.exp(-((v / stribeck) ** 2))
    return offset - level * np.tanh(v / np.maximum(smooth, 1e-150)) - viscous * v  # 0: narrower than any number


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
    posterior = _posterior(v, torque, whitener)
    return posterior.natural(posterior.modes(dip, constant)[0][1])


class _Posterior(NamedTuple):
    """The law of a curve, by z: the logarithms of its numbers in the sizes of the curve, and the constant torque.

    Logarithms keep the first five positive and the breakaway torque above the Coulomb torque.
    """

    v: Float[np.ndarray, " node"]
    torque: Float[np.ndarray, " node"]
    whitener: Float[np.ndarray, "node node"]
    wide: Float[np.ndarray, " param"]
    """Sizes of the numbers by the range of the curve."""

    def natural(self, z: Float[np.ndarray, "... param"]) -> Float[np.ndarray, "... param"]:
        """PARAMETERS of laws."""
        value = self.wide * np.concatenate([np.exp(z[..., :5]), z[..., 5:]], axis=-1)
        value[..., 1] += value[..., 0]
        return value

    def residual(self, z: Float[np.ndarray, "law param"]) -> Float[np.ndarray, "law row"]:
        """Residuals of laws, those of a prior behind them that only holds what the curve does not determine."""
        value = self.natural(z)
        away = (self.torque - curve(value.T[..., None], self.v)) @ self.whitener.T
        levels = np.stack([value[:, 0], value[:, 1] - value[:, 0], value[:, 3], value[:, 5]], 1)
        times = (z[:, [2, 4]] - np.log([0.1, 0.02])) / 2.0
        return np.concatenate([away, levels / self.wide[[0, 1, 3, 5]], times], axis=1)

    def log_density(self, z: Float[np.ndarray, "law param"]) -> Float[np.ndarray, " law"]:
        """Levels are as likely before as they are wide, not as their logarithms."""
        return np.sum(z[:, [0, 1, 3]], axis=1) - 0.5 * np.sum(self.residual(z) ** 2, axis=1)

    def modes(self, dip: bool = True, constant: bool = True) -> list[tuple[float, Float[np.ndarray, " param"]]]:
        """Cost and place of minima from several starts, the best first."""
        free, fits, no_dip = np.array([True, dip, dip, True, True, constant]), [], -200.0  # its logarithm
        for knee, sharpness in itertools.product(np.log([0.02, 0.1, 0.4]) if dip else [0.0], np.log([0.02, 0.1, 0.4])):
            start = np.array([np.log(0.3), np.log(0.3) if dip else no_dip, knee, np.log(0.3), sharpness - 1.5, 0.0])
            fits.append(self._mode(start, free))
        return sorted(fits, key=lambda fit: fit[0])

    def _mode(
        self, start: Float[np.ndarray, " param"], free: Bool[np.ndarray, " param"]
    ) -> tuple[float, Float[np.ndarray, " param"]]:
        """Cost and place of the minimum that is reached from a start where some numbers are `free`."""

        def residuals(z):
            laws = np.tile(start, (len(z), 1))
            laws[:, free] = z
            return self.residual(laws)

        def slopes(z):
            """Forward differences of all numbers in one call, over the root of the precision as SciPy takes them."""
            step = np.sqrt(np.finfo(float).eps) * np.maximum(np.abs(z), 1.0)
            off = residuals(np.vstack([z, z + np.diag(step)]))
            return ((off[1:] - off[0]) / step[:, None]).T

        with np.errstate(over="ignore"):  # a step too far: the next one is shorter
            fit = least_squares(lambda z: residuals(z[None])[0], start[free], slopes, method="lm", xtol=1e-8)  # type: ignore[arg-type]
        place = start.copy()
        place[free] = fit.x
        return float(fit.cost), place


def _posterior(
    v: Float[np.ndarray, " node"], torque: Float[np.ndarray, " node"], whitener: Float[np.ndarray, "node node"]
) -> _Posterior:
    """With the sizes of its numbers by the range of the curve."""
    top, scale = np.max(np.abs(v)), max(float(np.max(np.abs(torque))), 1e-9)
    return _Posterior(v, torque, whitener, np.array([scale, scale, top, scale / top, top, scale]))


def _fit_joint(
    v: Float[np.ndarray, " node"], torque: Float[np.ndarray, " node"], cov: Float[np.ndarray, "node node"], passed
) -> LawFit:
    least = (0.005 * max(float(np.max(np.abs(torque))), 1e-9)) ** 2
    cov = cov + np.diag(0.01 * np.diag(cov) + least)
    whitener = np.asarray(solve_triangular(np.linalg.cholesky(cov), np.eye(len(v)), lower=True))
    posterior = _posterior(v, torque, whitener)
    costs, places = map(np.asarray, zip(*posterior.modes(), strict=True))
    likely, random = np.exp(costs[0] - costs), np.random.default_rng(0)
    begin = places[random.choice(len(places), 48, p=likely / likely.sum())]
    with np.errstate(over="ignore", invalid="ignore"):  # laws beyond all numbers are not accepted
        draws = _draws(posterior.log_density, begin + 0.05 * random.standard_normal(begin.shape), random)
    draws, value = posterior.natural(draws), posterior.natural(places[0])
    std = 0.5 * np.quantile(np.abs(draws - value), 0.9545, axis=0)  # of a normal distribution within two
    unexplained = np.diag(cov) - np.var(curve(draws[::48].T[..., None], v), axis=0)
    difference, fast = torque - curve(value, v), CROSSED * value < passed
    value, std = (np.where(fast[[0, 2, 2, 0, 4, 0]] & SHAPE, np.nan, number) for number in (value, std))
    return LawFit(value, std, v, difference, np.sqrt(np.maximum(unexplained, least)), passed)


def _draws(
    log_density: Callable[[Float[np.ndarray, "walker param"]], Float[np.ndarray, " walker"]],
    walkers: Float[np.ndarray, "walker param"],
    random: np.random.Generator,
    moves: int = 600,
) -> Float[np.ndarray, "draw param"]:
    """Draws from a density that may bend and have several modes, by moving `walkers` that are near its modes.

    Each is stretched towards or away from one of the other half; the first third is left out, and 48 walkers repeat a
    standard deviation within 10 %. [Goodman & Weare 2010, Commun. Appl. Math. Comput. Sci. 5(1)]
    """
    level, draws = log_density(walkers), []
    for _ in range(moves):
        halves = np.array_split(random.permutation(len(walkers)), 2)
        for moving, still in (halves, halves[::-1]):
            stretch = (1 + random.uniform(size=len(moving))) ** 2 / 2
            origin = walkers[random.choice(still, len(moving))]
            trial = origin + stretch[:, None] * (walkers[moving] - origin)
            new, bar = log_density(trial), level[moving] + np.log(random.uniform(size=len(moving)))
            accepted = new + (walkers.shape[1] - 1) * np.log(stretch) > bar
            walkers[moving[accepted]], level[moving[accepted]] = trial[accepted], new[accepted]
        draws.append(walkers.copy())
    return np.concatenate(draws[moves // 3 :])


def describe(fit: LawFit, names: tuple[str, ...], angles: tuple[bool, ...]) -> list[str]:
    """One sentence per joint: the numbers of the law, what the curve leaves open, and where it is another curve."""
    out = []
    for j, (name, angle) in enumerate(zip(names, angles, strict=True)):
        numbers = zip(CALLED, fit.value[j], fit.std[j], LAW_UNITS[angle], strict=True)
        terms = [
            f"{word} {v:.3g} ± {s:.1g} {unit}" if s <= v or word == CALLED[-1] else f"{word} not determined"
            for word, v, s, unit in numbers  # NaN is not determined
        ]
        out.append(f"{name}: {', '.join(terms)}; {_where(fit, j, LAW_UNITS[angle][2])}")
    return out


def _where(fit: LawFit, joint: int, unit: str) -> str:
    """Reason of numbers that are NaN, and the runs of velocities at which the curve departs from the law, in words."""
    fast = f"{fit.passed[joint]:.2g} {unit} is less than a row from rest, so that its shape there is not seen; "
    fast = fast if np.isnan(fit.value[joint]).any() else ""
    if not fit.departs[joint].any():
        return f"{fast}the curve agrees with this law within 2 standard deviations."
    edges = np.flatnonzero(np.diff(fit.departs[joint].astype(int), prepend=0, append=0))
    ends = [[f"{fit.velocity[joint][i]:.2g}" for i in (a, b - 1)] for a, b in edges.reshape(-1, 2)]
    runs = [" to ".join(dict.fromkeys(pair)) for pair in ends]
    return f"{fast}the curve departs from this law at {', '.join(runs)} {unit}."
