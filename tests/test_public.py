"""Public functions: their docstrings have sections, and the examples in them run on one small slide."""

import doctest
import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nnap_em
from nnap_em.commands.cli import main

ROOMS = {name: getattr(nnap_em, name) for name in nnap_em._namespaces}
FUNCTIONS = {
    f"{room}.{name}".removeprefix("nnap_em."): getattr(home, name)
    for room, home in ({"nnap_em": nnap_em} | ROOMS).items()
    for name in home.__all__
    if inspect.isfunction(getattr(home, name))
}


@pytest.fixture(scope="module")
def names(tmp_path_factory):
    """A slide with its logs, and a fit of three epochs."""
    folder = tmp_path_factory.mktemp("public") / "bench"
    assert main(["simulate", str(folder), "--system", "slide", "--sequences", "4", "--test", "1", "--steps", "95"]) == 0
    rig, key = nnap_em.read_rig(folder / "rig.toml"), jax.random.key(0)
    logs, test = (nnap_em.read_logs(folder / part, rig) for part in ("train", "test"))
    fits = [nnap_em.identify(rig, logs.data, key=jax.random.key(seed), epochs=3) for seed in (0, 1)]
    diagnosis = nnap_em.Diagnosis(fits[0], fits[0], (), ())
    return {
        "nnap_em": nnap_em, "np": np, "jnp": jnp, "folder": str(folder), "rig": rig, "key": key, "logs": logs,
        "train": logs.data, "test": test.data, "fit": fits[0], "other": fits[1], "diagnosis": diagnosis,
    }  # fmt: skip


EXAMPLES = {
    test.name: test
    for name, function in FUNCTIONS.items()
    for test in doctest.DocTestFinder(recurse=False).find(inspect.unwrap(function), name)
    if test.examples
}


@pytest.mark.parametrize("name", sorted(EXAMPLES))
def test_an_example_runs(name, names):
    example = EXAMPLES[name]
    example.globs = dict(names)
    assert doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE).run(example).failed == 0
