"""Inputs that go on from row to row: closed forms, and scipy's simulation of linear systems (`lsim`)."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import rig_of, rig_text, slide
from scipy.signal import lsim

from nnap_em.estimate.em.build import build_system
from nnap_em.explain.check import late
from nnap_em.explain.inverse_dynamics import lag, regression
from nnap_em.logs.dataset import Dataset, pad
from nnap_em.machines.rig import HOLD, SMOOTH
from nnap_em.model import hooks
from nnap_em.model.effects import catalogue
from nnap_em.model.state_space import with_effects

DT, ROWS = 0.05, 40
LINES = hooks.Sampling(DT, smooth=True)


def _model(effects=(), smooth=True):
    return dataclasses.replace(with_effects(slide()[0], effects), smooth=smooth)


def _log(u) -> Dataset:
    rows = len(u)
    return Dataset(
        jnp.asarray(DT * np.arange(rows)), jnp.asarray(u)[:, None], jnp.full((rows, 2), jnp.nan), jnp.ones(rows, bool)
    )


def _run(model, u):
    step = lambda x, inputs: (model.transition(x, inputs), x)  # noqa: E731
    along = jax.jit(lambda seq: jax.lax.scan(step, jnp.asarray([0.1, -0.2]), model.inputs(seq))[1])
    return np.asarray(along(_log(u)))


def _signal(rows=ROWS):
    return np.sin(2.7 * DT * np.arange(rows)) + 0.3 * np.random.default_rng(0).normal(size=rows)


@pytest.mark.parametrize("smooth", [False, True])
def test_a_mass_moves_as_its_force_does(smooth):
    """m x'' = u: held, as scipy holds it; a parabola between rows, integrated twice."""
    model, m = _model(smooth=smooth), float(slide()[0].system.m)
    t, c = DT * np.arange(ROWS), (0.7, -1.3, 2.1)
    if smooth:
        u = c[0] + c[1] * t + c[2] * t**2
        v = -0.2 + (c[0] * t + c[1] * t**2 / 2 + c[2] * t**3 / 3) / m
        x = np.stack([0.1 - 0.2 * t + (c[0] * t**2 / 2 + c[1] * t**3 / 6 + c[2] * t**4 / 12) / m, v], axis=1)
    else:
        u, system = _signal(), ([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1 / m]], np.eye(2), np.zeros((2, 1)))
        x = lsim(system, u, t, X0=[0.1, -0.2], interp=False)[2]
    np.testing.assert_allclose(_run(model, u), x, rtol=1e-12, atol=1e-12)


def test_a_sine_loses_nothing_between_its_rows():
    """Velocity under sin(w t), w dt = 0.4: lines would be 1.3 % too small, (w dt)^2 / 12."""
    w, m = 0.4 / DT, float(slide()[0].system.m)
    v = _run(_model(), np.sin(w * DT * np.arange(400)))[:, 1]
    exact = -0.2 + (1 - np.cos(w * DT * np.arange(400))) / (w * m)
    np.testing.assert_allclose(v, exact, atol=2e-3 / (w * m))


def test_padding_and_horizons_end_the_course():
    u, model = _signal(), _model()
    padded = _log(np.append(u[:20], np.zeros(5)))._replace(valid=jnp.arange(25) < 20)
    courses = jax.jit(lambda *logs: [model.inputs(log).course for log in logs])
    short, padded, whole = courses(_log(u[:20]), padded, _log(u))
    np.testing.assert_array_equal(short[:19], padded[:19])
    np.testing.assert_array_equal(short[:18], whole[:18])


def _lagged(u, number):
    """tau y' = u - y, at rest with the input before the first row."""
    return lsim(([[-1 / number]], [[1 / number]], [[1.0]], [[0.0]]), u, DT * np.arange(ROWS), X0=[u[0]], interp=True)[1]


def _moved(u, number):
    """The line between rows, later."""
    return np.interp(DT * np.arange(ROWS) - number, DT * np.arange(ROWS), u)


