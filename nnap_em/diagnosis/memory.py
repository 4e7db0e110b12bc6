"""Friction with memory: the search of `diagnose`, restricted to the contact of each joint."""

from typing import cast

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from ..data.dataset import Dataset, stepped
from ..data.logs import Logs, sequences_of
from ..data.rig import Rig
from ..em.loop import EPOCHS, SCHEDULE, Schedule
from ..em.noise import white_readings
from ..fit.identify import Identified, MakeSmoother, Watch, finished, unwatched
from ..fit.identify import identify as identify_static
from ..model.dynamic_friction import DynamicFriction
from ..numerics.digits import share_of
from ..storage.log import Log, silent
from .context import SEARCH_EFFORT, SearchContext
from .hypothesis import Evidence
from .keys import key_of
from .losses import MultiStep
from .outcome import Diagnosis
from .search import search, unbranched


def identify(
    rig: Rig,
    data: Dataset | Logs,
    *,
    key: PRNGKeyArray,
    smoother: MakeSmoother | None = None,
    epochs: int = EPOCHS,
    schedule: Schedule = SCHEDULE,
    start: Identified | None = None,
    watch: Watch = unwatched,
) -> Identified:
    """Fit the declared unknowns of a rig to logs by Expectation-Maximisation: friction, uncertain parameters, noise.

    [Vantilborgh, Lefebvre & Crevecoeur, the paper that this library implements, algorithm 1]

    Args:
        rig: what is declared.
        data: sequences to fit.
        key: random key of the start.
        smoother: makes the smoother, such as `nnap_em.smoothers.ParticleSmoother`; without it that of `start`, or the
            cubature smoother.
        epochs: of EM, at most.
        schedule: the growing horizon.
        start: a fit to go on from.
        watch: called after every epoch with its state, the rows seen and the sequences used.

    Returns:
        The fitted model with what is needed to use it, to judge it and to go on; `print` shows a table.

    Raises:
        DataError: arrays are not of the rig: other columns, another interval, a row without an input.
        FitError: no sequence can be followed.

    Example:
        >>> fit = nnap_em.identify(rig, train, key=key, epochs=3)
        >>> fit.model.log_r.shape  # one measured column
        (1,)
    """
    options = {"key": key, "smoother": smoother, "epochs": epochs, "schedule": schedule, "start": start, "watch": watch}
    fitted = identify_static(rig, data, **options)
    return with_memory(fitted, data) if rig.memory and start is None else fitted


def with_memory(fitted: Identified, data: Dataset | Logs, log: Log = silent) -> Identified:
    """A fit with a static map, or one with contacts where the search accepts them; with a sentence on each joint."""
    data = Dataset(*map(jax.device_put, stepped(sequences_of(data, fitted.rig))))
    before, joints = fitted._replace(smoother=unbranched(fitted.bank)), len(fitted.model.system.coordinates)
    effort = SEARCH_EFFORT._replace(most=joints, shortlist=joints)
    white = white_readings(data, fitted.model)
    context = SearchContext(before, {}, data, MultiStep(), effort, log, white=white, kinds=(DynamicFriction,))
    found = search(context, release=finished)
    sentences = "\n".join(f"joint {j + 1}: {_sentence(found, j + 1)}" for j in range(joints))
    outcome = found.after if found.evidence else fitted
    return outcome._replace(smoother=fitted.smoother, memory=sentences)


def _sentence(found: Diagnosis, joint: int) -> str:
    """Outcome of the search at a joint, by the last round that judged it."""
    law, error = (DynamicFriction.name, joint, None, ()), "the squared error"
    laws = dict(zip(map(key_of, found.after.model.effects), found.evidence, strict=True))
    if law in laws:
        return f"memory (its contact removes {share_of(cast(Evidence, laws[law]).removed, error, 1)})"
    for step in reversed(found.steps):
        refused, seen = (dict(shares).get(law, np.nan) for shares in (step.refitted, step.screened))
        if np.isfinite(refused):
            return f"the static map is kept, memory predicts no better (it removes {share_of(refused, error, 1)})"
        if np.isfinite(seen):
            return f"the static map is kept, no memory is seen (a contact would remove {share_of(seen, error, 1)})"
    return "the static map is kept, no memory is seen"
