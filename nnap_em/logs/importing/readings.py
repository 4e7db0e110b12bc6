"""Readings as a sensor took them: each once, without the jumps of a counter, or with these marked."""

from collections.abc import Collection, Mapping
from dataclasses import replace

import numpy as np

from ...base.digits import counted
from ...machines.rig import Rig
from ..counters import counter
from ..held import hold, repeats
from .signals import Signal


def as_taken(
    signals: Mapping[str, Signal], rig: Rig, unwrap: Collection[str]
) -> tuple[dict[str, Signal], tuple[str, ...]]:
    """Signals without repeated readings, those to `unwrap` without jumps, and notes of what was found.

    Inputs are commands, which may repeat and jump; they are looked at only where they are to be unwrapped.
    """
    out, notes = dict(signals), []
    for name in rig.measured:
        s, rows = out[name], hold([out[name].y])
        if rows > 1:
            again = repeats(s.y, rows)
            out[name] = replace(s, t=np.delete(s.t, again), y=np.delete(s.y, again))
            notes.append(f"{name}: each reading stands in {rows:.3g} messages: {again.size} repeats are left out")
    for name in dict.fromkeys((*rig.measured, *unwrap)):
        s, unit = out[name], rig.unit(name)
        found = None if unit.endswith("/s") else counter(s.y, angle=unit == "rad")
        if found is None:
            notes += [f"{name} has no jumps of one size: nothing was unwrapped"] * (name in unwrap)
            continue
        text = f"{name} {found}, in {counted(found.rows.size, 'place')}"
        if name in unwrap:
            out[name] = replace(s, y=s.y + found.size * found.turns)
            notes.append(f"{text}: unwrapped")
        else:
            out[name] = replace(s, jumps=found.rows)
            notes.append(f"{text}: nothing is interpolated there; --unwrap {name} takes the jumps out")
    return out, tuple(notes)
