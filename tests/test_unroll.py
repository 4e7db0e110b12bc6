"""JAX functions written out as NumPy: the same numbers for every system and effect, or refused by name."""

import jax
import jax.numpy as jnp
import numpy as np
import plant
import pytest
from helpers import around, declared_model
from jaxtyping import Array, Float

from nnap_em.effects import catalogue
from nnap_em.export.unroll import UnrollError, unroll
from nnap_em.model.friction import FrictionNetwork
from nnap_em.model.state_space import Inputs, with_effects
from nnap_em.numerics.elementary import cos, sin

MODEL = declared_model(plant.Case(steps=20, hidden=False))
AROUND = around(MODEL)
CANDIDATES = {name: laws[0].probes[0] for name, kind in catalogue.items() if (laws := kind.candidates(AROUND))}


def _agrees(function, **arguments: Float[Array, "..."]) -> str:
    """The source gives JAX's numbers, for one state and for a batch."""
    source = unroll("function", function, **arguments)
    space: dict = {"np": np}
    exec(str(source), space)
    wanted = function(*arguments.values())
    for batch in ((), (3, 2)):
        flat = [tuple(np.broadcast_to(a, batch) for a in np.ravel(value)) for value in arguments.values()]
        outputs = space["function"](*flat)
        for mine, his in zip((outputs,) if len(wanted) == 1 else outputs, wanted, strict=True):
            parts = np.array([np.broadcast_to(np.asarray(a, float), batch) for a in mine])
            np.testing.assert_allclose(np.moveaxis(parts, 0, -1), np.broadcast_to(np.ravel(his), (*batch, len(mine))))
    return str(source)


@pytest.mark.parametrize("name", [name for name in CANDIDATES if name != "sensor_delay"])
def test_every_effect_of_the_catalogue(name):
    model = with_effects(MODEL, (CANDIDATES[name],))
    x = jnp.asarray(np.random.default_rng(0).normal(scale=3.0, size=model.log_q.shape[0]))
    inputs = Inputs(jnp.asarray([0.2]), jnp.asarray([0.1]), jnp.asarray(1.0), jnp.asarray(1.0))
    row = {name: value for name, value in inputs._asdict().items() if value is not None}

    def rate(x, force, *row):
        return (model.rate(x, Inputs(*row), force),)

    def reading(x, *row):
        return model.emission(x, Inputs(*row)), jax.jacfwd(model.emission)(x, Inputs(*row))

    _agrees(rate, x=x, force=jnp.asarray([0.1, 0.2]), **row)
    _agrees(reading, x=x, **row)


def test_the_network_is_short():
    """Two joints with 16 units: three lines a unit and a few more, not one for each of 88 weights."""
    network = FrictionNetwork(jnp.ones(2), jnp.ones(2), key=jax.random.key(0))
    assert _agrees(lambda v: (network(v),), v=jnp.asarray([0.3, -2.0])).count("\n") < 150


def test_what_derivatives_leave_behind_is_gone():
    """d (a x + b) / dx is a number."""
    source = unroll("slope", lambda x: (jax.jacfwd(lambda x: 2.0 * x + 1.0)(x),), x=jnp.ones(2))
    assert source.lines == ()
    assert source.results == (("2.0", "0.0", "0.0", "2.0"),)


