"""Public functions: their docstrings have sections, and the examples in them run on one small slide."""

import doctest
import inspect
from types import ModuleType

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
UNSAID = {"parallel.all_devices", "parallel.over", "systems.root"}
"""One line says all of them."""


@pytest.fixture(scope="module")
def names(tmp_path_factory):
    """A slide with its logs, and a fit of three epochs."""
    folder = tmp_path_factory.mktemp("public") / "bench"
    assert main(["simulate", str(folder), "--system", "slide", "--sequences", "2", "--test", "1", "--steps", "60"]) == 0
    rig, key = nnap_em.read_rig(folder / "rig.toml"), jax.random.key(0)
    logs, test = (nnap_em.read_logs(folder / part, rig) for part in ("train", "test"))
    fits = [nnap_em.identify(rig, logs.data, key=jax.random.key(seed), epochs=3) for seed in (0, 1)]
    diagnosis = nnap_em.Diagnosis(fits[0], fits[0], (), ())
    return {
        "nnap_em": nnap_em, "np": np, "jnp": jnp, "folder": str(folder), "rig": rig, "key": key, "logs": logs,
        "train": logs.data, "test": test.data, "fit": fits[0], "other": fits[1], "diagnosis": diagnosis,
    }  # fmt: skip


@pytest.mark.parametrize("name", sorted(FUNCTIONS))
def test_a_docstring_names_every_argument(name):
    function = FUNCTIONS[name]
    text, arguments = inspect.getdoc(function) or "", inspect.signature(function).parameters
    if name in UNSAID:
        return
    listed = text.split("\nArgs:\n")[-1].split("\n\n")[0] if "\nArgs:\n" in text else ""
    assert [line.split(":")[0].strip(" *") for line in listed.splitlines() if line[4:5] not in ("", " ")] == [
        *arguments
    ]
    assert "\nReturns:\n" in text or inspect.signature(function).return_annotation in (None, "None")


EXAMPLES = {
    test.name: test
    for name, function in FUNCTIONS.items()
    for test in doctest.DocTestFinder(recurse=False).find(inspect.unwrap(function), name)
    if test.examples
}


def test_most_functions_have_an_example():
    assert len(EXAMPLES) >= 20 and not any(isinstance(value, ModuleType) for value in FUNCTIONS.values())


@pytest.mark.parametrize("name", sorted(EXAMPLES))
def test_an_example_runs(name, names):
    example = EXAMPLES[name]
    example.globs = dict(names)
    assert doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE).run(example).failed == 0
