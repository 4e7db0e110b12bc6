"""Hypotheses of the start: what is read there needs none, and an angle whose sensor starts late needs them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from common_work import START_STD, one_start, wide_bank

from nnap_em.data.rig import Declared
from nnap_em.em.build import ALL_STARTS, MOVED, RATE_STARTS, build, measure_scales, read_at_start
from nnap_em.em.loop import e_step
from nnap_em.model.simulate import declared, examples, sweep_experiment
from nnap_em.smoother.gaussian import CubatureSmoother
from nnap_em.smoother.start import StartBank

KEY = jax.random.key(0)
LATE, ROWS = 30, 200


def _case(name: str, rows: int, measured: tuple[int, ...] | None = None):
    """Truth, its rig, and logs whose sensors start `rows` late."""
    model, sweep = examples[name]()
    if measured:
        model = dataclasses.replace(model, measured=measured, log_r=jnp.full(len(measured), 2 * jnp.log(0.01)))
    experiment = sweep_experiment(model, sweep, 6, ROWS, key=KEY)
    data = experiment.data
    return model, declared(name, model), experiment.x, data._replace(y=data.y.at[:, :rows].set(jnp.nan))


def _counts(rig, data) -> np.ndarray:
    """Number of hypotheses along each state."""
    offsets = np.asarray(build(rig, data, key=KEY).bank.offsets)
    return np.array([len(np.unique(column)) for column in offsets.T])


def test_an_angle_that_is_read_late_has_hypotheses():
    _, rig, _, data = _case("pendulum", LATE)
    assert _counts(rig, data).tolist() == [13, 5]
    assert _counts(rig, data._replace(y=jnp.nan_to_num(data.y))).tolist() == [1, 5]


@pytest.mark.parametrize(("std", "bank"), [(START_STD[1], one_start), (0.5, wide_bank)])
def test_the_banks_of_the_benchmark_are_those_of_their_priors(std, bank):
    """Rows "as the library sets it" of docs/results/throughput.md, and the rows of a start known to 0.5 rad."""
    _, rig, _, data = _case("acrobot", 0)
    rig = dataclasses.replace(rig, start=rig.start | {"theta2": Declared(0.0, std)})
    np.testing.assert_array_equal(build(rig, data, key=KEY).bank.offsets, bank.offsets)


@pytest.mark.parametrize(("more", "read"), [(-1, True), (1, False)])
def test_late_is_what_lets_it_move(more, read):
    """One row to either side of the moment at which the joint may have moved `MOVED`, in one sequence of six."""
    model, rig, _, data = _case("pendulum", 0)
    scales, rig = measure_scales(rig, model.system, data), dataclasses.replace(rig, dt=1e-3)
    rows = int(MOVED / (scales.speed[0] * rig.dt)) + (more > 0)
    assert rows > 0
    data = data._replace(y=data.y.at[2, :rows].set(jnp.nan))
    assert (rig.measured[0] in read_at_start(rig, model.system, data, scales)) == read


def test_hypotheses_of_a_machine_whose_sensors_are_all_late_are_bounded():
    """Without rates two angles have 13 x 13; with no limit they would have 25 times as many."""
    _, rig, _, data = _case("acrobot", LATE, (0, 1))
    counts = _counts(rig, data)
    assert np.prod(counts) <= ALL_STARTS and np.prod(counts[2:]) <= RATE_STARTS and counts[:2].tolist() == [13, 13]


def test_a_double_pendulum_is_followed_from_before_its_first_reading():
    """True model, joint 2 not read at all: the smoothed angles are the true ones in the rows without readings, too."""
    model, rig, x, data = _case("acrobot", LATE)
    problem = build(rig, data, key=KEY)
    model = dataclasses.replace(model, start=problem.model.start)
    errors = []
    for counts in (None, (1, 13, 1, 1)):
        bank = problem.bank if counts is None else StartBank(counts)
        smoothed = e_step(model, data, CubatureSmoother(bank, branching=False), key=KEY).state.mean
        off = (np.asarray(smoothed - x)[..., :2] + np.pi) % (2 * np.pi) - np.pi
        errors.append(np.sqrt(np.mean(off**2, axis=(1, 2))))
    assert errors[0].max() < 0.2 and errors[1].max() > 0.5
