"""Test of what the logs can identify."""
