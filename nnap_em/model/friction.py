"""The unknown term: one small network per joint from velocity to torque."""

from abc import abstractmethod
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int, PRNGKeyArray

from ..base.elementary import asinh


class AbstractJointMap(eqx.Module):
    """Torques that each depend on their own joint's velocity only; their derivatives then cost one slope, not one pass
    for every tangent.
    """

    @abstractmethod
    def torque(self, v: Float[Array, " dof"]) -> Float[Array, " dof"]:
        """Torques [N m] at joint velocities [rad/s]."""

    def __call__(self, v: Float[Array, " dof"]) -> Float[Array, " dof"]:
        """Torque of every joint [N m] at joint velocities."""
        return _torque(self, v)


@eqx.filter_custom_jvp
def _torque(friction: AbstractJointMap, v: Float[Array, " dof"]) -> Float[Array, " dof"]:
    return friction.torque(v)


@_torque.def_jvp
def _torque_jvp(primals, tangents):
    (friction, v), (by_weights, dv) = primals, tangents
    torque, slope = jax.jvp(friction.torque, (v,), (jnp.ones_like(v),))
    moved = jnp.zeros_like(torque) if dv is None else slope * dv
    if jax.tree.leaves(by_weights):
        moved = moved + eqx.filter_jvp(lambda f: f.torque(v), (friction,), (by_weights,))[1]
    return torque, moved


_together = eqx.filter_vmap(lambda mlp, features: mlp(features))


class FrictionNetwork(AbstractJointMap):
    """tau_f(v): joint velocities [rad/s] to joint torques [N m], a network for each joint.

    Each joint has features v / speed and asinh(v / knee), scaled to +-1 at `speed`, so that both the Stribeck
    region near rest and the viscous region are smooth in them.
    """

    mlp: eqx.nn.MLP
    """Leaves carry a leading joint axis."""
    speed: Float[Array, " dof"]
    """Largest velocity of interest [rad/s]."""
    knee: Float[Array, " dof"]
    """Velocity below which the map is resolved linearly [rad/s]."""
    scale: Float[Array, " dof"]
    """Torque of a unit output [N m]."""

    def __init__(
        self,
        speed: Float[Array, " dof"],
        scale: Float[Array, " dof"],
        *,
        key: PRNGKeyArray,
        width: int = 8,
        depth: int = 2,
        resolution: float = 100.0,
    ):
        self.mlp = _networks(key, speed, width, depth)
        self.speed = speed
        self.knee = speed / resolution
        self.scale = scale

    def torque(self, v: Float[Array, " dof"], through: Callable = _together) -> Float[Array, " dof"]:
        """Friction torque at joint velocities [N m], `through` the networks of all joints."""
        top = asinh(self.speed / self.knee)
        return self.scale * through(self.mlp, jnp.stack([v / self.speed, asinh(v / self.knee) / top], axis=-1))

    def by_entry(self) -> "FixedFriction":
        """This map in scalars, which fuse: for one state each product of a layer is a program of its own."""
        return FixedFriction(lambda v: self.torque(v, _in_scalars), self.scale)

    @eqx.filter_jit
    def nodes(self, count: int) -> Float[Array, "dof count"]:
        """Velocities [rad/s], dense near rest, at which the map is tabulated in the M-step."""
        top = jnp.arcsinh(self.speed / self.knee)
        line = jnp.linspace(-1.0, 1.0, count, dtype=self.speed.dtype)[None, :]
        return self.knee[:, None] * jnp.sinh(top[:, None] * line)

    @eqx.filter_jit
    def steepest(self) -> Float[Array, " dof"]:
        """Largest slope of every joint [N m s/rad]."""
        slope = lambda v: jax.jvp(self.torque, (v,), (jnp.ones_like(v),))[1]  # noqa: E731
        return jnp.max(jnp.abs(jax.vmap(slope)(self.nodes(201).T)), axis=0)

    @eqx.filter_jit
    def weights(self) -> Float[Array, " weight"]:
        """All network weights as one vector."""
        return ravel_pytree(eqx.filter(self.mlp, eqx.is_inexact_array))[0]

    def of_joint(self) -> Int[np.ndarray, "dof own"]:
        """Places in `weights` of those of each joint."""
        leaves = jax.tree.leaves(eqx.filter(self.mlp, eqx.is_inexact_array))
        joint = [np.repeat(np.arange(len(leaf)), leaf.size // len(leaf)) for leaf in leaves]
        return np.argsort(np.concatenate(joint), kind="stable").reshape(len(self.scale), -1)

    @eqx.filter_jit
    def with_weights(self, flat: Float[Array, " weight"]) -> "FrictionNetwork":
        """This map with the weights replaced."""
        arrays, static = eqx.partition(self.mlp, eqx.is_inexact_array)
        return eqx.tree_at(lambda f: f.mlp, self, eqx.combine(ravel_pytree(arrays)[1](flat), static))


@eqx.filter_jit
def _networks(key: PRNGKeyArray, speed: Float[Array, " dof"], width: int, depth: int) -> eqx.nn.MLP:
    """One for every joint, at random."""
    make = lambda key: eqx.nn.MLP(2, "scalar", width, depth, jax.nn.tanh, dtype=speed.dtype, key=key)  # noqa: E731
    return eqx.filter_vmap(make)(jax.random.split(key, speed.shape[0]))


def _in_scalars(mlp: eqx.nn.MLP, features: Float[Array, "dof 2"]) -> Float[Array, " dof"]:
    outputs, layers = [], jax.tree.leaves(eqx.filter(mlp.layers, eqx.is_array))
    for joint, values in enumerate(features):
        for weight, bias in zip(layers[::2], layers[1::2], strict=True):
            rows = zip(weight[joint], jnp.ravel(bias[joint]), strict=True)
            values = [sum(map(jnp.multiply, row, values), start) for row, start in rows]
            values = [mlp.activation(x) if bias is not layers[-1] else x for x in values]
        outputs += values
    return jnp.stack(outputs)


class FixedFriction(eqx.Module):
    """A map that is known, with the interface of one that is learned: there is nothing to learn."""

    law: Callable[[Float[Array, " dof"]], Float[Array, " dof"]]
    scale: Float[Array, " dof"]
    jointless: bool = eqx.field(static=True, default=False)
    """True of equations: `scale` is that of pushes at their ports, none of which has a map."""

    def __call__(self, v: Float[Array, " dof"]) -> Float[Array, " dof"]:
        """Torque at joint velocities [N m]."""
        return self.law(v)

    def nodes(self, count: int) -> Float[Array, "dof 2"]:
        """Two velocities; any would do."""
        return jnp.zeros((0, 2)) if self.jointless else jnp.asarray([[-1.0, 1.0]] * self.scale.shape[0])

    def steepest(self) -> Float[Array, " dof"]:
        """None is learned."""
        return jnp.zeros_like(self.scale)

    def weights(self) -> Float[Array, " 0"]:
        """None."""
        return jnp.zeros(0)

    def of_joint(self) -> Int[np.ndarray, "dof 0"]:
        """None."""
        return np.zeros((len(self.nodes(0)), 0), int)

    def with_weights(self, flat: Float[Array, " 0"]) -> "FixedFriction":
        """This map."""
        return self


def NoFriction(scale: Float[Array, " dof"], *, jointless: bool = False) -> FixedFriction:
    """A machine that is declared free of friction, or equations."""
    return FixedFriction(jnp.zeros_like, scale, jointless)
