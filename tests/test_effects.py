"""The catalogue against an independent simulator: each effect moves the machine as the other code says."""

import json
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import plant
import pytest
from helpers import around, declared_model, rate

from nnap_em.data.dataset import Dataset
from nnap_em.effects import catalogue, fields
from nnap_em.effects.function import Axis, UnknownFunction
from nnap_em.model.state_space import Inputs, with_effects

STEPS = 60


def _a(value):
    return jnp.asarray(value, float)


def _spring(e):
    at, cube = e["theta0"], e["k"] * e.get("k3", 0.0)  # k (q - at) + cube (q - at)^3 in powers of q
    moment = e["k"] * at + cube * at**3
    slope = e["k"] + 3 * cube * at**2
    return catalogue["torsional_spring"](_a(slope), _a(moment), _a(-3 * cube * at), _a(cube), joint=e["joint"])


def _bristle(e):
    b = plant.drawn_friction(_case())[e["joint"] - 1]["b"]
    numbers = (np.log(e["sigma0"]), 0.05 * np.sqrt(e["sigma0"]), b, 0.2, 1.0, 200.0)
    return catalogue["presliding_friction"](*map(_a, numbers), joint=e["joint"])


def _cogging(e):
    sine, cosine = (_a(e["amplitude"] * f(e["phase"])) for f in (np.cos, np.sin))
    over = (e.get("amplitude2", 0.0) * f(e.get("phase2", 0.0)) for f in (np.cos, np.sin))
    return catalogue["cogging"](sine, cosine, _a(e["k"]), _a(e["k"]), *over, joint=e["joint"])


def _eddy(e):
    even, odd = (_a(e["c"] * f(2 * e["center"])) for f in (np.cos, np.sin))
    return catalogue["eddy_brake"](even, odd, joint=e["joint"])


def _depth(e):
    cosine, sine = _a(e["depth"] * np.cos(e["phase"])), _a(-e["depth"] * np.sin(e["phase"]))
    return catalogue["position_dependent_friction"](cosine, sine, _a(e["n"]), joint=e["joint"])


def _shake(e):
    sine, cosine = (_a(e["amplitude"] * f(e["phase"])) for f in (np.cos, np.sin))
    return catalogue["base_vibration"](sine, cosine, _a(e["frequency"]))


def _flexible(e):
    damping = 0.2 * np.sqrt(e["k"] * plant.MOTOR_INERTIA)
    numbers = np.log([e["k"], plant.MOTOR_INERTIA, damping])
    return catalogue["joint_flexibility"](*map(_a, numbers), joint=2)


def _stop(e):
    numbers = (e["upper"], e["lower"], np.log(40.0), np.log(0.3))
    return catalogue["hard_stop"](*map(_a, numbers), _a(6.0), _a(0.0), joint=e["joint"])


def _play(e):
    numbers = (e["gap"], *np.log([plant.MOTOR_INERTIA, 0.08, 20.0]))
    return catalogue["backlash"](*map(_a, numbers), joint=e["joint"])


def _pulses(e):
    h = np.arange(1, 8)
    sine = _a(np.where(h % 2, 4 * e["amplitude"] / (np.pi * h), 0.0))
    return catalogue["periodic_force"](sine, jnp.zeros(7), _a(e["frequency"]), harmonics=7, joint=e["joint"])


def _of_one_number(name: str, number: str) -> Callable:
    """Maker of the effect of that name, which is this number at a joint."""
    return lambda e: catalogue[name](_a(e[number]), joint=e["joint"])


