"""Sequences over devices, groups and processes: the same numbers as one device gives."""

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import nnap
from shell import ENVIRONMENT

from nnap_em.base.parallel import all_devices, each, over
from nnap_em.cli.launch import free_address


def _weigh(common, one):
    scale, key, nothing = one
    return common["a"] @ scale, jax.random.normal(key, (3,)), nothing


def test_groups_and_a_mesh_change_nothing():
    common, scales = {"a": jnp.arange(6.0).reshape(2, 3)}, jnp.arange(21.0).reshape(7, 3)
    keys = jax.random.split(jax.random.key(0), 7)
    expected = jax.jit(jax.vmap(lambda k: jax.random.normal(k, (3,))))(keys)
    for together, place in ((None, None), (1, None), (3, None), (100, None), (None, all_devices()), (2, all_devices())):
        with over(place) if place else contextlib.nullcontext():
            product, draw, nothing = each(_weigh, common, (scales, keys, jnp.zeros((7, 4, 0))), together=together)
        assert nothing.shape == (7, 4, 0)
        np.testing.assert_allclose(product, np.asarray(scales) @ np.asarray(common["a"]).T, rtol=1e-15)
        np.testing.assert_array_equal(draw, expected)
    mesh = jax.make_mesh((1,), ("data",), axis_types=(jax.sharding.AxisType.Auto,))
    with pytest.raises(ValueError, match="seq"), over(mesh):
        pass


@pytest.fixture(scope="module")
def rig(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("parallel") / "rig"
    assert nnap("simulate", "--system", "slide", "--sequences", 5, "--test", 1, "--steps", 40, folder) == 0
    shutil.rmtree(folder / "test")  # nothing to predict: it is the fit that is spread
    return folder


@contextlib.contextmanager
def _launched(*order: object, env: dict[str, str] = ENVIRONMENT, own: bool = False) -> Iterator[subprocess.Popen]:
    """Processes of a command, which end at the end; `own`: they are a group that signals are sent to."""
    argv, piped = [sys.executable, "-m", "nnap_em.cli.launch", *map(str, order)], subprocess.PIPE
    run = subprocess.Popen(argv, env=env, start_new_session=own, stdout=subprocess.DEVNULL, stderr=piped, text=True)
    try:
        yield run
    finally:
        run.kill()


def _numbers(out: Path) -> dict[str, np.ndarray]:
    with np.load(out / "model.npz", allow_pickle=False) as stored:
        return {name: stored[name] for name in stored.files if stored[name].dtype.kind == "f"}


@pytest.mark.slow  # fast: test_groups_and_a_mesh_change_nothing
def test_two_launchers_are_two_machines_whose_processes_agree_with_one(rig, tmp_path):
    assert nnap("identify", rig, "--epochs", 1, "--out", tmp_path / "alone", "--quiet") == 0
    place = ["--coordinator", free_address(), "--here", "1", "--first"]
    order = [2, "identify", rig, "--epochs", 1, "--out"]
    with _launched(*place, 0, *order, tmp_path / "0") as one, _launched(*place, 1, *order, tmp_path / "1") as other:
        runs = one, other
        said = [run.communicate(timeout=300)[1] for run in runs]
    assert [run.returncode for run in runs] == [0, 0], said
    numbers, alone = _numbers(tmp_path / "0"), _numbers(tmp_path / "alone")
    assert len(numbers) > 5 and numbers.keys() == alone.keys()
    for name, value in numbers.items():
        # as over devices; the Hessian in the file is a sum over all rows, and as much larger
        np.testing.assert_allclose(value, alone[name], rtol=1e-8, atol=1e-8, err_msg=name)
    assert not (tmp_path / "1").exists()


TOY = """
import sys, time
if "--work" in sys.argv:  # not in the process that starts the others
    import numpy as np
    from nnap_em.cli import identify as command
    from nnap_em.base.journal import HERE, step
    @step(lambda *_: HERE)
    def toy(i):
        time.sleep(0.05)
        return np.full(3, float(i))
    command.identify = lambda *_, **__: [toy(i) for i in range(10_000)]
"""
"""A command of steps that take no time to compile, in processes that look for this module when they begin."""


@pytest.fixture
def toy(rig, tmp_path) -> Iterator[subprocess.Popen]:
    """Two processes of it that have finished a step, whose results go to `tmp_path / "out"`."""
    (tmp_path / "sitecustomize.py").write_text(TOY)
    env = ENVIRONMENT | {"PYTHONPATH": os.pathsep.join([str(tmp_path), ENVIRONMENT["PYTHONPATH"]])}
    with _launched(2, "identify", rig, "--out", tmp_path / "out", env=env, own=True) as run:
        deadline = time.monotonic() + 300
        while not list(tmp_path.glob("out/unfinished/*.npz")):
            assert run.poll() is None and time.monotonic() < deadline
            time.sleep(0.1)
        yield run


@pytest.mark.slow  # fast: test_a_chain_of_all_faults_is_survived
def test_a_dying_process_ends_the_run_and_leaves_the_finished_steps(toy, tmp_path):
    children = Path(f"/proc/{toy.pid}/task/{toy.pid}/children").read_text().split()
    os.kill(int(children[1]), signal.SIGKILL)
    _, said = toy.communicate(timeout=60)
    assert toy.returncode == 1
    assert "process 1 was killed by SIGKILL" in said and "give the same command again" in said
    assert list(tmp_path.glob("out/unfinished/toy-*.npz"))
