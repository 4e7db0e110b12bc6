"""First drafts of `rig.toml`."""
