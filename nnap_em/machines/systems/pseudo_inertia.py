"""Steps of a body's mass, centre and inertia that stay among those that some distribution of mass has.

The pseudo-inertia of a body, [[S, m c], [m c', m]] with the second moments S of its mass, is positive definite if and
only if the body can be [Wensing, Kim & Slotine 2018, IEEE RA-L 3(1)].  With its Cholesky factor L, whose diagonal moves
by its logarithm, every step has an end [Rucker & Wensing 2022, IEEE RA-L 7(2); Lin 2019, SIAM J. Matrix Anal. 40(4)].
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


class Numbers(NamedTuple):
    """Numbers of a body, in its own frame."""

    mass: Float[Array, ""]  # [kg]
    centre: Float[Array, "3"]  # [m]
    inertia: Float[Array, "3 3"]  # About the centre [kg m^2]


def pseudo(body: Numbers) -> Float[Array, "4 4"]:
    """The pseudo-inertia."""
    moment = body.mass * body.centre
    second = 0.5 * jnp.trace(body.inertia) * jnp.eye(3) - body.inertia + jnp.outer(moment, body.centre)
    return jnp.block([[second, moment[:, None]], [moment[None], body.mass[None, None]]])


def of_pseudo(pseudo_inertia: Float[Array, "4 4"]) -> Numbers:
    """The body of a pseudo-inertia."""
    mass, centre = pseudo_inertia[3, 3], pseudo_inertia[:3, 3] / pseudo_inertia[3, 3]
    second = pseudo_inertia[:3, :3] - mass * jnp.outer(centre, centre)
    return Numbers(mass, centre, jnp.trace(second) * jnp.eye(3) - second)


@jax.jit
def stepped(before: Numbers, after: Numbers) -> Numbers:
    """End of a step from `before`, a physical body, towards `after` in the logarithm of the Cholesky factor.

    To first order it is the step itself.  Not numbers where `before` cannot be.
    """
    change = jax.tree.map(jnp.subtract, after, before)
    inertia, moved = jax.jvp(pseudo, (before,), (change,))
    root = jnp.linalg.cholesky(inertia)
    inward = jax.scipy.linalg.solve_triangular(root, moved, lower=True)
    inward = jax.scipy.linalg.solve_triangular(root, inward.T, lower=True)
    by = root @ (jnp.tril(inward) - 0.5 * jnp.diag(jnp.diag(inward)))
    diagonal, by_diagonal = jnp.diag(root), jnp.diag(by)
    end = jnp.tril(root + by, -1) + jnp.diag(diagonal * jnp.exp(by_diagonal / diagonal))
    return of_pseudo(end @ end.T)
