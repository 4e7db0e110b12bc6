"""Fits of a declared machine to its logs: identify, predict, smooth, save and load."""
