"""Friction with memory: passive, odd, the static map in its limits; found and recovered where it is, and only there."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import plant
import pytest
from helpers import around, declared_model

from nnap_em.data.dataset import Dataset
from nnap_em.data.rig import Declared, Rig, read_rig, write_rig
from nnap_em.diagnosis import memory as memories
from nnap_em.diagnosis.memory import identify, with_memory
from nnap_em.diagnosis.outcome import Diagnosis, Step
from nnap_em.effects import OperatingPoint
from nnap_em.em.build import build_system, measure_scales
from nnap_em.fit.check import Along, memory
from nnap_em.fit.identify import begin, friction_table
from nnap_em.fit.store import load, save
from nnap_em.model.base import prepare
from nnap_em.model.dynamic_friction import SHAPES, DynamicFriction, hysteresis
from nnap_em.model.law import StribeckLaw
from nnap_em.model.simulate import simulate
from nnap_em.model.state_space import with_effects
from nnap_em.numerics.gaussian import Gaussian
from nnap_em.report.contacts import contacts
from nnap_em.smoother.particle.smoother import banked
from nnap_em.systems import specs

KNEE = 1e-3
PHYSICS = {"m": 0.5, "lc": 0.2, "I": 0.01, "g": 9.81}


def _contact(*, level=0.3, distance=0.02, damping=1e-9, rise=1e-9, shape=None) -> DynamicFriction:
    shape = jnp.zeros(SHAPES) if shape is None else shape
    numbers = map(jnp.log, jnp.asarray([level, distance, damping, rise, 0.2]))
    return DynamicFriction(*numbers, shape, knee=KNEE, stiffest=1e9, fastest=1e9, joint=1)


def _scene(v) -> OperatingPoint:
    v, still = jnp.ravel(jnp.asarray(v, float)), jnp.zeros(1)
    return OperatingPoint(None, still, v, still, jnp.zeros(()), still, None)  # type: ignore[arg-type]


def _random(key) -> DynamicFriction:
    key_shape, key_numbers = jax.random.split(key)
    level, distance, damping, rise = jnp.exp(jax.random.normal(key_numbers, (4,))) * jnp.asarray([0.3, 0.02, 0.01, 0.5])
    shape = 2 * jax.random.normal(key_shape, (SHAPES,))
    return _contact(level=level, distance=distance, damping=damping, rise=rise, shape=shape)


def test_no_closed_cycle_gives_energy():
    """At any rates on the way: the hidden state returns to where it began, and the contact has taken energy."""

    @jax.jit
    @jax.vmap
    def energies(key):
        key_contact, key_amplitude, key_phase = jax.random.split(key, 3)
        effect, n = _random(key_contact), jnp.arange(1.0, 6.0)
        amplitude = jax.random.normal(key_amplitude, (5,)) / n
        phase = jax.random.uniform(key_phase, (5,), maxval=2 * jnp.pi)
        dt, rows = 1e-3, 1000

        def step(s, k):
            v = 0.5 * jnp.sum(amplitude * jnp.sin(2 * jnp.pi * n * k.astype(float) / rows + phase))
            scene = _scene(v)
            slid = effect.force(scene, s[None])[0] - jnp.exp(effect.log_level) * effect.level(v) * jnp.tanh(v / KNEE)
            half = s + 0.5 * dt * effect.drift(scene, s[None])[0]
            return s + dt * effect.drift(scene, half[None])[0], -slid * v * dt

        def period(s, _):
            after, taken = jax.lax.scan(step, s, jnp.arange(rows))
            return after, (jnp.sum(taken), jnp.sum(jnp.abs(taken)), after - s)

        _, periods = jax.lax.scan(period, jnp.zeros(()), None, length=30)
        return jax.tree.map(lambda a: a[-1], periods)

    taken, size, moved = energies(jax.random.split(jax.random.key(0), 16))
    assert np.abs(moved).max() < 1e-4  # the last period is closed
    assert np.all(taken > -1e-3 * size)  # the integrator's own error
    assert np.mean(taken / size) > 0.1


def test_friction_is_odd():
    for key in jax.random.split(jax.random.key(0), 5):
        key, key_v, key_s = jax.random.split(key, 3)
        effect, v, s = _random(key), jax.random.normal(key_v), jax.random.uniform(key_s, (1,), minval=-1.0)
        for hook in (effect.force, effect.drift):
            np.testing.assert_allclose(hook(_scene(-v), -s), -hook(_scene(v), s), rtol=1e-12)


def test_steady_sliding_is_the_static_map():
    """The state rests at the level of its rate, and there the contact adds nothing."""
    for v, key in zip((-1.3, -0.05, 0.2, 2.0), jax.random.split(jax.random.key(0), 4), strict=True):
        effect = _random(key)
        steady = (effect.level(jnp.asarray(v)) * jnp.sign(v))[None]
        np.testing.assert_allclose(effect.drift(_scene(v), steady), 0.0, atol=1e-12)
        np.testing.assert_allclose(effect.force(_scene(v), steady), 0.0, atol=1e-12)


def test_no_level_is_the_static_map_and_a_short_distance_is_its_sign():
    faint = eqx.tree_at(lambda e: (e.log_level, e.log_damping), _contact(), (jnp.asarray(-60.0), jnp.asarray(-60.0)))
    np.testing.assert_allclose(faint.force(_scene(0.3), jnp.asarray([-1.0])), 0.0, atol=1e-20)
    short = hysteresis(_contact(distance=1e-9), 0.1)
    np.testing.assert_allclose(short.torque[2:100], -0.3, rtol=1e-6)


@pytest.mark.parametrize("amplitude", [0.01, 0.05])
def test_hysteresis_of_dahls_contact(amplitude):
    """The closed loop of s' = v (1 - s sign v) / delta ends at tanh(amplitude / delta)."""
    effect = _contact(distance=0.02)
    loop = hysteresis(effect, amplitude)
    delta = effect.values()["distance"]
    np.testing.assert_allclose(delta, 0.04, rtol=1e-6)
    np.testing.assert_allclose(loop.torque[100], -0.3 * jnp.tanh(amplitude / delta), rtol=1e-4)
    np.testing.assert_allclose(loop.torque[0], loop.torque[-1], rtol=1e-4)


