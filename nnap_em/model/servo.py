"""Servos: the law of a drive that makes torque of a command and of the position and rate of its joint."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .effects.actuator import InputDelay
from .effects.base import Scalar

Values = Mapping[str, Scalar]


class Law(NamedTuple):
    """A torque [N m, or N on a slide] in two parts: what the command sets, then what position and rate make of it."""

    feed: Callable[[Values, Float[Array, " time"]], Float[Array, " time"]]
    """Function of the command u, row by row."""
    torque: Callable[[Values, Scalar, Scalar, Scalar], Scalar]
    """Function of what was fed, the coordinate q and the rate v, at one moment."""


LAWS: Mapping[str, Law] = {
    "torque": Law(lambda p, u: u, lambda p, fed, q, v: fed),
    "position": Law(lambda p, u: p["kp"] * u, lambda p, fed, q, v: fed - p["kp"] * q - p.get("kd", 0.0) * v),
    "velocity": Law(lambda p, u: p["kv"] * u, lambda p, fed, q, v: fed - p["kv"] * v),
    "voltage": Law(lambda p, u: p["k"] / p["R"] * u, lambda p, fed, q, v: fed - p["k"] ** 2 / p["R"] * v),
    "damper": Law(lambda p, u: p["kv"] * u, lambda p, fed, q, v: -fed * v),
    "affine": Law(lambda p, u: p["gain"] * u, lambda p, fed, q, v: fed - p.get("kp", 0.0) * q - p.get("kd", 0.0) * v),
}
"""Coefficients of the kinds of `machines/servo.py`, without bias, limit and delay: all but the torque have those.

    position   kp (u - q) - kd v            velocity   kv (u - v)
    voltage    k (u - k v) / R              damper     -kv u v
    affine     gain u - kp q - kd v         [MuJoCo documentation, Computation, Actuation model: affine gain and bias]
"""


class Servo(eqx.Module):
    """A drive in the terms of its law: torque(t) = clip(law(u(t - delay), q(t), v(t)) + bias, -limit, limit).

    Coordinate and rate are those of the motor's side of a gear, the torque acts there, too. Before the first row the
    command stood as in it; a torque was 0.
    """

    column: str = eqx.field(static=True)
    """Name of the command."""
    kind: str = eqx.field(static=True)
    values: dict[str, Float[Array, "..."]]
    """Numbers by their keys in rig.toml, in the units of `machines/servo.py`; what is not there is none."""
    scales: tuple[tuple[str, int, float], ...] = eqx.field(static=True, default=())
    """Numbers that are proportional to columns of the logs: key, place of the column behind those of the inputs, and
    the value of that column at which the number is as declared."""

    def with_values(self, values: Mapping[str, Scalar]) -> "Servo":
        """The drive with other numbers, those of `values` that are its own, by their names in the rig ("goal.kp")."""
        numbers = {key: values.get(f"{self.column}.{key}", value) for key, value in self.values.items()}
        return replace(self, values=numbers)

    def at(self, columns: Float[Array, "*time column"] | None) -> "Servo":
        """The drive with its numbers as the columns that scale them stand, in one row or in all.

        Where there are no such columns, the numbers are as declared.
        """
        if not self.scales:
            return self
        values = dict(self.values)
        if columns is not None:
            for key, place, declared in self.scales:
                values[key] = values[key] * columns[..., place] / declared
        return replace(self, values=values, scales=())

    @property
    def feeds_back(self) -> bool:
        """True where the torque depends on the motion."""
        return self.kind != "torque"

    def fed(self, u: Float[Array, "*time"], through: Callable[..., Array]) -> Float[Array, "*time"]:
        """Values that the commands of a sequence, or of one row, set [N m, or N; of a damper N m s/rad or N s/m].

        `through` is that of `hooks.Sampling`.
        """
        if "delay" in self.values:
            u = through(InputDelay(self.values["delay"], joint=0), u, True)
        return LAWS[self.kind].feed(self.values, u)

    def torque(self, fed: Scalar, q: Scalar, v: Scalar) -> Scalar:
        """Torque at one moment [N m, or N], at a coordinate [rad, or m] and a rate."""
        torque = LAWS[self.kind].torque(self.values, fed, q, v) + self.values.get("bias", 0.0)
        if "limit" not in self.values:
            return torque
        limit = jnp.maximum(self.values["limit"], 0.0)
        return jnp.clip(torque, -limit, limit)


def unlimited(servo: Servo) -> Servo:
    """The servo as if its torque had no limit."""
    return replace(servo, values={key: value for key, value in servo.values.items() if key != "limit"})
