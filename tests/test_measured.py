"""Logs of real machines: every shared rig gives a model that follows its readings from the first step of EM on."""

from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import data_sets

from nnap_em.estimate.em.build import build
from nnap_em.estimate.em.loop import e_step, em_step
from nnap_em.estimate.smoother.gaussian import CubatureSmoother
from nnap_em.logs.read import read_logs
from nnap_em.machines.rig import read_rig
from nnap_em.machines.systems import specs


def _problem(folder: Path):
    """The first model of a rig, its rule and smoother, and two short sequences."""
    rig = read_rig(folder / "rig.toml", specs)
    data = read_logs(folder / "train", rig, trust=True).data  # what is masked is a matter of tests/test_data.py
    data = jax.tree.map(lambda a: jnp.asarray(a[:2, :60]), data)
    problem = build(rig, data, key=jax.random.key(0))
    return problem.model, problem.mstep, CubatureSmoother(problem.bank), data


def test_the_first_model_of_a_measured_arm_follows_its_readings(shared):
    """The second joint is hidden; errors are in standard deviations of the readings."""
    model, _, smoother, data = _problem(shared / "data/measured/dfki_c1_joint1")
    posterior = e_step(model, data, smoother, key=jax.random.key(1))
    off = np.asarray(data.y - posterior.state.mean[..., list(model.measured)]) / np.exp(0.5 * np.asarray(model.log_r))
    assert np.sqrt(np.nanmean(off**2)) < 1.5 and np.all(np.isfinite(posterior.loglik))


@pytest.mark.slow  # fast: test_the_first_model_of_a_measured_arm_follows_its_readings
def test_every_shared_rig_has_a_finite_first_step(shared):
    paths = data_sets(shared)
    assert paths
    for path in paths:
        model, rule, smoother, data = _problem(path.parent)
        after, info, loglik, _, states = em_step(model, data, smoother, rule, jax.random.key(1))
        assert info.used.any(), path
        numbers = jax.tree.leaves(eqx.filter((after, info, loglik, states), eqx.is_inexact_array))
        assert all(np.all(np.isfinite(a)) for a in numbers), path
