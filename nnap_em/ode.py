"""One sample interval of an ordinary differential equation, through diffrax, differentiable forward and backward."""

from collections.abc import Callable
from typing import ClassVar, Literal

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


class RK4(diffrax.AbstractERK):
    """Kutta's classical fourth-order method as a diffrax solver.

    `scan_kind="bounded"` lets `jax.jacfwd` and `jax.grad` both pass through a step.
    [Hairer, Norsett & Wanner 1993, table II.1.2]
    """

    scan_kind: Literal["lax", "checkpointed", "bounded"] | None = "bounded"
    tableau: ClassVar[diffrax.ButcherTableau | diffrax.MultiButcherTableau] = diffrax.ButcherTableau(
        a_lower=(np.array([0.5]), np.array([0.0, 0.5]), np.array([0.0, 0.0, 1.0])),
        b_sol=np.array([1 / 6, 1 / 3, 1 / 3, 1 / 6]),
        b_error=np.zeros(4),
        c=np.array([0.5, 0.5, 1.0]),
    )
    interpolation_cls: ClassVar[Callable] = diffrax.LocalLinearInterpolation

    def order(self, terms):
        return 4


def integrate(
    rate: Callable[[Float[Array, " state"]], Float[Array, " state"]],
    x: Float[Array, " state"],
    dt: float,
    substeps: int,
) -> Float[Array, " state"]:
    """State after `dt` [s] of x' = rate(x), by `substeps` equal steps of `RK4`.

    The input is held over the interval (zero-order hold), so the rate does not depend on time.
    """
    solver = RK4()
    term = diffrax.ODETerm(lambda t, y, args: rate(y))
    h = dt / substeps

    def body(x, _):
        x, _, _, _, _ = solver.step(
            term, jnp.zeros((), x.dtype), jnp.asarray(h, x.dtype), x, None, None, made_jump=False
        )
        return x, None

    x, _ = jax.lax.scan(body, x, None, length=substeps)
    return x
