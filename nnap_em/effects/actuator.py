# pyright: reportCallIssue=false, reportArgumentType=false
# (pyright takes equinox's abstract fields for fields of the constructor)
"""What stands between the commanded input and the joint."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .base import AbstractEffect, Candidate, Scalar, a, at_joint


def driven(around) -> list[tuple[int, float]]:
    """Driven joints and their largest input."""
    return [(j, float(size)) for j, size in zip(around.system.joints, around.drive, strict=True) if size > 0]


class MotorGain(AbstractEffect):
    """gain u."""

    name: ClassVar[str] = "motor_gain"
    confirm: ClassVar[str] = "Block the joint and measure its torque at one command."
    units: ClassVar[dict[str, str]] = {"gain": "-"}
    excess: Scalar
    """gain - 1."""
    joint: int | None = eqx.field(static=True)
    channel: str | None = eqx.field(static=True, default=None)

    @classmethod
    def candidates(cls, around):
        return [Candidate(cls(a(0.0), j), (cls(a(0.05), j),), cls(a(1.0), j)) for j, _ in driven(around)]

    def values(self):
        return {"gain": 1 + self.excess}

    def input(self, u, dt):
        return (1 + self.excess) * u


class DeadZone(AbstractEffect):
    """Nothing below width, sign(u) (|u| - width) beyond."""

    name: ClassVar[str] = "dead_zone"
    confirm: ClassVar[str] = "Raise the command slowly from zero until the joint moves, both ways."
    units: ClassVar[dict[str, str]] = {"width": "N m"}
    linear: ClassVar[bool] = False
    width: Scalar
    joint: int | None = eqx.field(static=True)
    channel: str | None = eqx.field(static=True, default=None)

    @classmethod
    def candidates(cls, around):
        grid = (0.03, 0.08, 0.15, 0.25, 0.4)
        return [
            Candidate(cls(a(0.0), j), (cls(a(share * size), j),), cls(a(0.3 * size), j))
            for j, size in driven(around)
            for share in grid
        ]

    def possible(self):
        return float(self.width) > 0

    def input(self, u, dt):
        return u - jnp.clip(u, -self.width, self.width)


class Saturation(AbstractEffect):
    """Limited to +-limit."""

    name: ClassVar[str] = "saturation"
    confirm: ClassVar[str] = (
        "Block the joint and raise the command until the torque stays the same; look at the drive's current limit."
    )
    units: ClassVar[dict[str, str]] = {"limit": "N m"}
    linear: ClassVar[bool] = False
    limit: Scalar
    joint: int | None = eqx.field(static=True)
    channel: str | None = eqx.field(static=True, default=None)

    @classmethod
    def candidates(cls, around):
        grid = (0.9, 0.75, 0.6, 0.45, 0.3, 0.2)
        return [
            Candidate(cls(a(2 * size), j), (cls(a(share * size), j),), cls(a(0.2 * size), j))
            for j, size in driven(around)
            for share in grid
        ]

    def possible(self):
        return float(self.limit) > 0

    def input(self, u, dt):
        return jnp.clip(u, -self.limit, self.limit)


class InputDelay(AbstractEffect):
    """u acts later by any time; before the first row it was 0."""

    name: ClassVar[str] = "input_delay"
    confirm: ClassVar[str] = "Log command and motor current on one clock."
    units: ClassVar[dict[str, str]] = {"delay": "s"}
    delay: Scalar
    joint: int | None = eqx.field(static=True)
    channel: str | None = eqx.field(static=True, default=None)

    @classmethod
    def candidates(cls, around):
        grid = (0.5, 1.5, 2.5, 4.0, 6.0, 9.0)
        return [
            Candidate(cls(a(0.0), j), (cls(a(n * around.dt), j),), cls(a(3 * around.dt), j))
            for j, _ in driven(around)
            for n in grid
        ]

    def possible(self):
        return float(self.delay) > 0

    def input(self, u, dt):
        late = jnp.arange(u.shape[0], dtype=u.dtype) - jnp.maximum(self.delay, 0.0) / dt
        whole = jnp.floor(late)
        share = late - whole
        padded = jnp.concatenate([jnp.zeros_like(u[:1]), u])
        take = lambda k: padded[jnp.clip(k.astype(int) + 1, 0, u.shape[0])]  # noqa: E731
        return (1 - share) * take(whole) + share * take(whole + 1)


class ActuatorLag(AbstractEffect):
    """First-order lag of time constant tau, the mean over each sample of the exact response."""

    name: ClassVar[str] = "actuator_lag"
    confirm: ClassVar[str] = "Log command and motor current on one clock, for a step."
    units: ClassVar[dict[str, str]] = {"tau": "s"}
    tau: Scalar
    joint: int | None = eqx.field(static=True)
    channel: str | None = eqx.field(static=True, default=None)

    @classmethod
    def candidates(cls, around):
        grid = (0.7, 1.5, 3.0, 5.0, 8.0, 15.0)
        return [
            Candidate(cls(a(0.0), j), (cls(a(n * around.dt), j),), cls(a(5 * around.dt), j))
            for j, _ in driven(around)
            for n in grid
        ]

    def possible(self):
        return float(self.tau) > 0

    def input(self, u, dt):
        tau = jnp.maximum(self.tau, 0.05 * dt)
        keep = jnp.exp(-dt / tau)
        share = tau / dt * (1 - keep)

        def step(torque, u):
            return u + (torque - u) * keep, u + (torque - u) * share

        return jax.lax.scan(step, jnp.zeros_like(u[0]), u)[1]


def _motor(around, joint: int) -> float:
    """A motor's inertia to begin with: a twentieth of the joint's."""
    rest = jnp.zeros(len(around.system.coordinates))
    return 0.05 * float(around.system.mass(rest)[joint - 1, joint - 1])


class Transmission(AbstractEffect):
    """A motor of small inertia that drives its joint through something soft or loose; u acts on the motor."""

    memory: ClassVar[int] = 2
    linear: ClassVar[bool] = False

    def wind(self, twist: Scalar) -> Scalar:
        """Torque on the joint at a twist of motor minus joint [rad]."""
        raise NotImplementedError

    log_inertia: eqx.AbstractVar[Scalar]
    """Of the motor [log kg m^2]."""
    log_damping: eqx.AbstractVar[Scalar]
    """[log N m s/rad]"""

    def memory_scale(self):
        return jnp.asarray([0.05, 1.0])

    def grip(self, twist: Scalar) -> Scalar:
        """Share of the damping that acts at a twist."""
        return jnp.ones_like(twist)

    def _torque(self, scene, memory):
        assert self.joint is not None
        twist, speed = memory
        return self.wind(twist) + jnp.exp(self.log_damping) * self.grip(twist) * (speed - scene.v[self.joint - 1])

    def force(self, scene, memory):
        assert self.joint is not None
        return at_joint(self.joint, self._torque(scene, memory) - scene.drive[self.joint - 1], scene)

    def drift(self, scene, memory):
        assert self.joint is not None
        push = scene.drive[self.joint - 1] - self._torque(scene, memory)
        return jnp.stack([memory[1] - scene.v[self.joint - 1], push * jnp.exp(-self.log_inertia)])


class JointFlexibility(Transmission):
    """An elastic transmission of stiffness k."""

    name: ClassVar[str] = "joint_flexibility"
    confirm: ClassVar[str] = "Block the link and twist the motor: the angle per torque."
    units: ClassVar[dict[str, str]] = {"k": "N m/rad"}
    substeps: ClassVar[int] = 5
    log_k: Scalar
    log_inertia: Scalar
    log_damping: Scalar
    joint: int | None = eqx.field(static=True)
    channel: str | None = eqx.field(static=True, default=None)

    @classmethod
    def candidates(cls, around):
        out = []
        for j, size in driven(around):
            inertia = _motor(around, j)
            for k in (2.0, 6.0, 20.0):
                make = lambda k, i=inertia, j=j: cls(  # noqa: E731
                    a(np.log(k)), a(np.log(i)), a(np.log(0.2 * np.sqrt(k * i))), j
                )
                out.append(Candidate(make(1e3 * size), (make(k * size),), cls(a(1.0), a(0.7), a(1.0), j)))
        return out

    def values(self):
        return {"k": jnp.exp(self.log_k)}

    def wind(self, twist):
        return jnp.exp(self.log_k) * twist


class Backlash(Transmission):
    """Play of width gap, with a stiff contact at either side."""

    name: ClassVar[str] = "backlash"
    confirm: ClassVar[str] = "Block the motor and wiggle the link."
    units: ClassVar[dict[str, str]] = {"gap": "rad"}
    substeps: ClassVar[int] = 10
    gap: Scalar
    log_inertia: Scalar
    log_damping: Scalar
    log_k: Scalar
    """Contact stiffness [log N m/rad]."""
    joint: int | None = eqx.field(static=True)
    channel: str | None = eqx.field(static=True, default=None)

    @classmethod
    def candidates(cls, around):
        out = []
        for j, size in driven(around):
            inertia = _motor(around, j)
            k = 50 * size
            for gap in (0.03, 0.1, 0.25):
                make = lambda gap, i=inertia, j=j, k=k: cls(  # noqa: E731
                    a(gap), a(np.log(i)), a(np.log(0.5 * np.sqrt(k * i))), a(np.log(k)), j
                )
                out.append(Candidate(make(0.0), (make(gap),), cls(a(0.1), a(0.7), a(1.0), a(0.7), j)))
        return out

    def possible(self):
        return float(self.gap) > 0

    def wind(self, twist):
        half = 0.5 * jnp.maximum(self.gap, 0.0)
        return jnp.exp(self.log_k) * (twist - jnp.clip(twist, -half, half))

    def grip(self, twist):
        half = 0.5 * jnp.maximum(self.gap, 0.0)
        return jnp.tanh(jnp.maximum(jnp.abs(twist) - half, 0.0) / 1e-3)
