"""Inference: a `Rig` and a `Dataset` give states, friction, numbers and noise; a fit gives predictions.

Smoothers, for `identify(..., smoother=...)`, are each made from the hypotheses of the start of a fit. With options one
is a function, `lambda bank: ParticleSmoother(CubatureSmoother(bank), num_particles=1000)`.
"""

from .smoother.gaussian import CubatureSmoother, ExtendedKalmanSmoother
from .smoother.mixture import MixtureSmoother
from .smoother.particle import ParticleSmoother
from .smoother.posterior import Posterior

__all__ = ["CubatureSmoother", "ExtendedKalmanSmoother", "MixtureSmoother", "ParticleSmoother", "Posterior"]
