"""Columns of candidates on a screen: friction can hold some of them, and lost sequences do not count."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nnap_em.diagnosis.columns import candidate_columns, tracks
from nnap_em.diagnosis.hypothesis import Hypothesis
from nnap_em.diagnosis.losses import MultiStep
from nnap_em.diagnosis.propose import proposals, seeded, surroundings
from nnap_em.diagnosis.smoothed import SmoothedFit, extended
from nnap_em.effects import catalogue
from nnap_em.effects.base import SearchScales
from nnap_em.em.local import local
from nnap_em.em.quadratic import friction_columns
from nnap_em.smoother.kalman import CUBATURE

ROWS = 60


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
    ((linearised, _),) = MultiStep().linearise(lost, [spring])
    assert not linearised.weight[1].any() and linearised.weight[[0, 2, 3]].all()
    ((unused, _),) = MultiStep().linearise(fit._replace(used=np.array([True, False, True, True])), [spring])
    # slopes are as wide as the speeds of all that have a path: those of three sequences or four
    np.testing.assert_allclose(unused.weight, linearised.weight, rtol=0.02)


def test_what_a_friction_map_holds_gains_nothing(bench, fit, around):
    """A constant torque, back-EMF and a joint's own drag are static maps of one velocity."""
    _, model, rule, data, path = bench
    maps = ("torque_offset", "motor_back_emf", "air_drag")
    held = [c for kind in maps for c in catalogue[kind].candidates(around) if c.start.joint]
    free = catalogue["torsional_spring"].candidates(around)
    track, nodes = tracks(model, path, jax.vmap(model.inputs)(data)), rule.weights(model).nodes
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
        """What the force's change within the step leaves, relative: of order dt^2."""

        def slopes(held: bool):
            monkeypatch.setattr(catalogue["unknown_function"], "held", held)
            return local(replace(full, dt=dt), wide.prior, at, seq, CUBATURE).by_parameter

        short, whole = map(np.asarray, jax.jit(lambda: (slopes(True), slopes(False)))())
        return np.linalg.norm(short - whole) / np.linalg.norm(whole)

    assert error(0.005) < 0.3 * error(0.01)  # a quarter, and what is of higher order
