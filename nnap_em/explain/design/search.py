"""The search for sequences: many are drawn, the best together are taken, and each is bettered in turn.

Friction has kinks, limits are walls and a free arm is chaotic, so that a slope of the cost leads nowhere for long: the
search is a seeded one.  Motions and information of a batch of proposals are a step, which is found again after a stop.
"""

from collections.abc import Sequence
from typing import NamedTuple, TypeVar

import jax
import numpy as np
from jaxtyping import Bool, Float, PRNGKeyArray

from ...base.journal import HERE, step
from ...base.log import Log, silent
from ...errors import DesignError
from ...estimate.predict import Paths
from .criteria import Criterion, Information, some
from .information import Fit, information
from .limits import Limits
from .play import allowed, blank, motions
from .signals import Proposal, drawn, mutated, played, starts


class Effort(NamedTuple):
    """Effort of a search."""

    pool: int = 192
    """Proposals to choose from."""
    batch: int = 48
    """Proposals that are played at once."""
    rounds: int = 20
    """Rounds of improvements."""
    tries: int = 12
    """Batches that may be drawn to fill the pool."""
    few: int = 2
    """Motions along which information is taken."""


DESIGN_EFFORT = Effort()
_Tree = TypeVar("_Tree")


class Setup(NamedTuple):
    """Constants on which motions and information of a proposal depend."""

    fit: Fit
    paths: Paths
    """Models drawn from the posterior."""
    limits: Limits
    t: Float[np.ndarray, " time"]
    key: PRNGKeyArray
    share: float = 1.0
    """Share of the expected information that counts (`criteria.share`)."""


class Plan(NamedTuple):
    """Sequences, and the information of each."""

    proposal: Proposal
    expected: Information


@step(lambda *_: (HERE, HERE))
def evaluated(setup: Setup, proposal: Proposal, recorded: int) -> tuple[Bool[np.ndarray, " proposal"], Information]:
    """Proposals that stay inside the limits, and the information of each."""
    u, start = played(proposal, setup.limits, setup.t), starts(proposal, setup.limits)
    trials = motions(setup.paths, setup.limits, setup.t, u, start, recorded, key=setup.key)
    seq = blank(setup.t, u, len(setup.fit.model.measured))
    return allowed(trials, setup.limits), setup.share * information(setup.fit, seq, trials.x)


def search(
    setup: Setup,
    criterion: Criterion,
    count: int,
    *,
    rng: np.random.Generator,
    effort: Effort = DESIGN_EFFORT,
    log: Log = silent,
) -> Plan:
    """The `count` sequences that answer best together.

    Raises DesignError where hardly any proposal stays inside the limits.
    """
    pool = _pool(setup, count, rng, effort, log)
    chosen, total = [], None
    for _ in range(count):  # greedily: what the next one adds to those that are chosen
        costs = criterion.cost(pool.expected if total is None else total + pool.expected)
        chosen.append(int(np.argmin(np.nan_to_num(costs, nan=np.inf))))
        added = some(pool.expected, chosen[-1])
        total = added if total is None else total + added
    plan = some(pool, np.asarray(chosen))
    log(f"the best {count} of {len(pool.proposal.family)}: cost {float(criterion.cost(plan.expected.sum(axis=0))):.3f}")
    change = (0.3, 0.05)  # change of the numbers of a proposal in the first round and in the last
    for number in range(effort.rounds):
        reach = change[0] * (change[1] / change[0]) ** (number / max(effort.rounds - 1, 1))
        plan = _bettered(setup, criterion, plan, rng, reach, effort)
        cost = float(criterion.cost(plan.expected.sum(axis=0)))
        log(f"round {number + 1} of {effort.rounds}: cost {cost:.3f} (one less: a factor 2.7 in a standard deviation)")
    return plan


def _pool(setup: Setup, count: int, rng: np.random.Generator, effort: Effort, log: Log) -> Plan:
    """Proposals that stay inside the limits; one that does not is tried again with smaller inputs."""
    inputs, states = setup.limits.low.size, setup.limits.first.size
    plans, waiting = [], drawn(rng, effort.batch, inputs, states)
    shrinks = 0.7  # factor on the size of a proposal that breaks a limit
    for _ in range(effort.tries):
        ok, expected = evaluated(setup, waiting, effort.few)
        plans.append(some(Plan(waiting, expected), ok))
        have = sum(len(plan.proposal.family) for plan in plans)
        log(f"{have} of {effort.pool} proposals inside the limits")
        if have >= effort.pool:
            break
        waiting.shape[~ok, :, -1] *= shrinks
        fresh = drawn(rng, effort.batch, inputs, states)
        again = ~ok & (waiting.shape[..., -1].max(axis=1) > shrinks**6)
        waiting = _joined([some(waiting, again), some(fresh, ~again)])
    plan = _joined(plans)
    if len(plan.proposal.family) < count:
        raise DesignError(
            f"only {len(plan.proposal.family)} of {effort.batch * effort.tries} proposals stay inside the limits; "
            "widen [limits] in rig.toml, or ask for fewer or shorter sequences"
        )
    return plan


def _bettered(
    setup: Setup, criterion: Criterion, plan: Plan, rng: np.random.Generator, reach: float, effort: Effort
) -> Plan:
    """Every sequence replaced by the best of some like it, where that is better."""
    count = len(plan.proposal.family)
    place = np.arange(effort.batch) % count
    other = mutated(rng, some(plan.proposal, place), reach)
    ok, expected = evaluated(setup, other, effort.few)
    for slot in range(count):
        mine = np.flatnonzero(ok & (place == slot))
        remainder = some(plan, np.arange(count) != slot).expected.sum(axis=0)
        costs = criterion.cost(remainder + some(expected, np.append(mine, 0)))[: len(mine)]
        current = float(criterion.cost(plan.expected.sum(axis=0)))
        if len(mine) and np.nanmin(costs, initial=np.inf) < current:
            best = int(mine[np.nanargmin(costs)])
            plan = _joined([some(plan, np.arange(count) < slot), some(Plan(other, expected), np.asarray([best])),
                            some(plan, np.arange(count) > slot)])  # fmt: skip
    return plan


def _joined(plans: Sequence[_Tree]) -> _Tree:
    return jax.tree.map(lambda *parts: np.concatenate(parts), *plans)
