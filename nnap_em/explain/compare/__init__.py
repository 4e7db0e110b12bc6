"""Fits of one machine against each other: joint tests for changes and pooled estimates."""
