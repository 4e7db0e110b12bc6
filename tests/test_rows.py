"""Rows in blocks: what all at once give, whatever the length, and differentiable both ways."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nnap_em.numerics.rows import BLOCK, rows


def _one(x, scale):
    return {"wave": jnp.sin(scale * x), "sum": jnp.sum(x * scale)}


@pytest.mark.parametrize("length", [1, BLOCK - 1, BLOCK, BLOCK + 1, 3 * BLOCK + 5])
def test_rows_in_blocks_are_the_rows_all_at_once(length):
    rng = np.random.default_rng(length)
    x, scale = jnp.asarray(rng.normal(size=(length, 3))), jnp.asarray(rng.normal(size=length))
    same = lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-13)  # noqa: E731
    jax.tree.map(same, rows(_one, x, scale), jax.vmap(_one)(x, scale))


def test_blocks_may_be_batched_and_differentiated():
    rng = np.random.default_rng(0)
    x, scale = jnp.asarray(rng.normal(size=(2, 40, 3))), jnp.asarray(rng.normal(size=(2, 40)))

    def total(over):
        return lambda x: jnp.sum(jax.vmap(lambda x, scale: over(_one, x, scale)["wave"])(x, scale) ** 2)

    blocks, whole = total(rows), total(lambda f, *trees: jax.vmap(f)(*trees))
    for derive in (jax.jacfwd, jax.grad):  # sums in another order
        np.testing.assert_allclose(derive(blocks)(x), derive(whole)(x), rtol=1e-12, atol=1e-12)
