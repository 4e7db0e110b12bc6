"""The hidden Markov model: x_{k+1} = f(x_k, u_k) + w_k, y_k = g(x_k, u_k) + v_k."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..base.gaussian import Gaussian
from ..base.ode import in_loop, integrate
from ..logs.dataset import Dataset
from . import hooks
from .base import AbstractModel
from .effects.base import AbstractEffect, OperatingPoint, Scalar
from .servo import Servo

SUBSTEPS, MOST_STEPS = 2, 64
"""Integration steps of one sample where nothing requires more, and at most."""


class Inputs(NamedTuple):
    """External inputs of a machine, in every row or in one."""

    u: Float[Array, "*time input"]
    """Torques at the joints [N m, or N]; with servos what commands set in them (`Servo.fed`)."""
    before: Float[Array, "*time input"]
    """Torques one row before; 0 in the first row."""
    time: Float[Array, "*time"]
    """The clock in the middle of the step [s]."""
    age: Float[Array, "*time"]
    """Since the first row [s]."""
    scale: Float[Array, "*time column"] | None = None
    """Columns that numbers of servos are proportional to; None where there are none."""
    course: Float[Array, "*time 2 input"] | None = None
    """Change of `u` until the next row, and its second difference around the step (`course`); None where it is held."""

    def at(self, part: Scalar | float) -> "Inputs":
        """The inputs at some part of the step, 0 in the row and 1 in the next."""
        if self.course is None:
            return self
        return self._replace(u=self.u + part * self.course[..., 0, :] - part * (1 - part) / 2 * self.course[..., 1, :])

    @classmethod
    def held(cls, u: Float[Array, " input"]) -> "Inputs":
        """One row of inputs that begin at time 0 and stay."""
        return cls(u, u, jnp.zeros((), u.dtype), jnp.zeros((), u.dtype))


class StateSpaceModel(AbstractModel):
    """Known physics with an unknown torque, observed through noise [paper, eqs. 6 to 8 and 16].

    The state is (q, v), then the memory of the effects in their order.
    """

    system: Any
    """The known physics, an `AbstractPlant`."""
    unknown: Callable[[Float[Array, " dof"]], Float[Array, " dof"]]
    """Static map of joint velocity to torque, to be learned."""
    start: Gaussian
    """Prior of the state in the first row."""
    log_q: Float[Array, " state"]
    """Log of the process-noise variance per step [rad^2, (rad/s)^2]."""
    log_r: Float[Array, " obs"]
    """Log of the measurement variance."""
    measured: tuple[int, ...] = eqx.field(static=True)
    """Places in `system.readable` of what is read, in the order of y."""
    dt: float = eqx.field(static=True)
    """Sample interval [s]."""
    substeps: int = eqx.field(static=True, default=SUBSTEPS)
    effects: tuple[AbstractEffect, ...] = ()
    """Laws that the declared physics lacks."""
    servos: tuple[Servo, ...] | None = None
    """Law that makes torque of every input; None where the inputs are torques."""
    smooth: bool = eqx.field(static=True, default=False)
    """True where inputs are signals that go on from row to row; False where they are held."""
    pace: float = eqx.field(static=True, default=1.0)
    """Time in which the horizons of predictions are counted [s]: 1 s for machines with joints."""

    @property
    def hides(self) -> bool:
        """True where a coordinate is not read."""
        return not set(range(len(self.system.coordinates))) <= set(self.measured)

    def __str__(self) -> str:
        names = self.system.readable
        noise = zip((names[i] for i in self.measured), np.exp(0.5 * np.asarray(self.log_r)), strict=True)
        reads = ", ".join(f"{name} (noise {std:.2g} {self.system.unit(name)})" for name, std in noise)
        effects = [self._described(effect) for effect in self.effects]
        every = f"{self.system}, a row every {self.dt:g} {self.system.unit('time')}"
        return "\n  ".join([every, f"reads: {reads}", *effects])

    def _described(self, effect: AbstractEffect) -> str:
        units, joint = effect.units_on(self.system), f" at joint {effect.joint}" if effect.joint else ""
        values = (f", {name} = {float(value):.4g} {units[name]}" for name, value in effect.values().items())
        return f"{effect.name}{joint}{''.join(values)}"

    def inputs(self, seq: Dataset) -> Inputs:
        """External inputs in every row, as the effects change them."""
        t = jnp.asarray(seq.t)
        u, scale = hooks.arriving(self.effects, self.servos, self.system, jnp.asarray(seq.u), self.rows.through)
        along = course(u, jnp.asarray(seq.valid)) if self.smooth else None
        return Inputs(u, jnp.concatenate([jnp.zeros_like(u[:1]), u[:-1]]), t + 0.5 * self.dt, t - t[:1], scale, along)

    def scene(self, x: Float[Array, " state"], u: Inputs) -> OperatingPoint:
        """State of the machine at one moment, as effects get it."""
        q, v = self.system.split(x)
        system = hooks.machine(self.effects, self.system, u.time)
        torque = hooks.driven(self.effects, self.servos, system, u.u, q, v, u.scale)
        friction = system.at_ports(self.unknown(v))
        return OperatingPoint(system, q, v, system.drive(torque), u.time, friction, self.unknown, torque)

    def driving(
        self, effects: Sequence[AbstractEffect], x: Float[Array, "time state"], u: Inputs
    ) -> Float[Array, "time dof"]:
        """Generalised force of the inputs along states in the middle of the steps, with `effects` on top [N m]."""
        fed = hooks.late(effects, self.servos, self.system, u.u, self.rows.through)
        if u.course is not None:
            fed = 0.5 * (fed + jnp.concatenate([fed[1:], fed[-1:]])) - u.course[:, 1] / 8

        def at(x: Float[Array, " state"], fed: Float[Array, " input"], scale) -> Float[Array, " dof"]:
            q, v = self.system.split(x)
            return self.system.drive(hooks.driven(effects, self.servos, self.system, fed, q, v, scale))

        return jax.vmap(at)(x, fed, u.scale)

    def rate(self, x: Float[Array, " state"], u: Inputs, force: Float[Array, " dof"]) -> Float[Array, " state"]:
        """Time derivative of the state under inputs u and an extra generalised force [N m]."""
        return jnp.stack(self.slopes(x, u, force))

    def slopes(self, x: Float[Array, " state"], u: Inputs, force: Float[Array, " dof"]) -> tuple[Scalar, ...]:
        """`rate`, entry by entry."""
        memory, scene = x[len(self.system.states) :], self.scene(x, u)
        push = hooks.pushed(self.effects, scene, memory, force)
        slopes = scene.system.slopes(scene.q, scene.v, cast(Array, scene.u), push)
        return *slopes, *hooks.drift(self.effects, scene, memory)

    @eqx.filter_jit
    def transition(
        self, x: Float[Array, " state"], u: Inputs, force: Float[Array, " dof"] | None = None
    ) -> Float[Array, " state"]:
        """Mean of the state one sample later."""
        extra = jnp.zeros(len(self.system.ports), x.dtype) if force is None else force
        slopes = lambda x, part=0.0: self.slopes(x, u.at(part), extra)  # noqa: E731
        return integrate(slopes, x, self.dt, self.steps, timed=self.smooth)

    def resolved(self) -> "StateSpaceModel":
        """This model with the integration steps that its friction requires, a power of two: programs are shared.

        Max over joints and poses of dt (M^-1)_jj |d tau_j / d v_j|.
        """
        steepest = np.asarray(cast(Any, self.unknown).steepest())
        if not steepest.any():  # no map is learned
            return self
        fastest = self.dt * np.max(self.system.mobility() * steepest)
        # Integration step as the fastest time in which learned friction ends a motion: the classical
        # Runge-Kutta method errs by a percent there, in a thin layer near rest, and is unstable from 2.8 on
        steps = min(MOST_STEPS, 2 ** math.ceil(math.log2(max(float(fastest), 1.0))))
        return dataclasses.replace(self, substeps=max(self.substeps, steps))

    def parameter(self, name: str) -> Any:
        """A declared parameter by its name in the rig: of a servo, "goal.kp", or of the machine."""
        column, _, key = name.rpartition(".")
        for servo in self.servos or ():
            if servo.column == column and key in servo.values:
                return servo.values[key]
        return self.system.parameter(name)

    @property
    def rows(self) -> hooks.Sampling:
        """Interval of the rows, and the course of the inputs between them."""
        return hooks.Sampling(self.dt, self.smooth)

    @property
    def steps(self) -> int:
        """Integration steps of one sample, as many as the stiffest effect requires."""
        return max([self.substeps, *(effect.substeps for effect in self.effects)])

    def true(
        self, x: Float[Array, " state"], u: Inputs, force: Float[Array, " dof"] | None = None
    ) -> Float[Array, " readable"]:
        """Coordinates, rates, and readings of the sensors beside these, at inputs u and an extra generalised force."""
        states, count = len(self.system.states), len(self.system.sensors)
        if not count:
            return x[:states]
        extra = jnp.zeros(len(self.system.ports), x.dtype) if force is None else force

        def senses(x: Float[Array, " state"]) -> Sequence[Scalar]:
            scene = self.scene(x, u)
            push = hooks.pushed(self.effects, scene, x[states:], extra)
            return scene.system.sensed(scene.q, scene.v, cast(Array, scene.u), push)

        return jnp.concatenate([x[:states], jnp.stack(in_loop(senses, x, count))])

    def readable(
        self, x: Float[Array, " state"], u: Inputs, force: Float[Array, " dof"] | None = None
    ) -> Float[Array, " readable"]:
        """Readings, without noise, of sensors on all coordinates and rates, and of the others."""
        names = self.system.readable

        def past(delay: Float[Array, ""]) -> Float[Array, " readable"]:
            """The state `delay` [s] ago, under the inputs of the row before, but no earlier than the first row."""
            along = None if u.course is None else jnp.stack([u.u - u.before, jnp.zeros_like(u.u)])
            before, reach = u._replace(u=u.before, course=along), jnp.minimum(delay, u.age)
            still, back = jnp.zeros(len(self.system.ports), x.dtype), reach / self.dt
            at = lambda part: before.at(jnp.maximum(1 - part * back, 0.0))  # noqa: E731
            slopes = lambda x, part=0.0: -reach * self.rate(x, at(part), still)  # noqa: E731
            ago = integrate(slopes, x, 1.0, 3, timed=along is not None)
            return self.true(ago, at(1.0), force)

        return hooks.read(self.effects, names, self.true(x, u, force), past)

    def shown(
        self, x: Float[Array, " state"], u: Inputs, force: Float[Array, " dof"] | None = None
    ) -> Float[Array, " readable"]:
        """Coordinates, rates and sensors; those that are measured as their sensors read them."""
        r, true = self.readable(x, u, force), self.true(x, u, force)
        return jnp.stack([r[i] if i in self.measured else true[i] for i in range(r.shape[0])])

    def emission(
        self, x: Float[Array, " state"], u: Inputs, force: Float[Array, " dof"] | None = None
    ) -> Float[Array, " obs"]:
        """Mean of the reading at the state x, and at the input that is held from then on."""
        r = self.readable(x, u, force)
        return jnp.stack([r[i] for i in self.measured])


def course(u: Float[Array, "time input"], valid: Bool[Array, " time"]) -> Float[Array, "time 2 input"]:
    """Course of a smooth signal in every step: its change, and the mean of its second differences at both ends.

    u(s) = u_k + s change - s (1 - s) / 2 bend, exact for a parabola.  Lines alone cut the corners of a sine: at 25 Hz a
    force of 1 Hz would be 0.5 % smaller, ten standard deviations of a mass.
    """
    inside = valid[2:, None]
    second = jnp.pad(jnp.where(inside, jnp.diff(u, n=2, axis=0), 0.0), ((1, 2), (0, 0)))
    known = jnp.pad(inside.astype(u.dtype), ((1, 2), (0, 0)))
    bend = (second[:-1] + second[1:]) / jnp.maximum(known[:-1] + known[1:], 1.0)
    return jnp.stack([jnp.diff(u, axis=0, append=u[-1:]), bend], axis=1)


def with_effects(model: StateSpaceModel, effects: tuple[AbstractEffect, ...]) -> StateSpaceModel:
    """`model` with other effects: memory states are dropped or begin at rest."""
    states = len(model.system.states)
    spread = [effect.memory_scale() for effect in effects if effect.memory]
    wide = jnp.concatenate([jnp.ones(0, model.log_q.dtype), *spread])
    mean = jnp.concatenate([model.start.mean[:states], jnp.zeros_like(wide)])
    cov = jax.scipy.linalg.block_diag(model.start.cov[:states, :states], jnp.diag((0.1 * wide) ** 2))
    log_q = jnp.concatenate([model.log_q[:states], 2 * jnp.log(1e-3 * wide)])
    return dataclasses.replace(model, start=Gaussian(mean, cov), log_q=log_q, effects=effects)
