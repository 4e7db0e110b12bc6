"""Expectation-Maximisation: E-step and M-step in turn, over a growing horizon, until nothing changes.

Under a wrong model the smoother of a hidden chaotic joint diverges within a second or two: the first epochs see the
head of every sequence only, and the horizon grows as the model improves. Likelihoods of one horizon are compared.
"""

import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from ...base.gaussian import Gaussian
from ...base.journal import HERE, step
from ...base.parallel import each
from ...base.random import keys_of
from ...errors import FitError
from ...logs.dataset import Dataset, horizon
from ...model.base import AbstractModel, prepare
from ..smoother.posterior import AbstractSmoother, Posterior, likeliest
from .mstep import AbstractMStep, MStepInfo, between, not_diverged
from .readings import onset


class EMState(NamedTuple):
    """Everything that is needed to go on: resuming from it gives the same numbers."""

    epoch: int
    model: AbstractModel
    """The model that the next epoch tries."""
    best: AbstractModel
    """The last model that was accepted at the present horizon."""
    proposal: AbstractModel
    """Model that the M-step proposes from `best`."""
    hessian: Float[Array, "phi phi"]
    """Posterior precision of phi at `best`: of the torques at the M-step's nodes, and of the parameters."""
    top: Float[np.ndarray, " seq"]
    """Log-likelihood of every sequence under `best`; -inf before there is one, NaN where a sequence is left out."""
    stride: float
    """Share of the way to `proposal` that is tried."""
    key: PRNGKeyArray
    loglik: Float[np.ndarray, " epoch"]
    """Mean log-likelihood of the sequences used, of every epoch so far; `DIVERGED` where all diverged."""
    ess: float
    """Mean effective sample size of the last epoch; infinite where nothing is sampled."""
    stage: int = 0
    since: int = 0
    """Place in `AbstractMStep.stages` of the rule in use, and the epoch from which on it is."""
    stop: str = ""
    """Reason of the end of the last fit: `RESTED`, `STEP_REFUSED` or `SPENT`; empty before one has ended."""


RESTED, STEP_REFUSED, SPENT = "at rest", "no step raises the likelihood", "epochs spent"


