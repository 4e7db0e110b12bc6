"""One sample interval of an ordinary differential equation, through diffrax, differentiable forward and backward."""

from collections.abc import Callable, Sequence
from typing import ClassVar

import diffrax
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


class RK4(diffrax.AbstractSolver):
    """Kutta's classical fourth-order method as a diffrax solver [Hairer, Norsett & Wanner 1993, table II.1.2].

    Each stage looks ahead along the slope of the one before it only, so that one loop over the stages holds the whole
    step: a compiler that sees them unrolled computes them again and again, and diffrax's own loop keeps all slopes.
    A result of a stage is made of one thing, the next point of the slope and the sum so far of the point
    (y1 = (-y0 + p2 + 2 p3 + p4) / 3 + h k4 / 6): of two made of a slope, XLA computes the whole rate in each.
    """

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar[Callable] = diffrax.LocalLinearInterpolation

    def order(self, terms):
        """Order of the error over an interval."""
        return 4

    def init(self, terms, t0, t1, y0, args):
        """No state."""
        return None

    def func(self, terms, t0, y0, args):
        """The rate itself."""
        return terms.vf(t0, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        """The value after one step, entry by entry: a batch of states is then one of each entry, without strides."""
        h = jnp.asarray(t1 - t0)
        times = t0 + h * jnp.asarray([0.0, 0.5, 0.5, 1.0], h.dtype)
        ahead = h * jnp.asarray([1 / 2, 1 / 2, 1.0, 1 / 6], h.dtype)
        share = jnp.asarray([-4 / 3, 1 / 3, 2 / 3, 1 / 3], h.dtype)

        def stage(carry, slices):
            (point, y1), (t, ahead, share) = carry, slices
            slope = terms.vf(t, tuple(point), args)
            after = [a + ahead * b for a, b in zip(start, slope, strict=True)]
            return (after, [a + share * b for a, b in zip(y1, point, strict=True)]), None

        start = list(y0)
        nothing = [a - a for a in start]  # batched as the loop's results are, which is then traced once, not twice
        (last, y1), _ = jax.lax.scan(stage, (start, nothing), (times, ahead, share))
        y1 = tuple(a + b for a, b in zip(y1, last, strict=True))
        return y1, None, {"y0": y0, "y1": y1}, None, diffrax.RESULTS.successful


def integrate(
    rate: Callable[..., Float[Array, " state"] | Sequence[Float[Array, ""]]],
    x: Float[Array, " state"],
    dt: float,
    substeps: int,
    *,
    timed: bool = False,
) -> Float[Array, " state"]:
    """State after `dt` [s] of x' = rate(x), by `substeps` equal steps of `RK4`; `timed`: of x' = rate(x, s), where s
    goes from 0 to 1 in that time.

    A rate may be handed over entry by entry: an array of many joints' accelerations is computed anew for every entry
    that is read.
    """
    solver = RK4()
    at = lambda t, step: ((step + t / h) / substeps,) if timed else ()  # noqa: E731
    term = diffrax.ODETerm(lambda t, y, step: tuple(rate(jnp.stack(y), *at(t, step))))
    zero, h = jnp.zeros((), x.dtype), jnp.asarray(dt / substeps, x.dtype)

    def body(x, step):
        x, *_ = solver.step(term, zero, h, x, step, None, made_jump=False)
        return x, None

    if substeps == 1:  # a loop in a loop is traced twice as often
        return jnp.stack(body(tuple(x), zero if timed else None)[0])
    entries, _ = jax.lax.scan(body, tuple(x), jnp.arange(substeps, dtype=x.dtype) if timed else None, length=substeps)
    return jnp.stack(entries)


def in_loop(
    function: Callable[[Float[Array, " state"]], Sequence[Float[Array, ""]]], x: Float[Array, " state"], count: int
) -> tuple[Float[Array, ""], ...]:
    """The `count` results of `function(x)` in a compiled loop of their own, as the stages of an interval are.

    Outside of one a recursion over joints is computed anew for every entry that is read of it: 357 us against 4 for the
    slopes of six readings at six joints. Both passes give the same; a loop of one pass would be unrolled.
    """

    def again(carry, _):
        return (carry[0], tuple(function(jnp.stack(carry[0])))), None

    (_, results), _ = jax.lax.scan(again, (tuple(x), (jnp.zeros((), x.dtype),) * count), None, length=2)
    return results
