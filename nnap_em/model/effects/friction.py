"""Forces of the velocity: drag, friction that changes with position, time and load, friction with memory."""

import math
from dataclasses import replace
from functools import partial
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .base import KNEE, AbstractEffect, Candidate, JointEffect, Scalar, a, fields, input_of, known, one, pair
from .function import Axis, axes_of, drawn


class PositionDependentFriction(JointEffect):
    """tau_f (1 + depth cos(n theta_j + phase))."""

    meaning: ClassVar[str] = "Friction is stronger at some angles than at others."
    confirm: ClassVar[str] = "Turn the joint slowly through its range and log the torque that it takes."
    units: ClassVar[dict[str, str]] = {"depth": "-", "n": "-", "phase": "rad"}
    dry: ClassVar[bool] = True
    words: ClassVar[dict[str, str]] = {"depth": "relative depth", "n": "periods per turn", "phase": "phase"}
    arguments: ClassVar[tuple[str, ...]] = ("position", "rate")
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

    def visible(self, around):
        return self.repeats(self.n, around)

    def friction(self, torque, scene):
        angle = self.n * self.own(scene.q)
        factor = 1 + self.cosine * jnp.cos(angle) + self.sine * jnp.sin(angle)
        return torque.at[self.joint - 1].multiply(factor)


class DryFriction(JointEffect):
    """-f(theta_j) sign(w_j), f free: what some angles take beside the learned map."""

    reported_as: ClassVar[str] = "unknown_function"
    meaning: ClassVar[str] = "Dry friction that depends on the angle, as of a worn tooth or a dented bearing."
    named: ClassVar[bool] = False
    confirm: ClassVar[str] = PositionDependentFriction.confirm
    held: ClassVar[bool] = True
    dry: ClassVar[bool] = True
    arguments: ClassVar[tuple[str, ...]] = ("position", "rate")
    weights: Float[Array, " basis"]
    axis: Axis
    knee: Scalar = known()
    """Rate over which the sign is smoothed [rad/s]."""
    rate: str = eqx.field(static=True, kw_only=True)
    """Name of w_j."""

    @classmethod
    def candidates(cls, around):
        places, out = axes_of(around), []
        for j, (name, rate) in enumerate(zip(around.system.coordinates, around.system.rates, strict=True), 1):
            if not around.learned or (name,) not in places:
                continue
            axis, size = places[name,](20), float(around.torque[j - 1])
            make = partial(cls, axis=axis, knee=KNEE * float(around.speed[j - 1]), rate=rate, joint=j)
            probes = tuple(make(jnp.asarray(0.05 * size * row)) for row in np.eye(axis.count))
            out.append(Candidate(make(jnp.zeros(axis.count)), probes, make(jnp.full(axis.count, 0.3 * size))))
        return out

    def inputs_named(self):
        return *self.axis.names, self.rate

    def inputs_free(self):
        return self.axis.names

    def force(self, scene, memory):
        taken = self.weights @ self.axis.basis(self.own(scene.q))
        return self.at(scene, -taken * jnp.tanh(self.own(scene.v) / self.knee))

    def curve(self, cov, system):
        return drawn(self.axis, self.weights, self.joint, cov, system, "dry friction")


class FrictionDrift(JointEffect):
    """tau_f (1 + change (1 - exp(-t / tau)))."""

    meaning: ClassVar[str] = "Friction changes with time, as by warming up."
    confirm: ClassVar[str] = "Run the same motion cold and warm."
    units: ClassVar[dict[str, str]] = {"change": "-", "tau": "s"}
    words: ClassVar[dict[str, str]] = {"change": "relative change", "tau": "time constant"}
    arguments: ClassVar[tuple[str, ...]] = ("rate", "time")
    change: Scalar
    pace: Scalar
    """Log of tau."""

    @classmethod
    def candidates(cls, around):
        if not around.learned:
            return []
        span = around.duration[1] - around.duration[0]
        paces = [math.log(share * span) for share in (0.05, 0.15, 0.4, 1.0)]
        return [one(partial(cls, joint=j), 0.0, 0.1, 1.0, (pace, 1.0)) for j in around.joints for pace in paces]

    def values(self):
        return {"change": self.change, "tau": jnp.exp(self.pace)}

    def friction(self, torque, scene):
        grown = 1 - jnp.exp(-scene.time * jnp.exp(-self.pace))
        return torque.at[self.joint - 1].multiply(1 + self.change * grown)


