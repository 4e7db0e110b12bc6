"""The catalogue against an independent simulator: each effect moves the machine as the other code says."""

import json
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import plant
import pytest
from helpers import around, declared_model, rate, slide

from nnap_em.explain.diagnosis.keys import replaced
from nnap_em.explain.diagnosis.propose import seeded
from nnap_em.logs.dataset import Dataset
from nnap_em.model.effects import catalogue, fields, flat
from nnap_em.model.effects.base import a as _a
from nnap_em.model.effects.function import OVERTONES, PeriodicForce
from nnap_em.model.state_space import with_effects

STEPS, MOTOR = 60, plant.MOTOR_INERTIA


def _spring(e):
    at, cube = e["theta0"], e["k"] * e.get("k3", 0.0)  # k (q - at) + cube (q - at)^3 in powers of q
    moment = e["k"] * at + cube * at**3
    return e["k"] + 3 * cube * at**2, moment, -3 * cube * at, cube


def _bristle(e):
    b = plant.drawn_friction(_case())[e["joint"] - 1]["b"]
    return np.log(e["sigma0"]), 0.05 * np.sqrt(e["sigma0"]), b, 0.2, 1.0, 200.0


def _wave(size: float, phase: float) -> tuple[float, float]:
    return size * np.cos(phase), size * np.sin(phase)


def _where(e):
    return {key: e[key] for key in ("joint", "channel") if key in e}


def _pulses(e):
    h = np.arange(1, 8)
    sine = _a(np.where(h % 2, 4 * e["amplitude"] / (np.pi * h), 0.0))
    return catalogue["periodic_force"](sine, jnp.zeros(7), _a(e["frequency"]), harmonics=7, joint=e["joint"])


ONE = """payload mass, link_inertia dI, link_length dl, center_of_mass dlc, air_drag c, dead_zone width,
base_tilt angle, saturation limit, input_delay delay, actuator_lag tau, torque_offset value, motor_back_emf b,
sensor_delay delay"""
NUMBERS: dict[str, Callable] = {
    **{name: lambda e, number=number: (e[number],) for name, number in map(str.split, ONE.split(","))},
    "torsional_spring": _spring,
    "motor_gain": lambda e: (e["gain"] - 1,),
    "cogging": lambda e: (
        *_wave(e["amplitude"], e["phase"]), e["k"], e["k"], *_wave(e.get("amplitude2", 0.0), e.get("phase2", 0.0))),
    "position_dependent_friction": lambda e: (*_wave(e["depth"], -e["phase"]), e["n"]),
    "friction_drift": lambda e: (e["change"], np.log(e["tau"])),
    "base_vibration": lambda e: (*_wave(e["amplitude"], e["phase"]), e["frequency"]),
    "payload_step": lambda e: (e["mass"], e["time"], 0.003),
    "presliding_friction": _bristle,
    "eddy_brake": lambda e: _wave(e["c"], 2 * e["center"]),
    "hard_stop": lambda e: (e["upper"], e["lower"], np.log(40.0), np.log(0.3), 6.0, 0.0),
    "backlash": lambda e: (e["gap"], *np.log([MOTOR, 0.08, 20.0])),
    "joint_flexibility": lambda e: np.log([e["k"], MOTOR, 0.2 * np.sqrt(e["k"] * MOTOR)]),
}  # fmt: skip
"""Numbers of the catalogue's effect by those of a simulator's one."""


MAKE = {name: lambda e, name=name: catalogue[name](*map(_a, NUMBERS[name](e)), **_where(e)) for name in NUMBERS} | {
    "one_sided_loss": lambda e: catalogue["one_sided_loss"](_a(e["loss"]), e["side"], "u", joint=e["joint"]),
    "load_friction": lambda e: catalogue["load_friction"](
        _a(e["mu"]), _a(e["knee"]), names=("u", "dtheta2"), joint=e["joint"]),
    "periodic_force": _pulses,
}  # fmt: skip
"""The catalogue's effect of a simulator's one."""
MOTION = {
    **{"sensor_delay": 0.02, "input_delay": 1e-9, "actuator_lag": 0.005},
    **{"presliding_friction": 0.03, "joint_flexibility": 0.03, "backlash": 0.03},
}
"""Laws of what was before, compared along motions: share of the effect that may be missed in a reading where a step in
time is approximate; the others are the same to rounding."""
CASES = plant.STRONG | plant.UNNAMED
AT_ONCE = {name: ("acrobot", name, CASES[name][0]) for name in MAKE if name not in MOTION} | {
    "a spring that stiffens": ("acrobot", "torsional_spring", {"joint": 2, "k": 0.04, "theta0": 0.3, "k3": 0.1}),
    "detents with an overtone": ("acrobot", "cogging",
        {"joint": 2, "amplitude": 0.03, "k": 4.0, "phase": 0.5, "amplitude2": 0.012, "phase2": 1.0}),
    "a spring of a slide": ("slide", "torsional_spring", {"joint": 1, "k": 2.0, "theta0": 0.1}),
    "a tilt of a pendulum": ("pendulum", "base_tilt", {"angle": 0.2}),
}  # fmt: skip
"""Laws of the moment, compared at states: system, name and numbers."""
CRUDE = {"hard_stop": 1e-3}
"""Relative tolerance of laws whose two forms differ: the damper of our stop sets in over a hundredth of a radian."""
NOT_COMPARED = {
    "sensor_quantization": "as noise it moves no mean",
    "unknown_function": "it has no form; its parts are tested below",
    "dry_friction": "tests/test_inputs.py has its formula",
    **dict.fromkeys(("sensor_bias", "sensor_scale"), "tests/test_planted.py has their readings"),
    **dict.fromkeys(("coulomb_change", "viscous_change", "change"), "tests/test_changed.py changes a machine"),
}
OF_EQUATIONS = {name for name, kind in catalogue.items() if kind.__module__ == "nnap_em.model.effects.equations"}
"""Laws of plants without joints; tests/test_equation_laws.py has theirs."""


