"""Curves made by formula, and learned from noisy readings in the basis of an unknown function, are told as they are."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nnap_em.explain.diagnosis.shapes import shape
from nnap_em.machines.systems.pendulum import Pendulum
from nnap_em.machines.systems.slide import Slide
from nnap_em.model.effects import catalogue
from nnap_em.model.effects.base import Curve
from nnap_em.model.effects.function import Axis, InputAxis

PENDULUM = Pendulum(**{k: jnp.asarray(v) for k, v in dict(m=0.5, lc=0.3, I=0.02, g=9.81).items()}, joints=(1,))
SLIDE = Slide(m=jnp.asarray(1.0), joints=(1,))
PART = Axis(("theta1",), -1.5, 1.5, False, 20)
NODE = 3.0 / 19
TURN = Axis(("theta1",), -np.pi, np.pi, True, 20)
TIME = Axis(("time",), 0.0, 5.0, False, 20)


def _learned(f, axis, rng, *, noise=0.08, inside=(0.0, 1.0), system=PENDULUM) -> Curve:
    """The curve that 2000 readings of f teach, at random places of the axis; `noise` is its error in rms of f."""
    low, high = float(axis.low), float(axis.high)
    x = low + (high - low) * rng.uniform(*inside, 2000)
    y = f(x)
    std = noise * np.std(y) * np.sqrt(x.size / axis.count)
    basis = np.asarray(jax.vmap(axis.basis)(jnp.asarray(x)))
    cov = np.linalg.inv(basis.T @ basis / std**2 + np.eye(axis.count) / (3 * np.std(y)) ** 2)
    weights = cov @ basis.T @ (y + std * rng.standard_normal(x.size)) / std**2
    curve = catalogue["unknown_function"](jnp.asarray(weights), (axis,), joint=1).curve(cov, system)
    assert curve is not None
    return curve


def _bend(rng, below=-2.0):
    a, above = rng.uniform(-0.5, 0.5), rng.uniform(1, 3)
    truth = {"place": (a, NODE / 2), "slope_below": (below, 0.3), "slope_above": (above, 0.3)}
    return "bend", PART, lambda x: np.where(x < a, below, above) * (x - a), truth


def _hinge(rng):
    return _bend(rng, 0.0)


def _line(rng):
    slope = rng.uniform(-3, 3)
    return "line", PART, lambda x: slope * x, {"slope": (slope, 0.1 * abs(slope))}


def _step(rng):
    a, height = rng.uniform(-0.9, 0.9), rng.uniform(-2, 2)
    truth = {"place": (a, NODE / 4), "height": (height, 0.1 * abs(height)), "transition": (1.5 * NODE, 1e-9)}
    return "step", PART, lambda x: height * (x > a), truth


def _bump(rng):
    a, height, width = rng.uniform(-0.8, 0.8), rng.uniform(0.5, 2), rng.uniform(0.2, 0.3)
    truth = {"place": (a, NODE / 4), "height": (height, 0.1 * height), "width": (2.355 * width, 0.1)}
    return "bump", PART, lambda x: height * np.exp(-0.5 * ((x - a) / width) ** 2), truth


def _round(rng):
    """A dip across the end of the turn."""
    a, width = rng.choice([-1, 1]) * rng.uniform(2.95, 3.05), rng.uniform(0.4, 0.6)
    truth = {"place": (a, 0.08), "height": (-1.0, 0.1), "width": (2.355 * width, 0.2)}
    return "dip", TURN, lambda x: -np.exp(-0.5 * (((x - a + np.pi) % (2 * np.pi) - np.pi) / width) ** 2), truth


def _ripple(rng):
    n, a, phase = rng.integers(2, 7), rng.uniform(0.1, 1), rng.uniform(-3, 3)
    truth = {"periods_per_turn": (n, 1e-9), "amplitude": (a, 0.1 * a), "phase": (phase, 0.15)}
    return "ripple", TURN, lambda x: a * np.sin(n * x + phase), truth


def _square(rng):
    f, a, duty, start = rng.uniform(0.35, 0.45), rng.uniform(0.1, 1), rng.uniform(0.4, 0.6), rng.uniform(0.1, 0.9)
    truth = {"frequency": (f, 0.01), "amplitude": (a, 0.1 * a), "duty": (duty, 0.04), "rises_at": (start, 0.06)}
    return "square wave", TIME, lambda t: a * np.where((f * (t - start)) % 1.0 < duty, 1, -1), truth


@pytest.mark.parametrize("form", (_line, _hinge, _bend, _step, _bump, _round, _ripple, _square))
def test_a_known_shape_is_named_with_its_numbers(form):
    rng = np.random.default_rng(0)
    kind, axis, f, truth = form(rng)
    named = shape(_learned(f, axis, rng))
    assert named.kind == kind, named.words
    for name, (value, tolerance) in truth.items():
        assert named.numbers[name][0] == pytest.approx(value, abs=tolerance, rel=0), (name, named.words)
    assert named.explains > 0.95


def test_what_was_not_visited_has_no_say():
    """Half a turn was seen, across its end: a step there is a step, and not what the curve does elsewhere."""
    rng, (low, high) = np.random.default_rng(0), (-0.25, 0.25)
    centre = np.pi * (low + high) - np.pi
    away = lambda x: (x - centre + np.pi) % (2 * np.pi) - np.pi  # noqa: E731
    curve = _learned(lambda x: 0.4 * (away(x) > 0.2), TURN, rng, inside=(low, high))
    form = shape(curve)
    assert form.kind == "step" and "of the range of theta1" in form.words
    assert form.numbers["place"][0] == pytest.approx((centre + 0.2 + np.pi) % (2 * np.pi) - np.pi, abs=0.1)
    assert form.numbers["height"][0] == pytest.approx(0.4, rel=0.1)
    far = curve.std > 0.8 * curve.std.max()
    wild = curve._replace(mean=curve.mean + far * rng.standard_normal(far.size))
    assert far.any() and shape(wild).words == form.words


def test_noise_is_no_shape():
    """Random weights whose standard deviations say that they are noise, and no curve at all."""
    for seed in range(4):
        rng = np.random.default_rng(seed)
        cov = np.diag(rng.uniform(0.5, 2.0, 20))
        weights = jnp.asarray(np.sqrt(np.diag(cov)) * rng.standard_normal(20))
        curve = catalogue["unknown_function"](weights, (PART,), joint=1).curve(cov, PENDULUM)
        form = shape(curve)
        assert form.kind == "smooth" and form.explains == 0.0, form.words
    form = shape(curve._replace(mean=0 * curve.mean))
    assert form.kind == "smooth" and form.numbers["height"][0] == 0.0


def test_words_have_bounds_where_the_basis_shows_no_more_and_units():
    rng = np.random.default_rng(2)
    step = shape(_learned(lambda x: 1.0 * (x > 0.3), PART, rng))
    assert "a step up at theta1 = " in step.words and "(or a transition no wider than 0.237 rad)" in step.words
    wide = shape(_learned(lambda x: np.tanh((x - 0.3) / 0.3), PART, rng))
    assert wide.kind == "step" and "no wider" not in wide.words
    finest = shape(_learned(lambda x: np.cos(10 * x), TURN, rng))
    assert finest.kind == "ripple" and "10 periods a turn" in finest.words and "at least" in finest.words
    fast = shape(_learned(lambda t: np.sin(2 * np.pi * t), TIME, rng))
    assert fast.words.startswith("a ripple in time of 1.00 Hz")
    position = _learned(lambda x: np.sin(2 * np.pi * x / 0.25), Axis(("x",), 0.0, 1.0, False, 20), rng, system=SLIDE)
    assert "a ripple in x of period 0.25 m, amplitude " in shape(position).words
    axis = InputAxis(("tau2",), -0.3, 0.3, False, 20, index=0)
    loss = shape(_learned(lambda u: 0.2 * np.maximum(0, u - 0.05), axis, rng))
    assert loss.numbers["slope_above"][1] == "" and loss.words.endswith("above")
    once = shape(_learned(lambda x: 1.0 * ((x > -1) & (x < 1.5)), TURN, rng))
    assert once.words.startswith("a step up at theta1 = -1") and "and down again at 1.5" in once.words
