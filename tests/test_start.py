"""Hypotheses of the start: what is read there needs none, and an angle whose sensor starts late needs them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from nnap_em.estimate.em.build import ALL_STARTS, RATE_STARTS, build
from nnap_em.logs.dataset import Dataset
from nnap_em.machines.rig import Declared
from nnap_em.model.simulate import declared, examples, paper_model

LATE, ROWS = 30, 96


def _counts(name: str, model, late: int, **start: Declared) -> list[int]:
    """Number of hypotheses along each state, of logs of any motion whose sensors start `late` rows late."""
    rig, t = declared(name, model), model.dt * np.arange(ROWS)
    y = np.sin(5 * t + np.arange(3.0)[:, None])[..., None] + np.arange(float(len(model.measured)))
    y[:, :late] = np.nan
    t = np.broadcast_to(t, y.shape[:2])
    data = Dataset(*map(jnp.asarray, (t, np.cos(3 * t)[..., None], y, np.ones(t.shape, bool))))
    bank = build(dataclasses.replace(rig, start=rig.start | start), data, key=jax.random.key(0)).bank
    return [len(np.unique(column)) for column in np.asarray(bank.offsets).T]


def test_an_angle_that_is_read_late_has_hypotheses():
    pendulum, arm = examples["pendulum"]().model, paper_model()
    assert _counts("pendulum", pendulum, LATE) == [13, 5]
    assert _counts("pendulum", pendulum, 0) == [1, 5]
    assert _counts("acrobot", arm, 0, theta2=Declared(0.0, 0.5)) == [1, 13, 1, 1]
    # without rates two angles have 13 x 13; with no limit they would have 25 times as many
    both = dataclasses.replace(arm, measured=(0, 1))
    counts = _counts("acrobot", both, LATE)
    assert np.prod(counts) <= ALL_STARTS and np.prod(counts[2:]) <= RATE_STARTS and counts[:2] == [13, 13]
