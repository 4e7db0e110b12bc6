"""Multi-step errors and their shares against brute force: roll-outs moved by hand, regressions by least squares."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nnap_em.data.dataset import Dataset
from nnap_em.diagnosis import columns as columns_of
from nnap_em.diagnosis.columns import candidate_columns, tracks
from nnap_em.diagnosis.hypothesis import Hypothesis
from nnap_em.diagnosis.losses import MultiStep
from nnap_em.diagnosis.propose import surroundings
from nnap_em.diagnosis.screen import screen
from nnap_em.diagnosis.smoothed import SmoothedFit
from nnap_em.effects import Candidate, catalogue
from nnap_em.em import multistep
from nnap_em.em.multistep import (
    HORIZONS,
    SHORT_HORIZONS,
    OpenLoop,
    errors,
    finish,
    followed,
    grid_of,
    huber,
    open_loop,
    ratio,
    robust_scale,
    weighed,
)
from nnap_em.em.noise import third_differences, white_readings
from nnap_em.em.prior import ParameterPrior
from nnap_em.em.shape import friction_prior
from nnap_em.model.base import prepare
from nnap_em.model.simulate import paper_model
from nnap_em.model.state_space import with_effects
from nnap_em.numerics.gaussian import Gaussian

ROWS = 60


@pytest.fixture(scope="module")
def question(bench):
    rig, model, rule, data, path = bench
    bare = Hypothesis(model, rule)
    return rig, SmoothedFit(bare, bare, path, data, np.ones(4, bool), ROWS)


@pytest.fixture(scope="module")
def around(question):
    rig, q = question
    return surroundings(rig, q.model, q.data, q.path, ROWS)


@eqx.filter_jit
def _moves(model, start, data):
    """States of `model` run alone from a start in every sequence."""
    step = lambda x, u: (model.transition(x, u), x)  # noqa: E731
    return jax.vmap(lambda start, seq: jax.lax.scan(step, start, model.inputs(seq))[1])(start, data)


@pytest.fixture(scope="module")
def known(question):
    """The same machine with all states read, nearly without noise, along its own motion."""
    _, q = question
    start = jnp.asarray([0.3, 0.2, 0.5, -1.0])
    starts = jnp.tile(start, (len(q.data.t), 1))
    model = replace(
        q.model,
        measured=(0, 1, 2, 3),
        start=Gaussian(start, 1e-6 * jnp.eye(4)),
        log_q=jnp.log(jnp.asarray([1e-9, 1e-9, 1e-4, 1e-4])),
        log_r=jnp.log(jnp.asarray([1e-8, 1e-8, 1e-4, 1e-4])),
    )
    x = _moves(model, starts, q.data)
    path = Gaussian(x, jnp.broadcast_to(1e-8 * jnp.eye(4), (*x.shape, 4)))
    declared = q.hypothesis.refitted(model)
    return q._replace(declared=declared, hypothesis=declared, path=path, data=q.data._replace(y=x))


def test_errors_are_those_of_the_model_run_alone(known):
    """None on its own motion; on that of a heavier machine, the difference of the two from the same start."""
    grid, prior = grid_of(known.model.dt, ROWS), known.m_step.prior
    error = errors(followed(known.model, prior, known.path, known.data))
    assert error.shape == (4, len(grid.starts(ROWS)), 2, 2)
    assert 0 < np.abs(error).max() < 0.1 * 1e-4  # of the noise of an angle: 32 bits are enough
    exact = replace(known.model, log_r=known.model.log_r - 10.0)  # and here they are not
    assert np.abs(errors(followed(exact, prior, known.path, known.data))).max() < 1e-12
    heavy = eqx.tree_at(lambda m: m.system.m2, known.model, 1.1 * known.model.system.m2)
    error = errors(followed(heavy, prior, known.path, known.data))
    first = int(grid.starts(ROWS)[0])
    later = known.data._replace(u=jnp.roll(known.data.u, -first, axis=1))
    x = _moves(heavy, known.path.mean[:, first], later)[:, grid.ages[0]]
    difference = known.path.mean[:, first + grid.ages[0]] - x
    # the filter is at the first start to the noise of its readings
    every = errors(followed(heavy, prior, known.path, known.data), see=(0, 1, 2, 3))
    np.testing.assert_allclose(error[:, 0, 0], difference[:, :2], atol=0.05 * float(jnp.abs(difference[:, :2]).max()))
    np.testing.assert_allclose(every[:, 0, 0], difference, atol=0.05 * float(jnp.abs(difference).max()))
    np.testing.assert_array_equal(every[..., :2], error)


def test_all_horizons_share_one_program_and_its_errors(known, monkeypatch):
    """The same error after 0.1 s whether the longest horizon is that or 0.5 s, from every start that both have."""
    along = followed(known.model, known.m_step.prior, known.path, known.data)
    traced, one = [], multistep._errors
    monkeypatch.setattr(multistep, "_errors", lambda *args: (traced.append(1), one(*args))[1])
    short, before = errors(along, SHORT_HORIZONS), len(traced)
    both = errors(along, (*SHORT_HORIZONS, *HORIZONS))
    assert len(traced) == before > 0 and np.isfinite(short).all()
    assert short.shape[1] > both.shape[1] > 0
    np.testing.assert_array_equal(short[:, : both.shape[1]], both[:, :, :2])


LAWS = ("torsional_spring", "payload", "base_tilt", "motor_gain", "eddy_brake", "sensor_bias", "sensor_scale")


@pytest.fixture(scope="module")
def with_laws(around, known):
    """Candidates of LAWS, and the machine with all, one of which has a strength: one program for every law."""
    candidates = [catalogue[name].candidates(around)[0] for name in LAWS]

    def model(place: int, strength: float):
        laws = [c.start for c in candidates]
        weak = lambda start, probe: start + strength * (probe - start)  # noqa: E731
        laws[place] = jax.tree.map(weak, laws[place], candidates[place].probes[0])
        return with_effects(known.model, tuple(laws))

    return candidates, model


def test_columns_are_difference_quotients(with_laws, known):
    """A column is minus the change of the error where a hundredth of the effect is in the model."""
    candidates, model = with_laws
    extra = candidate_columns(known.model, candidates)(
        tracks(known.model, known.path, jax.jit(jax.vmap(known.model.inputs))(known.data))
    )
    some = lambda index: jax.tree.map(lambda a: a[index], extra)  # noqa: E731
    prior = known.m_step.prior
    along = followed(known.model, prior, known.path, known.data)
    before = open_loop(along, known.m_step.weights(known.model), some)
    errors_of = lambda *strength: errors(followed(model(*strength), prior, known.path, known.data))  # noqa: E731
    counts = [len(c.probes) for c in candidates]
    for place, column in enumerate(np.cumsum([0, *counts[:-1]]) - sum(counts)):
        quotient = -(errors_of(place, 1e-2) - before.error) / 1e-2
        off = before.columns[..., column] - quotient
        # the force is held over a step, the slopes are as wide as predictions err: 2 % at most with this key
        assert np.linalg.norm(off) < 0.05 * np.linalg.norm(quotient), LAWS[place]


def test_a_screen_in_blocks_is_that_of_all_at_once(question, around, monkeypatch):
    """Shares and placebos, also where a free function has many parameters under one name."""
    _, q = question
    free = next(c for c in catalogue["unknown_function"].candidates(around) if len(c.probes) > 5)
    q = q._replace(hypothesis=q.hypothesis.plus(free.start, free))
    names = "torsional_spring", "cogging", "motor_gain"
    candidates = [*(catalogue[name].candidates(around)[0] for name in names), free]
    whole = screen(MultiStep(), q, candidates)
    monkeypatch.setattr(columns_of, "COLUMNS_AT_ONCE", 5)
    parts = screen(MultiStep(), q, candidates)
    for one, other in zip(parts, whole, strict=True):
        assert one.candidate is other.candidate and one.band == other.band
        np.testing.assert_allclose([one.chance, *one.share.folds], [other.chance, *other.share.folds], rtol=1e-9)
        np.testing.assert_allclose(one.share[:2], other.share[:2], rtol=1e-9)


def test_blocks_keep_the_order_and_are_about_as_large_as_said(around, monkeypatch):
    law, sizes = catalogue["motor_gain"].candidates(around)[0].start, (2, 2, 3, 3, 3, 1, 9, 1)
    every = [Candidate(law, (law,) * size, law) for size in sizes]
    monkeypatch.setattr(columns_of, "COLUMNS_AT_ONCE", 7)
    blocks = columns_of.blocks_of(every)
    assert [[len(one.probes) for one in block] for block in blocks] == [[2, 2], [3, 3, 3], [1], [9, 1]]
    assert all(a is b for a, b in zip([one for block in blocks for one in block], every, strict=True))


def test_a_probe_gives_the_same_column_beside_all_others_as_alone(question, around):
    """Probes share a stack, what is equal in it, and a program with their class."""
    _, q = question
    kinds = {"unknown_function": "UnknownFunction", "cogging": "Cogging", "sensor_bias": "SensorBias", "motor_gain": ""}
    candidates = [candidate for kind in kinds for candidate in catalogue[kind].candidates(around)]
    candidates = [*candidates[1::2], *candidates[::2]]
    track = tracks(q.model, q.path, jax.jit(jax.vmap(q.model.inputs))(q.data))
    force, reading = map(np.asarray, candidate_columns(q.model, candidates)(track))
    probes = [probe for candidate in candidates for probe in candidate.probes]
    assert force.shape[1] == reading.shape[1] == len(probes)
    for kind in filter(None, kinds.values()):
        places = [i for i, probe in enumerate(probes) if type(probe).__name__ == kind]
        place = places[len(places) // 2]
        alone = candidate_columns(q.model, [Candidate(probes[place], 2 * (probes[place],), probes[place])])(track)
        for i in range(2):  # forces are up to some 100: rounding
            np.testing.assert_allclose(force[:, place], alone.force[:, i], atol=1e-12)
            np.testing.assert_allclose(reading[:, place], alone.reading[:, i], atol=1e-12)
        assert np.abs(force[:, place]).max() + np.abs(reading[:, place]).max() > 1e-3


def test_a_fit_to_multi_step_errors_finds_the_parameter(known):
    """Of a machine whose second mass is 4 % heavier, read without noise, the fit finds the mass and the errors fall."""
    heavy = eqx.tree_at(lambda m: m.system.m2, known.model, 1.04 * known.model.system.m2)
    x = _moves(heavy, known.path.mean[:, 0], known.data)
    data, path = known.data._replace(y=x), known.path._replace(mean=x)
    mean = jnp.ravel(known.model.system.m2)
    prior = ParameterPrior(("m2",), mean, 0.1 * mean)
    rule = eqx.tree_at(lambda m: m.prior, known.m_step, prior)
    fitted = finish(known.model, rule, path, data, known.used)
    before, after = (errors(f) for f in (followed(known.model, prior, path, data), fitted))
    assert ratio(before, after, known.used) < 0.05
    assert float(fitted.model.system.m2 / heavy.system.m2) == pytest.approx(1.0, abs=0.01)


def test_a_law_that_is_there_removes_the_error(with_laws, known):
    """Of readings that a machine with a spring would give, the model with the spring leaves less than without it."""
    model = with_laws[1]
    x = _moves(model(0, 1.0), known.path.mean[:, 0], known.data)
    path, data = known.path._replace(mean=x), known.data._replace(y=x)
    before, after = (errors(followed(model(0, k), known.m_step.prior, path, data)) for k in (0.0, 1.0))
    assert ratio(before, before, known.used) == 1.0
    assert ratio(before, after, known.used) < 0.01


def test_friction_is_free_in_the_span_of_known_laws(bench):
    _, model, rule, _, _ = bench
    weights = rule.weights(model)
    precision, _ = friction_prior(model, weights)
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
    assert robust_scale(error)[:, 0, 0, 0] == pytest.approx(1.4826 * np.array([1.0, 1.0, 1.0, 2.0, 1.0]))
    after = error.copy()
    after[:3] *= 0.5  # three of four recordings are predicted twice as well
    inside = np.array([1.0, 1.0, 1.0, 4.0]) / 1.4826**2  # squared errors in scales: none is an outlier
    left = ((0.25 * inside[:3]).sum() + inside[3]) / inside.sum()
    assert ratio(error, after, np.ones(5, bool)) == pytest.approx(left)


def test_an_outlier_counts_as_a_line():
    assert huber(np.array(1.0), 1.0) == 1.0
    assert huber(np.array(10.0), 1.0) == pytest.approx(2 * (2 * 10.0 - 2))
    assert np.isfinite(huber(np.array(np.inf), 1.0))


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


@pytest.mark.parametrize(
    ("measured", "enough"),
    [((0, 1), "one one"), ((0, 2), "one paired"), ((0, 2), "one one"), ((2, 3), "paired one"), ((2, 3), "one paired")],
)
def test_all_measured_coordinates_must_be_white_or_where_none_is_measured_one_reading(measured, enough):
    """A system of two coordinates has these at places 0 and 1 of what can be read, and its rates at 2 and 3."""
    rng = np.random.default_rng(3)
    motion, white = np.sin(np.linspace(0, 20, 2000))[None], rng.normal(size=(1, 2000))
    one, paired = motion + 0.01 * white, motion + 0.005 * (white + np.roll(white, 1))
    valid = np.ones((1, 2000), bool)
    readings = {"one": one, "paired": paired}
    model = replace(paper_model(), measured=measured)

    def seen(*names: str) -> bool:
        y = np.stack([readings[name] for name in names], axis=-1)
        return white_readings(Dataset(0.0 * motion, motion[..., None], y, valid), model)

    assert seen(*enough.split())
    assert not seen("paired", "paired")
    assert seen("one", "paired") == (0 not in measured or 1 not in measured)
    assert seen("paired", "one") == (0 not in measured)


def test_white_noise_is_told_from_a_filtered_sensor():
    rng = np.random.default_rng(0)
    motion = np.sin(np.linspace(0, 20, 2000))[None]
    white = rng.normal(size=(1, 2000))
    assert third_differences(motion + 0.01 * white) == pytest.approx(-0.75, abs=0.03)  # -15 of 20 [binomials]
    paired = (white + np.roll(white, 1)) / 2  # (1 - z)^3 (1 + z): -4 of 10
    assert third_differences(motion + 0.01 * paired) == pytest.approx(-0.4, abs=0.03)


def test_a_constant_input_is_no_error(bench):
    """A torque column of zeros: every other candidate keeps its number."""
    rig, model, _, data, path = bench
    still = data._replace(u=jnp.zeros_like(data.u))
    for kind in catalogue.values():
        for candidate in kind.candidates(surroundings(rig, model, still, path, ROWS)):
            for leaf in jax.tree.leaves((candidate.start, candidate.probes)):
                assert np.isfinite(np.asarray(leaf)).all(), candidate.start.name


def test_every_law_can_be_predicted_in_32_bits(around, known):
    """No number of 64 bits inside a law makes an error of types, and the errors are of 32 bits."""
    laws = [law.candidates(around)[:1] for law in catalogue.values()]
    assert sum(map(len, laws)) > 25
    model = with_effects(known.model, tuple(candidate.start for few in laws for candidate in few))
    x, seq = np.zeros((ROWS, model.start.mean.shape[0])), prepare(model, jax.tree.map(lambda a: a[0], known.data))
    model, x, seq = multistep._single((model, x, seq))
    grid = np.arange(5, 50, 5), np.asarray([5, 10])
    assert eqx.filter_eval_shape(multistep._errors, (model, *grid), (x, seq)).dtype == jnp.float32


def test_a_late_clock_and_a_wound_up_joint_need_64_bits(known):
    along = followed(known.model, known.m_step.prior, known.path, known.data)
    assert multistep._single_enough(along)
    late = known.data._replace(t=known.data.t + 1.7e9)  # a session that began in 1970
    assert not multistep._single_enough(along._replace(data=late))
    assert not multistep._single_enough(along._replace(state=along.state + 1e3))
