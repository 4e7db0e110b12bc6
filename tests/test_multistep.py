"""Multi-step errors, their sensitivities, what candidates change of them: roll-outs moved by hand, sums written out."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nnap_em.base.gaussian import Gaussian
from nnap_em.estimate.em import multistep
from nnap_em.estimate.em.build import build
from nnap_em.estimate.em.multistep import OpenLoop, errors, finish, followed, open_loop, ratio, weighed
from nnap_em.estimate.em.prior import ParameterPrior
from nnap_em.estimate.em.quadratic import local
from nnap_em.estimate.em.readings import third_differences, white_readings
from nnap_em.estimate.em.weights import friction_prior
from nnap_em.estimate.smoother.kalman import CUBATURE
from nnap_em.explain.diagnosis.columns import candidate_columns, tracks
from nnap_em.explain.diagnosis.hypothesis import Hypothesis
from nnap_em.explain.diagnosis.propose import surroundings
from nnap_em.explain.diagnosis.smoothed import SmoothedFit
from nnap_em.logs.dataset import Dataset
from nnap_em.model.base import prepare
from nnap_em.model.effects import Candidate, catalogue
from nnap_em.model.simulate import declared, examples, paper_model
from nnap_em.model.state_space import with_effects

ROWS = 60
TRUTH = replace(examples["pendulum"]().model, measured=(0, 1), log_r=jnp.log(jnp.asarray([1e-8, 1e-4])))
RIG = declared("pendulum", TRUTH)


@eqx.filter_jit
def _moves(model, start, data):
    """States of `model` run alone from a start in every sequence."""
    step = lambda x, u: (model.transition(x, u), x)  # noqa: E731
    return jax.vmap(lambda start, seq: jax.lax.scan(step, start, model.inputs(seq))[1])(start, data)


@pytest.fixture(scope="module")
def known() -> SmoothedFit:
    """A pendulum whose states are read nearly without noise, along its own motion."""
    t = np.broadcast_to(TRUTH.dt * np.arange(ROWS), (4, ROWS))
    u = 0.1 * np.sin(t * np.array([3.0, 5.0, 7.0, 9.0])[:, None])[..., None]
    data = Dataset(*map(jnp.asarray, (t, u, np.zeros((4, ROWS, 2)), np.ones(t.shape, bool))))
    start = Gaussian(jnp.asarray([1.5, -1.0]), 1e-6 * jnp.eye(2))
    data = data._replace(y=_moves(TRUTH, jnp.tile(start.mean, (4, 1)), data))
    problem = build(RIG, data, key=jax.random.key(0))
    model = replace(problem.model, start=start, log_q=jnp.log(jnp.asarray([1e-9, 1e-4])))
    x = _moves(model, jnp.tile(start.mean, (4, 1)), data)
    path = Gaussian(x, jnp.broadcast_to(1e-8 * jnp.eye(2), (*x.shape, 2)))
    bare = Hypothesis(model, problem.mstep)
    return SmoothedFit(bare.model, bare, path, data._replace(y=x), np.ones(4, bool), ROWS)


@pytest.fixture(scope="module")
def around(known):
    return surroundings(RIG, known.model, known.data, known.path, ROWS)


def _followed(known, model=None):
    return followed(model or known.model, known.m_step.prior, known.path, known.data)


def test_errors_are_those_of_the_model_run_alone(known):
    """None on its own motion; on that of a heavier machine, the difference of the two from the same starts."""
    grid = multistep.grid_along(known.model, known.data)
    starts, ages = grid.starts(ROWS), list(grid.ages)
    along = _followed(known)
    error = errors(along)
    assert error.shape == (4, len(starts), 2, 1)
    assert 0 < np.abs(error).max() < 0.1 * 1e-4  # of the noise of an angle: 32 bits are enough
    # of a session that began in 1970, or a joint wound up, they are not
    late = along._replace(data=known.data._replace(t=known.data.t + 1.7e9))
    assert np.abs(errors(late)).max() < 1e-12
    assert multistep._single_enough(along) and not multistep._single_enough(along._replace(state=along.state + 1e3))
    heavy = eqx.tree_at(lambda m: m.system.m, known.model, 1.1 * known.model.system.m)
    along = _followed(known, heavy)
    error, every = errors(along), errors(along, see=(0, 1))
    from_start = lambda a: np.concatenate([np.roll(a, -k, axis=1) for k in starts])  # noqa: E731
    mean, data = from_start(known.path.mean), jax.tree.map(from_start, known.data)
    difference = (mean - _moves(heavy, mean[:, 0], data))[:, ages].reshape(len(starts), 4, 2, 2).swapaxes(0, 1)
    # the filter is at a start to the noise of its readings
    np.testing.assert_allclose(every, difference, atol=0.05 * np.abs(difference).max())
    np.testing.assert_array_equal(every[..., :1], error)


LAWS = ("torsional_spring", "link_inertia", "base_tilt", "motor_gain", "eddy_brake", "sensor_bias", "sensor_scale")


def test_columns_are_difference_quotients(around, known):
    """A column is minus the change of the error where a hundredth of the effect is in the model.

    The machine has all laws, one of which has a strength: one program for every law.
    """
    candidates = [catalogue[name].candidates(around)[0] for name in LAWS]
    extra, along = candidate_columns(known.model, candidates)(_tracks(known)), _followed(known)
    before = open_loop(along, known.m_step.weights(known.model), lambda index: jax.tree.map(lambda a: a[index], extra))
    counts = [len(c.probes) for c in candidates]
    for place, column in enumerate(np.cumsum([0, *counts[:-1]]) - sum(counts)):
        laws = [c.start for c in candidates]
        weak = lambda start, probe: start + 1e-2 * (probe - start)  # noqa: E731
        laws[place] = jax.tree.map(weak, laws[place], candidates[place].probes[0])
        quotient = -(errors(_followed(known, with_effects(known.model, tuple(laws)))) - before.error) / 1e-2
        off = before.columns[..., column] - quotient
        # the force is held over a step, the slopes are as wide as predictions err: 2 % at most with this key
        assert np.linalg.norm(off) < 0.05 * np.linalg.norm(quotient), LAWS[place]


@eqx.filter_jit
def _tracks(fit: SmoothedFit):
    return tracks(fit.model, fit.path, jax.vmap(fit.model.inputs)(fit.data))


def test_a_lost_sequence_does_not_count_not_even_as_nan(known):
    """Columns of the others are the same but for the width of the slopes, that of three sequences or four."""
    weights = known.m_step.weights(known.model)
    lost = known._replace(path=known.path._replace(mean=known.path.mean.at[1].set(jnp.nan)))
    some, every = (open_loop(_followed(one), weights) for one in (lost, known))
    rest = np.array([0, 2, 3])
    assert not weighed(some, known.used)[1].any() and np.isfinite(some.columns[rest]).all()
    np.testing.assert_allclose(some.columns[rest], every.columns[rest], atol=0.02 * np.abs(every.columns).max())


def test_a_probe_gives_the_same_column_beside_all_others_as_alone(known, around):
    """Probes share a stack, what is equal in it, and a program with their class."""
    kinds = {"unknown_function": "UnknownFunction", "cogging": "Cogging", "sensor_bias": "SensorBias", "motor_gain": ""}
    candidates = [candidate for kind in kinds for candidate in catalogue[kind].candidates(around)]
    candidates = [*candidates[1::2], *candidates[::2]]
    track = _tracks(known)
    force, reading = map(np.asarray, candidate_columns(known.model, candidates)(track))
    probes = [probe for candidate in candidates for probe in candidate.probes]
    assert force.shape[1] == reading.shape[1] == len(probes)
    for kind in filter(None, kinds.values()):
        places = [i for i, probe in enumerate(probes) if type(probe).__name__ == kind]
        place = places[len(places) // 2]
        alone = candidate_columns(known.model, [Candidate(probes[place], 2 * (probes[place],), probes[place])])(track)
        for i in range(2):  # forces are up to some 100: rounding
            np.testing.assert_allclose(force[:, place], alone.force[:, i], atol=1e-12)
            np.testing.assert_allclose(reading[:, place], alone.reading[:, i], atol=1e-12)
        assert np.abs(force[:, place]).max() + np.abs(reading[:, place]).max() > 1e-3


def test_a_fit_to_multi_step_errors_finds_the_parameter(known):
    """The fit finds the mass of a machine that is 4 % heavier, read without noise, and the errors fall."""
    heavy = eqx.tree_at(lambda m: m.system.m, known.model, 1.04 * known.model.system.m)
    x = _moves(heavy, known.path.mean[:, 0], known.data)
    mean = jnp.ravel(known.model.system.m)
    prior = ParameterPrior(("m",), mean, 0.1 * mean)
    rule = eqx.tree_at(lambda m: m.prior, known.m_step, prior)
    moved = known._replace(data=known.data._replace(y=x), path=known.path._replace(mean=x))
    fitted = finish(known.model, rule, moved.path, moved.data, known.used)
    assert ratio(errors(_followed(moved)), errors(fitted), known.used) < 0.05
    assert float(fitted.model.system.m / heavy.system.m) == pytest.approx(1.0, abs=0.01)


def test_friction_is_free_in_the_span_of_known_laws(known):
    weights = known.m_step.weights(known.model)
    precision, _ = friction_prior(known.model, weights)
    nodes = np.asarray(weights.nodes)
    top, count = np.abs(nodes[0]).max(), nodes.shape[1]
    block = precision[:count, :count]
    for law in (nodes[0] / top, np.tanh(nodes[0] / (0.03 * top))):
        assert law @ block @ law < 1e-6 * np.trace(block)
    even = np.abs(nodes[0]) / top  # friction that pushes one way
    assert even @ block @ even > 1e-3 * np.trace(block) / count


def test_a_loud_recording_counts_by_the_root_of_its_loudness():
    """Errors of constant size 1, 1, 1, 4 and one recording without any: scales by hand."""
    size = np.array([1.0, 1.0, 1.0, 4.0, np.nan])
    error = size[:, None, None, None] * np.sign(np.random.default_rng(0).normal(size=(5, 30, 2, 1)))
    assert multistep.robust_scale(error)[:, 0, 0, 0] == pytest.approx(1.4826 * np.array([1.0, 1.0, 1.0, 2.0, 1.0]))
    after = error.copy()
    after[:3] *= 0.5  # three of four recordings are predicted twice as well
    inside = np.array([1.0, 1.0, 1.0, 4.0]) / 1.4826**2  # squared errors in scales: none is an outlier
    left = ((0.25 * inside[:3]).sum() + inside[3]) / inside.sum()
    assert ratio(error, after, np.ones(5, bool)) == pytest.approx(left)


def test_an_outlier_counts_as_a_line():
    assert multistep.huber(np.array(1.0), 1.0) == 1.0
    assert multistep.huber(np.array(10.0), 1.0) == pytest.approx(2 * (2 * 10.0 - 2))
    assert np.isfinite(multistep.huber(np.array(np.inf), 1.0))


def test_weights_are_one_over_the_variance_and_less_for_outliers():
    """Two horizons of unlike size, an outlier of 20 scales, a reading that is missing, a sequence that is lost."""
    error = np.tile(np.array([1.0, -1.0, 1.0, -1.0, 1.0])[None, :, None, None], (3, 1, 2, 1))
    error[:, :, 1] *= 10.0
    error[1, 2, 0], error[1, 3, 1], error[2] = 20.0 * 1.4826, np.nan, 1e6
    weight = weighed(OpenLoop(error, np.ones((*error.shape, 1)), np.array([1.0, 2.0])), np.array([True, True, False]))
    near, far = 1 / 1.4826**2, 1 / 14.826**2 / 2.0
    assert weight[0, 0, :, 0].tolist() == pytest.approx([near, far])
    assert weight[1, 2, 0, 0] == pytest.approx(near * 2.0 / 20.0)
    assert weight[1, 3, 1, 0] == 0.0
    assert not weight[2].any()


def test_a_ratio_of_errors_is_that_of_the_sequences_used():
    before = np.tile(np.array([0.9, 1.0, 1.1])[None, :, None, None], (3, 1, 2, 1))
    after = before * np.array([0.5, 0.5, 20.0])[:, None, None, None]
    used = np.array([True, True, False])
    assert ratio(before, after, used) == pytest.approx(0.25)
    assert ratio(before, after, ~used) > 25
    wide = np.where(np.arange(2)[:, None] == 1, np.array([0.1, 1.0, 4.0])[None, :, None, None], before)
    assert ratio(wide, wide * np.array([0.5, 1.0])[:, None], used) == pytest.approx(0.625)  # each horizon counts once
    ran, gone = after.copy(), before.copy()
    ran[0, 0], gone[0, 0] = np.nan, np.nan
    assert ratio(before, ran, used) > 5  # what runs away is no gain
    assert ratio(gone, ran, used) == pytest.approx(0.25)  # what was not read says nothing


def test_a_few_large_errors_weigh_less_at_the_scale_of_the_others():
    """Nine of ten errors fall to a tenth: at the old scale squares count, at the new one the last is on a line."""
    before = np.ones((1, 10, 1, 1))
    after = np.where(np.arange(10) > 0, 0.1, 1.0)[None, :, None, None]
    small, line = 1 / 1.4826**2, 2.0 * (2 * 10.0 / 1.4826 - 2.0)
    assert ratio(before, after, np.ones(1, bool)) == pytest.approx(0.109)
    assert ratio(before, after, np.ones(1, bool), own=True) == pytest.approx((9 * small + line) / (10 * line))


def test_all_measured_coordinates_must_be_white_or_where_none_is_measured_one_reading():
    """A system of two coordinates has these at places 0 and 1 of what can be read, and its rates at 2 and 3."""
    rng = np.random.default_rng(3)
    motion, noise = np.sin(np.linspace(0, 20, 2000))[None], rng.normal(size=(1, 2000))
    readings = {"one": motion + 0.01 * noise, "paired": motion + 0.005 * (noise + np.roll(noise, 1))}
    assert third_differences(readings["one"]) == pytest.approx(-0.75, abs=0.03)  # -15 of 20 [binomials]
    assert third_differences(readings["paired"]) == pytest.approx(-0.4, abs=0.03)  # (1 - z)^3 (1 + z): -4 of 10
    for measured in ((0, 1), (0, 2), (2, 3)):
        model = replace(paper_model(), measured=measured)
        for names in ("one one", "one paired", "paired one", "paired paired"):
            y = np.stack([readings[name] for name in names.split()], axis=-1)
            data = Dataset(0.0 * motion, motion[..., None], y, np.ones((1, 2000), bool))
            first, second = (name == "one" for name in names.split())
            white = {(0, 1): first and second, (0, 2): first, (2, 3): first or second}[measured]
            assert white_readings(data, model) == white, (measured, names)


def test_a_constant_input_is_no_error(known):
    """A torque column of zeros: every other candidate keeps its number."""
    still = known.data._replace(u=jnp.zeros_like(known.data.u))
    for kind in catalogue.values():
        for candidate in kind.candidates(surroundings(RIG, known.model, still, known.path, ROWS)):
            for leaf in jax.tree.leaves((candidate.start, candidate.probes)):
                assert np.isfinite(np.asarray(leaf)).all(), candidate.start.name


def test_every_law_can_be_predicted_in_32_bits(around, known):
    """No number of 64 bits inside a law makes an error of types, and the states are of 32 bits."""
    laws = [law.candidates(around)[:1] for law in catalogue.values()]
    assert sum(map(len, laws)) > 20
    model = with_effects(known.model, tuple(candidate.start for few in laws for candidate in few))
    seq = prepare(model, jax.tree.map(lambda a: a[0], known.data))
    model, x, u = multistep._single((model, model.start.mean, jax.tree.map(lambda a: a[0], seq.inputs)))
    for part in (model.transition, model.emission):
        assert eqx.filter_eval_shape(part, x, u).dtype == jnp.float32


def test_a_function_of_many_weights_is_a_force_held_over_the_step(known, around, monkeypatch):
    """The short way to its sensitivities against differentiation through the whole step."""
    one = catalogue["unknown_function"].candidates(around)[0]
    full, wide, _ = known.hypothesis.plus(one.probes[3], one)
    seq, at = jax.tree.map(lambda a: a[0, :20], (known.data, known.path))

    def slopes(held: bool):
        monkeypatch.setattr(catalogue["unknown_function"], "held", held)
        return local(full, wide.prior, at, seq, CUBATURE).by_parameter

    short, whole = map(np.asarray, jax.jit(lambda: (slopes(True), slopes(False)))())
    # the force changes within a step of 10 ms, of order dt^2: 0.6 %; one at the beginning of the step would be 8 % off
    assert 0 < np.linalg.norm(short - whole) < 0.01 * np.linalg.norm(whole)
