"""Two fits of one machine, each on the recordings of the other: one law behind the quantities that differ."""

from collections.abc import Iterator
from typing import NamedTuple

import jax

from ..data.dataset import Dataset
from ..data.rig import Rig
from ..diagnosis.change import changes
from ..diagnosis.findings import findings
from ..diagnosis.search import diagnose
from ..diagnosis.smoothed import along
from ..diagnosis.verdict import RISEN
from ..em.loop import SEARCHED
from ..em.recorded import errors_of, left_out, level, levels, risen
from ..fit.identify import Identified
from ..fit.known import known
from ..numerics.digits import number
from ..storage.log import Log, silent
from .compare import Cause, Comparison


class Recorded(NamedTuple):
    """Recordings of a fit, and what was declared with them."""

    rig: Rig
    data: Dataset


def explained(comparison: Comparison, first: Recorded, second: Recorded, log: Log = silent) -> Comparison:
    """The comparison of two fits with what changed from the first to the second by `diagnose`.

    Raises FitError where one of them follows no recording of the other.
    """
    one, two = (fit.fitted for fit in comparison.fits)
    key = jax.random.fold_in(one.state.key, SEARCHED)
    judged = (*_judged(comparison, one, first, two, second), *_judged(comparison, two, second, one, first))
    diagnosis = diagnose(second.rig, second.data, key=key, log=log, start=one, own=first.data)
    accepted = findings(diagnosis)
    worn = all({*f.effect.signals(one.model.system)} <= {*one.model.system.rates} for f in accepted)
    some = accepted or (diagnosis.risen is not None and diagnosis.risen.p_value < RISEN)
    bent = "which is this change seen through friction" if some else "which the recordings do not confirm"
    text = changes(diagnosis, accepted, None).replace("the fit", comparison.names[0])
    return comparison._replace(cause=Cause(text, "" if accepted and worn else bent, judged))


def _judged(
    comparison: Comparison, fit: Identified, own: Recorded, other: Identified, recorded: Recorded
) -> Iterator[str]:
    """A sentence on the errors of a fit on the recordings of the other."""
    names = {id(each.fitted): each.name for each in comparison.fits}
    beside = along(fit, jax.device_put(own.data), fit.smoother)
    out = levels(left_out(beside.model, beside.m_step, beside.path, beside.data, beside.used))
    put = known(fit, recorded.rig, recorded.data, key=jax.random.fold_in(fit.state.key, SEARCHED))
    now = along(put, jax.device_put(recorded.data), put.smoother)
    test = risen(out.level, level(errors_of(now.model, now.m_step, now.path, now.data), out.scale))
    size = f"{number(test.ratio, 2)} times those on its own recordings left out (p = {number(test.p_value, 2)})"
    yield f"On the recordings of {names[id(other)]} the errors of {names[id(fit)]} are {size}"
