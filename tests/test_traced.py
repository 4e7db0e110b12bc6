"""Programs that are kept between runs: the same numbers, found again, and never another program's."""

import dataclasses
import json
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nnap_em.base import parallel, traced
from nnap_em.base.gaussian import Gaussian
from nnap_em.estimate.smoother.kalman import Affine, Cubature, Tangent
from nnap_em.model.simulate import examples
from nnap_em.model.state_space import Inputs, StateSpaceModel


@pytest.fixture
def cache(tmp_path, monkeypatch) -> Path:
    """A cache in use, in a process that has no program yet."""
    monkeypatch.setattr(traced._Programs, "folder", tmp_path / "cache")
    monkeypatch.setattr(traced._Programs, "ready", {})
    for function in (_linearised, _called_back, _wrong):  # as if it were the package's
        monkeypatch.setattr(function, "__module__", "nnap_em.somewhere")
    return tmp_path / "cache"


def _kept(cache: Path) -> set[str]:
    return {path.name for path in cache.glob("*")}


def _linearised(common, one):
    """One step of a slide about each state: a small program, whose outcome is a tuple with names."""
    model, rule = common
    x, u = one
    return jax.vmap(lambda x, u: rule(model, Gaussian(x, jnp.eye(2)), Inputs.held(u)))(x, u)


class _Work(NamedTuple):
    model: StateSpaceModel
    rule: Tangent | Cubature
    x: jax.Array
    u: jax.Array


@pytest.fixture(scope="module")
def work() -> _Work:
    rng = np.random.default_rng(0)
    x, u = (jnp.asarray(rng.normal(size=(3, 5, n))) for n in (2, 1))
    return _Work(examples["slide"]().model, Tangent(), x, u)


def _done(work: _Work, monkeypatch) -> Affine:
    """The outcome of `_linearised` with no program left in memory, as in the next process."""
    monkeypatch.setattr(traced._Programs, "ready", {})
    parallel._program.cache_clear()
    return parallel.each(_linearised, work[:2], work[2:])


def _same(a, b) -> None:
    for one, other in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_program_found_again_gives_the_same_to_the_last_bit_and_traces_nothing(cache, work, monkeypatch, tmp_path):
    """An entry is data that runs nothing; a damaged one is made anew."""
    calls, transition = [], type(work.model).transition
    with monkeypatch.context() as patch:
        patch.setattr(traced._Programs, "folder", None)
        plain = _done(work, monkeypatch)
    first = _done(work, monkeypatch)
    (path,) = cache.glob("*")
    with monkeypatch.context() as patch:
        patch.setattr(type(work.model), "transition", lambda *args: calls.append(1) or transition(*args))
        again = _done(work, monkeypatch)
        other = _done(work._replace(x=work.x + 1.0), monkeypatch)  # other numbers are no other program
    assert not calls and len(_kept(cache)) == 1
    _same(plain, first)
    _same(first, again)
    assert type(again) is type(plain)
    assert np.abs(np.asarray(first.offset - other.offset)).max() > 0

    whole, mark = path.read_bytes(), tmp_path / "mark"
    form, _, program = whole.partition(b"\n")
    assert json.loads(form)[0] == "nnap_em.estimate.smoother.kalman:Affine"
    path.write_bytes(json.dumps(["os:mkdir", str(mark)]).encode() + b"\n" + program)
    assert traced._read(path) is None and not mark.exists()
    path.write_bytes(whole[: len(whole) // 2])
    _same(first, _done(work, monkeypatch))
    assert len(path.read_bytes()) == len(whole)


OTHERS = {
    "rule": lambda work: work._replace(rule=Cubature()),
    "constant": lambda work: work._replace(model=dataclasses.replace(work.model, substeps=3)),
    "shape": lambda work: jax.tree.map(lambda a: a[:, :4] if a.ndim == 3 else a, work),
    "type": lambda work: work._replace(u=work.u.astype(jnp.float32)),
    "text of the package": lambda work: work,
}


@pytest.mark.parametrize("other", OTHERS)
def test_what_decides_a_program_makes_another(cache, work, monkeypatch, other):
    _done(work, monkeypatch)
    if other == "text of the package":
        monkeypatch.setattr(traced, "surroundings", lambda: "after an edit")
    with jax.numpy_dtype_promotion("standard"):
        changed = _done(OTHERS[other](work), monkeypatch)
        assert len(_kept(cache)) == 2
        monkeypatch.setattr(traced._Programs, "folder", None)
        _same(changed, _done(OTHERS[other](work), monkeypatch))


def _called_back(common, one):
    return jax.pure_callback(lambda x: 2 * x, jax.ShapeDtypeStruct((), one.dtype), one, vmap_method="sequential")


def _wrong(common, one):
    raise ZeroDivisionError("told by the function")


def test_what_a_key_cannot_tell_or_a_file_cannot_hold_runs_all_the_same(cache, work, monkeypatch):
    """A function of another package may say something else tomorrow; so may a closure."""
    numbers = jnp.arange(3.0)
    for factor in (2.0, 3.0):
        scaled = parallel.each(lambda common, one: common * one, jnp.asarray(factor), numbers)
        np.testing.assert_array_equal(scaled, factor * np.arange(3.0))
    np.testing.assert_array_equal(parallel.each(_called_back, None, numbers), [0.0, 2.0, 4.0])
    with pytest.raises(ZeroDivisionError, match="told by the function"):
        parallel.each(_wrong, None, numbers)
    slope = 2.0
    closure = lambda v: slope * v  # noqa: E731
    closure.__module__ = "nnap_em.somewhere"
    with pytest.raises(TypeError, match="somewhere"):
        traced._key(len, [], closure)
    assert not _kept(cache)
    cache.write_text("no folder")
    assert np.isfinite(np.asarray(_done(work, monkeypatch).matrix)).all()
