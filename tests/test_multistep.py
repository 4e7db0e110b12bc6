"""Multi-step errors, their sensitivities and a screen of candidates: roll-outs moved by hand, sums written out."""

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
from nnap_em.diagnosis.propose import proposals, seeded, surroundings
from nnap_em.diagnosis.screen import screen
from nnap_em.diagnosis.smoothed import SmoothedFit, extended
from nnap_em.effects import Candidate, catalogue
from nnap_em.em import multistep
from nnap_em.em.local import local
from nnap_em.em.multistep import (
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
from nnap_em.em.quadratic import friction_columns
from nnap_em.em.shape import friction_prior
from nnap_em.model.base import prepare
from nnap_em.model.simulate import paper_model
from nnap_em.model.state_space import with_effects
from nnap_em.numerics.gaussian import Gaussian
from nnap_em.smoother.kalman import CUBATURE

ROWS = 60


@pytest.fixture(scope="module")
def fit(bench) -> SmoothedFit:
    _, model, rule, data, path = bench
    bare = Hypothesis(model, rule)
    return SmoothedFit(bare, bare, path, data, np.ones(4, bool), ROWS)


@pytest.fixture(scope="module")
def around(bench, fit):
    return surroundings(bench[0], fit.model, fit.data, fit.path, ROWS)


@eqx.filter_jit
def _tracks(fit: SmoothedFit):
    return tracks(fit.model, fit.path, jax.vmap(fit.model.inputs)(fit.data))


@eqx.filter_jit
def _moves(model, start, data):
    """States of `model` run alone from a start in every sequence."""
    step = lambda x, u: (model.transition(x, u), x)  # noqa: E731
    return jax.vmap(lambda start, seq: jax.lax.scan(step, start, model.inputs(seq))[1])(start, data)


@pytest.fixture(scope="module")
def known(fit) -> SmoothedFit:
    """The same machine with all states read, nearly without noise, along its own motion."""
    start = jnp.asarray([0.3, 0.2, 0.5, -1.0])
    starts = jnp.tile(start, (len(fit.data.t), 1))
    model = replace(
        fit.model,
        measured=(0, 1, 2, 3),
        start=Gaussian(start, 1e-6 * jnp.eye(4)),
        log_q=jnp.log(jnp.asarray([1e-9, 1e-9, 1e-4, 1e-4])),
        log_r=jnp.log(jnp.asarray([1e-8, 1e-8, 1e-4, 1e-4])),
    )
    x = _moves(model, starts, fit.data)
    path = Gaussian(x, jnp.broadcast_to(1e-8 * jnp.eye(4), (*x.shape, 4)))
    declared = fit.hypothesis.refitted(model)
    return fit._replace(declared=declared, hypothesis=declared, path=path, data=fit.data._replace(y=x))


def test_errors_are_those_of_the_model_run_alone(known):
    """None on its own motion; on that of a heavier machine, the difference of the two from the same starts."""
    grid, prior = grid_of(known.model.dt, ROWS), known.m_step.prior
    starts, ages = grid.starts(ROWS), list(grid.ages)
    error = errors(followed(known.model, prior, known.path, known.data))
    assert error.shape == (4, len(starts), 2, 2)
    assert 0 < np.abs(error).max() < 0.1 * 1e-4  # of the noise of an angle: 32 bits are enough
    exact = replace(known.model, log_r=known.model.log_r - 10.0)  # and here they are not
    assert np.abs(errors(followed(exact, prior, known.path, known.data))).max() < 1e-12
    heavy = eqx.tree_at(lambda m: m.system.m2, known.model, 1.1 * known.model.system.m2)
    along = followed(heavy, prior, known.path, known.data)
    error, every = errors(along), errors(along, see=(0, 1, 2, 3))
    from_start = lambda a: np.concatenate([np.roll(a, -k, axis=1) for k in starts])  # noqa: E731
    mean, data = from_start(known.path.mean), jax.tree.map(from_start, known.data)
    difference = (mean - _moves(heavy, mean[:, 0], data))[:, ages].reshape(len(starts), 4, 2, 4).swapaxes(0, 1)
    # the filter is at a start to the noise of its readings
    np.testing.assert_allclose(error, difference[..., :2], atol=0.05 * np.abs(difference[..., :2]).max())
    np.testing.assert_allclose(every, difference, atol=0.05 * np.abs(difference).max())
    np.testing.assert_array_equal(every[..., :2], error)


LAWS = ("torsional_spring", "payload", "base_tilt", "motor_gain", "eddy_brake", "sensor_bias", "sensor_scale")


def test_columns_are_difference_quotients(around, known):
    """A column is minus the change of the error where a hundredth of the effect is in the model.

    The machine has all laws, one of which has a strength: one program for every law.
    """
    candidates, prior = [catalogue[name].candidates(around)[0] for name in LAWS], known.m_step.prior
    extra = candidate_columns(known.model, candidates)(_tracks(known))
    along = followed(known.model, prior, known.path, known.data)
    weights = known.m_step.weights(known.model)
    before = open_loop(along, weights, lambda index: jax.tree.map(lambda a: a[index], extra))
    counts = [len(c.probes) for c in candidates]
    for place, column in enumerate(np.cumsum([0, *counts[:-1]]) - sum(counts)):
        laws = [c.start for c in candidates]
        weak = lambda start, probe: start + 1e-2 * (probe - start)  # noqa: E731
        laws[place] = jax.tree.map(weak, laws[place], candidates[place].probes[0])
        model = with_effects(known.model, tuple(laws))
        quotient = -(errors(followed(model, prior, known.path, known.data)) - before.error) / 1e-2
        off = before.columns[..., column] - quotient
        # the force is held over a step, the slopes are as wide as predictions err: 2 % at most with this key
        assert np.linalg.norm(off) < 0.05 * np.linalg.norm(quotient), LAWS[place]


def test_a_screen_in_blocks_is_that_of_all_at_once(fit, around, monkeypatch):
    """Shares and placebos, also where a free function has many parameters under one name."""
    free = next(c for c in catalogue["unknown_function"].candidates(around) if len(c.probes) > 5)
    fit = fit._replace(hypothesis=fit.hypothesis.plus(free.start, free))
    names = "torsional_spring", "cogging", "motor_gain"
    candidates = [*(catalogue[name].candidates(around)[0] for name in names), free]
    whole = screen(MultiStep(), fit, candidates)
    monkeypatch.setattr(columns_of, "COLUMNS_AT_ONCE", 5)
    parts = screen(MultiStep(), fit, candidates)
    for one, other in zip(parts, whole, strict=True):
        assert one.candidate is other.candidate and one.band == other.band
        np.testing.assert_allclose([one.chance, *one.share.folds], [other.chance, *other.share.folds], rtol=1e-9)
        np.testing.assert_allclose(one.share[:2], other.share[:2], rtol=1e-9)


def test_a_probe_gives_the_same_column_beside_all_others_as_alone(fit, around):
    """Probes share a stack, what is equal in it, and a program with their class."""
    kinds = {"unknown_function": "UnknownFunction", "cogging": "Cogging", "sensor_bias": "SensorBias", "motor_gain": ""}
    candidates = [candidate for kind in kinds for candidate in catalogue[kind].candidates(around)]
    candidates = [*candidates[1::2], *candidates[::2]]
    track = _tracks(fit)
    force, reading = map(np.asarray, candidate_columns(fit.model, candidates)(track))
    probes = [probe for candidate in candidates for probe in candidate.probes]
    assert force.shape[1] == reading.shape[1] == len(probes)
    for kind in filter(None, kinds.values()):
        places = [i for i, probe in enumerate(probes) if type(probe).__name__ == kind]
        place = places[len(places) // 2]
        alone = candidate_columns(fit.model, [Candidate(probes[place], 2 * (probes[place],), probes[place])])(track)
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


def test_a_lost_sequence_does_not_count_not_even_as_nan(fit, around):
    spring = catalogue["torsional_spring"].candidates(around)[:1]
    lost = fit._replace(path=fit.path._replace(mean=fit.path.mean.at[1].set(jnp.nan)))
    ((linearised, _),) = MultiStep().linearise(lost, [spring])
    assert not linearised.weight[1].any() and linearised.weight[[0, 2, 3]].all()
    ((unused, _),) = MultiStep().linearise(fit._replace(used=np.array([True, False, True, True])), [spring])
    # slopes are as wide as the speeds of all that have a path: those of three sequences or four
    np.testing.assert_allclose(unused.weight, linearised.weight, rtol=0.02)


def test_what_a_friction_map_holds_gains_nothing(bench, fit, around):
    """A constant torque, back-EMF and a joint's own drag are static maps of one velocity."""
    _, model, rule, *_ = bench
    maps = ("torque_offset", "motor_back_emf", "air_drag")
    held = [c for kind in maps for c in catalogue[kind].candidates(around) if c.start.joint]
    free = catalogue["torsional_spring"].candidates(around)
    track, nodes = _tracks(fit), rule.weights(model).nodes
    columns = jax.jit(jax.vmap(jax.vmap(lambda v: friction_columns(nodes, v[None], jnp.eye(2)))))
    own = columns(track.middle[..., 2:])
    own = np.asarray(own).reshape(-1, nodes.size)
    force = np.moveaxis(candidate_columns(model, [*held, *free])(track).force, 1, -1).reshape(len(own), -1)
    share = np.sum((force - own @ np.linalg.lstsq(own, force, rcond=None)[0]) ** 2, axis=0) / np.sum(force**2, axis=0)
    # what the map has no nodes for, and what a spring keeps: 4e-4 at most and 0.025 at least with this key
    assert np.all(share[: len(held)] < 0.003)
    slope, moment = share[len(held) :: 2], share[len(held) + 1 :: 2]
    assert np.all(slope > 0.01) and np.all(moment < 0.003)  # the moment of a spring at zero is a constant torque


def test_effects_come_and_go(bench, around):
    """Adding two effects and dropping the first leaves the second with its parameters and its prior."""
    _, model, rule, data, path = bench
    candidates = {c.start.name: c for c in proposals(around)}
    spring, bristle = candidates["torsional_spring"], candidates["presliding_friction"]
    bare = Hypothesis(model, rule)
    both = bare.plus(seeded(spring, np.ones(2)), spring).plus(seeded(bristle, np.ones(1)), bristle)
    assert both.model.log_q.shape == (5,)
    assert extended(both.model, path, data).mean.shape == (4, ROWS, 5)
    assert [a.effect.name for a in both.additions] == ["torsional_spring", "presliding_friction"]
    left, alone = both.without(0), bare.plus(seeded(bristle, np.ones(1)), bristle)
    assert eqx.tree_equal(left.model.effects, alone.model.effects)
    assert left.m_step.prior.names == alone.m_step.prior.names
    np.testing.assert_array_equal(left.m_step.prior.std, alone.m_step.prior.std)
    np.testing.assert_array_equal(left.m_step.prior.mean, alone.m_step.prior.mean)
    assert left.without(0).m_step.prior.names == rule.prior.names


def test_a_function_of_many_weights_is_a_force_held_over_the_step(bench, around, monkeypatch):
    """The short way to its sensitivities against differentiation through the whole step."""
    _, model, rule, data, path = bench
    one = next(c for c in catalogue["unknown_function"].candidates(around) if c.start.joint == 2)
    full, wide, _ = Hypothesis(model, rule).plus(one.probes[3], one)
    seq, at = jax.tree.map(lambda a: a[0, :20], (data, path))

    def error(dt: float) -> float:
        """Relative error by the change of the force within the step, of order dt^2."""

        def slopes(held: bool):
            monkeypatch.setattr(catalogue["unknown_function"], "held", held)
            return local(replace(full, dt=dt), wide.prior, at, seq, CUBATURE).by_parameter

        short, whole = map(np.asarray, jax.jit(lambda: (slopes(True), slopes(False)))())
        return np.linalg.norm(short - whole) / np.linalg.norm(whole)

    assert error(0.005) < 0.3 * error(0.01)  # a quarter, and what is of higher order
