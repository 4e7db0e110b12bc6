"""Logs on the grid as a data set: which sequence is for training, and its file."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ...base.digits import counted
from ...errors import DataError
from ...machines.rig import Rig
from ..formats import write_csv
from .resample import Resampled


def places(logs: Sequence[Resampled], test: float) -> list[str]:
    """The files of all sequences that are used, in the order of the logs: the last ones are for the test.

    `test` from 1 on is how many, below 1 their share; one sequence is left to train on.
    """
    count = sum(len(log.values) for log in logs)
    tests = round(test) if test >= 1 else min(math.ceil(test * count - 1e-9), count - 1)
    if tests >= count:
        hint = "give fewer, or set [import] longest lower in rig.toml"
        raise DataError(
            f"--test {test:g}: the logs give {counted(count, 'sequence')}, and one is needed to train on; {hint}"
        )
    digits = max(len(str(count - 1)), 3)
    return [f"train/{i:0{digits}d}.csv" for i in range(count - tests)] + [
        f"test/{i:0{digits}d}.csv" for i in range(tests)
    ]


def write_sequences(folder: Path, logs: Sequence[Resampled], files: Sequence[str], rig: Rig) -> None:
    """One CSV file a sequence; the clock begins at 0 in each, or runs on from the first log's, as the rig declares."""
    names = iter(files)
    for log in logs:
        used = [stretch for stretch in log.sequences if not stretch.why]
        for stretch, values in zip(used, log.values, strict=True):
            offset = 0.0 if rig.clock == "sequence" else (log.origin - logs[0].origin) / rig.ns + stretch.start
            time = offset + rig.dt * np.arange(stretch.rows)
            write_csv(folder / next(names), {"time": time} | dict(values))