@pytest.mark.parametrize(
    "name, number, truth",
    [("actuator_lag", 0.13, _lagged), ("input_delay", 0.02, _moved), ("input_delay", 0.12, _moved),
     ("motor_gain", 0.1, lambda u, number: (1 + number) * u)],
)  # fmt: skip
def test_what_a_drive_does_to_the_line_between_rows_at_once_and_row_by_row(name, number, truth):
    effect, u, system = catalogue[name].of(number, joint=1), _signal(), _model().system
    stream = hooks.command_stream((effect,), None, system, LINES)
    step = lambda memory, row: stream.step(memory, row[0], row[1])  # noqa: E731
    first = jnp.arange(ROWS) == 0
    rows, whole = jax.jit(
        lambda u: (
            jax.lax.scan(step, stream.memory, (u, first))[1],
            hooks.arriving((effect,), None, system, u, LINES.through)[0],
        )
    )(jnp.asarray(u)[:, None])
    np.testing.assert_allclose(rows[:, 0], truth(u, number), atol=1e-12)
    np.testing.assert_allclose(whole[:, 0], truth(u, number), atol=1e-12)


def test_a_late_sensor_reads_the_line_before_its_row():
    """The position `delay` ago, by the closed form of a mass under a linear force."""
    delay, u = 0.03, _signal()
    model = _model((catalogue["sensor_delay"].of(delay, channel="x"),))
    x, m = _run(model, u), float(model.system.m)
    read = jax.jit(lambda x, log: jax.vmap(model.emission)(x, model.inputs(log)))(jnp.asarray(x), _log(u))[1:, 0]
    slope = np.diff(u) / DT
    past = x[1:, 0] - delay * x[1:, 1] + (u[1:] * delay**2 / 2 - slope * delay**3 / 6) / m  # by a line
    np.testing.assert_allclose(read, past, atol=1e-12)


@functools.cache
def _recordings(hold: str, delay: float = 0.0) -> Dataset:
    """Slides of 2.1 kg with dry and viscous friction under a force in time, every 40 ms, by Runge-Kutta steps."""
    rng, h, rows = np.random.default_rng(3), 0.002, 300
    size, speed, phase = rng.uniform(2, 5, (4, 3)), rng.uniform(1, 9, (4, 3)), rng.uniform(0, 6, (4, 3))
    smooth = lambda t: np.sum(size * np.sin(speed * t + phase), axis=1)  # noqa: E731

    def rate(t, x):
        force = FORCES[hold](smooth, t - delay)
        return np.stack([x[1], (force - np.tanh(x[1] / 0.02) - 1.5 * x[1]) / 2.1])

    x, read = np.zeros((2, 4)), []
    for k in range(rows):
        read.append(x[0])
        for t in 0.04 * k + h * np.arange(20):
            a = rate(t, x)
            b = rate(t + h / 2, x + h / 2 * a)
            c = rate(t + h / 2, x + h / 2 * b)
            x = x + h / 6 * (a + 2 * b + 2 * c + rate(t + h - 1e-6, x + h * c))  # before the force of the next row
    t, noise = 0.04 * np.arange(rows), 3e-4 * rng.normal(size=(rows, 4))
    u = np.stack([smooth(one) for one in t])
    logs = zip(u.T[..., None], (np.stack(read) + noise).T[..., None], strict=True)
    return pad([(t, inputs, readings) for inputs, readings in logs])


FORCES = {HOLD: lambda smooth, t: smooth(0.04 * np.floor(t / 0.04 + 1e-9)), SMOOTH: lambda smooth, t: smooth(t)}


@pytest.mark.parametrize("true", FORCES)
@pytest.mark.parametrize("declared", FORCES)
def test_torque_and_motion_show_the_hold(true, declared, tmp_path):
    """They differ by half a row; the line to write is the hold of the truth, and nothing where it is declared."""
    model = 'type = "slide"\nm = { mean = 2.0, std = 0.2 }\nfriction = "unknown"\nactuated_joint = 1\n'
    rig = rig_of(tmp_path, rig_text(model, ["x"], 0.04).replace(HOLD, declared))
    found = lag(regression(rig, build_system(rig), _recordings(true)), 0)
    expected = {(HOLD, SMOOTH): -0.5, (SMOOTH, HOLD): 0.5}.get((declared, true), 0.0)
    assert abs(found.rows - expected) < 0.05 and found.std < 0.03
    assert found.counts == (true != declared)
    assert not found.counts or f'input_hold = "{true}"' in late(rig, found)
