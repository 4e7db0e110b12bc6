"""Regression of the logged torques on the declared inverse dynamics, and on those of a log with a mistake corrected.

    tau = M(q) a + c(q, v) + g(q) + friction(v)

Friction is any static map, and uncertain numbers may move within `WITHIN` of their std.  Readings are differentiated in
short windows; the rest of their noise is taken out of both sides by one low-pass, since a torque and an acceleration
that were smoothed in different ways do not agree [Gautier 1997, ICRA, "Dynamic identification of robots with power
model"].
"""

import itertools
import math
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import orth
from scipy.optimize import least_squares
from scipy.signal import savgol_coeffs

from ..estimate.em.prior import ParameterPrior, declared_prior
from ..estimate.em.servos import build_servos
from ..estimate.identifiability import not_identifiable
from ..logs.dataset import Dataset
from ..logs.noise import reading_noise
from ..machines.rig import HOLD, SMOOTH, Rig
from ..machines.systems import AbstractSystem
from ..model import hooks

WIDTH, ORDER = 7, 4
"""Rows and degree of the polynomials that differentiate: a short window hardly bends a fast motion."""
ACCEL_NOISE = 3e-3
"""Noise of a filtered acceleration as a share of its size: half of the smallest misfit that counts."""
PIECE_ROWS, PIECES = 300, 15
"""Rows of a piece of the logs, and number of pieces, evenly over them."""
KNOTS = 13
"""Velocities between which the friction map of a joint is straight."""
FILTERED_ROWS = 5 * KNOTS
"""Filtered rows below which nothing is concluded."""
WITHIN = 3.0
"""Standard deviations within which an uncertain number may move; masses, lengths and inertias remain positive."""
PASSES = 6
"""Evaluations of the torques in a fit of uncertain numbers: products of three of them bend."""
SMALLEST_MISFIT = 5e-5
"""Share of the squared torque that may stay unexplained: 0.7 % of the torque, as a zero off by 0.4 degrees leaves."""
LARGEST_REMAINDER = 0.25
"""Largest ratio of the unexplained with a named mistake corrected to that without: 0.6 and more on seven double
pendulums and a servo as recorded; the right correction leaves 0.3 at most at its joint, but for small zeros."""
UNEXPLAINED = 0.2
"""Largest share of the squared torque that a named mistake leaves unexplained."""
UNIT_FACTOR = 1.5
"""Factor from which on a torque is in another unit; less may be the gain of a motor, or a mass."""
TRIANGLE = {HOLD: (0.5, 0.5, 0.0), SMOOTH: (1 / 12, 5 / 6, 1 / 12)}
"""Weights of the row before, a row and the next in the force in a second difference, a mean over both intervals
with a triangle as its weight: of inputs that are held, and of smooth ones [Numerov 1924]."""
ERROR_BLOCKS = 20
"""Blocks of rows whose errors are taken as independent."""
LATE, SURE_LAG, WITHOUT_LAG = 0.25, 5.0, 0.75
"""Lag that counts [rows, and its standard deviations], and share of the unexplained squared torque that it leaves: 0.85
and more on double pendulums and a servo as recorded, 0.03 of a load cell at 25 Hz that was declared as held."""
REACH = 6
"""Largest lag of a torque that is looked for [rows]."""


class Lag(NamedTuple):
    """The time by which an input acts later than its declared hold has it."""

    rows: float
    """Below 0 where it acts earlier [rows]."""
    std: float
    """Standard deviation of it, by blocks of rows."""
    remains: float
    """Squared torque that stays unexplained with it, over that without it."""

    @property
    def counts(self) -> bool:
        """True where it is nearer to half a row, by which held and smooth inputs differ, than to none, and explains."""
        certain = max(LATE, SURE_LAG * self.std) < abs(self.rows) < REACH - 1
        return certain and self.remains < WITHOUT_LAG


class Explanation(NamedTuple):
    """A correction of the log, and the part of the torques that stays unexplained with it."""

    remains: Float[np.ndarray, " dof"]
    """Share of the squared torque of each joint that stays unexplained."""
    text: str = ""
    ruins: bool = True
    """True where a fit to the log as it is would be in vain."""