def _case(*effects) -> plant.Case:
    return plant.Case(effects=effects, steps=STEPS, hidden=False, seed=3)


@pytest.fixture(scope="module")
def motions():
    """Readings without noise along motions: of the simulator, of the model with the effect and of the one without."""
    base = _case()
    u, t, start = plant.torques(base)[:3], plant.clocks(base)[:3], plant.starts(base)[:3]
    clock = t[:, None] + plant.DT * np.arange(u.shape[1])
    read = np.zeros((*u.shape, len(plant.measured(base))))
    seqs = Dataset(*map(jnp.asarray, (clock, u[..., None], read, np.ones(u.shape, bool))))

    def along(model):
        step = lambda x, u: (model.transition(x, u), model.emission(x, u))  # noqa: E731
        memory = model.start.mean.shape[0] - start.shape[1]
        starts = jnp.pad(jnp.asarray(start), ((0, 0), (0, memory)))
        return jax.vmap(lambda start, seq: jax.lax.scan(step, start, model.inputs(seq))[1])(starts, seqs)

    bare = {name: declared_model(_case(*CASES[name])) for name in MOTION}
    full = {name: with_effects(model, (MAKE[name](CASES[name][0]),)) for name, model in bare.items()}
    none = {"none": declared_model(base), "transmission": bare["backlash"]}  # with the drag of a motor of its own
    mine = jax.jit(lambda: {name: along(model) for name, model in (full | none).items()})()
    simulated = {}
    for name in MOTION:
        rig = plant.build(_case(*CASES[name]))
        simulated[name] = plant.noise_free(rig, plant.simulate(rig, start, u, t))
    without = {name: "transmission" if name in plant.TRANSMISSION else "none" for name in MOTION}
    return {name: (simulated[name], mine[name], mine[without[name]]) for name in MOTION}


@pytest.mark.parametrize("name", MOTION)
def test_moves_as_the_independent_simulator_says(name, motions):
    """From the sixth row on: a late sensor reads the start until the delay is over; one step backward knows none."""
    _compare(*(np.asarray(path)[:, 6:] for path in motions[name]), MOTION[name])


def _compare(simulated, mine, without, share):
    """Errors of each column as a share of the effect in it."""
    axes = tuple(range(simulated.ndim - 1))
    effect, missed = (np.sqrt(np.mean((simulated - other) ** 2, axis=axes)) for other in (without, mine))
    moved = effect > 1e-9
    assert moved.any()
    assert np.all(missed[moved] < share * effect[moved]), (missed, effect)


@pytest.fixture(scope="module")
def rates():
    """Rates of change of random states: of the simulator, of the model with the effect and of the model without."""
    rng = np.random.default_rng(0)
    every = rng.normal(size=(100, 4)) * [2.0, 2.0, 6.0, 6.0]
    u, t = rng.normal(size=(100, 1)), rng.uniform(0.0, 200.0, 100)
    cases = {
        n: plant.Case(system=s, effects=({"name": name} | e,), hidden=False, seed=3)
        for n, (s, name, e) in AT_ONCE.items()
    }
    states = {n: every if case.system == "acrobot" else every[:, ::2] for n, case in cases.items()}
    models = {n: declared_model(case) for n, case in cases.items()}
    models = {n: with_effects(model, (MAKE[AT_ONCE[n][1]](cases[n].effects[0]),)) for n, model in models.items()}
    for n in ("acrobot", "slide", "pendulum"):
        models[n] = declared_model(plant.Case(system=n, hidden=False, seed=3))
        states[n] = every if n == "acrobot" else every[:, ::2]

    of = lambda model, x: jax.vmap(lambda *at: rate(model, *at))(*map(jnp.asarray, (x, u, t)))  # noqa: E731
    mine = jax.jit(lambda: {n: of(model, states[n]) for n, model in models.items()})()
    return {
        n: (plant.rates(plant.build(case), states[n], u[:, 0], t), mine[n], mine[case.system])
        for n, case in cases.items()
    }


