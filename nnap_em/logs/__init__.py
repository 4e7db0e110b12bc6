"""What was recorded: log files in, a padded `Dataset` out; import from recorders, and first drafts of a rig.toml."""
