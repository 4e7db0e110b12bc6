"""Friction with memory: from a fit with a static map to one with a hidden state in each joint that needs it.

screen  score test of a faint contact of every joint, at some presliding distances, along the smoothed path
extend  the contacts that it finds join the model, and EM goes on from the static fit
decide  they stay where the likelihood grows and the multi-step errors fall; else the static fit does
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..data.dataset import Dataset
from ..effects import fields
from ..em.local import locals_along
from ..em.loop import REMEMBERED, EMState, FitError, Schedule, e_step, fit, later_state
from ..em.mstep import ScoringMStep, not_diverged
from ..em.prior import ParameterPrior
from ..em.quadratic import Local, friction_columns, reading_columns, whitened_sensitivities
from ..model.dynamic_friction import SHAPES, DynamicFriction
from ..model.friction import FrictionNetwork
from ..model.state_space import StateSpaceModel, with_effects
from ..numerics.gaussian import Gaussian
from ..numerics.ode import integrate
from ..numerics.parallel import each
from ..prediction_error.multistep import JUDGED, errors, followed, ratio
from ..smoother.kalman import TANGENT, kalman_filter
from ..smoother.posterior import AbstractSmoother

DISTANCES = 4
"""Presliding distances that are tried."""
FAINT = 1e-3
"""Level of a contact that is tried over the dry friction of the map: the likelihood is linear in it."""
WALD = 5.0
"""Standard deviations by which a level must differ from zero; 12.5 nat, as for an effect."""
GAIN = 0.5 * WALD**2
"""Log-likelihood that a contact must add [nat]."""
RISE, STRIBECK = 0.1, 0.05
"""First rise of the level towards rest, and the velocity over which it falls, over the largest."""
STD = {"log_level": 1.0, "log_distance": 2.0, "log_damping": 1.0, "log_rise": 1.5, "log_velocity": 1.5, "shape": 1.5}
"""Prior standard deviations of the numbers of a contact."""


Watch = Callable[[EMState, int, Bool[np.ndarray, " seq"]], None]


class Sizes(NamedTuple):
    """Sizes of the motion and friction of every joint, in which contacts are tried."""

    shortest: Float[np.ndarray, " dof"]
    """Travel within two samples after a reversal [rad]."""
    longest: Float[np.ndarray, " dof"]
    """A tenth of the range of the coordinate [rad]."""
    speed: Float[np.ndarray, " dof"]
    """Largest velocity [rad/s]."""
    level: Float[np.ndarray, " dof"]
    """Dry friction of the learned map: its odd part at a tenth of the speed [N m]."""
    inertia: Float[np.ndarray, " dof"]
    """Least inertia of a joint, the others free [kg m^2]."""


class Screen(NamedTuple):
    """Score test of a faint contact in every joint, at one presliding distance each."""

    distance: Float[np.ndarray, " dof"]
    """[rad]"""
    wald: Float[np.ndarray, " dof"]
    """Estimated level over its standard deviation."""
    level: Float[np.ndarray, " dof"]
    """Estimated level [N m], to first order."""
    std: Float[np.ndarray, " dof"]
    """Its standard deviation [N m]."""


class Remembered(NamedTuple):
    """A fit after the search for memory, and what the search found."""

    state: EMState
    m_step: ScoringMStep
    sentences: tuple[str, ...]
    """One for each joint."""


def sizes(model: StateSpaceModel, path: Gaussian, data: Dataset, used: Bool[np.ndarray, " seq"]) -> Sizes:
    """Sizes along the smoothed paths of the sequences `used`."""
    dof, mean = len(model.system.coordinates), np.asarray(path.mean)
    known = np.asarray(data.valid) & used[:, None] & np.isfinite(mean).all(axis=-1)
    q, v = mean[..., :dof], mean[..., dof : 2 * dof]
    rise = np.diff(v, axis=1)[known[:, 1:] & known[:, :-1]]
    shortest = 2 * model.dt * np.sqrt(np.mean(rise**2, axis=0)) + 1e-12
    low, high = np.percentile(q[known], [1, 99], axis=0)
    speed = np.percentile(np.abs(v[known]), 99.5, axis=0) + 1e-9
    poses = q[known][np.linspace(0, known.sum() - 1, 64).astype(int)]
    level, inertia = map(np.asarray, _levels(model, jnp.asarray(0.1 * speed), jnp.asarray(poses)))
    return Sizes(shortest, np.maximum(0.1 * (high - low), 2 * shortest), speed, level, inertia)


@eqx.filter_jit
def _levels(model: StateSpaceModel, v: Float[Array, " dof"], q: Float[Array, "pose dof"]):
    alone = 1 / jax.vmap(lambda q: jnp.diag(jnp.linalg.inv(model.system.mass(q))))(q)
    dry = 0.5 * jnp.abs(model.unknown(v) - model.unknown(-v))
    network = cast(FrictionNetwork, model.unknown)
    return jnp.maximum(dry, 0.01 * network.scale), jnp.min(alone, axis=0)


def contact(model: StateSpaceModel, scales: Sizes, joint: int, level: float, distance: float) -> DynamicFriction:
    """Dahl's contact of a joint, of some level [N m] and distance [rad].

    Its damper is a fifth of critical at the level of the map, and falls with the level.
    """
    j, step = joint - 1, model.dt / model.steps
    damping = 0.4 * level * math.sqrt(scales.inertia[j] / (scales.level[j] * distance))
    log = lambda x: jnp.asarray(math.log(x), float)  # noqa: E731
    return DynamicFriction(
        log_level=log(level),
        log_distance=log(distance),
        log_damping=log(damping),
        log_rise=log(RISE),
        log_velocity=log(STRIBECK * scales.speed[j]),
        shape=jnp.zeros(SHAPES),
        knee=0.01 * scales.speed[j],
        stiffest=scales.inertia[j] / step**2,  # a radian of its own vibration in an integration step
        fastest=jnp.asarray(2 / step, float),  # within the stability of Runge and Kutta's method, 2.78
        joint=joint,
    )


def with_contacts(
    model: StateSpaceModel, rule: ScoringMStep, contacts: Sequence[DynamicFriction], only: tuple[str, ...] = ()
) -> tuple[StateSpaceModel, ScoringMStep]:
    """The model with contacts more, and the rule that estimates their numbers too, or `only` some of them."""
    old = len(model.effects)
    names = [(i, name) for i, effect in enumerate(contacts) for name in only or fields(effect)]
    means = [jnp.ravel(getattr(contacts[i], name)) for i, name in names]
    stds = [jnp.full_like(mean, STD[name]) for (_, name), mean in zip(names, means, strict=True)]
    prior = ParameterPrior(
        rule.prior.names + tuple(f"{old + i}.{name}" for i, name in names),
        jnp.concatenate([rule.prior.mean, *means]),
        jnp.concatenate([rule.prior.std, *stds]),
    )
    full = with_effects(model, (*model.effects, *contacts))
    where = lambda m: (m.prior, m.log_q_prior)  # noqa: E731
    return full, eqx.tree_at(where, rule, (prior, full.log_q), is_leaf=lambda leaf: leaf is None)


def straight_at_rest(model: StateSpaceModel, contacts: Sequence[DynamicFriction]) -> StateSpaceModel:
    """The model whose map is a straight line where the contacts take the place of the sign of the rate.

    A joint passes there within a sample or two at each reversal: a network would be free to have any peak.
    """
    network = cast(FrictionNetwork, model.unknown)
    rest = jnp.zeros_like(network.scale) if network.rest is None else network.rest
    for effect in contacts:
        rest = rest.at[effect.joint - 1].set(effect.knee)
    return eqx.tree_at(lambda m: m.unknown.rest, model, rest, is_leaf=lambda leaf: leaf is None)


@eqx.filter_jit
def extended(model: StateSpaceModel, path: Gaussian, data: Dataset) -> Gaussian:
    """`path` of the model without its last effects, with the memory that these would have along it."""
    width, states = path.mean.shape[-1], model.start.mean.shape[0]
    still = jnp.zeros(len(model.system.coordinates), path.mean.dtype)

    def one(mean, cov, seq):
        def step(m, slices):
            x, u = slices
            memory_rate = lambda m: model.rate(jnp.concatenate([x, m]), u, still)[width:]  # noqa: E731
            return integrate(memory_rate, m, model.dt, model.steps), m

        _, memory = jax.lax.scan(step, model.start.mean[width:], (mean, model.inputs(seq)))
        wide = jnp.zeros((mean.shape[0], states, states), cov.dtype)
        wide = wide.at[:, :width, :width].set(cov).at[:, width:, width:].set(model.start.cov[width:, width:])
        return Gaussian(jnp.concatenate([mean, memory], axis=1), wide)

    return jax.vmap(one)(path.mean, path.cov, data) if states > width else path


def _score(common, one) -> tuple[Float[Array, " phi"], Float[Array, "phi phi"]]:
    """Score and information of one sequence, linear about its path: of the node torques, then of the parameters."""
    (log_q, log_r, start, nodes), (linear, path) = common, one
    dof = nodes.shape[0]
    filtered = kalman_filter(log_q, log_r, start, linear.affine, linear.reading, linear.seq)
    speed = path.mean[:, None, dof : 2 * dof]
    torque = jax.vmap(lambda v, by_force: friction_columns(nodes, v, by_force))(speed, linear.by_force)
    columns = jnp.where(linear.seq.active[:, None, None], jnp.concatenate([torque, linear.by_parameter], axis=-1), 0.0)
    jac = whitened_sensitivities(filtered, columns, reading_columns(nodes, speed, linear), linear.seq.observed)
    jac = jac.reshape(-1, jac.shape[-1])
    return jac.T @ filtered.innovation.ravel(), jac.T @ jac


def screen(
    model: StateSpaceModel,
    rule: ScoringMStep,
    path: Gaussian,
    data: Dataset,
    used: Bool[np.ndarray, " seq"],
    scales: Sizes,
    distance: Float[np.ndarray, " dof"],
    joints: Sequence[int],
) -> Screen:
    """Score test of a contact in each of some joints, counted from 0, friction and parameters refitted under their
    priors.

    [Rao 1948, Proc. Camb. Phil. Soc. 44(1)]  One linearisation of the model, no EM.
    """
    level = FAINT * scales.level
    contacts = [contact(model, scales, j + 1, level[j], distance[j]) for j in joints]
    faint, rule = with_contacts(model, rule, contacts, ("log_level",))
    path = extended(faint, path, data)
    linear: Local = locals_along(faint, rule.prior, path, data, TANGENT)
    weights = rule.weights(faint)
    common = faint.log_q, faint.log_r, faint.start, weights.nodes
    scores, informations = map(np.asarray, each(_score, common, (linear, path)))
    used = used & np.isfinite(scores).all(axis=1) & np.isfinite(informations).all(axis=(1, 2))
    score, information = scores[used].sum(axis=0), informations[used].sum(axis=0)
    precision = np.asarray(weights.prior_precision(faint.unknown)) + information
    nuisance, levels = slice(0, len(score) - len(joints)), slice(len(score) - len(joints), len(score))
    precision[levels, levels] -= np.eye(len(joints))  # a level is free
    both = np.linalg.solve(
        precision[nuisance, nuisance], np.column_stack([precision[nuisance, levels], score[nuisance]])
    )
    left = np.diag(precision[levels, levels] - precision[levels, nuisance] @ both[:, :-1])  # each joint's contact alone
    pull = score[levels] - precision[levels, nuisance] @ both[:, -1]
    sign = np.sqrt(np.maximum(left, 1e-300))
    out = Screen(distance, *(np.zeros_like(distance) for _ in range(3)))
    at = list(joints)
    out.wald[at], out.level[at], out.std[at] = pull / sign, level[at] * pull / sign**2, level[at] / sign
    return out


class _Fit(NamedTuple):
    """A fit with its smoothed paths."""

    state: EMState
    rule: ScoringMStep
    path: Gaussian
    loglik: Float[np.ndarray, " seq"]
    used: Bool[np.ndarray, " seq"]

    @property
    def model(self) -> StateSpaceModel:
        return cast(StateSpaceModel, self.state.best)


def _smoothed(state: EMState, rule: ScoringMStep, smoother: AbstractSmoother, data: Dataset) -> _Fit:
    posterior = e_step(state.best, data, smoother, key=state.key)
    return _Fit(state, rule, posterior.state, np.asarray(posterior.loglik), np.asarray(not_diverged(posterior, data)))


def remember(
    state: EMState, rule: ScoringMStep, smoother: AbstractSmoother, data: Dataset, *, epochs: int, watch: Watch
) -> Remembered:
    """The static fit `state`, or where data show memory a fit with a contact in each joint that shows it.

    A joint whose friction the model lacks pushes the others too: the one that shows memory best goes first, and the
    others are screened again with it in the model, or without it where it is refused.
    """
    fitted = _smoothed(state, rule, smoother, data)
    joints = range(len(fitted.model.system.coordinates))
    sentences: dict[int, str] = {}
    for _ in joints:
        left = [j for j in joints if not sentences.get(j, "").startswith((FOUND, REFUSED))]
        scales = sizes(fitted.model, fitted.path, data, fitted.used)
        steps = np.geomspace(scales.shortest, scales.longest, DISTANCES)
        tries = [
            screen(fitted.model, fitted.rule, fitted.path, data, fitted.used, scales, step, left) for step in steps
        ]
        best = {j: max(tries, key=lambda tested: tested.wald[j]) for j in left}
        sentences |= {j: _unseen(fitted.model, scales, tries, j) for j in left}
        j = max(left, key=lambda j: best[j].wald[j], default=-1)
        if j < 0 or best[j].wald[j] < WALD:
            break
        level = float(np.clip(best[j].level[j], 0.1 * scales.level[j], scales.level[j]))
        bristle = contact(fitted.model, scales, j + 1, level, best[j].distance[j])
        trial = _with(fitted, bristle, smoother, data, epochs=epochs, watch=watch)
        accepted, reason = _judged(fitted, trial, data)
        sentences[j] = f"{FOUND if accepted else REFUSED} ({reason})"
        if accepted and trial is not None:
            fitted = trial
    return Remembered(fitted.state, fitted.rule, tuple(f"joint {j + 1}: {sentences[j]}" for j in joints))


def _with(
    fitted: _Fit, bristle: DynamicFriction, smoother: AbstractSmoother, data: Dataset, *, epochs: int, watch: Watch
) -> _Fit | None:
    """EM from a fit on, over whole sequences, with a contact more; None where it diverges."""
    model, rule = with_contacts(straight_at_rest(fitted.model, [bristle]), fitted.rule, [bristle])
    key = jax.random.fold_in(fitted.state.key, REMEMBERED + bristle.joint)
    begin, before = later_state(model, rule, key=key), fitted.state.epoch
    blank = np.full(len(data.t), -np.inf)
    begin = begin._replace(top=blank, loglik=blank[:1])

    def later(state: EMState, seen: int, used: Bool[np.ndarray, " seq"]) -> None:
        watch(state._replace(epoch=before + state.epoch - 1), seen, used)

    longest = int(np.max(np.sum(np.asarray(data.valid), axis=1)))
    try:
        state = fit(begin, data, smoother, rule, epochs=epochs + 1, schedule=Schedule(first=longest), watch=later)
    except FitError:
        return None
    loglik = np.concatenate([fitted.state.loglik, state.loglik[1:]])
    return _smoothed(state._replace(epoch=before + state.epoch - 1, loglik=loglik), rule, smoother, data)


def _judged(fitted: _Fit, trial: _Fit | None, data: Dataset) -> tuple[bool, str]:
    """True where a trial is likelier by `GAIN`, predicts better and loses no sequence; and the evidence."""
    if trial is None:
        return False, "EM diverges with it"
    both = fitted.used & trial.used
    gain = float(np.sum((trial.loglik - fitted.loglik)[both]))
    before, after = (errors(followed(one.model, one.rule.prior, one.path, data), JUDGED) for one in (fitted, trial))
    falls = ratio(before, after, both)
    reason = f"{gain:.3g} nat likelier, squared multi-step error {falls:.3g} times that of the static map"
    return bool(both.sum() == fitted.used.sum() and gain >= GAIN and falls < 1.0), reason


FOUND = "memory"
REFUSED = "the static map is kept, memory predicts no better"


def _unseen(model: StateSpaceModel, scales: Sizes, tries: Sequence[Screen], j: int) -> str:
    """The static map is kept since no distance shows a contact, with the levels that would have been seen."""
    unit, angle = model.system.force_unit(j + 1), model.system.unit(model.system.coordinates[j])
    least, level = WALD * max(tested.std[j] for tested in tries), scales.level[j]
    text = f"the static map is kept, no memory from {tries[0].distance[j]:.2g} to {tries[-1].distance[j]:.2g} {angle}"
    if least > level:
        return f"{text}; the logs could not show it: a level below {least:.2g} {unit}, and friction is {level:.2g}"
    return f"{text} with a level above {least:.2g} {unit}"