class LoadFriction(JointEffect):
    """Friction of a gear that grows with the torques through it: that of the motor u, and that of the load c.

    -(|mu u + mu_load c| + (|mu_stribeck u + mu_load_stribeck c| + square) e^-(w / stribeck_velocity)^2) sign(w),
    where c is gravity and what rotation adds. [Duclusaud, Passault, Padois & Ly 2025, "Extended Friction Models for the
    Physics Simulation of Servo Actuators", M3 to M6]  The order from plain to rich is

        mu |u|, or mu |u + c| (M3)  <  its Stribeck part (M4), or both sides apart  <  both (M5)  <  the square (M6).

    Each form holds those before it, and is tried once one of them is found.  M1 and M2 are static maps of velocity: the
    learned friction holds them.  The exponent 2 of the Stribeck part is fixed; they fit it.
    """

    reported_as: ClassVar[str] = "unknown_function"
    meaning: ClassVar[str] = "Friction of a gear that grows with the torques through it."
    confirm: ClassVar[str] = "Lift and lower a weight slowly: the torques differ by twice the friction, at each weight."
    units: ClassVar[dict[str, str]] = {
        **dict.fromkeys(("mu", "mu_load", "mu_stribeck", "mu_load_stribeck"), "-"),
        "stribeck_velocity": "rad/s",
        **dict.fromkeys(("square_motor", "square_load"), "1/(N m)"),
    }
    above_zero: ClassVar[str] = "mu"
    mu: Scalar
    knee: Scalar = known()
    """Rate over which the sign is smoothed [rad/s]."""
    load: Scalar | None = None
    """Share of the load's torque; None: that of the motor's or, unless `whole`, none."""
    stribeck: Scalar | None = None
    load_stribeck: Scalar | None = None
    log_velocity: Scalar | None = None
    """[log rad/s]"""
    square_motor: Scalar | None = None
    square_load: Scalar | None = None
    """Coefficients of the torque of the motor where the load drives, and the reverse [1/(N m)]."""
    whole: bool = eqx.field(static=True, default=False, kw_only=True)
    """True where motor and load share one coefficient unless each has its own."""
    names: tuple[str, str] = eqx.field(static=True, kw_only=True)
    """Names of the input and of the rate."""

    @classmethod
    def candidates(cls, around):
        def make(j: int, whole: bool):
            names = around.column(j), around.system.rates[j - 1]
            return partial(cls, knee=a(KNEE * float(around.speed[j - 1])), whole=whole, names=names, joint=j)

        return [one(make(j, whole), 0.0, 0.05, 0.5) for j, _ in around.driven for whole in (False, True)]

    def richer(self, around):
        two_sided, falls = self.load is not None, self.stribeck is not None
        if not falls:
            both = [self._with_stribeck(share * float(around.speed[self.joint - 1])) for share in (0.05, 0.15, 0.4)]
            return [_grown(self, form) for form in both] + ([] if two_sided else [_grown(self, self._with_load())])
        if not two_sided:
            return [_grown(self, self._with_load())]
        if self.square_load is not None:
            return []
        squared = replace(self, square_motor=a(0.0), square_load=a(0.0))
        return [_grown(self, squared, 1 / float(around.torque[self.joint - 1]))]

    def _with_stribeck(self, velocity: float) -> "LoadFriction":
        both = None if self.load is None else a(0.0)
        return replace(self, stribeck=a(0.0), log_velocity=a(math.log(velocity)), load_stribeck=both)

    def _with_load(self) -> "LoadFriction":
        share = 1.0 if self.whole else 0.0
        split = replace(self, load=share * self.mu)
        return split if self.stribeck is None else replace(split, load_stribeck=share * self.stribeck)

    def values(self):
        whole = lambda motor, load: motor if load is None and self.whole else load  # noqa: E731
        numbers = {"mu": self.mu, "mu_load": whole(self.mu, self.load), "mu_stribeck": self.stribeck}
        numbers["mu_load_stribeck"] = whole(self.stribeck, self.load_stribeck)
        if self.log_velocity is not None:
            numbers["stribeck_velocity"] = jnp.exp(self.log_velocity)
        numbers |= {"square_motor": self.square_motor, "square_load": self.square_load}
        return {name: value for name, value in numbers.items() if value is not None}

    def is_physical(self):
        return float(self.mu) + (0.0 if self.load is None else float(self.load)) > 0

    def inputs_named(self):
        return self.names

    def signals(self, system):
        return input_of(self.joint), system.rates[self.joint - 1]

    def level(self, motor: Scalar, load: Scalar, rate: Scalar) -> Scalar:
        """Size of the friction at the torques of motor and load [N m] and at a rate [rad/s]."""
        total = _through(motor, load, self.mu, self.load, whole=self.whole)
        if self.stribeck is None or self.log_velocity is None:
            return total
        stribeck = _through(motor, load, self.stribeck, self.load_stribeck, whole=self.whole)
        if self.square_motor is not None and self.square_load is not None:
            squares = self.square_load * load**2, self.square_motor * motor**2
            driving = jnp.where(jnp.abs(motor) > jnp.abs(load), *squares)
            stribeck = stribeck + jnp.where(motor * load > 0, driving, 0.0)
        return total + stribeck * jnp.exp(-((rate * jnp.exp(-self.log_velocity)) ** 2))

    def force(self, scene, memory):
        motor, rate = self.own(scene.drive), self.own(scene.v)
        meets = self.whole or self.load is not None
        load = self.own(scene.system.bias(scene.q, scene.v)) if meets else jnp.zeros_like(motor)
        return self.at(scene, -self.level(motor, load, rate) * jnp.tanh(rate / self.knee))