def test_an_elastic_contact_that_yields_is_stiff_until_it_slides():
    """All of the fall behind: Phi is nearly 1 up to s = 0, whose stiffness is then twice that of Dahl's contact."""
    late = _contact(shape=jnp.asarray([-20.0] * (SHAPES - 1) + [20.0]))
    ratio = late.values()["stiffness"] / _contact().values()["stiffness"]
    np.testing.assert_allclose(ratio, 2 * (1 - 0.5**SHAPES), rtol=1e-6)


def _logs(stiffness: float | None, seed: int, sequences: int = 16, rows: int = 60) -> Dataset:
    """A pendulum with Dahl friction of 0.08 N m and 0.02 N m s/rad, or with its static limit; both states read."""
    rng, dt, sub = np.random.default_rng(seed), 0.02, 20
    t = dt * np.arange(rows)
    amplitude, period, phase = (rng.uniform(*r, sequences) for r in ((0.1, 0.6), (0.5, 2.0), (0.0, 6.3)))
    u = amplitude * np.sin(2 * np.pi * t[:, None] / period + phase)
    q, v, s, y = rng.uniform(-1, 1, sequences), np.zeros(sequences), np.zeros(sequences), []
    inertia, h = PHYSICS["I"] + PHYSICS["m"] * PHYSICS["lc"] ** 2, dt / sub
    for force in u:
        y.append(np.stack([q, v], axis=-1))
        for _ in range(sub):
            weight = PHYSICS["m"] * PHYSICS["g"] * PHYSICS["lc"] * np.sin(q)
            dry = np.tanh(v / 0.02) if stiffness is None else s
            v = v + h * (force - weight - 0.08 * dry - 0.02 * v) / inertia
            q = q + h * v
            if stiffness is not None:
                s = np.sign(v) + (s - np.sign(v)) * np.exp(-np.abs(v) * h * stiffness / 0.08)
    read = np.stack(y, axis=1) + rng.normal(size=(sequences, rows, 2)) * [0.002, 0.02]
    return Dataset(np.tile(t, (sequences, 1)), u.T[..., None], read, np.ones(read.shape[:2], bool))


