"""Two fits of one machine, each on the recordings of the other: one law behind the quantities that differ."""

from typing import NamedTuple

import jax

from ..data.dataset import Dataset
from ..data.rig import Rig
from ..diagnosis.change import changes
from ..diagnosis.findings import findings
from ..diagnosis.search import diagnose
from ..diagnosis.smoothed import along, risen_since
from ..diagnosis.verdict import RISEN
from ..em.loop import SEARCHED
from ..fit.known import known
from ..numerics.digits import number
from ..storage.log import Log, silent
from .compare import Cause, Comparison, Fit, unconfirmed


class Recorded(NamedTuple):
    """Recordings of a fit, and what was declared with them."""

    rig: Rig
    data: Dataset


def explained(comparison: Comparison, first: Recorded, second: Recorded, log: Log = silent) -> Comparison:
    """The comparison of two fits with what changed from the first to the second by `diagnose`.

    Raises FitError where one of them follows no recording of the other.
    """
    one, two = comparison.fits
    judged = _judged(one, first, two, second), _judged(two, second, one, first)
    start, system, key = one.fitted, one.fitted.model.system, jax.random.fold_in(one.fitted.state.key, SEARCHED)
    diagnosis = diagnose(second.rig, second.data, key=key, log=log, start=start, own=first.data)
    accepted, test = findings(diagnosis), diagnosis.risen
    worn = all(set() < {*f.effect.signals(system)} <= {*system.rates} for f in accepted)
    some = accepted or (test is not None and test.p_value < RISEN)
    text = changes(diagnosis, accepted).replace("the fit", one.name)
    bent = "" if accepted and worn else "which is this change seen through friction"
    return (comparison if some else unconfirmed(comparison))._replace(cause=Cause(text, bent, judged))


def _judged(fit: Fit, own: Recorded, other: Fit, recorded: Recorded) -> str:
    """A sentence on the errors of a fit on the recordings of the other."""
    one = fit.fitted
    put = known(one, recorded.rig, recorded.data, key=jax.random.fold_in(one.state.key, SEARCHED))
    pairs = (one, own.data), (put, recorded.data)
    test = risen_since(*(along(each, jax.device_put(data), each.smoother) for each, data in pairs))
    size = f"{number(test.ratio, 2)} times those on its own recordings left out (p = {number(test.p_value, 2)})"
    return f"On the recordings of {other.name} the errors of {fit.name} are {size}"
