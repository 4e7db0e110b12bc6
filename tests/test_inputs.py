"""Signals of a law: every input is its own, any number of joints, and the free form of a law is of the same ones."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import plant
import pytest

from nnap_em.base.gaussian import Gaussian
from nnap_em.estimate.em.build import build
from nnap_em.explain.diagnosis.hypothesis import Hypothesis
from nnap_em.explain.diagnosis.keys import completed, complexity, contains, remainder_of
from nnap_em.explain.diagnosis.propose import proposals, surroundings
from nnap_em.explain.diagnosis.screen import screen
from nnap_em.explain.diagnosis.smoothed import SmoothedFit
from nnap_em.logs.dataset import Dataset
from nnap_em.machines.rig import Declared, Rig
from nnap_em.model.effects import catalogue, free_form
from nnap_em.model.effects.base import OperatingPoint
from nnap_em.model.effects.function import Axis, UnknownFunction
from nnap_em.model.state_space import Inputs, with_effects

STATES = ("theta1", "theta2", "dtheta1", "dtheta2")
RIG = Rig(
    "two", "acrobot", {name: Declared(value, 0.0) for name, value in plant.SYSTEMS["acrobot"].parameters.items()},
    False, ("tau1", "tau2"), (1, 2), 0.01, "sequence", STATES, dict.fromkeys(STATES, 0.001), {},
)  # fmt: skip
ROWS, COUNT = 80, 3


def _recorded(model, effects=(), moved=(1.0, 1.0)) -> Dataset:
    """Noise-free readings of a machine with these effects, each input a sine of its own."""
    t = 0.01 * np.arange(ROWS)
    speed = 2 * np.pi * np.array([[1.3, 2.1], [0.8, 1.7], [1.9, 1.1]])
    u = np.asarray(moved) * [0.5, 0.25] * np.sin(speed[:, None] * t[:, None] + np.arange(COUNT)[:, None, None])
    blank = Dataset(np.tile(t, (COUNT, 1)), u, np.zeros((COUNT, ROWS, 4)), np.ones((COUNT, ROWS), bool))
    full = with_effects(model, effects)

    def one(x, seq):
        return jax.lax.scan(lambda x, u: (full.transition(x, u), x), x, full.inputs(seq))[1]

    start = jnp.asarray(np.random.default_rng(0).normal(size=(COUNT, 4)) * 0.3)
    return blank._replace(y=np.asarray(jax.jit(jax.vmap(one))(start, jax.tree.map(jnp.asarray, blank))))


def _asked(effects=(), moved=(1.0, 1.0)):
    """The declared model and its rule, the readings, the paths, and what a search knows of them."""
    bare = build(RIG, _recorded_blank(), key=jax.random.key(0)).model
    data = _recorded(bare, effects, moved)
    problem = build(RIG, data, key=jax.random.key(0))
    model = with_effects(problem.model, ())
    path = Gaussian(jnp.asarray(data.y), jnp.broadcast_to(1e-8 * jnp.eye(4), (COUNT, ROWS, 4, 4)))
    return model, problem.mstep, data, path, surroundings(RIG, model, data, path, ROWS)


def _recorded_blank() -> Dataset:
    t = np.tile(0.01 * np.arange(ROWS), (COUNT, 1))
    return Dataset(t, np.ones((COUNT, ROWS, 2)), np.sin(t)[..., None] * np.ones(4), np.ones(t.shape, bool))


@pytest.fixture(scope="module")
def plain():
    return _asked()


def _screened(asked, candidates):
    model, rule, data, path, _ = asked
    data = jax.tree.map(jnp.asarray, data)
    bare = Hypothesis(model, rule)
    return screen(SmoothedFit(bare.model, bare, path, data, np.ones(COUNT, bool), ROWS), candidates)


def _functions(around):
    """Of one signal each."""
    every = catalogue["unknown_function"].candidates(around)
    return [c for c in every if isinstance(c.start, UnknownFunction) and len(c.start.axes) == 1]


def test_a_function_of_every_input_is_tried_and_one_of_the_second_is_found_at_its_joint(plain):
    tried = {(c.start.joint, c.start.inputs_named()): c.start for c in _functions(plain[-1])}
    assert {place for place in tried if "tau" in place[1][0]} == {(1, ("tau1",)), (2, ("tau2",))}
    bump = jnp.zeros(20).at[13:17].set(0.1)
    asked = _asked((UnknownFunction(bump, tried[2, ("tau2",)].axes, joint=2),))
    candidates = _functions(asked[-1])
    best = candidates[int(np.argmax([v.share.inside for v in _screened(asked, candidates)]))].start
    assert (best.joint, best.inputs_named()) == (2, ("tau2",))


def test_a_drive_that_gives_less_for_more_is_none(plain):
    """A dead zone as a free function is possible, a ripple of the torque is not; of a place both are."""
    (axis,) = next(c for c in _functions(plain[-1]) if c.start.inputs_named() == ("tau2",)).start.axes
    u = np.linspace(float(axis.low), float(axis.high), 200)
    basis = np.asarray(jax.vmap(axis.basis)(jnp.asarray(u)))
    learned = lambda force: jnp.asarray(np.linalg.lstsq(basis, force, rcond=1e-4)[0])  # noqa: E731
    size = float(axis.high)
    zone, ripple = -np.clip(u, -0.2 * size, 0.2 * size), 0.3 * size * np.sin(25 * u / size)
    place = Axis(("theta2",), -1.0, 1.0, False, 20)
    ends, beyond = (jax.vmap(place.basis)(jnp.asarray(at)) for at in ([-1.0, 1.0], [-3.0, 1.5]))
    np.testing.assert_array_equal(ends, beyond)  # nothing is learned beyond the ends
    for force, signal, possible in ((zone, axis, True), (ripple, axis, False), (ripple, place, True)):
        assert UnknownFunction(learned(force), (signal,), joint=2).is_physical() == possible


def test_every_law_of_a_place_a_rate_or_an_input_has_a_free_form(plain):
    around = plain[-1]._replace(learned=True, session=True)
    named = [c.start for c in proposals(around) if c.start.joint == 2 and c.start.named]
    forms = {law.name: free_form(law, around) for law in named}
    signals = {name: candidates[0].start.inputs_named() for name, candidates in forms.items() if candidates}
    place, rate = ("theta2",), ("theta2", "dtheta2")
    assert signals == {
        **dict.fromkeys(("torsional_spring", "cogging", "hard_stop"), place),
        **dict.fromkeys(("position_dependent_friction", "eddy_brake"), rate),
        **dict.fromkeys(("motor_gain", "dead_zone", "saturation", "one_sided_loss"), ("tau2",)),
        "load_friction": ("tau2", "dtheta2"),
        "friction_drift": ("dtheta2", "time"),
        "periodic_force": ("time",),
    }


def test_what_is_not_seen_to_repeat_has_no_periods(plain):
    """The 2 rad where it mostly is hold more than one and a half of five periods a turn, and less of 4.5."""
    around = plain[-1]._replace(width=2 * np.ones(2), learned=True)
    for law, periods in (("cogging", "near"), ("position_dependent_friction", "n")):
        of = [c.start for c in catalogue[law].candidates(around) if c.start.joint == 2]
        seen = {float(getattr(one, periods)): one.visible(around) for one in of}
        assert seen[5.0] and seen[max(seen)] and not any(seen[k] for k in seen if k < 4.6)


def _spots(around):
    """Dry friction at some angles, by its joint."""
    return {c.start.joint: c for c in catalogue["dry_friction"].candidates(around._replace(learned=True))}


def test_dry_friction_at_an_angle_is_one_free_function_against_the_motion(plain):
    """Its formula; its price is that of one signal; and what a law without a form may stand for."""
    spots, system = _spots(plain[-1]), plain[0].system
    assert {joint: c.start.inputs_named() for joint, c in spots.items()} == {
        j: (f"theta{j}", f"dtheta{j}") for j in (1, 2)
    }
    both = next(
        c.start
        for c in catalogue["unknown_function"].candidates(plain[-1])
        if (c.start.joint, c.start.inputs_named()) == (2, ("theta2", "dtheta2"))
    )
    weights, axis = 0.1 * np.sin(np.arange(20.0)), spots[2].start.axis
    law = dataclasses.replace(spots[2].start, weights=jnp.asarray(weights))
    assert (complexity(law), complexity(both), complexity(law, with_effects(plain[0], (both,)))) == (1, 2, 1)
    none = jnp.zeros(2)
    for at, rate in ((0.3, 2.0), (0.3, -2.0), (-0.1, 0.01)):
        q, v = jnp.array([1.0, at]), jnp.array([0.5, rate])
        scene = OperatingPoint(system, q, v, none, jnp.zeros(()), none, lambda _: none)
        taken = weights @ np.asarray(axis.basis(jnp.asarray(at)))
        np.testing.assert_allclose(law.force(scene, none), [0.0, -taken * np.tanh(rate / float(law.knee))], rtol=1e-12)
    wave, brake = (catalogue[name].of(*numbers, joint=2) for name, numbers in FORMS_OF_FRICTION.items())
    for free, named, ok in ((law, wave, True), (law, brake, False), (both, wave, True), (both, brake, True)):
        assert contains(free, named, system) == ok == (remainder_of(free, with_effects(plain[0], (named,))) == 0)
        assert completed(named, with_effects(plain[0], (free,))) == ok


FORMS_OF_FRICTION = {"position_dependent_friction": (0.1, 0.2, 3.0), "eddy_brake": (0.1, 0.2)}


def test_a_spot_of_dry_friction_is_found_as_one(plain):
    """Beside functions of two signals and friction that repeats with the angle, which explain a part of it."""
    spot = _spots(plain[-1])[2].start
    centre = np.asarray(spot.axis.centres())
    weights = 0.3 * np.exp(-0.5 * ((centre - np.median(centre)) / 0.1) ** 2)
    law = dataclasses.replace(spot, weights=jnp.asarray(weights))
    drawn = law.curve(np.eye(20), plain[0].system)
    assert drawn.of == "dry friction" and drawn.x[np.argmax(drawn.mean)] == pytest.approx(
        np.median(centre), abs=np.ptp(drawn.x) / 60
    )
    asked = _asked((law,))
    every = proposals(asked[-1]._replace(learned=True))
    rivals = [c for c in every if c.start.joint == 2 and len(c.start.signals(plain[0].system)) == 2]
    best = max(zip(_screened(asked, rivals), rivals, strict=True), key=lambda pair: pair[0].share.least)[1].start
    assert best.name == "dry_friction"


def test_a_joint_is_seen_where_it_moves(plain):
    """At rest for three quarters of the time, it repeats what it does in the rest of it."""
    model, _, data, path, _ = plain
    rest = 3 * ROWS // 4
    mean = np.asarray(path.mean).copy()
    mean[..., 1] = np.append(np.zeros(rest), np.linspace(-1.0, 1.0, ROWS - rest))
    mean[..., 3] = np.append(np.zeros(rest), np.full(ROWS - rest, 3.0))
    mean[..., 0] = mean[..., 2] = 0.0  # the other never moves
    still, seen = surroundings(RIG, model, data, path._replace(mean=jnp.asarray(mean)), ROWS).width
    assert still == 0.0 and seen == pytest.approx(0.9 * 2.0, abs=2.0 / 19)  # it moves through 20 places


def test_a_spring_is_straight_beyond_what_was_seen():
    """A cubic that bends down would push outward there without end."""
    model = build(RIG, _recorded_blank(), key=jax.random.key(0)).model
    spring = catalogue["torsional_spring"].of(1.0, 0.1, 0.2, -0.8, 1.0, joint=2)
    free = catalogue["torsional_spring"].of(1.0, 0.1, 0.2, -0.8, joint=2)

    def pull(effect, angle):
        full = with_effects(model, (effect,))
        return float(effect.force(full.scene(jnp.asarray([0.0, angle, 0.0, 0.0]), Inputs.held(jnp.zeros(2))), None)[1])

    assert pull(spring, 0.9) == pytest.approx(pull(free, 0.9)) and pull(spring, -0.9) == pytest.approx(pull(free, -0.9))
    assert pull(spring, 1.0) == pull(spring, 5.0) and pull(free, 5.0) > 50.0