def _rig(**changes) -> Rig:
    physics = {name: Declared(value, 0.0) for name, value in PHYSICS.items()}
    noise = {"theta1": 0.002, "dtheta1": 0.02}
    rig = Rig("m", "pendulum", physics, True, ("u",), (1,), 0.02, "sequence", tuple(noise), noise, {}, memory=True)
    return replace(rig, **changes)


@pytest.fixture(scope="module")
def fitted():
    """Fit to logs with memory."""
    return identify(_rig(), _logs(4.0, 0), key=jax.random.key(0))


def test_a_fit_recovers_dahls_friction(fitted):
    """Within three of the stated standard deviations, which are themselves small."""
    assert fitted.memory.startswith("joint 1: memory")
    (contact,) = contacts(fitted)
    for name, truth in (("coulomb", 0.08), ("stiffness", 4.0)):
        number = contact.parameters[name]
        assert abs(number.value - truth) < 3 * number.std < 0.4 * truth
    assert contact.joint == 1 and "presliding stiffness" in contact.text and "N m/rad" in contact.text
    assert np.ptp(contact.loop.torque) == pytest.approx(2 * 0.08 * np.tanh(1.0), rel=0.15)  # at its distance, by Dahl


def test_the_table_is_the_torque_of_steady_sliding(fitted):
    """Map and contact, its state at the level of the rate, above and below the knee; odd but for the map's offset."""
    (effect,) = fitted.model.effects
    v = jnp.asarray([-20.0, -0.9, -0.1, 0.1, 0.9, 20.0]) * effect.knee
    torque = [
        fitted.model.unknown(one[None])[0] + effect.force(_scene(one), (effect.level(one) * jnp.sign(one))[None])[0]
        for one in v
    ]
    table = friction_table(fitted, v[None])
    np.testing.assert_allclose(table.torque[0], jnp.stack(torque), rtol=1e-12)
    assert np.all(np.abs(np.abs(table.torque[0, 1:5]) - 0.08) < 3 * table.std[0, 1:5])  # Dahl's level, next to rest too


def test_a_static_map_is_kept_where_there_is_no_memory():
    fitted = identify(_rig(), _logs(None, 0), key=jax.random.key(0))
    assert fitted.model.effects == ()
    assert fitted.memory.startswith("joint 1: the static map is kept, no memory is seen")


@pytest.mark.parametrize(
    ("turns", "amplitude", "marks"), [(20, 0.5, "ok"), (19, 0.5, "warning"), (20, 0.02, "warning")]
)
def test_check_counts_reversals_and_compares_the_noise_with_the_range(turns, amplitude, marks):
    """A sine that reverses so often, its angle read with 6 mrad: below a tenth of a range of 1 rad, not of 0.04 rad."""
    t = 0.02 * np.arange(1000)
    rate = np.pi * turns / t[-1]
    y = amplitude * np.stack([np.sin(rate * t), rate * np.cos(rate * t)], axis=-1)[None]
    data = Dataset(t[None], np.zeros((1, 1000, 1)), y, np.ones((1, 1000), bool))
    rig = _rig()
    model, scales = begin(rig, data, key=jax.random.key(0)).model, measure_scales(rig, build_system(rig), data)
    rig = replace(rig, noise_std={"theta1": 0.006, "dtheta1": 0.02})
    (row,) = memory(rig, model, data, Along(y, *3 * [np.zeros(0)]), scales._replace(acceleration=np.zeros(1)))
    assert row.mark == marks and f"joint 1: {turns} reversals" in row.text and "0.006 rad" in row.text