CASES = {
    "loop": lambda x: (jax.lax.fori_loop(0, 3, lambda i, y: y * x + i, x),),
    "branches": lambda x: (jax.lax.cond(x[0] > 0, jnp.sin, jnp.cos, x), jax.lax.cond(x[0] < 0, jnp.sin, jnp.cos, x)),
    "where": lambda x: (jnp.where(x > 0.5, x, -x), jnp.clip(x, 0.4, 0.6), jnp.sign(x), jnp.maximum(x, x[::-1])),
    "matrices": lambda x: (jnp.outer(x, x) @ jnp.arange(6.0).reshape(3, 2), jnp.sum(jnp.outer(x, x), axis=0)),
    "moves": lambda x: (x.at[1].set(2.0), x.at[1].add(2.0), x.at[2].mul(x[0]), jnp.roll(x, 1), x[jnp.asarray([2, 0])]),
    "powers": lambda x: (x**3, x**0.5, x**-2, jnp.sqrt(x), 1 / x, jnp.exp(x), jnp.log1p(x), jax.nn.sigmoid(x)),
    "whole numbers": lambda x: (
        jnp.where(jnp.round(9 * x).astype(jnp.int32) & 2 == 2, x, -x),
        (7 * x).astype(int).astype(float),
        (x > 0.4).astype(float) * x,
        jnp.where(~(x > 0.4) | (x > 0.6), x, 1.0),
        jnp.where((x > 0.4) ^ (x > 0.6), x, 1.0) + (x > 0.4).astype(int).astype(float),
    ),
    "all quadrants": lambda x: (sin(20 * x), cos(20 * x), cos(-40 * x)),
    "partly numbers": lambda x: (
        jnp.where(~jnp.stack([x[0] > 0.4, jnp.asarray(True), jnp.asarray(False)]), x, 9.0),
        jnp.where(jnp.stack([x[0] > 0.4, jnp.asarray(True), jnp.asarray(False)]), jnp.asarray([1.0, 2.0, 3.0]), x),
        jnp.stack([jnp.float64(1.0), jnp.float64(2.5), x[2]]) / jnp.asarray([2.0, 2.0, 0.3]),
        jnp.round(jnp.stack([jnp.float64(0.5), jnp.float64(-1.5), 5 * x[1]])),
        jnp.clip(jnp.stack([jnp.float64(0.5), jnp.float64(7.0), x[1]]), 0.6, 2.0),
    ),
    "constants": lambda x: (jnp.full(3, jnp.inf), jnp.where(x > 9, -jnp.inf, x), -jnp.ones(3)),
}


@pytest.mark.parametrize("function", CASES.values(), ids=CASES)
def test_what_jax_has(function):
    _agrees(function, x=jnp.asarray([0.3, 0.5, 0.7]))


REFUSED = {
    "erf": (lambda x: (jax.scipy.special.erf(x),), "'erf' has no plain NumPy form"),
    "sort": (lambda x: (jnp.sort(x),), "'sort' has no plain NumPy form"),
    "a loop of unknown length": (lambda x: (jax.lax.while_loop(lambda y: y[0] < 9, lambda y: 2 * y, x),), "'while'"),
    "a long loop": (lambda x: (jax.lax.fori_loop(0, 9999, lambda i, y: y * x, x),), "a loop of 9999 passes"),
    "whole numbers divided": (lambda x: (jax.lax.div((9 * x).astype(int), 2).astype(float),), "of whole numbers"),
    "what is left of whole numbers": (
        lambda x: (jax.lax.rem((9 * x).astype(int), 2).astype(float),),
        "of whole numbers",
    ),
    "bits": (lambda x: ((~(9 * x).astype(int)).astype(float),), "'not' of whole numbers"),
    "three cases": (
        lambda x: (jax.lax.select_n(jnp.floor(3 * x).astype(jnp.int32), x, 2 * x, 3 * x),),
        "'select_n' of more than two cases",
    ),
    "a half away from zero": (lambda x: (jax.lax.round(x),), "'round' away from zero"),
    "steered": (lambda x: (jax.lax.dynamic_slice(x, (jnp.argmax(x),), (1,)),), "has no plain NumPy form|other numbers"),
}


@pytest.mark.parametrize("function, reason", REFUSED.values(), ids=REFUSED)
def test_what_numpy_has_not_is_refused_by_name(function, reason):
    with pytest.raises(UnrollError, match=reason):
        unroll("function", function, x=jnp.asarray([0.3, 0.5, 0.7]))
