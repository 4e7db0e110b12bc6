"""The next experiment: inputs that determine what a fit leaves open."""
