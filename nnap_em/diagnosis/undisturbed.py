"""Recordings without their external disturbances: cut at each, and fitted anew."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float

from ..data.dataset import Dataset
from ..em.loop import FitError
from ..fit.identify import Identified
from .interventions import LEVEL, MORE, Intervention, in_order, interventions, overlap

ROUNDS = 3
"""Largest number of new fits: a fit without one disturbance shows another more clearly."""


def without(
    data: Dataset, disturbances: tuple[Intervention, ...], dt: float, *, restart: bool = True
) -> tuple[Dataset, tuple[int, ...]]:
    """The recordings cut at the disturbances, and the recording that every piece comes from.

    The rows between two disturbances become a sequence of their own, if they are enough.  Without `restart`, where the
    state of the first row is declared and holds there alone, only the rows before the first disturbance stay.
    """
    cut_margin, shortest = 0.1, 0.5  # time left out around a disturbance, and shortest piece that is of use [s]
    margin, least = round(cut_margin / dt), max(2, round(shortest / dt))
    pieces: list[tuple[int, int, int]] = []
    for i, valid in enumerate(np.asarray(data.valid)):
        use = np.append(valid, False)
        for disturbance in disturbances:
            if disturbance.sequence == i:
                use[max(0, disturbance.first - margin) : disturbance.last + margin + 1] = False
        edges = np.flatnonzero(np.diff(np.concatenate([[False], use]).astype(int)))
        runs = [(i, int(a), int(b)) for a, b in edges.reshape(-1, 2)]
        if not restart:
            runs = [run for run in runs if run[1] == 0]
        pieces += [run for run in runs if run[2] - run[1] >= min(least, valid.sum())]
    if not pieces:
        return data, ()
    rows = max(b - a for _, a, b in pieces)
    t, u, y, _ = (np.asarray(part) for part in data)

    def cut(values: Float[np.ndarray, "seq time *column"], filler: float | None) -> np.ndarray:
        parts = [values[i, a:b] for i, a, b in pieces]
        pad = [np.full((rows - len(p), *p.shape[1:]), p[-1] if filler is None else filler) for p in parts]
        return np.stack([np.concatenate(both) for both in zip(parts, pad, strict=True)])

    length = np.asarray([b - a for _, a, b in pieces])
    valid: Bool[np.ndarray, "seq time"] = np.arange(rows) < length[:, None]
    return Dataset(cut(t, None), cut(u, 0.0), cut(y, np.nan), valid), tuple(i for i, _, _ in pieces)


def disturbance_free(
    fit: Callable[[Dataset], Identified], fitted: Identified, data: Dataset
) -> tuple[Identified, Dataset, tuple[Intervention, ...], tuple[int, ...]]:
    """A fit without disturbances, its sequences, the disturbances, and the recording that each sequence is a piece of.

    `fitted` is the fit of all rows.
    """
    used, disturbances, pieces = data, interventions(fitted, data), tuple(range(len(data.t)))
    for _ in range(ROUNDS if disturbances else 0):
        cut, of = without(data, disturbances, fitted.rig.dt, restart=not fitted.rig.start)
        try:
            fitted = fit(cut) if of else fitted
        except FitError:  # too few rows are left: the fit of all rows stays
            break
        used, pieces = (cut, of) if of else (used, pieces)
        added = [
            t for t in interventions(fitted, data, MORE * LEVEL) if not any(overlap(t, old) for old in disturbances)
        ]
        if not added:
            break
        disturbances = tuple(sorted([*disturbances, *added], key=in_order))
    return fitted, used, disturbances, pieces
