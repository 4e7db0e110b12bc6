"""Logs of a rig and what their owner declares: `rig.toml` and log files in, `Rig` and a padded `Dataset` out."""
