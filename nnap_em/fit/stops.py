"""Rows of a log that reach the joint ranges of a machine file, whose stops have no force in the model."""

from collections.abc import Iterator

import numpy as np

from ..data.dataset import Dataset
from ..data.machine import unpacked
from ..data.rig import Rig
from ..numerics.digits import counted


def at_stops(rig: Rig, data: Dataset) -> Iterator[str]:
    """A sentence for every measured joint whose readings touch an end of its range."""
    if not rig.machine:
        return
    machine = unpacked(rig.machine)
    for joint, name in zip(machine.joints, machine.states, strict=False):
        if joint.range is None or name not in rig.measured:
            continue
        y = np.asarray(data.y)[..., rig.measured.index(name)]
        low, high = joint.range
        margin = 0.005 * (high - low)  # within which a reading counts as at its end
        touched = np.isfinite(y) & ((y < low + margin) | (y > high - margin))
        if touched.any():
            unit = rig.unit(name)
            text = (
                f"{name}: {counted(touched.sum(), 'reading')} at or beyond its range of {low:.4g} to {high:.4g} {unit}"
            )
            yield f"{text}; stops have no force in the model: leave those stretches out, or let diagnose find hard_stop"