@pytest.mark.parametrize("name", AT_ONCE)
def test_accelerates_as_the_independent_simulator_says(name, rates):
    _compare(*rates[name], CRUDE.get(name, 1e-9))


def test_numbers_of_a_law_are_those_that_were_written_and_what_must_be_above_zero_is_refused_below():
    for name in ("a spring that stiffens", "detents with an overtone"):
        _, kind, law = AT_ONCE[name]
        for key, value in MAKE[kind](law).values().items():
            np.testing.assert_allclose(value, law[key], rtol=1e-6)
    for name in ("payload", "input_delay", "saturation"):
        effect = MAKE[name](CASES[name][0])
        if number := effect.above_zero:
            below = eqx.tree_at(lambda e: getattr(e, number), effect, -getattr(effect, number))
            assert effect.is_physical() and not below.is_physical()


MORE = {"payload": {"centre_x", "centre_y", "centre_z"}}
"""Parameters that are reported beside those of the vocabulary."""


def test_the_vocabulary_is_covered(shared):
    words = json.loads((shared / "vocabulary.json").read_text())
    assert set(words) - set(catalogue) == {"asymmetric_friction"}  # a static map: the friction network is its model
    assert set(MAKE) | set(NOT_COMPARED) == set(catalogue) - OF_EQUATIONS
    for name, kind in catalogue.items():
        if name in OF_EQUATIONS or kind.__module__ == "nnap_em.model.effects.change":
            continue
        assert kind.key() in words, f"{name}: {kind.key()} is no word of vocabulary.json; name one by `reported_as`"
        assert kind.confirm and kind.__doc__, f"{name} says no way to confirm it, or has no docstring"
        assert set(kind.units) - MORE.get(name, set()) == set(words[kind.key()]["parameters"]) or name in plant.UNNAMED


UNITS = (
    ("acrobot", "torsional_spring", 4, {"joint": 1}, {"k": "N m/rad", "theta0": "rad"}),
    ("slide", "torsional_spring", 4, {"joint": 1}, {"k": "N/m", "theta0": "m"}),
    ("slide", "air_drag", 1, {"joint": 1}, {"c": "N s^2/m^2"}),
    ("acrobot", "air_drag", 1, {}, {"c": "N s^2/m^2"}),
    ("acrobot", "sensor_bias", 1, {"channel": "dtheta1"}, {"bias": "rad/s"}),
    ("acrobot", "sensor_delay", 1, {"channel": "all"}, {"delay": "s"}),
)


def test_units_are_those_of_the_machine_and_the_channel():
    for system, name, count, where, units in UNITS:
        effect = catalogue[name](*count * [_a(0.1)], **where)
        assert effect.units_on(declared_model(plant.Case(system=system)).system) == units


def test_a_linear_law_is_tried_from_no_strength():
    """The numbers that the probes of a linear law move are zero at its start, where it has no effect."""
    model = declared_model(plant.Case(steps=20, hidden=False))
    numbers = lambda e: np.concatenate([np.ravel(getattr(e, name)) for name in fields(e)])  # noqa: E731
    every = [candidate for kind in catalogue.values() for candidate in kind.candidates(around(model))]
    linear = [candidate for candidate in every if candidate.start.linear]
    assert len({candidate.start.name for candidate in linear}) > 15
    for candidate in linear:
        start, *probes = map(numbers, (candidate.start, *candidate.probes))
        moved = np.any([probe != start for probe in probes], axis=0)
        assert moved.any() and not start[moved].any(), candidate.start.name


def test_every_period_that_the_recording_holds_is_near_one_that_is_tried():
    """A wrong period is off by a fifth of a turn at the end of the recording; none is longer than the recording."""
    model, _ = slide()
    for span in (5.0, 12.0, 20.0):
        every = PeriodicForce.candidates(around(model)._replace(duration=(0.0, span), ending=span))
        tried = np.array([float(candidate.start.frequency) for candidate in every])
        assert tried.min() * span >= 1.0
        wanted = np.linspace(tried.min(), 4.0, 1000)
        assert np.abs(wanted[:, None] - tried).min(axis=1).max() * span < 0.201


def test_once_a_period_is_found_its_overtones_are_tried_in_the_place_of_the_sine():
    model, _ = slide()
    known = PeriodicForce(_a([0.4]), _a([0.1]), _a(0.96), harmonics=1, joint=1)
    (full,) = known.richer(around(model))
    assert replaced(full.start, with_effects(model, (known,))) == 0  # in its place, not beside it
    time = jnp.linspace(0.0, 3.0, 40)
    np.testing.assert_allclose(full.start.waveform(0.96 * time), known.waveform(0.96 * time), atol=1e-12)
    grown = seeded(full, np.zeros(len(full.probes)))
    np.testing.assert_array_equal(flat(grown), flat(full.start))
    assert full.start.harmonics == OVERTONES and not full.start.richer(around(model))
