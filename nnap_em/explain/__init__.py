"""Explanation of what a model leaves: checks of logs, search for effects, comparison of fits, design of experiments."""
