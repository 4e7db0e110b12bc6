"""The servos that a rig declares, and the integration step that their stiffness requires."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...logs.dataset import Dataset
from ...machines.rig import Rig
from ...machines.servo import KINDS
from ...machines.systems import AbstractSystem
from ...model import hooks
from ...model.servo import Servo, unlimited

LAG = 5
"""Rows over which differences are taken."""


def build_servos(rig: Rig) -> tuple[Servo, ...]:
    """The declared drives, at the mean of what is uncertain; none where all inputs are torques."""
    numbers = {name: jnp.asarray(rig.parameters[name].mean, float) for name in {*rig.parameters} - {*rig.bodies}}

    def servo(column: str, kind: str) -> Servo:
        keys = (key for key in KINDS[kind] if f"{column}.{key}" in numbers)
        values = {key: numbers[f"{column}.{key}"] for key in keys}
        scales = ((key, rig.input_scales.get(f"{column}.{key}", {})) for key in values)
        flat = tuple((key, rig.scale_columns.index(name), at) for key, scale in scales for name, at in scale.items())
        return Servo(column, kind, values, flat)

    return tuple(servo(*pair) for pair in rig.kinds.items()) if rig.input_kinds else ()


def steps_of_sample(system: AbstractSystem, servos: tuple[Servo, ...], data: Dataset, dt: float) -> float:
    """Integration steps that a sample needs, by the fastest eigenvalue of M a = -K q - D v at rest in some poses, K and
    D the slopes of the servos' torques at the largest gains in the logs.
    """
    if not servos:
        return 0.0
    scale = np.asarray(data.u)[np.asarray(data.valid), len(servos) :]
    largest = jnp.asarray(scale.max(axis=0), float) if scale.size else None
    servos = tuple(servo.at(largest) for servo in servos)
    dof = len(system.coordinates)
    q = jnp.asarray(np.random.default_rng(0).uniform(-np.pi, np.pi, (32, dof)), float)
    slopes = np.asarray(_servo_slopes(system, tuple(unlimited(servo) for servo in servos), q))
    state = np.concatenate([np.concatenate([np.zeros((32, dof, dof)), np.tile(np.eye(dof), (32, 1, 1))], 2), slopes], 1)
    # half the fastest time of a servo at its joint, of which the classical Runge-Kutta method bears 2.8
    return float(np.max(np.abs(np.linalg.eigvals(state)))) * dt / 0.5


@eqx.filter_jit
def _servo_slopes(system: AbstractSystem, servos, q: Float[Array, "pose dof"]) -> Float[Array, "pose dof state"]:
    """Derivatives by position and rate of the accelerations that servos give, per unit of the fed-back signal."""
    fed, still = jnp.ones(len(servos)), jnp.zeros(q.shape[1])

    def one(q):
        force = lambda x, v: system.drive(hooks.driven((), servos, system, fed, x, v))  # noqa: E731
        return jnp.linalg.solve(system.mass(q), jnp.concatenate(jax.jacfwd(force, (0, 1))(q, still), axis=1))

    return jax.vmap(one)(q)


def torque_along(
    servo: Servo, u: Float[np.ndarray, "seq time"], q: Float[np.ndarray, "seq time"], scale: np.ndarray, dt: float
) -> Float[np.ndarray, "seq time"]:
    """Torque of a servo at logged commands and positions of the motor's side [N m, or N]; NaN where none is read.

    With gains by the columns `scale`; rates are differences over `LAG` rows before and after.
    """
    ahead = np.concatenate([q[:, LAG:], np.repeat(q[:, -1:], LAG, axis=1)], axis=1)
    behind = np.concatenate([np.repeat(q[:, :1], LAG, axis=1), q[:, :-LAG]], axis=1)
    columns = jnp.asarray(scale, float) if scale.size else None
    fed = jax.vmap(lambda u, scale: servo.at(scale).fed(u, hooks.Sampling(dt).through))(jnp.asarray(u, float), columns)
    each = jax.vmap(jax.vmap(lambda scale, *row: servo.at(scale).torque(*row)))
    rate = jnp.asarray((ahead - behind) / (2 * LAG * dt), float)
    return np.asarray(each(columns, fed, jnp.asarray(q, float), rate))
