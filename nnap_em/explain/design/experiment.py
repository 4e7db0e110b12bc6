"""The next experiment: which inputs, played on the machine, determine best what a fit leaves open."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from ...base.digits import counted
from ...base.log import Log, silent
from ...errors import DesignError
from ...estimate.em.mstep import not_diverged
from ...estimate.identify import Identified
from ...estimate.predict import drawn_paths, posterior_of
from ...logs.dataset import Dataset
from .criteria import Criterion, Information, share, some
from .information import Fit, information, known
from .limits import Limits, limits_of
from .play import allowed, motions
from .search import DESIGN_EFFORT, Effort, Plan, Setup, evaluated, search
from .signals import Proposal, played, starts

TRIED, CHECKED, DRAWN_IN = 32, 500, 200
"""Models from the posterior by which every proposal is tried, and the chosen ones; how many of these a figure shows."""


class Design(NamedTuple):
    """Sequences to be played, and their expected information."""

    fitted: Identified
    limits: Limits
    t: Float[np.ndarray, " time"]
    """[s]"""
    u: Float[np.ndarray, "sequence time input"]
    """[N m, or N]"""
    start: Float[np.ndarray, "sequence readable"]
    """Start of each sequence, set by hand."""
    low: Float[np.ndarray, "sequence time readable"]
    """The central 98 % of the motions."""
    middle: Float[np.ndarray, "sequence time readable"]
    high: Float[np.ndarray, "sequence time readable"]
    fit: Fit
    expected: Information
    """Information of all sequences."""
    old: Information
    """Information of as much time of the old inputs."""
    criterion: Criterion
    slow: Float[np.ndarray, " dof"]
    """Speed below which a fifth of the rows of the logs are: near rest [rad/s]."""


def design(
    fitted: Identified,
    data: Dataset,
    *,
    key: PRNGKeyArray,
    seconds: float = 60.0,
    sequences: int = 6,
    effort: Effort = DESIGN_EFFORT,
    log: Log = silent,
) -> Design:
    """Inputs to play next, so that their logs determine best what a fit leaves open: found by a seeded search.

    Every sequence stays inside the limits of its rig (`limits_of`) for 500 models drawn from the posterior, process
    noise included.

    Args:
        fitted: the model.
        data: the logs that it was fitted to.
        key: random key of the search.
        seconds: length of all sequences together [s].
        sequences: their number.
        effort: size of the search.
        log: receives a line of progress at a time.

    Returns:
        Inputs (sequence, row, input) [N m, or N], the starts they assume, and the standard deviations to expect.

    Raises:
        DesignError: the rig has no input, a start is out of the limits, or nothing is open.
    """
    key_paths, key_noise, key_check, key_search = jax.random.split(key, 4)
    friction = fitted.rig.friction
    if not (friction or fitted.m_step.prior.size):
        raise DesignError("nothing is open: the fit has no friction map and no parameter")
    rows = round(seconds / sequences / fitted.rig.dt)
    if rows < 20:
        raise DesignError(
            f"{counted(sequences, 'sequence')} in {seconds:g} s: {counted(rows, 'row')} each; give more --seconds"
        )
    data = jax.device_put(data)
    posterior = posterior_of(fitted, data)
    path, used = np.asarray(posterior.state.mean), np.asarray(not_diverged(posterior, data))
    limits, fit = limits_of(fitted.rig, fitted.model.system, data, path, used), known(fitted)
    dof, followed = fit.nodes.shape[0], np.asarray(data.valid) & used[:, None] & np.isfinite(path).all(axis=-1)
    visited = path[followed][:, dof : 2 * dof]
    slow = np.percentile(np.abs(visited), 20, axis=0)  # speeds near rest: of 20 % of the rows,
    slow = np.maximum(slow, np.sort(np.abs(fit.nodes), axis=1)[:, 2])  # or up to the first nodes where it stood still
    criterion = Criterion(fit, *_weighted(fit, visited, slow), friction)
    t = fitted.rig.dt * np.arange(rows + 1)
    setup = Setup(fit, drawn_paths(fitted, TRIED, key=key_paths), limits, t, key_noise)
    row = _row_of_logs(setup, data, path, used)
    count = float(np.sum(np.asarray(data.valid)[used]))
    setup = setup._replace(share=share(fit, count * row))
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key_search)))
    plan = search(setup, criterion, sequences, rng=rng, effort=effort, log=log)
    checked = setup._replace(paths=drawn_paths(fitted, CHECKED, key=key_check), key=key_check)
    plan, trials = _checked(setup, checked, plan, effort, log)
    u, start = played(plan.proposal, limits, t), starts(plan.proposal, limits)
    low, middle, high = np.quantile(np.asarray(trials.x)[..., : start.shape[1]], (0.01, 0.5, 0.99), axis=1)
    old = setup.share * sequences * t.size * row
    expected = plan.expected.sum(axis=0)
    return Design(fitted, limits, t, u, start, low, middle, high, fit, expected, old, criterion, slow)


def _weighted(fit: Fit, visited: Float[np.ndarray, "row dof"], slow: Float[np.ndarray, " dof"]):
    """Size of the friction of every joint, and weight of velocities: the visited ones, and near rest alone."""
    nodes, dof = np.asarray(fit.nodes), fit.nodes.shape[0]
    low, high = np.percentile(visited, [0.5, 99.5], axis=0)
    # Share of the largest velocity: below it velocities count alike, above it the less the denser they would be
    place = np.arcsinh(nodes / (0.05 * np.abs(nodes).max(axis=1, keepdims=True)))
    everywhere = np.gradient(place, axis=1) * ((nodes >= low[:, None]) & (nodes <= high[:, None]))
    near = np.gradient(nodes, axis=1) * (np.abs(nodes) <= slow[:, None])
    weight = np.stack([everywhere, near])
    weight = weight / np.maximum(weight.sum(axis=2, keepdims=True), 1e-12) / dof
    torque = np.stack([np.asarray(fit.model.unknown(jnp.asarray(v))) for v in nodes.T], axis=1)
    scale = np.sqrt(np.sum(weight[0] * torque**2, axis=1) * dof)
    return np.maximum(scale, 1e-3 * scale.max() + 1e-12), weight


def _checked(setup: Setup, checked: Setup, plan: Plan, effort: Effort, log: Log):
    """The plan and its motions by many more models; sequences that break a limit are made smaller."""
    proposal = Proposal(*map(np.array, plan.proposal))
    for _ in range(12):
        u, start = played(proposal, setup.limits, setup.t), starts(proposal, setup.limits)
        trials = motions(checked.paths, setup.limits, setup.t, u, start, DRAWN_IN, key=checked.key)
        ok = allowed(trials, setup.limits)
        if ok.all():
            break
        log(f"too near a limit in {CHECKED} trials: {counted(np.sum(~ok), 'sequence')} made smaller")
        proposal.shape[~ok, :, -1] *= 0.85
    else:
        raise DesignError("no sequence of this kind stays inside the limits; widen [limits] in rig.toml")
    count = len(proposal.family)
    _, each = evaluated(setup, some(proposal, np.arange(effort.batch) % count), effort.few)  # one program serves
    return Plan(proposal, each[:count]), trials


def _row_of_logs(setup: Setup, data: Dataset, path: Float[np.ndarray, "seq time state"], used) -> Information:
    """Information of a row of the logs, the mean along their smoothed motions, as far as a new sequence is long."""
    rows = setup.t.size
    cut = jax.tree.map(lambda a: np.asarray(a)[used, :rows], data)
    short = rows - cut.t.shape[1]
    grow = lambda a, **how: np.pad(a, [(0, 0), (0, max(short, 0))] + [(0, 0)] * (a.ndim - 2), **how)  # noqa: E731
    t, u, y = (grow(a, mode="edge") for a in cut[:3])
    cut = Dataset(t, u, y, grow(cut.valid))
    x = grow(path[used, :rows], mode="edge")
    each = information(setup.fit, cut, jnp.asarray(x[:, None]))
    return each.sum(axis=0) / max(float(cut.valid.sum()), 1.0)
