"""Rows in blocks: what all at once give, whatever the length, and differentiable both ways."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nnap_em.numerics.gaussian import MOST_UNROLLED, Gaussian
from nnap_em.numerics.rows import ROWS_AT_ONCE, rows


def _path(mean):
    return Gaussian(mean, jnp.broadcast_to(jnp.eye(mean.shape[-1]), (*mean.shape, mean.shape[-1])))


def _one(state, scale):
    return {"wave": jnp.sin(scale * state.mean), "sum": jnp.sum(state.cov @ state.mean * scale)}


def _all(function, *trees):
    return jax.vmap(function)(*trees)


LENGTHS = [1, ROWS_AT_ONCE - 1, ROWS_AT_ONCE, ROWS_AT_ONCE + 1, 3 * ROWS_AT_ONCE + 5]


@pytest.mark.parametrize("length, states", [*((length, 3) for length in LENGTHS), (LENGTHS[-1], MOST_UNROLLED + 1)])
def test_rows_in_blocks_are_the_rows_all_at_once(length, states):
    rng = np.random.default_rng(length)
    x, scale = jnp.asarray(rng.normal(size=(length, states))), jnp.asarray(rng.normal(size=length))
    same = lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-13)  # noqa: E731
    jax.tree.map(same, *jax.jit(lambda x, s: [over(_one, _path(x), s) for over in (rows, _all)])(x, scale))


@pytest.mark.parametrize(("states", "loops"), [(MOST_UNROLLED, 1), (MOST_UNROLLED + 1, 0)])
def test_only_few_states_are_cut_in_blocks(states, loops):
    """Programs of many states in blocks take gigabytes to compile."""
    x, scale = jnp.ones((70, states)), jnp.ones(70)
    program = str(jax.make_jaxpr(lambda x, scale: rows(_one, _path(x), scale))(x, scale))
    assert program.count("scan[") == loops


def test_blocks_may_be_batched_and_differentiated():
    rng = np.random.default_rng(0)
    x, scale = jnp.asarray(rng.normal(size=(2, 40, 3))), jnp.asarray(rng.normal(size=(2, 40)))

    def total(over):
        return lambda x: jnp.sum(jax.vmap(lambda x, s: over(_one, _path(x), s)["wave"])(x, scale) ** 2)

    slopes = jax.jit(lambda x: [derive(total(over))(x) for derive in (jax.jacfwd, jax.grad) for over in (rows, _all)])(
        x
    )
    for blocks, whole in (slopes[:2], slopes[2:]):  # sums in another order
        np.testing.assert_allclose(blocks, whole, rtol=1e-12, atol=1e-12)
