"""A force that repeats itself: the period is looked for first, then the waveform at that period."""

import jax
import jax.numpy as jnp
import numpy as np
from helpers import around, slide

from nnap_em.diagnosis.keys import replaced
from nnap_em.diagnosis.propose import seeded
from nnap_em.effects import flat
from nnap_em.effects.function import OVERTONES, PeriodicForce
from nnap_em.model.state_space import with_effects

MODEL, _ = slide()


def _surroundings(span: float = 5.0):
    return around(MODEL)._replace(duration=(0.0, span), ending=span, inputs=("u",))


def test_every_period_that_the_recording_holds_is_near_one_that_is_tried():
    """A wrong period is off by a fifth of a turn at the end of the recording; none is longer than the recording."""
    for span in (5.0, 12.0, 20.0):
        every = [candidate.start for candidate in PeriodicForce.candidates(_surroundings(span))]
        tried = np.array([float(start.frequency) for start in every if start.joint == 1])
        assert tried.min() * span >= 1.0
        wanted = np.linspace(tried.min(), 4.0, 1000)
        assert np.abs(wanted[:, None] - tried).min(axis=1).max() * span < 0.201


def test_the_waveform_is_the_sum_of_its_harmonics_and_repeats():
    rng = np.random.default_rng(0)
    sine, cosine = rng.normal(size=(2, 4))
    force = PeriodicForce(jnp.asarray(sine), jnp.asarray(cosine), jnp.asarray(2.0), harmonics=4, joint=1)
    turns = rng.uniform(size=50)
    angle = 2 * np.pi * np.outer(turns, np.arange(1, 5))
    series = np.sin(angle) @ sine + np.cos(angle) @ cosine
    np.testing.assert_allclose(force.waveform(jnp.asarray(turns)), series, atol=1e-12)
    np.testing.assert_allclose(force.waveform(jnp.asarray(turns + 3.0)), series, atol=1e-10)
    many = np.asarray(force.waveform(jnp.linspace(0.0, 1.0, 1000, endpoint=False)))
    np.testing.assert_allclose(force.values()["size"], np.sqrt(np.mean(many**2)), rtol=1e-9)


def test_once_found_its_overtones_are_tried_in_its_place():
    known = PeriodicForce(jnp.asarray([0.4]), jnp.asarray([0.1]), jnp.asarray(0.96), harmonics=1, joint=1)
    model = with_effects(MODEL, (known,))
    (full,) = known.richer(_surroundings())
    assert replaced(full.start, model) == 0  # in its place, not beside it
    time = jnp.linspace(0.0, 3.0, 40)
    wave = lambda effect: jax.vmap(lambda t: effect.waveform(effect.frequency * t))(time)  # noqa: E731
    np.testing.assert_allclose(wave(full.start), wave(known), atol=1e-12)  # it begins where the sine is
    grown = seeded(full, np.zeros(len(full.probes)))
    np.testing.assert_array_equal(flat(grown), flat(full.start))
    assert full.start.harmonics == OVERTONES and not full.start.richer(_surroundings())
