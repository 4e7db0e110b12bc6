"""Public names: where they are, and that the examples of their docstrings run on one small slide."""

import dataclasses
import doctest
import importlib
import inspect
import re
import tomllib
from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import nnap
from rigs import slide_rig
from shell import ROOT

import nnap_em

TOP = {name: getattr(nnap_em, name) for name in nnap_em.__all__}
WINGS = {name: value for name, value in TOP.items() if isinstance(value, ModuleType)}
ROOMS = {name: wing for name, wing in WINGS.items() if name != "output"}
ROOMS |= {f"output.{name}": importlib.import_module(f"nnap_em.output.{name}") for name in ("export", "plots")}
FUNCTIONS = {
    f"{room}.{name}".removeprefix("nnap_em."): getattr(home, name)
    for room, home in ({"nnap_em": nnap_em} | ROOMS).items()
    for name in home.__all__
    if inspect.isfunction(getattr(home, name))
}


def test_names_are_loaded_from_their_homes_and_listed():
    assert nnap_em.identify is importlib.import_module("nnap_em.estimate.identify").identify
    assert set(TOP) <= set(dir(nnap_em))
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert version == nnap_em.__version__
    with pytest.raises(AttributeError, match="no attribute 'identity'"):
        _ = nnap_em.identity  # type: ignore[attr-defined]


def test_reference_has_every_public_name():
    listed = re.findall(r"^::: (nnap_em\.[\w.]+)\.(\w+)$", (ROOT / "docs/api.md").read_text(), re.MULTILINE)
    there = [id(getattr(importlib.import_module(home), name)) for home, name in listed]
    public = [value for name, value in TOP.items() if name not in {*WINGS, "__version__"}]
    public += [getattr(room, name) for room in ROOMS.values() for name in room.__all__]
    assert {id(value) for value in public} <= set(there) and len(set(there)) == len(there)


@pytest.fixture(scope="module")
def names(tmp_path_factory, slide_fit):
    """A slide with its logs, and two fits of it."""
    folder = tmp_path_factory.mktemp("public") / "bench"
    assert nnap("simulate", folder, "--system", "slide", "--sequences", 4, "--test", 1, "--steps", 95) == 0
    rig, key = slide_rig(), jax.random.key(0)
    logs, test = (nnap_em.read_logs(folder / part, rig) for part in ("train", "test"))
    best = dataclasses.replace(slide_fit.state.best, log_r=slide_fit.state.best.log_r + 1.0)
    other = slide_fit._replace(state=slide_fit.state._replace(best=best))
    diagnosis = nnap_em.Diagnosis(slide_fit, slide_fit, (), ())
    return {
        "nnap_em": nnap_em, "np": np, "jnp": jnp, "folder": str(folder), "rig": rig, "key": key, "logs": logs,
        "train": logs.data, "test": test.data, "fit": slide_fit, "other": other, "diagnosis": diagnosis,
    }  # fmt: skip


EXAMPLES = {
    test.name: test
    for name, function in FUNCTIONS.items()
    for test in doctest.DocTestFinder(recurse=False).find(inspect.unwrap(function), name)
    if test.examples
}


DEAR = ("check", "identify_from", "estimate.ExtendedKalmanSmoother")  # fast: test_check.py, test_changed.py


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] * (n in DEAR)) for n in sorted(EXAMPLES)])
def test_an_example_runs(name, names):
    example = EXAMPLES[name]
    example.globs = dict(names)
    assert doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE).run(example).failed == 0
