"""Expectation-Maximisation: first model, E-step, M-step and their loop."""
