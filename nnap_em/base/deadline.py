"""A moment after which a long computation begins no new step (`journal.step`)."""

import contextlib
import contextvars
import math
import time
from collections.abc import Iterator

from .parallel import everywhere

_end: contextvars.ContextVar[float] = contextvars.ContextVar("nnap_em_deadline", default=math.inf)


class TimeUp(RuntimeError):
    """The deadline has passed; finished steps are kept where a journal is."""


@contextlib.contextmanager
def until(moment: float) -> Iterator[None]:
    """Within, a step that begins after `moment` of `time.monotonic()` raises TimeUp, in every process alike."""
    token = _end.set(moment)
    try:
        yield
    finally:
        _end.reset(token)


def late() -> bool:
    """True where the deadline has passed in any process."""
    end = _end.get()
    return end < math.inf and not everywhere(time.monotonic() < end)


def in_time() -> None:
    """Raises TimeUp where the deadline has passed."""
    if late():
        raise TimeUp("the time is up")