class Motion(NamedTuple):
    """Motion in pieces of the logs, in short windows, and the filters by which both sides are compared."""

    q: Float[np.ndarray, "piece time dof"]
    v: Float[np.ndarray, "piece time dof"]
    a: Float[np.ndarray, "piece time dof"]
    torque: Float[np.ndarray, "piece time input"]
    """Generalised force of every input, mean over the intervals before and behind a row, as `TRIANGLE` [N m, or N]."""
    braking: Float[np.ndarray, "piece time input"]
    """Part of it that is back-EMF of a `voltage` drive while its command is 0."""
    inertial: Float[np.ndarray, " tap"]
    """Filter of what holds an acceleration."""
    direct: Float[np.ndarray, "dof tap"]
    """Filter of all else, which has the window of the joint's acceleration in it."""


class Regression(NamedTuple):
    """Logged torques and those that the declared machine needs, filtered alike; rows are those without a gap."""

    system: AbstractSystem
    motion: Motion
    prior: ParameterPrior
    """Uncertain numbers of the machine."""
    least: Float[np.ndarray, " param"]
    """Smallest changes of these numbers [std]."""
    rows: Bool[np.ndarray, "piece time"]
    inputs: Float[np.ndarray, "row input"]
    friction: list[Float[np.ndarray, "row direction"]]
    """Orthonormal directions of the friction map of every joint."""
    plain: Float[np.ndarray, "part row dof"]
    """Torques of inertia, of velocities and of gravity along the log as it is."""

    @property
    def size(self) -> Float[np.ndarray, " dof"]:
        """Size of the torque that the declared machine needs [N m, or N]."""
        inertia, velocity, gravity = self.plain
        return np.sqrt(np.var(inertia + velocity, axis=0) + np.var(gravity, axis=0)) + 1e-300

    @property
    def driven(self) -> list[int]:
        """Joints of the inputs, counted from 0; one input each."""
        return [joint - 1 for joint in self.system.joints]

    def parts(
        self,
        moved: np.ndarray | float = 0.0,
        *,
        sign: np.ndarray | float = 1.0,
        shift: np.ndarray | float = 0.0,
        gravity: np.ndarray | float = 1.0,
        slopes: bool = False,
    ) -> Float[np.ndarray, "part row dof *param"]:
        """Torques of inertia, velocities and gravity with numbers so many std from their mean, or the slopes by them.

        The coordinates are sign (reading - shift), and of every joint's gravity a share counts.
        """
        motion, share = self.motion, gravity * np.ones(len(self.system.coordinates))
        moved = moved * np.ones(self.prior.size)
        rows = ((sign * part).reshape(-1, len(share)) for part in (motion.q - shift, motion.v, motion.a))
        parts = np.asarray(_torques(self.system, self.prior, *map(jnp.asarray, (moved, share, *rows)), slopes=slopes))
        inertia, *others = np.moveaxis(parts.reshape(*motion.q.shape[:2], *parts.shape[1:]), 2, 0)
        both = [filtered(inertia, motion.inertial), *(_by_joint(part, motion.direct) for part in others)]
        return np.stack(both)[:, self.rows]

    def remains(self, inputs: Float[np.ndarray, "row input"] | None = None, **change) -> Float[np.ndarray, " dof"]:
        """Share of the squared torque that stays unexplained, by joint, with other inputs or changes of `parts`."""
        applied = self.applied(self.inputs if inputs is None else inputs)

        def error(moved: np.ndarray) -> np.ndarray:
            return self.beyond(self.parts(moved, **change).sum(axis=0) - applied).ravel()

        def slopes(moved: np.ndarray) -> np.ndarray:
            return self.beyond(self.parts(moved, **change, slopes=True).sum(axis=0)).reshape(-1, len(moved))

        moved = np.zeros(self.prior.size)
        if len(moved):
            moved = least_squares(error, moved, slopes, (self.least, WITHIN), max_nfev=PASSES).x
        return np.mean(error(moved).reshape(applied.shape) ** 2, axis=0)

    def applied(self, inputs: Float[np.ndarray, "row input"]) -> Float[np.ndarray, "row dof"]:
        """Generalised force of the inputs."""
        out = np.zeros((len(inputs), len(self.size)))
        out[:, self.driven] = inputs
        return out

    def beyond(self, torque: Float[np.ndarray, "row dof *any"]) -> Float[np.ndarray, "row dof *any"]:
        """Part of a torque that no static friction explains, in units of `size`."""
        columns = zip(np.moveaxis(torque, 1, 0), self.friction, self.size, strict=True)
        return np.stack([(one - basis @ (basis.T @ one)) / size for one, basis, size in columns], axis=1)


