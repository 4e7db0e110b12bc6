"""Logs of a rig and what their owner declares: `rig.toml` and log files in, `Rig` and a padded `Dataset` out."""

from .dataset import Dataset, fill_missing, pad
from .logs import Logs, read_logs

__all__ = ["Dataset", "Logs", "fill_missing", "pad", "read_logs"]
