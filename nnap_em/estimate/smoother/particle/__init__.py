"""Particle smoother: a filter that looks ahead, and draws of trajectories backward through its particles."""

from .backward import ExactBackward, ffbs
from .filter import particle_filter
from .potentials import Bootstrap, Guided, Lookahead, Potentials
from .smoother import ParticleSmoother

__all__ = [
    "Bootstrap",
    "ExactBackward",
    "Guided",
    "Lookahead",
    "ParticleSmoother",
    "Potentials",
    "ffbs",
    "particle_filter",
]