def test_particles_and_cubature_points_smooth_the_state_of_a_contact_alike():
    """Means within four standard errors of the paths that are drawn, on a simulated joint that reverses five times."""
    start = begin(_rig(), _logs(4.0, 0, sequences=2), key=jax.random.key(0))
    law = StribeckLaw(*(jnp.asarray([x]) for x in (0.08, 0.08, 0.2, 0.02, 0.005)))
    dahl = replace(_contact(level=0.08), stiffest=300.0, fastest=200.0)
    first = Gaussian(jnp.asarray([0.5, 0.0, 0.0]), jnp.diag(jnp.asarray([0.05, 0.05, 0.5]) ** 2))
    model = with_effects(replace(start.model, unknown=law), (dahl,))
    model = replace(model, start=first, log_q=2 * jnp.log(jnp.asarray([2e-4, 1e-2, 2e-2])))
    u = 0.4 * jnp.sin(2 * jnp.pi * 0.02 * jnp.arange(40.0) / 0.6)[None, :, None]
    logs = simulate(model, first.mean[None], u, key=jax.random.key(1))
    seq = prepare(model, jax.tree.map(lambda a: a[0], logs.data))
    paths = 100
    particles = banked(start.bank, num_particles=300, num_paths=paths)
    (mean, cov), drawn = (
        eqx.filter_jit(smoother)(model, seq, key=jax.random.key(2)).state for smoother in (start.smoother, particles)
    )
    std = np.sqrt(cov[:, 2, 2])
    assert np.ptp(mean[:, 2]) > 1.0 and std.max() < 0.6  # the contact winds up both ways
    np.testing.assert_array_less(np.abs(drawn.mean[:, 2] - mean[:, 2]), 4 * std / np.sqrt(paths))


def test_a_fit_with_memory_is_stored(fitted, tmp_path):
    save(tmp_path / "model.npz", fitted)
    again = load(tmp_path / "model.npz")
    assert again.memory == fitted.memory
    for a, b in zip(jax.tree.leaves(again.model), jax.tree.leaves(fitted.model), strict=True):
        np.testing.assert_array_equal(a, b)


def test_dynamic_friction_is_declared_and_written(tmp_path):
    write_rig(_rig(), tmp_path / "rig.toml")
    assert 'friction = "dynamic"' in (tmp_path / "rig.toml").read_text()
    assert read_rig(tmp_path / "rig.toml", specs) == _rig()


def test_contacts_are_tried_from_none_to_the_dry_friction_of_the_map():
    """None adds nothing; in steady sliding, at any rate, neither do the others; sizes are those of the joint."""
    scales = around(declared_model(plant.Case()))._replace(dry=np.array([0.3, 0.02]))
    candidates = DynamicFriction.candidates(scales)
    assert [c.start.joint for c in candidates] == [1] * 4 + [2] * 4
    assert DynamicFriction.candidates(scales._replace(learned=False)) == []
    for candidate in candidates:
        (probe,), j = candidate.probes, candidate.start.joint - 1
        np.testing.assert_allclose(jnp.exp(probe.log_level), scales.dry[j], rtol=1e-12)
        scene = _scene(jnp.asarray([0.7, -0.4]))
        steady = (probe.level(scene.v[j]) * jnp.sign(scene.v[j]))[None]
        np.testing.assert_allclose(probe.force(scene, steady), 0.0, atol=1e-12)
        np.testing.assert_allclose(candidate.start.force(scene, jnp.zeros(1)), 0.0, atol=1e-4 * scales.dry[j])
        assert abs(probe.force(scene, jnp.zeros(1))[j]) > 0.5 * scales.dry[j]


@pytest.mark.parametrize(
    ("steps", "sentence"),
    [
        ([], "no memory is seen"),
        ([(0.04, None)], "no memory is seen (a contact would remove 4.0% of the squared error)"),
        ([(0.4, -0.02), (0.01, None)], "no memory is seen (a contact would remove 1.0% of the squared error)"),
        ([(0.4, -0.02)], "memory predicts no better (it removes -2.0% of the squared error)"),
    ],
)
def test_a_joint_that_is_refused_is_not_one_without_memory(monkeypatch, steps, sentence):
    """The sentence is that of the last round which judged the joint."""
    law = (DynamicFriction.name, 1, None, ())
    rounds = tuple(Step(60, ((law, seen),), () if left is None else ((law, left),), None, 4) for seen, left in steps)
    fit = begin(_rig(), _logs(4.0, 0, sequences=2), key=jax.random.key(0))
    monkeypatch.setattr(memories, "search", lambda context, **_: Diagnosis(context.before, context.before, (), rounds))
    assert with_memory(fit, _logs(4.0, 0, sequences=2)).memory == f"joint 1: the static map is kept, {sentence}"
