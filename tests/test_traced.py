"""Programs that are kept between runs: the same numbers, found again, and never another program's."""

import dataclasses
import json
import pickle
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from shell import ENVIRONMENT, ROOT

from nnap_em.em.loop import e_step
from nnap_em.model.simulate import examples, sweep_experiment
from nnap_em.numerics import parallel, traced
from nnap_em.smoother.gaussian import CubatureSmoother, ExtendedKalmanSmoother
from nnap_em.smoother.start import StartBank
from nnap_em.storage.cache import Cache

EXTENDED = ExtendedKalmanSmoother(StartBank((1, 1)))


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """A cache in use, in a process that has no program yet."""
    programs = Cache(tmp_path / "cache")
    monkeypatch.setattr(traced._Programs, "cache", programs)
    monkeypatch.setattr(traced._Programs, "ready", {})
    return programs


def _kept(cache: Cache) -> set[str]:
    return {path.name for path in cache.folder.glob("*")}


@pytest.fixture(scope="module")
def work():
    """A model and logs of it."""
    model, sweep = examples["slide"]()
    return model, sweep_experiment(model, sweep, 3, 40, key=jax.random.key(0)).data


def _smoothed(work, smoother, monkeypatch):
    """`e_step` as the next process would do it."""
    monkeypatch.setattr(traced._Programs, "ready", {})
    parallel._program.cache_clear()
    return e_step(work[0], work[1], smoother, key=jax.random.key(0))


def test_a_program_found_again_gives_the_same_to_the_last_bit_and_traces_nothing(cache, work, monkeypatch):
    smoother, calls = CubatureSmoother(StartBank((1, 3))), []
    plain = e_step(work[0], work[1], smoother, key=jax.random.key(0))
    first = _smoothed(work, smoother, monkeypatch)
    assert len(_kept(cache)) == 1
    transition = type(work[0]).transition
    monkeypatch.setattr(type(work[0]), "transition", lambda *args: calls.append(1) or transition(*args))
    again = _smoothed(work, smoother, monkeypatch)
    assert not calls and len(_kept(cache)) == 1
    for a, b, c in zip(*map(jax.tree.leaves, (plain, first, again)), strict=True):
        np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(b, c)
    assert type(again) is type(plain)


@pytest.mark.parametrize("other", ["smoother", "constant", "shape", "type"])
def test_what_decides_a_program_makes_another(cache, work, monkeypatch, other):
    smoother, (model, data) = EXTENDED, work
    _smoothed(work, smoother, monkeypatch)
    if other == "smoother":
        smoother = CubatureSmoother(smoother.bank)
    elif other == "constant":
        model = dataclasses.replace(model, substeps=3)
    elif other == "shape":
        data = jax.tree.map(lambda a: a[:, :30], data)
    else:
        data = data._replace(u=data.u.astype(jnp.float32))
    with jax.numpy_dtype_promotion("standard"):
        posterior = _smoothed((model, data), smoother, monkeypatch)
        assert len(_kept(cache)) == 2
        monkeypatch.setattr(traced._Programs, "cache", None)
        np.testing.assert_array_equal(posterior.state.mean, _smoothed((model, data), smoother, monkeypatch).state.mean)


def test_other_numbers_are_no_other_program(cache, work, monkeypatch):
    model, data = work
    first = _smoothed(work, EXTENDED, monkeypatch)
    heavier = dataclasses.replace(model, log_q=model.log_q + 1.0)
    second = _smoothed((heavier, data), EXTENDED, monkeypatch)
    assert len(_kept(cache)) == 1
    assert np.abs(np.asarray(first.state.cov - second.state.cov)).max() > 0


def test_another_text_of_the_package_makes_another(cache, work, monkeypatch):
    _smoothed(work, EXTENDED, monkeypatch)
    monkeypatch.setattr(traced, "_surroundings", lambda: "after an edit")
    _smoothed(work, EXTENDED, monkeypatch)
    assert len(_kept(cache)) == 2


def _own(common, one):
    return common * one


def test_what_a_key_cannot_tell_is_not_kept(cache):
    """A function of another package may say something else tomorrow under the same name."""
    np.testing.assert_array_equal(parallel.each(_own, jnp.asarray(2.0), jnp.arange(3.0)), [0.0, 2.0, 4.0])
    assert not _kept(cache)


def test_what_is_not_kept_takes_its_arguments_anew(cache):
    """Other numbers of the same shapes are not answered with the result of the first."""
    for factor in (2.0, 3.0):
        product = parallel.each(_own, jnp.asarray(factor), jnp.arange(3.0))
        np.testing.assert_array_equal(product, factor * np.arange(3.0))


def _called_back(common, one):
    return jax.pure_callback(lambda x: 2 * x, jax.ShapeDtypeStruct((), one.dtype), one, vmap_method="sequential")


def _wrong(common, one):
    raise ZeroDivisionError("told by the function")


