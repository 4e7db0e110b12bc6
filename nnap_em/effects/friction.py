"""Friction that changes: with the position, with time, with the load."""

import math
from functools import partial
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .base import Candidate, JointEffect, Scalar, a, input_of, known, one, pair


class PositionDependentFriction(JointEffect):
    """tau_f (1 + depth cos(n theta_j + phase))."""

    name: ClassVar[str] = "position_dependent_friction"
    confirm: ClassVar[str] = "Turn the joint slowly through its range and log the torque that it takes."
    units: ClassVar[dict[str, str]] = {"depth": "-", "n": "-", "phase": "rad"}
    cosine: Scalar
    sine: Scalar
    n: Scalar

    @classmethod
    def candidates(cls, around):
        turning = around.turning if around.learned else []
        return [pair(partial(cls.of, joint=j), 0.1, 1.0, (n, 0.3)) for j in turning for n in np.arange(1.0, 7.0)]

    def values(self):
        depth = jnp.sqrt(self.sine**2 + self.cosine**2 + 1e-30)
        return {"depth": depth, "n": self.n, "phase": jnp.arctan2(-self.sine, self.cosine)}

    def signals(self, system):
        return system.coordinates[self.joint - 1], system.rates[self.joint - 1]

    def friction(self, torque, scene):
        angle = self.n * self.own(scene.q)
        factor = 1 + self.cosine * jnp.cos(angle) + self.sine * jnp.sin(angle)
        return torque.at[self.joint - 1].multiply(factor)


class FrictionDrift(JointEffect):
    """tau_f (1 + change (1 - exp(-t / tau)))."""

    name: ClassVar[str] = "friction_drift"
    confirm: ClassVar[str] = "Run the same motion cold and warm."
    units: ClassVar[dict[str, str]] = {"change": "-", "tau": "s"}
    change: Scalar
    pace: Scalar
    """Log of tau."""

    @classmethod
    def candidates(cls, around):
        if not around.learned:
            return []
        span = around.duration[1] - around.duration[0]
        out = []
        for j in around.joints:
            make = partial(cls.of, joint=j)
            paces = [math.log(share * span) for share in (0.05, 0.15, 0.4, 1.0)]
            out += [Candidate(make(0.0, pace), (make(0.1, pace),), make(1.0, 1.0)) for pace in paces]
        return out

    def values(self):
        return {"change": self.change, "tau": jnp.exp(self.pace)}

    def signals(self, system):
        return system.rates[self.joint - 1], "time"

    def friction(self, torque, scene):
        grown = 1 - jnp.exp(-scene.time * jnp.exp(-self.pace))
        return torque.at[self.joint - 1].multiply(1 + self.change * grown)


class LoadFriction(JointEffect):
    """Coulomb friction -mu |u| sign(w) that grows with the torque u through the gear."""

    name: ClassVar[str] = "load_friction"
    reported_as: ClassVar[str] = "unknown_function"
    confirm: ClassVar[str] = "Lift and lower a weight slowly: the torques differ by twice the friction, at each weight."
    units: ClassVar[dict[str, str]] = {"mu": "-"}
    above_zero: ClassVar[str] = "mu"
    mu: Scalar
    knee: Scalar = known()
    """Rate over which the sign is smoothed [rad/s]."""
    names: tuple[str, str] = eqx.field(static=True, kw_only=True)
    """Of the input and of the rate."""

    @classmethod
    def candidates(cls, around):
        out = []
        for j, _ in around.driven:
            knee, names = a(0.02 * float(around.speed[j - 1])), (around.column(j), around.system.rates[j - 1])
            out.append(one(partial(cls, knee=knee, names=names, joint=j), 0.0, 0.05, 0.5))
        return out

    def inputs_named(self):
        return self.names

    def signals(self, system):
        return input_of(self.joint), system.rates[self.joint - 1]

    def force(self, scene, memory):
        return self.at(scene, -self.mu * jnp.abs(self.own(scene.drive)) * jnp.tanh(self.own(scene.v) / self.knee))
