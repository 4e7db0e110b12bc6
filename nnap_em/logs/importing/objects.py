"""Numbers of decoded messages: dicts, lists and objects with fields, whoever decoded them."""

import functools
import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from .recording import steps

NAMES = ("name", "names", "joint_names")
"""Fields that name the entries of the arrays beside them."""
LISTED_ENTRIES = 256
"""Entries of an array that are listed."""


def flatten(message: Any) -> dict[str, float]:
    """All numbers of a message by their paths; entries of an array by name where names stand beside it."""
    return dict(_numbers(message, ""))


def pick(message: Any, path: str) -> float:
    """The number at a path; NaN where the message has none."""
    at, names = _way(message, path) if isinstance(message, dict) else (message, steps(path))
    parent = None
    try:
        for step in names:
            if isinstance(step, int):
                at = at[step]
            elif step[0] == "[":
                at = at[_names(parent)[step[1:]]]
            else:
                at, parent = _get(at, step), at
        return math.nan if at is None or isinstance(at, str) else float(at)
    except (KeyError, IndexError, ValueError, AttributeError, TypeError):
        return math.nan


def _way(message: Any, path: str) -> tuple[Any, tuple[str | int, ...]]:
    """Start and steps of a path in a dict; a name with dots or brackets, as `Torque [Nm]`, is one step."""
    while isinstance(message, dict) and path not in message and isinstance(message.get(path.split(".")[0]), dict):
        head, _, path = path.partition(".")
        message = message[head]
    return message, (path,) if isinstance(message, dict) and path in message else steps(path)


def _numbers(at: Any, path: str) -> Iterator[tuple[str, float]]:
    if isinstance(at, bool | int | float | np.number | np.bool_):
        yield path, float(at)
    elif _is_list(at):
        for i, item in enumerate(at[:LISTED_ENTRIES]):
            yield from _numbers(item, f"{path}[{i}]")
    elif not isinstance(at, str | bytes | None):
        names = _names(at)
        for field in _fields(at):
            value, inner = _get(at, field), f"{path}.{field}" if path else field
            if _is_list(value) and len(value) == len(names) and field not in NAMES:
                for name, item in zip(names, value, strict=True):
                    yield from _numbers(item, f"{inner}[{name}]")
            else:
                yield from _numbers(value, inner)


def _is_list(value: Any) -> bool:
    quick = list, tuple, np.ndarray
    return isinstance(value, quick) or (isinstance(value, Sequence) and not isinstance(value, str | bytes))


def _names(parent: Any) -> dict[str, int]:
    """Places of the entries by their names, different texts all."""
    for field in NAMES:
        found = _get(parent, field, None)
        if found is not None and _is_list(found) and len(found) and isinstance(found[0], str):
            return _places(tuple(found))
    return {}


@functools.lru_cache
def _places(names: tuple[Any, ...]) -> dict[str, int]:
    different = len(set(names)) == len(names) and all(isinstance(name, str) and name for name in names)
    return {name: i for i, name in enumerate(names)} if different else {}


def _fields(at: Any) -> Sequence[str]:
    if isinstance(at, dict):
        return [str(name) for name in at]
    described = getattr(at, "DESCRIPTOR", None)
    return [field.name for field in described.fields] if described else list(vars(at))


def _get(at: Any, field: str, *absent: Any) -> Any:
    if isinstance(at, dict):
        return at.get(field, *absent) if absent else at[field]
    return getattr(at, field, *absent)