ONE = """payload mass, link_inertia dI, link_length dl, center_of_mass dlc, air_drag c, dead_zone width,
saturation limit, input_delay delay, actuator_lag tau, torque_offset value, motor_back_emf b"""
MAKE = {name: _of_one_number(name, number) for name, number in map(str.split, ONE.split(","))} | {
    "torsional_spring": _spring,
    "base_tilt": lambda e: catalogue["base_tilt"](_a(e["angle"])),
    "motor_gain": lambda e: catalogue["motor_gain"](_a(e["gain"] - 1), joint=e["joint"]),
    "cogging": _cogging,
    "position_dependent_friction": _depth,
    "friction_drift": lambda e: catalogue["friction_drift"](_a(e["change"]), _a(np.log(e["tau"])), joint=e["joint"]),
    "sensor_bias": lambda e: catalogue["sensor_bias"](_a(e["bias"]), channel=e["channel"]),
    "sensor_scale": lambda e: catalogue["sensor_scale"](_a(e["scale"] - 1), channel=e["channel"]),
    "sensor_delay": lambda e: catalogue["sensor_delay"](_a(e["delay"]), channel=e["channel"]),
    "base_vibration": _shake,
    "payload_step": lambda e: catalogue["payload_step"](_a(e["mass"]), _a(e["time"]), _a(0.003), joint=e["joint"]),
    "presliding_friction": _bristle,
    "eddy_brake": _eddy,
    "hard_stop": _stop,
    "backlash": _play,
    "joint_flexibility": _flexible,
    "one_sided_loss": lambda e: catalogue["one_sided_loss"](_a(e["loss"]), e["side"], "u", joint=e["joint"]),
    "load_friction": lambda e: catalogue["load_friction"](
        _a(e["mu"]), _a(e["knee"]), names=("u", "dtheta2"), joint=e["joint"]
    ),
    "periodic_force": _pulses,
}
"""The catalogue's effect of a simulator's one."""
MOTION = {
    **{"sensor_bias": 1e-9, "sensor_scale": 1e-9, "sensor_delay": 0.02, "input_delay": 1e-9, "actuator_lag": 0.005},
    **{"presliding_friction": 0.03, "joint_flexibility": 0.03, "backlash": 0.03},
}
"""Laws of readings and of what was before, compared along motions: share of the effect that may be missed in a reading
where a step in time is approximate; the others are the same to rounding."""
CASES = plant.STRONG | plant.UNNAMED
AT_ONCE = {name: ("acrobot", name, CASES[name][0]) for name in MAKE if name not in MOTION} | {
    "a spring that stiffens": ("acrobot", "torsional_spring", {"joint": 2, "k": 0.04, "theta0": 0.3, "k3": 0.1}),
    "detents with an overtone": (
        "acrobot", "cogging",
        {"joint": 2, "amplitude": 0.03, "k": 4.0, "phase": 0.5, "amplitude2": 0.012, "phase2": 1.0},
    ),
    "a spring of a slide": ("slide", "torsional_spring", {"joint": 1, "k": 2.0, "theta0": 0.1}),
    "a tilt of a pendulum": ("pendulum", "base_tilt", {"angle": 0.2}),
}  # fmt: skip
"""Laws of the moment, compared at states: system, name and numbers."""
CRUDE = {"hard_stop": 1e-3}
"""Relative tolerance of laws whose two forms differ: the damper of our stop sets in over a hundredth of a radian."""
NOT_COMPARED = {
    "sensor_quantization": "as noise it moves no mean",
    "unknown_function": "it has no form; its parts are tested below",
    **dict.fromkeys(("coulomb_change", "viscous_change", "change"), "tests/test_changed.py changes a machine"),
}


OF_EQUATIONS = {name for name, kind in catalogue.items() if kind.__module__ == "nnap_em.effects.equations"}
"""Laws of plants without joints; tests/test_equations.py has theirs."""


def test_every_effect_is_compared_with_the_simulator():
    assert set(MAKE) | set(NOT_COMPARED) == set(catalogue) - OF_EQUATIONS
    assert not set(MAKE) & set(NOT_COMPARED)


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
    bare = {n: declared_model(case) for n, case in cases.items()}
    full = {n: with_effects(model, (MAKE[AT_ONCE[n][1]](cases[n].effects[0]),)) for n, model in bare.items()}

    of = lambda model, x: jax.vmap(lambda *at: rate(model, *at))(*map(jnp.asarray, (x, u, t)))  # noqa: E731
    mine, without = jax.jit(lambda: [{n: of(each[n], states[n]) for n in each} for each in (full, bare)])()
    return {n: (plant.rates(plant.build(cases[n]), states[n], u[:, 0], t), mine[n], without[n]) for n in cases}


@pytest.mark.parametrize("name", AT_ONCE)
def test_accelerates_as_the_independent_simulator_says(name, rates):
    _compare(*rates[name], CRUDE.get(name, 1e-9))


def test_numbers_of_a_stiffening_spring_and_of_detents_are_those_that_were_written():
    for name in ("a spring that stiffens", "detents with an overtone"):
        _, kind, law = AT_ONCE[name]
        for key, value in MAKE[kind](law).values().items():
            np.testing.assert_allclose(value, law[key], rtol=1e-6)


@pytest.mark.parametrize("name", [name for name in MAKE if catalogue[name].above_zero])
def test_what_must_be_above_zero_is_refused_below(name):
    effect = MAKE[name]({**plant.STRONG, **plant.UNNAMED}[name][0])
    number = lambda e: getattr(e, e.above_zero)  # noqa: E731
    below, none = (eqx.tree_at(number, effect, share * number(effect)) for share in (-1.0, 0.0))
    assert effect.is_physical() and not below.is_physical() and not none.is_physical()