def motion_along(rig: Rig, system: AbstractSystem, data: Dataset) -> Motion | None:
    """Motion along the logs; None where a coordinate is hardly read, or an input is neither a torque nor a voltage.

    Numbers of a drive are as declared: the friction map takes up an error of its back-EMF.
    """
    read, coordinates = rig.measured, list(zip(system.coordinates, system.rates, system.angles, strict=True))
    seen = all(name in read or (rate in read and not turns) for name, rate, turns in coordinates)
    servos, valid = build_servos(rig), np.asarray(data.valid)
    if not seen or rig.scale_columns or not {*rig.kinds.values()} <= {"torque", "voltage"}:
        return None
    fed = np.asarray(data.u, float)[..., : len(system.joints)]
    still, sampled = fed == 0, hooks.Sampling(rig.dt, rig.input_hold == SMOOTH)
    if servos:
        fed = jax.vmap(lambda u: hooks.arriving((), servos, system, u, sampled.through)[0])(jnp.asarray(fed))
    y, u, still = (_pieces(np.asarray(part, float), valid) for part in (data.y, fed, still))
    value, slope, bend = (savgol_coeffs(WIDTH, ORDER, deriv, rig.dt, use="dot") for deriv in range(3))
    # an acceleration is the mean of the true one with a window, of readings of the position or of the rate
    of_position, of_rate = np.cumsum(np.cumsum(bend))[:-2] * rig.dt**2, -np.cumsum(slope)[:-1] * rig.dt
    ways = (slope, bend, np.pad(of_position, 1)), (value, slope, np.convolve(of_rate, [0.5, 0.5]))
    columns, joints, sources = dict(zip(read, np.moveaxis(y, -1, 0), strict=True)), [], []
    for name, rate, _ in coordinates:
        both = zip((name, rate), ways, strict=True)
        options = [(key, reading_noise(columns[key]), *way) for key, way in both if key in columns]
        key, noise, first, second, window = min(options, key=lambda option: option[1] * np.linalg.norm(option[3]))
        v, a = filtered(columns[key], first), filtered(columns[key], second)
        q = filtered(columns[name], value) if name in columns else np.nancumsum(v, axis=1) * rig.dt
        joints.append((q, v, a))
        sources.append((noise, second, window))
    q, v, a = (np.stack(part, axis=-1) for part in zip(*joints, strict=True))
    low = None
    # Rows of the low-pass: the first that leaves accelerations a noise below `ACCEL_NOISE`, else the last that fits
    for length in (length for length in (9, 15, 25, 41, 61) if 2 * length < a.shape[1]):
        bell = np.hanning(length + 2)[1:-1] / np.hanning(length + 2).sum()
        passed = filtered(a, bell)
        passed = passed[np.isfinite(passed).all(axis=-1)]
        if len(passed) < FILTERED_ROWS:
            break
        low, size = bell, np.sqrt(np.mean(passed**2, axis=0))
        if np.all([n * np.linalg.norm(np.convolve(taps, low)) for n, taps, _ in sources] <= ACCEL_NOISE * size):
            break
    if low is None:
        return None
    edge = WIDTH // 2
    both = (filtered(part, np.array(TRIANGLE[rig.input_hold])) for part in (u, still))
    torque, still = (np.pad(part, ((0, 0), (1, 1), (0, 0)), constant_values=np.nan)[:, edge:-edge] for part in both)
    braking = np.zeros_like(torque)
    if servos:
        driven = jax.vmap(jax.vmap(lambda u, q, v: hooks.driven((), servos, system, u, q, v)))
        torque, unfed = (np.asarray(driven(*map(jnp.asarray, (u, q, v)))) for u in (torque, braking))
        volts = np.array([servo.kind == "voltage" for servo in servos])
        braking = np.where((still > 0) & volts, still * unfed, 0.0)
    gears = np.asarray(system.gears)
    direct = np.stack([np.convolve(low, window) for *_, window in sources])
    return Motion(q, v, a, torque * gears, braking * gears, np.pad(low, edge), direct)


