"""What is missing: checks of logs, the search for effects, comparison of fits, the next experiment."""
