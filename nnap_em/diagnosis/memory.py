"""Friction with memory: the search of `diagnose`, restricted to the contact of each joint."""

import functools
from typing import cast

import jax
import numpy as np

from ..data.dataset import Dataset
from ..data.logs import Logs, sequences_of
from ..data.rig import Rig
from ..fit.identify import Identified, finished
from ..fit.identify import identify as identify_static
from ..model.dynamic_friction import DynamicFriction
from ..numerics.digits import share_of
from ..prediction_error.noise import white_readings
from ..storage.log import Log, silent
from .context import SEARCH_EFFORT, SearchContext
from .hypothesis import Evidence
from .keys import key_of
from .losses import MultiStep
from .outcome import Diagnosis
from .search import search, unbranched


@functools.wraps(identify_static)
def identify(rig: Rig, data: Dataset | Logs, *, start: Identified | None = None, **options) -> Identified:
    """The fit; where `friction = "dynamic"` is declared with a contact in each joint whose friction has memory."""
    fitted = identify_static(rig, data, start=start, **options)
    return with_memory(fitted, data) if rig.memory and start is None else fitted


def with_memory(fitted: Identified, data: Dataset | Logs, log: Log = silent) -> Identified:
    """A fit with a static map, or one with contacts where the search accepts them; with a sentence on each joint."""
    data = Dataset(*map(jax.device_put, sequences_of(data, fitted.rig)))
    before, joints = fitted._replace(smoother=unbranched(fitted.bank)), len(fitted.model.system.coordinates)
    effort = SEARCH_EFFORT._replace(most=joints, shortlist=joints)
    context = SearchContext(before, {}, data, MultiStep(), effort, log, kinds=(DynamicFriction,))
    found = search(context, white=white_readings(data, fitted.model), release=finished)
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
