"""Looking back: what later laws made needless goes again, and so does what all together is not worth it."""

import math
from typing import cast

import numpy as np

from ..em.identify import finished
from ..em.loop import EMState
from ..em.multistep import JUDGED, SOON
from ..model.state_space import StateSpaceModel
from .case import open_loop_error, significance, trimmed
from .evidence import Worth, lazy, readings
from .grow import Loop, ahead, asked, grow
from .hypothesis import Found, Hypothesis
from .keys import key_of, words
from .outcome import Closed, Step
from .refit import refit

CLEAR = 100.0
"""Loss by the curvature of the fit [nat] from which on no refit is needed to see that an effect is needed."""


class Difference(Worth):
    """What one hypothesis has over another that it contains, both as they are fitted."""

    def __init__(self, loop: Loop, less: Hypothesis, full: Hypothesis, gain: float):
        self.loop, self.less, self.full, self.gain = loop, less, full, gain
        self.readings = readings(loop.data)

    @lazy
    def error(self) -> float:
        """Squared open-loop error of the one over that of the other."""
        return self._over(JUDGED)

    @lazy
    def soon(self) -> float:
        """The same over the first tenth of a second."""
        return self._over(SOON)

    def _over(self, horizons: tuple[float, ...]) -> float:
        (a, one), (b, other) = (asked(self.loop, each, self.loop.longest) for each in (self.less, self.full))
        return open_loop_error(a, b, self.loop.data, one & other, horizons)


def needed(loop: Loop, now: Hypothesis, state: EMState | None) -> tuple[Hypothesis, EMState | None]:
    """Without the effects that later ones made needless.

    The curvature of the fit names the least; a fit without it decides: curvature alone has struck effects whose loss
    was hundreds of nats.
    """
    while state is not None and now.found:
        now = now.refitted(cast(StateSpaceModel, state.best))
        losses = [_loss(now, state, i) for i in range(len(now.found))]
        least = int(np.argmin(losses))
        if losses[least] > CLEAR:
            break
        less = now.without(least)
        path = asked(loop, less, loop.longest)[0]
        trial = refit(less.model, less.m_step, path.path, loop.data, path.used, passes=loop.effort.passes)
        gain = trimmed((np.nan_to_num(state.top, nan=-1e3) - trial.loglik)[path.used])
        verdict = loop.rule.keeps(Difference(loop, less.refitted(trial.model), now, gain))
        if verdict.believed and now.model.effects[least].possible():
            break
        loop.say(f"  {words(key_of(now.model.effects[least]))} is needless now: it {verdict.reason}")
        now = less.refitted(trial.model)
        state = grow(loop, now, loop.longest, loop.longest) if now.found else None
    return now, state


def _loss(now: Hypothesis, state: EMState, place: int) -> float:
    """Log-likelihood that goes with an effect [nat]; none with one whose value makes no sense, all with steps seen."""
    effect, found = now.model.effects[place], now.found[place]
    if effect.read_off or found is None:
        return math.inf
    if not effect.possible():
        return 0.0
    return 0.5 * significance(found.candidate, now, state.hessian, place) ** 2


def concluded(loop: Loop, now: Hypothesis, state: EMState | None, steps: list[Step]) -> Closed:
    """The outcome, where all that was found together is worth it over the whole length; if not, less of it."""
    before = loop.before
    while state is not None and now.found:
        after = finished(before._replace(state=state, m_step=now.m_step), loop.data)
        now = now.refitted(after.model)
        verdict = loop.rule.keeps(Difference(loop, loop.bare, now, ahead(state, before.state)))
        # steps were read off the numbers themselves
        if verdict.believed or any(effect.read_off for effect in now.model.effects):
            return Closed(before, after, cast(tuple[Found, ...], now.found), tuple(steps))
        loop.say(f"  over the whole length it {verdict.reason} only: without the last law")
        now = now.without(len(now.found) - 1)
        state = grow(loop, now, loop.longest, loop.longest) if now.found else None
    return Closed(before, before, (), tuple(steps))