class Schedule(eqx.Module):
    """Number of samples of each sequence that an epoch uses."""

    first: int = eqx.field(static=True, default=60)
    growth: float = eqx.field(static=True, default=1.6)
    hold: int = eqx.field(static=True, default=2)
    """Epochs at a horizon before it grows; the first horizon lasts one more."""

    def horizon(self, epoch: int, longest: int) -> int:
        """Samples seen in `epoch`, counted from 0."""
        return min(longest, round(self.first * self.growth ** max(0, (epoch - 1) // self.hold)))


def e_step(
    model: AbstractModel, data: Dataset, smoother: AbstractSmoother, *, key: PRNGKeyArray, kept: Gaussian | None = None
) -> Posterior:
    """Smooth every sequence of `data`, on the devices of `parallel.over`; those that are too wide by the second
    smoother, too, or about the path that was `kept` of that: the likelier outcome is taken.
    """
    first, second = _alone(model, data, smoother, key=key), smoother.second()
    if second is None or first.width is None or isinstance(first.width, Tracer):  # no numbers within a larger program
        return first
    some = np.flatnonzero(~(np.asarray(first.width) <= second.wide))
    if not some.size:
        return first
    wide = jax.tree.map(lambda a: np.asarray(a)[some], (data, first.state, *[kept] * (kept is not None)))
    path, loglik = each(_likeliest_path, (model, second), wide, together=1 if kept is None else None)
    return _replaced(first, path, loglik, some)


def _alone(model: AbstractModel, data: Dataset, smoother: AbstractSmoother, *, key: PRNGKeyArray) -> Posterior:
    """`e_step` without a second smoother."""
    batch = data, keys_of(key, data.t.shape[0])
    together = max(1, smoother.room // (data.t.shape[1] * smoother.bytes_per_row))
    outcomes = [each(_smooth, (model, one), batch, together=together) for one in smoother.tries()]
    return outcomes[0] if len(outcomes) == 1 else each(_likeliest, None, outcomes)


def _likeliest_path(common, one) -> tuple[Posterior, Float[Array, ""]]:
    """The likeliest path of the second smoother, and the likelihood of that of the first, each linearised about itself:
    a relinearisation may diverge.
    """
    (model, second), (seq, first, *kept) = common, one
    paths, before = second.paths(model, prepare(model, seq), first, *kept)
    return jax.tree.map(lambda a: a[likeliest(paths.loglik)], paths), before[-1]


def _replaced(first: Posterior, second: Posterior, loglik: Float[Array, " some"], index) -> Posterior:
    """`second` at the places `index` of `first`, where it is likelier than these are by their `loglik`."""
    known = np.flatnonzero(np.asarray(second.loglik) > np.nan_to_num(np.asarray(loglik), nan=-np.inf, neginf=-np.inf))

    def put(a: jax.Array, b: jax.Array) -> jax.Array:
        out = np.array(a)
        out[index[known]] = np.asarray(b)[known]
        return jax.device_put(out)

    moved = jax.tree.map(put, first._replace(width=None), second._replace(width=None))
    return moved._replace(width=first.width)


def _likeliest(_, tries: list[Posterior]) -> Posterior:
    """The likeliest of one sequence, with the width of the first."""
    best = likeliest(jnp.stack([posterior.loglik for posterior in tries]))
    return jax.tree.map(lambda *leaves: jnp.stack(leaves)[best], *tries)._replace(width=tries[0].width)


def _smooth(common, one) -> Posterior:
    (model, smoother), (seq, key) = common, one
    return smoother(model, prepare(model, seq), key=key)


@step(lambda model, *_, **__: (model, MStepInfo(HERE, HERE), HERE, HERE, Gaussian(HERE, HERE)))
def em_step(
    model: AbstractModel,
    data: Dataset,
    smoother: AbstractSmoother,
    m_step: AbstractMStep,
    key: PRNGKeyArray,
    *,
    kept: Gaussian | None = None,
    growing: bool = False,
) -> tuple[AbstractModel, MStepInfo, Float[Array, " seq"], Float[Array, " seq"], Gaussian]:
    """One E-step and one M-step: the next model, the log-likelihoods of this one, the effective sample sizes, and the
    smoothed paths.

    While the horizon is `growing`, no sequence is smoothed a second time: the noise is still so large that all are
    wide. `step` keeps the result in the journal of a command, from which it goes on after a stop.
    """
    posterior = _alone(model, data, smoother, key=key) if growing else e_step(model, data, smoother, key=key, kept=kept)
    model, info = m_step(model, posterior, data)
    return model, info, posterior.loglik, posterior.ess, posterior.state


def start_state(model: AbstractModel, m_step: AbstractMStep, *, key: PRNGKeyArray) -> EMState:
    """The state before the first epoch."""
    return EMState(0, model, model, model, m_step.no_hessian(model), np.full(1, -np.inf), 1.0, key, np.zeros(0), np.inf)


def later_state(model: AbstractModel, m_step: AbstractMStep, *, key: PRNGKeyArray) -> EMState:
    """The state of a model that was fitted before: its noise is settled, and the M-step free."""
    return start_state(model, m_step, key=key)._replace(epoch=1, stage=len(m_step.stages()) - 1)


SCHEDULE = Schedule()
WIDENED, SMOOTHED = 1 << 30, (1 << 30) + 1
"""Numbers folded into the key of a fit for draws after it, of its covariance and states."""
EPOCHS = 40
"""Epochs of a fit at most."""
DIVERGED = -1e6
"""Log-likelihood of an epoch or a sequence without one [nat]."""
REST = 0.05
"""Change of the log-likelihood, twice running, at which EM is at rest [nat a sequence]."""


def fit(
    state: EMState,
    data: Dataset,
    smoother: AbstractSmoother,
    m_step: AbstractMStep,
    *,
    epochs: int = EPOCHS,
    schedule: Schedule = SCHEDULE,
    tolerance: float = REST,
    watch: Callable[[EMState, int, Bool[np.ndarray, " seq"]], None] = lambda state, seen, used: None,
) -> EMState:
    """EM from `state` until `epochs` are done or the likelihood rests.

    It rests when, with the whole data in sight, the mean log-likelihood of a sequence moves by less than `tolerance`
    nats twice running, or when less than a fifth of a step would be tried. Before the last stage of the M-step the next
    one then begins, from the best model. Horizons are counted from shortly before the first motion of each sequence.
    Raises FitError when no sequence can be followed by the first model at a horizon; later ones are refused.
    """
    longest, still = int(np.max(np.sum(np.asarray(data.valid), axis=1))), onset(np.asarray(data.y))
    stages = m_step.stages()
    last = len(stages) - 1
    if state.epoch == 0:
        model = _settle_noise(state.model, horizon(data, schedule.first, still), smoother, state.key)
        state = state._replace(model=model, best=model)
    kept = None
    held_rest = 0.5  # the same before the M-step is released: likelihoods are compared no more exactly
    while state.epoch < epochs:
        seen = schedule.horizon(state.epoch, longest)
        ended = _ended(state, schedule, longest, tolerance if state.stage == last else held_rest)
        if ended and state.stage == last:
            return state._replace(stop=ended)
        if ended:
            state = _released(state)
        elif seen > schedule.horizon(max(state.epoch - 1, 0), longest):
            state = state._replace(top=np.full(state.top.size, -np.inf), stride=1.0)
        if seen == longest and state.stage < min(1, last):
            state = _released(state)
        rule, key = stages[state.stage], jax.random.fold_in(state.key, state.epoch)
        rule = rule.while_growing() if seen < longest else rule
        part, options = horizon(data, seen, still), {"kept": kept, "growing": seen < longest}
        proposal, info, loglik, ess, path = em_step(state.model, part, smoother, rule, key, **options)
        used, followed = np.asarray(info.used), np.isfinite(state.top)
        if not (used.any() or followed.any()):
            raise FitError(
                f"epoch {state.epoch + 1}: all {used.size} sequences diverge within the first {seen} samples; "
                "check units, signs and the start prior, or declare a wider one"
            )
        same: Callable[[], float] = lambda: -math.inf  # noqa: E731
        if kept is not None and used.any():
            same = functools.partial(_rise, state, kept, data, rule, used)
        if used.any():
            state = state._replace(ess=float(np.mean(np.asarray(ess)[used])))
        used = used if used.any() else followed  # where all are lost the step was too long
        tried, state = state.model, _judge(state, proposal, info.hessian, np.asarray(loglik), used, same)
        kept = path if seen == longest and state.best is tried else kept
        watch(state, seen, used)
    return state._replace(stop=SPENT)


def _released(state: EMState) -> EMState:
    """The next stage of the M-step, from the best model, integrated as finely as friction has become steep; there are
    no likelihoods to compare with.
    """
    best, unknown = state.best.resolved(), np.full(state.top.size, -np.inf)
    state = state._replace(model=best, best=best, proposal=best, top=unknown, stride=1.0)
    return state._replace(stage=state.stage + 1, since=state.epoch)


def unsettled(state: EMState, schedule: Schedule, longest: int) -> float:
    """Rise of the log-likelihood in the last two epochs of a fit [nat a sequence]; 0 for one that is at rest, infinite
    where fewer than three epochs saw whole sequences. A sampled likelihood rises by more than it ever fell.
    """
    epochs = range(state.epoch - len(state.loglik), state.epoch)  # a fit begun from another starts at 1
    every = [(schedule.horizon(epoch, longest), v) for epoch, v in zip(epochs, state.loglik, strict=True)]
    whole = [v for seen, v in every if seen == longest and v > DIVERGED]  # a refused step is none
    if len(whole) < 3:
        return math.inf
    least = 2 * REST if math.isinf(state.ess) else max(2 * REST, float(np.max(-np.diff(whole))))
    rise = float(max(whole[-2:]) - max(whole[:-2]))
    return rise if rise >= least else 0.0


def _rise(state: EMState, path: Gaussian, data: Dataset, rule, used: Bool[np.ndarray, " seq"]) -> float:
    """Rise of the log-likelihood from the best model to the one that was tried, beyond what is known [nat a sequence].

    Both are linearised about the `path` from which the step was made, which changes the likelihood of the best one: it
    is known no better, on a real arm with steep friction than 50 nat. -inf where a sequence was lost, or for samples.
    """
    if np.any(np.isfinite(state.top) & ~used) or math.isfinite(state.ess):
        return -math.inf
    best, tried = (np.asarray(rule.loglik(model, path, data)) for model in (state.best, state.model))
    both = used & np.isfinite(state.top)
    return float(np.mean((tried - best)[both]) - abs(np.mean((best - state.top)[both])))


def _judge(
    state: EMState, proposal: AbstractModel, hessian, loglik, used, same: Callable[[], float] = lambda: -math.inf
) -> EMState:
    """Accept the model that was tried, or go back to the best one and try a shorter way from there.

    Half a nat a sequence is allowed, since likelihoods are not exact.  What falls along its own path may rise along the
    `same` path.  A sequence left out under the best model does not count, one that diverges under the new one does.
    """
    loglik = np.nan_to_num(loglik, nan=DIVERGED, neginf=DIVERGED)
    mean = float(np.mean(loglik[used]))
    if (rises := bool(np.nanmean(loglik - state.top) >= -0.5)) or same() > 0:
        top = np.where(used, loglik, np.nan)
        stride = min(1.0, 2 * state.stride) if rises else state.stride
        state = state._replace(best=state.model, proposal=proposal, hessian=hessian, top=top, stride=stride)
    else:
        state = state._replace(stride=state.stride / 3)
    model = between(state.best, state.proposal, state.stride)
    return state._replace(epoch=state.epoch + 1, model=model, loglik=np.append(state.loglik, mean))


def _settle_noise(model: AbstractModel, data: Dataset, smoother, key: PRNGKeyArray) -> AbstractModel:
    """`model` with its process noise scaled to the likeliest size: the error of its motion is unknown."""
    scales, logliks = (1.0, 0.3, 0.1, 0.03, 0.01), []
    trials = [eqx.tree_at(lambda m: m.log_q, model, model.log_q + 2 * math.log(scale)) for scale in scales]
    for trial in trials:
        posterior = _alone(trial, data, smoother, key=key)
        used = np.asarray(not_diverged(posterior, data))
        logliks.append(float(np.mean(np.asarray(posterior.loglik)[used])) if used.any() else -math.inf)
    return trials[int(np.argmax(logliks))]


def _ended(state: EMState, schedule: Schedule, longest: int, tolerance: float) -> str:
    """Reason to end a stage of a fit; empty where there is none."""
    if state.epoch - state.since < 3 or schedule.horizon(state.epoch - 3, longest) < longest:
        return ""
    if state.stride < 0.2 and math.isinf(state.ess):  # a sampled likelihood may fall by chance
        return STEP_REFUSED
    return RESTED if np.all(np.abs(np.diff(state.loglik[-3:])) < tolerance) else ""