def regression(rig: Rig, system: AbstractSystem, data: Dataset) -> Regression | None:
    """Both sides of the inverse dynamics along the logs; None where they do not show one of them."""
    motion = motion_along(rig, system, data)
    if motion is None:
        return None
    held = not_identifiable(rig, system, data)
    uncertain = {name: of for name, of in rig.parameters.items() if of.std and name in rig.bodies and name not in held}
    prior = declared_prior(uncertain)
    positive = [of.mean > 0 and ("." not in n or n.endswith(("mass", "armature"))) for n, of in uncertain.items()]
    least = np.where(positive, np.maximum(-WITHIN, -prior.mean / prior.std), -WITHIN)
    inputs = _by_joint(motion.torque, motion.direct[[joint - 1 for joint in system.joints]])
    maps = [filtered(_hats(motion.v[..., j]), taps) for j, taps in enumerate(motion.direct)]
    full = np.ones(inputs.shape[:2], bool)
    problem = Regression(system, motion, prior, least, full, inputs, [], inputs)
    plain = problem.parts().reshape(3, *full.shape, -1)
    rows = np.all([np.isfinite(part).all(axis=-1) for part in (*plain, inputs, *maps)], axis=0)
    if rows.sum() < FILTERED_ROWS:
        return None
    friction = [_directions(one[rows]) for one in maps]
    return problem._replace(rows=rows, inputs=inputs[rows], friction=friction, plain=plain[:, rows])


def explanations(rig: Rig, problem: Regression) -> Iterator[Explanation]:
    """Every mistake that a log may have, corrected."""
    for text, ruins, change in _corrections(rig, problem):
        yield Explanation(problem.remains(**change), text, ruins)


def _corrections(rig: Rig, problem: Regression) -> Iterator[tuple[str, bool, dict[str, np.ndarray]]]:
    """Mistakes with their hint, whether a fit would be in vain, and the changes of `remains` that correct them."""
    names, inputs, motion, eye = rig.input_columns, problem.inputs, problem.motion, np.eye(len(problem.size))
    slopes = gains(problem)
    if text := "; ".join(_in_other_units(rig, problem.system, slopes)):
        yield text, True, {"inputs": slopes * inputs}
    if coasting := [name for i, name in enumerate(names) if motion.braking[..., i].any()]:
        text = f'{" and ".join(coasting)}: at 0 V the drive does not brake, it coasts, and kind = "voltage" has its '
        text += "back-EMF there, too: set the driver to brake, or leave rows at 0 V out"
        yield text, False, {"inputs": inputs - _by_joint(motion.braking, motion.direct[problem.driven])[problem.rows]}
    for i, j in itertools.combinations(range(len(names)), 2):
        order = np.arange(len(names))
        order[[i, j]] = j, i
        yield f"{names[i]} and {names[j]} are swapped: exchange the columns", True, {"inputs": inputs[:, order]}
    without = _weightless(problem)
    if weightless := [name for name, joint in zip(names, problem.driven, strict=True) if without[joint]]:
        text = f"{' and '.join(weightless)}: the gravity of the declared bodies is not in it: log the whole torque of "
        text += "the motor, with what a controller adds against gravity; or a spring or counterweight bears it"
        yield text, False, {"gravity": 1.0 - without}
    for name, rate, axis in zip(problem.system.coordinates, problem.system.rates, eye, strict=True):
        text = f"{name} counts in the other direction than that of the machine: multiply it by -1, and {rate}"
        yield text, True, {"sign": 1 - 2 * axis}
    for joint, bias in _zeros(problem):
        text = f"{problem.system.coordinates[joint]} reads {bias:.3g} rad ({np.degrees(bias):.3g} degrees) more than "
        text += "it is: subtract that" + ", or level the base, which is tilted by the opposite" * (joint == 0)
        yield text, False, {"shift": bias * eye[joint]}


def gains(problem: Regression) -> Float[np.ndarray, " input"]:
    """Slope of the needed torque by every input; declared numbers are held, or all would shrink together."""
    needed, fed = problem.beyond(problem.plain.sum(axis=0)), problem.beyond(problem.applied(problem.inputs))
    return (np.sum(fed * needed, axis=0) / np.maximum(np.sum(fed**2, axis=0), 1e-300))[problem.driven]


