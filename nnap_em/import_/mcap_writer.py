"""Channels of numbers beside a log, as JSON messages in one MCAP file, for Foxglove and other viewers.

The format: mcap.dev/spec.
"""

import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..data.dataset import DataError
from ..data.logs import Logs
from ..storage.files import replace_bytes
from .recording import EXTRA


class Channel(NamedTuple):
    """Columns of one topic, for every sequence."""

    units: Mapping[str, str]
    """Unit by column."""
    values: Float[np.ndarray, "seq time column"]


def require_mcap(path: Path) -> None:
    """Raise DataError where the package that writes MCAP files is not installed."""
    try:
        import mcap.writer  # noqa: F401
    except ImportError:
        raise DataError(f"{path}: MCAP files cannot be written without mcap; {EXTRA}") from None


def write_mcap(path: Path, logs: Logs, channels: Mapping[str, Channel]) -> None:
    """Write a message per topic and row: `file`, `time` [s] of the log, and every column that is a finite number.

    The file is whole or absent. Log times are those of the logs; a sequence that would begin before the end of the one
    before follows it by a second.
    Raises DataError where mcap is not installed.
    """
    require_mcap(path)
    from mcap.writer import Writer

    content = io.BytesIO()
    writer = Writer(content)
    writer.start(library="nnap_em")
    numbers, fixed = {}, {"file": {"type": "string"}, "time": {"type": "number", "description": "s"}}
    for topic, channel in channels.items():
        columns = {name: {"type": "number", "description": unit} for name, unit in channel.units.items()}
        text = json.dumps({"type": "object", "properties": fixed | columns})
        schema = writer.register_schema(topic.lstrip("/"), "jsonschema", text.encode())
        numbers[topic] = writer.register_channel(topic, "json", schema)
    valid = np.asarray(logs.data.valid)
    for i, (file, stamps) in enumerate(zip(logs.files, _stamps(logs), strict=True)):
        time = np.asarray(logs.data.t, np.float64)[i]
        for k in np.flatnonzero(valid[i]):
            stamp = int(stamps[k])
            for topic, channel in channels.items():
                row = zip(channel.units, channel.values[i, k].tolist(), strict=True)
                message = {"file": file, "time": float(time[k])} | {n: x for n, x in row if np.isfinite(x)}
                writer.add_message(numbers[topic], stamp, json.dumps(message).encode(), stamp)
    writer.finish()
    replace_bytes(path, content.getvalue())


def _stamps(logs: Logs) -> list[np.ndarray]:
    """Log times of the rows of every sequence [ns]."""
    gap = 1.0  # between the sequences of logs whose clocks all begin at the same time [s]
    out, end = [], -gap
    for t, valid in zip(np.asarray(logs.data.t, np.float64), np.asarray(logs.data.valid), strict=True):
        shift = end + gap - t[0] if t[0] <= end or t[0] < 0 else 0.0
        end = float(t[valid][-1] + shift)
        out.append(np.round((t + shift) * 1e9).astype(np.int64))
    return out
