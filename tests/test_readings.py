"""Noise, codes and motion of readings, from logs whose truth is known."""

import jax
import numpy as np
import pytest

from nnap_em.estimate.em.build import build
from nnap_em.estimate.em.mstep import RELEASES, RESTING_OFFSET
from nnap_em.estimate.em.readings import RESTS, ROWS_BEFORE, at_rest, onset
from nnap_em.logs.dataset import pad
from nnap_em.logs.noise import fast_reading_noise, reading_noise, resolution
from nnap_em.machines.rig import Declared, Rig

T = 0.01 * np.arange(600)


def _motion(rest: float) -> np.ndarray:
    """A smooth motion after some seconds of rest, in four sequences."""
    return np.tile(np.where(rest > T, 0.0, np.sin(2 * (T - rest)) ** 2), (4, 1))


@pytest.mark.parametrize("rest", [0.0, 3.0, 5.0])
@pytest.mark.parametrize("noise", [1e-4, 1e-2])
def test_noise_is_that_of_the_log(rest, noise):
    y = _motion(rest) + noise * np.random.default_rng(0).standard_normal((4, 600))
    assert reading_noise(y) == pytest.approx(noise, rel=0.1)  # of 2,400 third differences
    assert resolution(y) == 0.0


@pytest.mark.parametrize("rest", [3.0, 5.0])
@pytest.mark.parametrize("step", [1e-3, 2 * np.pi / 4096])
def test_codes_of_a_resting_encoder_are_noise_of_rounding_at_least(rest, step):
    """Most third differences of the readings are zero from three seconds of rest on."""
    y = np.round(_motion(rest) / step) * step
    assert resolution(y) == pytest.approx(step)
    assert step / np.sqrt(12) <= reading_noise(y) < step


def test_a_smooth_signal_without_noise_has_no_codes():
    assert resolution(_motion(3.0)) == 0.0
    assert reading_noise(_motion(3.0)) < 1e-5
    assert reading_noise(np.zeros((2, 600))) == reading_noise(np.full((2, 3), np.nan)) == 0.0


def test_noise_of_readings_in_some_rows_is_that_of_the_readings():
    """Every second one, as of a sensor that is read at half of the rate."""
    y = _motion(0.0) + 1e-2 * np.random.default_rng(0).standard_normal((4, 600))
    y[:, 1::2] = np.nan
    assert reading_noise(y) == pytest.approx(1e-2, rel=0.2)


@pytest.mark.parametrize(("rest", "steps"), [(0.0, False), (1.5, False), (2.7, True), (4.5, True)])
def test_logs_that_rest_are_told_from_those_that_move(rest, steps):
    """Of the rest of the motion some 6 % are turns, which are slower than the noise shows."""
    y = _motion(rest) + 1e-4 * np.random.default_rng(0).standard_normal((4, 600))
    assert (at_rest(y) > RESTS) == steps
    assert at_rest(y) == pytest.approx(rest / 6.0, abs=0.07)


def test_a_horizon_begins_shortly_before_the_first_motion_of_any_sensor():
    y = np.stack([_motion(3.0), 0.0 * _motion(0.0)], axis=-1)
    y += 1e-4 * np.random.default_rng(0).standard_normal(y.shape)
    moving, still = onset(y), onset(y[..., 1:])
    assert np.all(np.abs(moving - (300 - ROWS_BEFORE)) <= 6)  # five rows ahead, and the first millimetres
    assert np.all(still == 0) and np.all(onset(_motion(0.0)[..., None]) == 0)


def test_a_fit_of_logs_that_rest_begins_coarse_and_one_of_logs_that_move_does_not():
    """Both are stored alike."""
    slide = {"m": Declared(1.0, 0.0)}
    rig = Rig("slide", "slide", slide, True, ("u",), (1,), 0.01, "sequence", ("x",), {}, {})
    rules = []
    for rest in (0.0, 4.5):
        y = _motion(rest) + 1e-4 * np.random.default_rng(0).standard_normal((4, 600))
        data = pad([(T, np.ones((600, 1)), each[:, None]) for each in y])
        rules.append(build(rig, data, key=jax.random.key(0)).mstep)
    moving, resting = rules
    assert moving.stages() == (moving,) and np.all(np.isinf(moving.reach))
    widths = [float(rule.departure) for rule in resting.stages()]
    np.testing.assert_allclose(widths[:-1], RESTING_OFFSET * np.asarray(RELEASES))
    assert np.isinf(widths[-1]) and 0 < float(resting.reach[0]) < 1.0  # a tenth of the drive, 1 N
    assert moving.reach.shape == resting.reach.shape == (1,)


@pytest.mark.parametrize("period, share", [(9, 0.1), (50, 0.03)])
def test_a_fast_signal_is_not_taken_for_noise(period, share):
    """Of nine rows a period third differences are (2 sin(pi/9))^3 / sqrt(20) of the amplitude, 7 %."""
    y = np.sin(2 * np.pi / period * np.arange(2000.0) + 0.1 * np.arange(2000.0) ** 0.5)
    noisy = (y + 1e-2 * np.random.default_rng(0).standard_normal(2000))[None]
    assert fast_reading_noise(noisy) == pytest.approx(1e-2, rel=share)
    assert (reading_noise(noisy) > 5e-2) == (period == 9)