def test_what_cannot_be_written_down_runs_all_the_same(cache, monkeypatch):
    for function in (_called_back, _wrong):
        monkeypatch.setattr(function, "__module__", "nnap_em.somewhere")
    np.testing.assert_array_equal(parallel.each(_called_back, None, jnp.arange(3.0)), [0.0, 2.0, 4.0])
    assert not _kept(cache)
    with pytest.raises(ZeroDivisionError, match="told by the function"):
        parallel.each(_wrong, None, jnp.arange(3.0))


def test_a_closure_is_told_by_nothing():
    def made(slope):
        return lambda v: slope * v

    made.__module__ = "nnap_em.somewhere"
    inside = made(2.0)
    inside.__module__ = "nnap_em.somewhere"
    with pytest.raises(TypeError, match="somewhere"):
        traced._key(len, [], inside)


def test_what_is_damaged_is_made_anew(cache, work, monkeypatch):
    first = _smoothed(work, EXTENDED, monkeypatch)
    (name,) = _kept(cache)
    whole = (cache.folder / name).read_bytes()
    (cache.folder / name).write_bytes(whole[: len(whole) // 2])
    again = _smoothed(work, EXTENDED, monkeypatch)
    np.testing.assert_array_equal(first.state.mean, again.state.mean)
    assert len((cache.folder / name).read_bytes()) == len(whole)


class _Opened:
    """Writes a file where it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (str(self.path), "w")


def test_an_entry_is_data_and_runs_nothing(cache, work, monkeypatch, tmp_path):
    """Neither a pickle nor the name of a function in the place of a program."""
    _smoothed(work, EXTENDED, monkeypatch)
    (name,) = _kept(cache)
    whole, mark = (cache.folder / name).read_bytes(), tmp_path / "mark"
    form, _, program = whole.partition(b"\n")
    assert json.loads(form)[0] == "nnap_em.smoother.posterior:Posterior"
    assert traced._unpacked(whole) is not None
    other = json.dumps(["os:mkdir", str(mark)]).encode() + b"\n" + program
    for content in (pickle.dumps(_Opened(mark)), pickle.dumps((program, _Opened(mark))), other):
        assert traced._unpacked(content) is None
        assert not mark.exists()


def _named(common, one):
    return {"doubled": common * one}


def test_an_outcome_with_other_nodes_than_tuples_and_lists_is_not_kept(cache, monkeypatch):
    monkeypatch.setattr(_named, "__module__", "nnap_em.somewhere")
    out = parallel.each(_named, jnp.asarray(2.0), jnp.arange(3.0))
    np.testing.assert_array_equal(out["doubled"], [0.0, 2.0, 4.0])
    assert not _kept(cache)


def test_a_shelf_that_cannot_be_written_is_none(work, monkeypatch, tmp_path):
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setattr(traced._Programs, "cache", Cache(tmp_path / "file"))
    monkeypatch.setattr(traced._Programs, "ready", {})
    assert np.isfinite(np.asarray(_smoothed(work, EXTENDED, monkeypatch).state.mean)).all()


def test_what_a_killed_process_left_half_written_goes(tmp_path):
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    (tmp_path / f".key.{dead.pid}.part").write_text("half")
    (tmp_path / "key").write_text("whole")
    assert _kept(Cache(tmp_path)) == {"key"}


TWO = """
import json, sys
import jax, numpy as np
jax.config.update("jax_enable_x64", True)
from nnap_em.em.loop import e_step
from nnap_em.model.simulate import examples, sweep_experiment
from nnap_em.numerics import parallel, profile, traced
from nnap_em.smoother.gaussian import CubatureSmoother
from nnap_em.smoother.start import StartBank
from nnap_em.storage.cache import Cache
from pathlib import Path
traced.use_cache(Cache(Path(sys.argv[1])))
parallel.use_every_device()
model, sweep = examples["slide"]()
data = sweep_experiment(model, sweep, 3, 40, key=jax.random.key(0)).data
with profile.profiling() as told:
    found = e_step(model, data, CubatureSmoother(StartBank((1, 3))), key=jax.random.key(0))
spent = told.spent["each_smooth"]
print(json.dumps([jax.device_count(), sum(spent["trace"]), float(np.sum(np.asarray(found.state.mean) ** 2))]))
"""


def test_over_two_devices_another_process_finds_it(tmp_path):
    """Keys do not hang on what differs among processes, addresses of functions say."""

    def run():
        command, two = [sys.executable, "-c", TWO, str(tmp_path)], {"JAX_NUM_CPU_DEVICES": "2"}
        done = subprocess.run(command, cwd=ROOT, env=ENVIRONMENT | two, capture_output=True, text=True, check=True)
        return json.loads(done.stdout)

    first, again = run(), run()
    assert len(list(tmp_path.glob("*"))) == 1
    assert first[0] == again[0] == 2 and first[2] == again[2]
    assert again[1] < 0.2 * first[1]
