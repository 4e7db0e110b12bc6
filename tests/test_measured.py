"""Logs of real machines: every shared rig gives a model and finite first E-step, one is identified."""

from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import data_sets

from nnap_em.data.dataset import Dataset
from nnap_em.data.logs import read_logs
from nnap_em.data.rig import Rig, read_rig
from nnap_em.em.build import build
from nnap_em.em.loop import e_step
from nnap_em.fit.identify import identify
from nnap_em.smoother.gaussian import CubatureSmoother
from nnap_em.systems import specs

_e_step = eqx.filter_jit(e_step)


def _read(folder: Path, sequences: int, rows: int) -> tuple[Rig, Dataset]:
    """The head of the first training sequences."""
    rig = read_rig(folder / "rig.toml", specs)
    data = read_logs(folder / "train", rig, trust=True).data  # what is masked is a matter of tests/test_data.py
    return rig, jax.tree.map(lambda a: jnp.asarray(a[:sequences, :rows]), data)


@pytest.mark.slow  # fast: test_a_measured_arm_is_identified
def test_every_shared_rig_has_a_finite_first_e_step(shared):
    folders = [path.parent for path in data_sets(shared)]
    assert folders
    for folder in folders:
        rig, data = _read(folder, 2, 100)
        problem = build(rig, data, key=jax.random.key(0))
        posterior = _e_step(problem.model, data, CubatureSmoother(problem.bank), key=jax.random.key(1))
        numbers = posterior._replace(ess=posterior.loglik)  # infinite: nothing is sampled
        assert all(np.all(np.isfinite(a)) for a in jax.tree.leaves(numbers)), folder


def test_a_measured_arm_is_identified(shared):
    """The second joint is hidden; the fitted model explains the first one better than the first model does."""
    rig, data = _read(shared / "data/measured/dfki_c1_joint1", 4, 60)
    used = []
    fitted = identify(
        rig,
        data,
        key=jax.random.key(0),
        smoother=CubatureSmoother,
        epochs=4,
        watch=lambda state, seen, kept: used.append(kept),
    )
    loglik = fitted.state.loglik
    assert len(loglik) == 4 and np.all(np.isfinite(loglik))
    assert all(np.all(kept) for kept in used)
    assert loglik.max() > loglik[0]
    assert np.all(np.linalg.eigvalsh(np.asarray(fitted.state.hessian)) > 0)