def _through(motor: Scalar, load: Scalar, share: Scalar, load_share: Scalar | None, *, whole: bool) -> Scalar:
    """Friction of a share of the torques through a gear [N m]; `load` is what the motor holds up."""
    if load_share is not None:
        return jnp.abs(share * motor + load_share * load)
    return share * jnp.abs(motor + load if whole else motor)


def _grown(old: LoadFriction, start: LoadFriction, size: float = 1.0) -> Candidate:
    """A form with some numbers more, each of them a strength but the Stribeck velocity."""
    new = [name for name in fields(start) if getattr(old, name) is None and name != "log_velocity"]
    numbers = {name: getattr(start, name) for name in fields(start)}
    probes = tuple(replace(start, **{name: numbers[name] + 0.05 * size}) for name in new)
    wide = {name: a(0.5 * (size if name.startswith("square") else 1.0)) for name in numbers}
    if start.log_velocity is not None:
        wide["log_velocity"] = a(0.7)
    return Candidate(start, probes, replace(start, **wide))  # pyrefly: ignore[bad-argument-type]  (numbers)


class AirDrag(AbstractEffect):
    """-c |w| w at a joint, or the drag of a point at the tip (joint None)."""

    meaning: ClassVar[str] = "A brake that grows with the square of speed, as air does."
    confirm: ClassVar[str] = "Swing once with the tip shrouded, or once slow and once fast."
    units: ClassVar[dict[str, str]] = {"c": "N m s^2/rad^2"}
    words: ClassVar[dict[str, str]] = {"c": "drag coefficient"}
    units_free: ClassVar[dict[str, str]] = {"c": "N s^2/m^2"}
    above_zero: ClassVar[str] = "c"
    c: Scalar

    @classmethod
    def candidates(cls, around):
        sizes = [float(size) for size in around.torque / around.speed**2]
        out = [one(partial(cls, joint=j), 0.0, 0.1 * size, size) for j, size in zip(around.joints, sizes, strict=True)]
        tip = around.system.tip(jnp.zeros(len(sizes)))
        return out if tip is None else [*out, one(cls, 0.0, sizes[-1], 100 * sizes[-1])]

    def force(self, scene, memory):
        if self.joint is not None:
            v = scene.v[self.joint - 1]
            return jnp.zeros_like(scene.v).at[self.joint - 1].set(-self.c * jnp.abs(v) * v)
        jac = jax.jacfwd(scene.system.tip)(scene.q)
        speed = jac @ scene.v
        return -self.c * jac.T @ (speed * jnp.sqrt(jnp.sum(speed**2) + 1e-12))


