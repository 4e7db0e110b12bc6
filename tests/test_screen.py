"""One-step errors and their columns against difference quotients; what friction can hold is projected out."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nnap_em.data.dataset import Dataset
from nnap_em.diagnosis.hypothesis import Hypothesis
from nnap_em.diagnosis.losses import OneStep
from nnap_em.diagnosis.propose import proposals, seeded, surroundings
from nnap_em.diagnosis.screen import overlaps, project, screen
from nnap_em.diagnosis.smoothed import SmoothedFit, extended
from nnap_em.effects import catalogue
from nnap_em.effects.base import SearchScales
from nnap_em.em.local import local
from nnap_em.model.state_space import with_effects
from nnap_em.numerics.gaussian import Gaussian
from nnap_em.smoother.kalman import CUBATURE, kalman_filter

ROWS = 60


def _innovations(model, full, rule, path: Gaussian, seq: Dataset):
    """Whitened innovations of `model` linearised about a path, moved by what `full` does otherwise on that path."""
    linear = local(model, rule.prior, path, seq, CUBATURE)
    both = [jax.vmap(m.transition)(path.mean, m.inputs(seq)) for m in (full, model)]
    read = [jax.vmap(m.emission)(path.mean, m.inputs(seq)) for m in (full, model)]
    affine = linear.affine._replace(offset=linear.affine.offset + both[0] - both[1])
    reading = linear.reading._replace(offset=linear.reading.offset + read[0] - read[1])
    return kalman_filter(model.log_q, model.log_r, model.start, affine, reading, linear.seq).innovation


@pytest.fixture
def fit(bench) -> SmoothedFit:
    _, model, rule, data, path = bench
    bare = Hypothesis(model, rule)
    return SmoothedFit(bare, bare, path, data, np.ones(4, bool), ROWS)


@pytest.fixture
def around(bench) -> SearchScales:
    rig, model, _, data, path = bench
    return surroundings(rig, model, data, path, ROWS)


def test_a_lost_sequence_does_not_count_not_even_as_nan(fit, around):
    spring = catalogue["torsional_spring"].candidates(around)[:1]
    lost = fit._replace(path=fit.path._replace(mean=fit.path.mean.at[1].set(jnp.nan)))
    ((linearised,),) = OneStep().linearise(lost, [spring])
    assert not linearised.weight[1].any() and linearised.weight[[0, 2, 3]].all()
    ((unused,),) = OneStep().linearise(fit._replace(used=np.array([True, False, True, True])), [spring])
    np.testing.assert_array_equal(unused.weight, linearised.weight)


@pytest.mark.parametrize(
    "name", ["torsional_spring", "payload", "base_tilt", "eddy_brake", "input_delay", "sensor_bias", "sensor_scale"]
)
def test_columns_are_difference_quotients(bench, fit, around, name):
    """A column is minus the change of the whitened innovations; its force is held over a step, so to some per cent."""
    _, model, rule, data, path = bench
    candidate = catalogue[name].candidates(around)[-1]
    small = 1.0 if name == "input_delay" else 1e-2  # its probe is of finite size
    weak = jax.tree.map(lambda start, p: start + small * (p - start), candidate.start, candidate.probes[-1])
    full = with_effects(model, (weak,))
    run = eqx.filter_jit(lambda other, p, s: _innovations(model, other, rule, p, s))
    for i in range(2):
        seq, at = jax.tree.map(lambda a, i=i: a[i], data), jax.tree.map(lambda a, i=i: a[i], path)
        before = run(model, at, seq)
        column = -(run(full, at, seq) - before) / small
        size = float(jnp.linalg.norm(column) * jnp.linalg.norm(before))
        ((linearised,),) = OneStep().linearise(fit, [[candidate]])
        np.testing.assert_allclose(linearised.error[i], before, atol=1e-5)
        own = linearised.columns[i, ..., -1].astype(float)
        assert float(jnp.sum(own * before)) == pytest.approx(float(jnp.sum(column * before)), abs=0.02 * size)
        assert float(jnp.sum(own**2)) == pytest.approx(float(jnp.sum(column**2)), rel=0.05)


def test_what_a_friction_map_holds_gains_nothing(bench, fit, around):
    """A constant torque, back-EMF and a joint's own drag are static maps of one velocity."""
    _, model, rule, _, _ = bench
    maps = ("torque_offset", "motor_back_emf", "air_drag")
    held = [c for kind in maps for c in catalogue[kind].candidates(around) if c.start.joint]
    free = catalogue["torsional_spring"].candidates(around)
    ((linearised,),) = OneStep().linearise(fit, [[*held, *free]])
    count = rule.weights(model).nodes.size + rule.weights(model).prior.size
    none, weak = np.zeros(linearised.error.shape[:2], int), 1e-4 * np.eye(count)  # a prior that counts for nothing
    rows = project(linearised, none, none, weak, np.zeros(count))
    whole = np.sum(linearised.columns[..., count:].astype(float) ** 2 * linearised.weight[..., None], axis=(0, 1, 2))
    share = np.sum(rows.columns**2, axis=0) / whole
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


def test_a_tilt_is_a_biased_angle_and_a_spring_is_not(fit, around):
    """The interface calls the first two the same model; here it is measured."""
    names = ("base_tilt", "sensor_bias", "torsional_spring")
    candidates = [catalogue[name].candidates(around)[0] for name in names]
    seen = screen(OneStep(), fit, candidates)
    tilt, bias, spring = overlaps(seen, seen.screened[0])
    # itself; the same but for the prior of the first row (3e-4 with this key); another force (0.7)
    assert tilt < 1e-6
    assert bias < 0.02
    assert spring > 0.2


def test_a_function_of_many_weights_is_a_force_held_over_the_step(bench, around, monkeypatch):
    """The short way to its sensitivities against differentiation through the whole step."""
    _, model, rule, data, path = bench
    one = next(c for c in catalogue["unknown_function"].candidates(around) if c.start.joint == 2)
    full, wide, _ = Hypothesis(model, rule).plus(one.probes[3], one)
    seq, at = jax.tree.map(lambda a: a[0], data), jax.tree.map(lambda a: a[0], path)

    def error(dt: float) -> float:
        """What the force's change within the step leaves, relative: of order dt^2."""
        ways = []
        for held in (True, False):
            monkeypatch.setattr(catalogue["unknown_function"], "held", held)
            ways.append(local(replace(full, dt=dt), wide.prior, at, seq, CUBATURE).by_parameter)
        return float(jnp.linalg.norm(ways[0] - ways[1]) / jnp.linalg.norm(ways[1]))

    assert error(0.005) < 0.3 * error(0.01)  # a quarter, and what is of higher order
