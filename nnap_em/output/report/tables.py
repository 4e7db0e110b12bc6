"""Numbers as files: JSON reports and friction tables, written whole or not at all."""

import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from ...estimate.identify import nodes_between
from ...logs.formats import write_csv

FRICTION = "joint,velocity,torque,torque_std"
"""First line of a friction table."""
INNER = (0.5, 99.5)
"""Percentiles of the rows between which a range counts as visited."""


def json_text(document: Mapping[str, Any], naming: Callable[[str], str] = str) -> str:
    """A document as JSON, texts as `naming` returns them."""
    return json.dumps(plain(document, naming), indent=1, allow_nan=False, ensure_ascii=False) + "\n"


def plain(value: Any, naming: Callable[[str], str] = str) -> Any:
    """A document as JSON holds it: named tuples by their fields, arrays as lists, null for what is not finite."""
    if isinstance(value, tuple) and type(value) is not tuple:
        value = value._asdict()  # type: ignore[attr-defined]
    if isinstance(value, np.ndarray | jax.Array):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {name: plain(item, naming) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item, naming) for item in value]
    if isinstance(value, str):
        return naming(value)
    return None if isinstance(value, float) and not math.isfinite(value) else value


def visited_nodes(velocity: Float[np.ndarray, "sample dof"]) -> Float[np.ndarray, "dof node"]:
    """Velocities from the 0.5th to the 99.5th percentile of each joint, dense near rest, where friction bends."""
    low, high = np.percentile(velocity, INNER, axis=0)
    return nodes_between(low, high, 101)


def write_friction(path: Path, velocity, torque, std) -> None:
    """A friction table as the interface has it: joint,velocity,torque,torque_std."""
    joint = np.repeat(1 + np.arange(velocity.shape[0]), velocity.shape[1])
    columns = {"velocity": velocity, "torque": torque, "torque_std": std}
    write_csv(path, {"joint": joint} | {name: np.asarray(values).ravel() for name, values in columns.items()})
