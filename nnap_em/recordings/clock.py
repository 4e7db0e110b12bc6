"""The times of a topic: which clock to take, and what is wrong with it."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from ..numerics.digits import counted
from .recording import refuse

APART = 10.0
"""Seconds between stamp and log time from which on they are those of two clocks."""
BACK = 1.0
"""Seconds that a log may be out of order: writers of several threads are, a clock that was set back is more."""


class Clock(NamedTuple):
    """Times that rise, and the messages that they belong to."""

    t: Int[np.ndarray, " kept"]
    """ns."""
    used: Int[np.ndarray, " kept"]
    """Indices of the used messages, in the order of their times."""
    name: str
    notes: tuple[str, ...]


def choose(
    path: Path, topic: str, log: Int[np.ndarray, " message"], stamp: Int[np.ndarray, " message"] | None
) -> Clock:
    """Header stamps where they are there, rise and are of the log's clock; log times otherwise [ns].

    Raises DataError where there is no time at all, or it runs backwards.
    """
    where = f"topic {topic!r}"
    order = np.argsort(log, kind="stable")
    notes = []
    if stamp is not None:
        reason = _odd(stamp[order], log[order])
        if reason is None:
            return _single(stamp[order], order, "header stamp", ())
        notes.append(f"header stamps {reason}: log times are taken")
    if log.size > 1 and log.min() == log.max():
        hint = "record with stamps, or write the topic with a header"
        refuse(path, where, f"has no stamps: all {log.size} messages are at {log[0] * 1e-9:g} s", hint)
    steps = np.diff(log)
    back = steps < 0
    if back.any():
        k = int(np.argmin(np.where(back, log[1:] - np.maximum.accumulate(log)[:-1], 0)))
        amount = float(np.maximum.accumulate(log)[k] - log[k + 1]) * 1e-9
        if amount > BACK:
            refuse(path, where, *_backwards(f"message {k + 2}", amount))
        notes.append(f"{counted(back.sum(), 'message')} out of order by up to {amount:.2g} s: sorted")
    return _single(log[order], order, "log time", tuple(notes))


def rising(path: Path, where: str, t: Int[np.ndarray, " row"], name: str) -> Clock:
    """The times of a table [ns], which may stand but not run backwards."""
    back = np.flatnonzero(np.diff(t) < 0)
    if back.size:
        k = int(back[0])
        refuse(path, where, *_backwards(f"row {k + 2}", float(t[k] - t[k + 1]) * 1e-9))
    if t.size > 1 and t[0] == t[-1]:
        refuse(path, where, f"has no stamps: all {t.size} rows are at {t[0] * 1e-9:g} s", "log the time [s]")
    return _single(t, np.arange(t.size), name, ())


def _backwards(row: str, amount: float) -> tuple[str, str]:
    hint = "the clock was set back there: cut the file at that place"
    return f"time runs backwards at {row}, by {amount:.6g} s", hint


def _single(t: Int[np.ndarray, " m"], order: Int[np.ndarray, " m"], name: str, notes: tuple[str, ...]) -> Clock:
    """The last of the messages at one time: the last command is held."""
    last = np.append(np.diff(t) > 0, True)
    if not last.all():
        same = counted(np.sum(~last), "message")
        notes = (*notes, f"{same} with the time of the next one: the last of each is taken")
    return Clock(t[last], order[last], name, notes)


def _odd(stamp: Int[np.ndarray, " message"], log: Int[np.ndarray, " message"]) -> str | None:
    """Reason why stamps are no clock."""
    if stamp.max() == stamp.min():
        return "are all the same" if stamp[0] else "are all 0"
    back = np.flatnonzero(np.diff(stamp) < 0)
    if back.size:
        return f"run backwards ({back.size} times)"
    offset = float(np.median(np.abs(stamp - log))) * 1e-9
    return f"are of another clock, {offset:.4g} s from that of the log" if offset > APART else None
