"""The engineer's friction law."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


class StribeckLaw(eqx.Module):
    """Coulomb, viscous and Stribeck friction of each joint.

        tau_f(v) = -[(coulomb + (breakaway - coulomb) exp(-(v / stribeck)^2)) tanh(v / smooth) + viscous v]

    [Armstrong-Helouvry, Dupont & Canudas de Wit 1994, Automatica 30(7), sec. 2, with a smooth sign]
    """

    coulomb: Float[Array, " dof"]
    """[N m]"""
    breakaway: Float[Array, " dof"]
    """[N m]"""
    stribeck: Float[Array, " dof"]
    """[rad/s]"""
    viscous: Float[Array, " dof"]
    """[N m s/rad]"""
    smooth: Float[Array, " dof"]
    """[rad/s]"""

    def __call__(self, v: Float[Array, " dof"]) -> Float[Array, " dof"]:
        level = self.coulomb + (self.breakaway - self.coulomb) * jnp.exp(-((v / self.stribeck) ** 2))
        return -(level * jnp.tanh(v / self.smooth) + self.viscous * v)
