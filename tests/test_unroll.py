"""JAX functions written out as C: compiled, the same numbers for every system and effect; or refused by name."""

import ctypes
import subprocess

import jax
import jax.numpy as jnp
import numpy as np
import plant
import pytest
from helpers import around, declared_model

from nnap_em.base.elementary import cos, sin
from nnap_em.errors import ExportError
from nnap_em.model.effects import catalogue
from nnap_em.model.friction import FrictionNetwork
from nnap_em.model.state_space import Inputs, with_effects
from nnap_em.output.export.c99 import WHOLE, Dialect, function
from nnap_em.output.export.unroll import unroll

MODEL = declared_model(plant.Case(steps=20, hidden=False))
CANDIDATES = {name: laws[0].probes[0] for name, kind in catalogue.items() if (laws := kind.candidates(around(MODEL)))}
STRICT = ["gcc", "-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror"]
X = jnp.asarray([0.3, 0.5, 0.7])
NETWORK = FrictionNetwork(jnp.ones(2), jnp.ones(2), key=jax.random.key(0))


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


def _of_effect(effect):
    """Rate, reading and its slopes of the arm with an effect, of a state."""
    model = with_effects(MODEL, (effect,))
    row = Inputs(jnp.asarray([0.2]), jnp.asarray([0.1]), jnp.asarray(1.0), jnp.asarray(1.0))

    def values(x, u):
        inputs = row._replace(u=u)
        emission = lambda x: model.emission(x, inputs)  # noqa: E731
        return model.rate(x, inputs, jnp.asarray([0.1, 0.2])), emission(x), jax.jacfwd(emission)(x)

    x = np.random.default_rng(0).normal(scale=3.0, size=model.log_q.shape[0])
    return values, {"x": jnp.asarray(x), "u": jnp.asarray([0.2])}


FUNCTIONS = {name: _of_effect(law) for name, law in CANDIDATES.items() if name != "sensor_delay"} | {
    "network": (lambda v: (NETWORK(v),), {"v": jnp.asarray([0.3, -2.0])}),
    **{name: (case, {"x": X}) for name, case in CASES.items()},
}


@pytest.fixture(scope="module")
def numbers(tmp_path_factory):
    """Results of all functions in C, which is one library, and in JAX, which is one program."""
    folder = tmp_path_factory.mktemp("c")
    sources = {name: unroll(f"f{i}", f, **arguments) for i, (name, (f, arguments)) in enumerate(FUNCTIONS.items())}
    for file, dialect in (("f.c", Dialect()), ("single.c", Dialect("float", single=True))):
        texts = WHOLE.replace("double", dialect.real), *(function(source, dialect) for source in sources.values())
        (folder / file).write_text("\n".join(["#include <math.h>", *texts]))
    subprocess.run([*STRICT, "-shared", "-fPIC", "f.c", "-o", "f.so", "-lm"], cwd=folder, check=True)
    subprocess.run([*STRICT, "-Wdouble-promotion", "-fsyntax-only", "single.c"], cwd=folder, check=True)
    library = ctypes.CDLL(str(folder / "f.so"))
    truths = jax.jit(lambda given: {name: f(**given[name]) for name, (f, _) in FUNCTIONS.items()})
    wanted, results = truths({name: arguments for name, (_, arguments) in FUNCTIONS.items()}), {}
    for name, source in sources.items():
        inputs = [np.ravel(np.asarray(a, float)) for a in FUNCTIONS[name][1].values()]
        out = np.zeros(len(source.results))
        getattr(library, source.name)(*(a.ctypes.data_as(ctypes.c_void_p) for a in (*inputs, out)))
        results[name] = out, np.concatenate([np.ravel(a) for a in wanted[name]])
    return results


@pytest.mark.parametrize("name", FUNCTIONS)
def test_compiled_c_has_the_numbers_of_jax(name, numbers):
    np.testing.assert_allclose(*numbers[name], rtol=1e-7)


def test_what_derivatives_leave_behind_is_gone():
    """d (a x + b) / dx is a number."""
    source = unroll("slope", lambda x: (jax.jacfwd(lambda x: 2.0 * x + 1.0)(x),), x=jnp.ones(2))
    assert source.lines == () and source.results == (2.0, 0.0, 0.0, 2.0)


REFUSED = (
    (lambda x: (jax.scipy.special.erf(x),), "'erf' has no plain C form"),
    (lambda x: (jax.lax.while_loop(lambda y: y[0] < 9, lambda y: 2 * y, x),), "'while'"),
    (lambda x: (jax.lax.fori_loop(0, 9999, lambda i, y: y * x, x),), "a loop of 9999 passes"),
    (lambda x: (jax.lax.div((9 * x).astype(int), 2).astype(float),), "of whole numbers"),
    (lambda x: (jax.lax.select_n(jnp.floor(3 * x).astype(jnp.int32), x, 2 * x, 3 * x),), "of more than two cases"),
    (lambda x: (jax.lax.round(x),), "'round' away from zero"),
    (lambda x: (jax.lax.dynamic_slice(x, (jnp.argmax(x),), (1,)),), "has no plain C form"),
)


def test_what_c_has_not_is_refused_by_name():
    for refused, reason in REFUSED:
        with pytest.raises(ExportError, match=reason):
            unroll("function", refused, x=jnp.asarray([0.3, 0.5, 0.7]))