def lag(problem: Regression, i: int) -> Lag:
    """Lag of input i at which its torque agrees best with the inverse dynamics, friction and uncertain numbers free.

    The best whole number of rows, then one step of Gauss and Newton.
    """
    joint, motion, torque = problem.driven[i], problem.motion, problem.motion.torque[..., i]
    free = np.concatenate([problem.friction[joint], problem.parts(slopes=True).sum(axis=0)[:, joint]], axis=1)
    far = np.pad(torque, ((0, 0), (REACH, REACH)), constant_values=np.nan)
    shifts = range(-REACH, REACH + 1)
    late = [filtered(far[:, REACH - k :][:, : torque.shape[1]], motion.direct[joint])[problem.rows] for k in shifts]
    inside = np.isfinite(late).all(axis=0)
    if inside.sum() < FILTERED_ROWS:
        return Lag(0.0, math.inf, 1.0)
    misfits, free = (problem.plain.sum(axis=0)[:, joint] - late)[:, inside], _directions(free[inside])
    misfits -= (misfits @ free) @ free.T
    best = 1 + int(np.argmin(np.sum(misfits[1:-1] ** 2, axis=1)))
    moved = 0.5 * (misfits[best - 1] - misfits[best + 1])
    size = float(moved @ moved) + 1e-300
    rows = float(moved @ misfits[best]) / size
    blocks = np.array_split(moved * (misfits[best] - rows * moved), ERROR_BLOCKS)
    std = math.sqrt(sum(float(block.sum()) ** 2 for block in blocks)) / size
    remains = float(np.sum((misfits[best] - rows * moved) ** 2) / np.sum(misfits[REACH] ** 2))
    return Lag(shifts[best] + rows, std, remains)


def _in_other_units(rig: Rig, system: AbstractSystem, slopes: Float[np.ndarray, " input"]) -> Iterator[str]:
    """Inputs of the wrong sign or in another unit."""
    for name, joint, gain in zip(rig.input_columns, system.joints, slopes, strict=True):
        same = 1 / UNIT_FACTOR < abs(gain) < UNIT_FACTOR
        if same and gain < 0:
            yield f"{name} has the wrong sign (its motor gain is {gain:.3g}): multiply it by -1"
        elif not same and gain != 0:
            wrong = "of the wrong sign and " if gain < 0 else ""
            text = f"{name} is {wrong}in another unit: multiply it by {gain:.3g} to have {system.force_unit(joint)} ("
            text += "a current, per mille of a rated torque, a torque before the gear?)"
            yield f"{text}; or masses and lengths are not in kg and m"


def _weightless(problem: Regression) -> Bool[np.ndarray, " dof"]:
    """Joints whose torque holds none of the declared gravity."""
    inertia, velocity, gravity = problem.plain
    rest, weight = problem.beyond(inertia + velocity - problem.applied(problem.inputs)), problem.beyond(gravity)
    share = -np.sum(rest * weight, axis=0) / np.maximum(np.sum(weight**2, axis=0), 1e-300)
    carried = 0.3  # share of the declared gravity below which a torque holds none of it
    return (np.abs(share) < carried) & (np.std(weight, axis=0) > 0)


TURNS = 5
"""Zeros that determine the torques at every other: they are trigonometric polynomials of degree two in the angle of a
hinge, since M and c are quadratic in rotations and g is linear."""


def _zeros(problem: Regression) -> Iterator[tuple[int, float]]:
    """Joints with an angle, and what it reads too much at best [rad], which follows from torques at a few."""
    applied, tried = problem.applied(problem.inputs), 2 * np.pi / TURNS * np.arange(TURNS)
    waves = lambda b: np.stack([np.ones_like(b), np.cos(b), np.sin(b), np.cos(2 * b), np.sin(2 * b)], axis=-1)  # noqa: E731
    fine = np.linspace(-np.pi, np.pi, 3601)
    for joint in np.flatnonzero(problem.system.angles):
        axis = np.eye(len(problem.size))[joint]
        errors = [problem.beyond(problem.parts(shift=b * axis).sum(axis=0) - applied).ravel() for b in tried]
        amplitudes = np.linalg.solve(waves(tried), np.stack(errors))
        squares = np.einsum("bi,ij,bj->b", waves(fine), amplitudes @ amplitudes.T, waves(fine))
        yield int(joint), float(fine[np.argmin(squares)])


