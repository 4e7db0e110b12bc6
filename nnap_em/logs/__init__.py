"""Recordings: log files give a padded `Dataset`; importers give log files, drafts a first `rig.toml`."""