class BackEmf(JointEffect):
    """The motor's torque falls by b w; a learned friction map holds it."""

    name: ClassVar[str] = "motor_back_emf"
    meaning: ClassVar[str] = "The torque of the motor falls with its speed."
    confirm: ClassVar[str] = "Log the motor current beside the command."
    units: ClassVar[dict[str, str]] = {"b": "N m s/rad"}
    words: ClassVar[dict[str, str]] = {"b": "torque lost per speed"}
    b: Scalar

    @classmethod
    def candidates(cls, around):
        sizes = ((j, float(around.torque[j - 1] / around.speed[j - 1])) for j in around.system.joints)
        return [one(partial(cls, joint=j), 0.0, 0.1 * size, size) for j, size in sizes]

    def force(self, scene, memory):
        return self.at(scene, -self.b * self.own(scene.v))


class PreslidingFriction(JointEffect):
    """The LuGre bristle: s' = -sigma0 (w + |w| s / g(w)), friction s + sigma1 s' / sigma0 - b w.

    In steady sliding that is the learned map: g is what the map holds beyond its viscous part.
    [Canudas de Wit, Olsson, Astrom & Lischinsky 1995, eqs. 1 to 3, written in the bristle's torque s]
    """

    meaning: ClassVar[str] = "Friction with memory: before it slides, the joint gives like a spring."
    confirm: ClassVar[str] = "Push the joint at rest with a small torque and see whether it springs back."
    units: ClassVar[dict[str, str]] = {"sigma0": "N m/rad"}
    words: ClassVar[dict[str, str]] = {"sigma0": "stiffness"}
    memory: ClassVar[int] = 1
    linear: ClassVar[bool] = False
    log_sigma: Scalar
    damping: Scalar
    """sigma1 [N m s/rad]."""
    viscous: Scalar
    """b [N m s/rad]."""
    knee: Scalar = known()
    """Speed [rad/s] below which the map is read at this speed: it is smooth near rest, the bristle is not."""
    size: Scalar = known()
    fastest: Scalar = known()
    """Largest relaxation rate that the integrator bears [1/s]."""

    @classmethod
    def candidates(cls, around):
        if not around.learned:
            return []
        out = []
        for j in around.joints:
            size, speed, b = (float(values[j - 1]) for values in (around.torque, around.speed, around.viscous))
            fixed = (KNEE * speed, size, 2.0 / around.dt)
            for s in (0.5, 2.0, 8.0, 32.0):
                inner = 0.4 * np.sqrt(s * size * around.inertia(j))  # a fifth of critical
                stiff, soft = (cls.of(np.log(k * size), inner, b, *fixed, joint=j) for k in (1e4, s))
                spread = cls.of(1.0, inner, 0.5 * b + 0.01 * size / speed, *fixed, joint=j)
                out.append(Candidate(stiff, (soft,), spread))
        return out

    def values(self):
        return {"sigma0": jnp.exp(self.log_sigma)}

    def memory_scale(self):
        return 0.1 * self.size[None]

    def _level(self, scene):
        v = self.own(scene.v)
        fast = jnp.sign(v) * jnp.sqrt(v**2 + self.knee**2)
        away = scene.v.at[self.joint - 1].set(jnp.where(v == 0, self.knee, fast))
        total = jnp.abs(0.5 * self.own(scene.map(away) - scene.map(-away)))
        return jnp.maximum(total - self.viscous * jnp.abs(fast), 0.1 * total) + 1e-9

    def force(self, scene, memory):
        torque = memory[0] + self.damping * jnp.exp(-self.log_sigma) * self.drift(scene, memory)[0]
        return self.at(scene, torque - self.viscous * self.own(scene.v) - self.own(scene.friction))

    def drift(self, scene, memory):
        v, level = self.own(scene.v), self._level(scene)
        relax = jnp.minimum(jnp.exp(self.log_sigma) * jnp.abs(v) / level, self.fastest)
        return jnp.stack([-jnp.sign(v) * relax * level - relax * memory[0]])