MORE = {"payload": {"centre_x", "centre_y", "centre_z"}}
"""Parameters that are reported beside those of the vocabulary."""


def test_the_vocabulary_is_covered(shared):
    words = json.loads((shared / "vocabulary.json").read_text())
    assert set(words) - set(catalogue) == {"asymmetric_friction"}  # a static map: the friction network is its model
    for name, kind in catalogue.items():
        if name in OF_EQUATIONS or kind.__module__ == "nnap_em.effects.change":
            continue
        assert kind.key() in words, f"{name}: {kind.key()} is no word of vocabulary.json; name one by `reported_as`"
        assert kind.confirm and kind.__doc__, f"{name} says no way to confirm it, or has no docstring"
        assert set(kind.units) - MORE.get(name, set()) == set(words[kind.key()]["parameters"]) or name in plant.UNNAMED


UNITS = {
    "spring on an arm": ("acrobot", "torsional_spring", 4, {"joint": 1}, {"k": "N m/rad", "theta0": "rad"}),
    "spring on a slide": ("slide", "torsional_spring", 4, {"joint": 1}, {"k": "N/m", "theta0": "m"}),
    "drag of a joint": ("acrobot", "air_drag", 1, {"joint": 2}, {"c": "N m s^2/rad^2"}),
    "drag on a slide": ("slide", "air_drag", 1, {"joint": 1}, {"c": "N s^2/m^2"}),
    "drag of the tip": ("acrobot", "air_drag", 1, {}, {"c": "N s^2/m^2"}),
    "bias of a rate": ("acrobot", "sensor_bias", 1, {"channel": "dtheta1"}, {"bias": "rad/s"}),
    "bias of a position": ("slide", "sensor_bias", 1, {"channel": "x"}, {"bias": "m"}),
    "delay of all": ("acrobot", "sensor_delay", 1, {"channel": "all"}, {"delay": "s"}),
    "tilt": ("acrobot", "base_tilt", 1, {}, {"angle": "rad"}),
}


@pytest.mark.parametrize(("system", "name", "count", "where", "units"), UNITS.values(), ids=UNITS)
def test_units_are_those_of_the_machine_and_the_channel(system, name, count, where, units):
    effect = catalogue[name](*count * [_a(0.1)], **where)
    assert effect.units_on(declared_model(plant.Case(system=system)).system) == units


def test_basis_functions_of_an_angle_go_round():
    axis = Axis(("theta2",), -np.pi, np.pi, True, 14)
    np.testing.assert_allclose(axis.basis(_a(0.3)), axis.basis(_a(0.3 + 2 * np.pi)), atol=1e-12)
    ones = UnknownFunction(jnp.ones(14), (axis,), joint=2)
    values = [float(ones.torque([_a(v)])) for v in np.linspace(-3, 3, 41)]
    assert np.ptp(values) < 1e-3 * np.mean(values)  # enough overlap for a constant


def test_absent_strength_is_no_effect():
    """A linear effect with strength zero leaves the rate and the reading to the last bit or nearly so."""
    model = declared_model(plant.Case(steps=20, hidden=False))
    x, row = jnp.asarray([0.3, -0.5, 2.0, -3.0]), Inputs(_a([0.2]), _a([0.1]), _a(1.0), _a(1.0))
    starts = [candidate.start for kind in catalogue.values() for candidate in kind.candidates(around(model))]
    laws = {start.name: start for start in starts if start.linear and not start.memory}
    assert len(laws) > 15 and all(map(fields, laws.values()))
    both = lambda model: (model.rate(x, row, jnp.zeros(2)), model.emission(x, row))  # noqa: E731
    found, (rate, _) = jax.jit(
        lambda: ({n: both(with_effects(model, (law,))) for n, law in laws.items()}, both(model))
    )()
    for name, (changed, reading) in found.items():
        np.testing.assert_allclose(changed, rate, atol=1e-9, err_msg=name)
        np.testing.assert_allclose(reading, x, atol=1e-12, err_msg=name)


def test_a_vibration_has_a_period_in_the_recording():
    """A slower one is an acceleration that hardly changes, as a tilt is."""
    kind, known_of = catalogue["base_vibration"], around(declared_model(_case()))
    first = kind.candidates(known_of)[0].start
    assert float(first.frequency) == pytest.approx(1 / (known_of.duration[1] - known_of.duration[0]))
    assert first.is_physical()
    assert not eqx.tree_at(lambda law: law.frequency, first, 0.99 * first.frequency).is_physical()