def mistakes(found: Iterable[Explanation], plain: Float[np.ndarray, " dof"]) -> list[Explanation]:
    """Mistakes whose correction explains torques of which the log as it is leaves the share `plain`; best first.

    None where the best correction explains no joint much better, or where it explains little.
    """
    total = lambda one: float(np.sum(np.log(np.maximum(one.remains, SMALLEST_MISFIT / 10))))  # noqa: E731
    ranked = sorted([Explanation(plain), *found], key=total)
    explained = (ranked[0].remains <= LARGEST_REMAINDER * plain) & (ranked[0].remains <= UNEXPLAINED)
    if not np.any(explained & (plain > SMALLEST_MISFIT)):
        return []
    tied = 1.1  # ratio of the unexplained of two corrections up to which both mistakes are named
    return [one for one in ranked if total(one) <= total(ranked[0]) + len(plain) * math.log(tied)]


@eqx.filter_jit
def _torques(system: AbstractSystem, prior: ParameterPrior, moved, share, q, v, a, *, slopes: bool):
    """Torques of inertia, velocities and gravity by row, or their slopes by numbers that are so far from their mean."""

    def torques(moved, q, v, a):
        machine = prior.write(system, moved)
        gravity = machine.bias(q, jnp.zeros_like(v))
        return jnp.stack([machine.mass(q) @ a, machine.bias(q, v) - gravity, share * gravity])

    return jax.vmap(jax.jacfwd(torques) if slopes else torques, (None, 0, 0, 0))(moved, q, v, a)


def filtered(x: Float[np.ndarray, "piece time *any"], taps: Float[np.ndarray, " tap"]) -> np.ndarray:
    """Sums of whole windows with the weights `taps`, NaN where a row of the window is."""
    return np.lib.stride_tricks.sliding_window_view(x, len(taps), axis=1) @ taps


def _by_joint(x: Float[np.ndarray, "piece time joint *any"], taps: Float[np.ndarray, "joint tap"]) -> np.ndarray:
    """`filtered`, of every joint with weights of its own."""
    return np.einsum("ptj...w,jw->ptj...", np.lib.stride_tricks.sliding_window_view(x, taps.shape[1], axis=1), taps)


def _pieces(values: Float[np.ndarray, "seq time column"], valid: Bool[np.ndarray, "seq time"]) -> np.ndarray:
    """Pieces of about `PIECE_ROWS` rows, evenly over all sequences, `PIECES` at most; a short one ends in NaN."""
    count = np.maximum(1, np.round(valid.sum(axis=1) / PIECE_ROWS).astype(int))
    parts = [part for rows, ok, n in zip(values, valid, count, strict=True) for part in np.array_split(rows[ok], n)]
    parts = [parts[i] for i in np.unique(np.linspace(0, len(parts) - 1, PIECES).astype(int))]
    out = np.full((len(parts), max(map(len, parts)), values.shape[-1]), np.nan)
    for place, part in zip(out, parts, strict=True):
        place[: len(part)] = part
    return out


def _hats(v: Float[np.ndarray, "piece time"]) -> Float[np.ndarray, "piece time node"]:
    """Shares of the nodes of a friction map, which are dense near rest, where friction bends."""
    low, high = np.nanpercentile(v, [0.5, 99.5])
    knee = 0.01 * max(-low, high, 1e-12)
    nodes = knee * np.sinh(np.linspace(np.arcsinh(min(low / knee, -1)), np.arcsinh(max(high / knee, 1)), KNOTS))
    return np.stack([np.interp(v, nodes, one) for one in np.eye(KNOTS)], axis=-1)


def _directions(columns: Float[np.ndarray, "row column"]) -> Float[np.ndarray, "row direction"]:
    """Orthonormal directions of the columns, without those that the log hardly has."""
    return np.asarray(orth(columns / (np.linalg.norm(columns, axis=0) + 1e-300), rcond=1e-4))
