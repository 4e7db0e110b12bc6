"""Rates beside their coordinates, late or scaled on purpose: closed forms, from both sides of the bound."""

import numpy as np
import pytest

from nnap_em.explain.check import rates
from nnap_em.explain.rates import MISREAD, timing
from nnap_em.logs.dataset import Dataset
from nnap_em.machines.rig import Declared, Rig

DT, ROWS, COUNT = 0.02, 401, 5
RIG = Rig("s", "slide", {"m": Declared(1.0, 0.0)}, True, ("u",), (1,), DT, "sequence", ("x", "dx"), {}, {})
RATES = np.random.default_rng(1).uniform([1.0], [4.0], (COUNT, 4))
PHASES = np.random.default_rng(2).uniform(0, 6.3, (COUNT, 4))
T = DT * np.arange(ROWS)


def _motion(order: int, late: float = 0.0) -> np.ndarray:
    """Derivative of sums of sinusoids, some time ago."""
    at = RATES[..., None] * (T - late) + PHASES[..., None] + order * np.pi / 2
    return np.sum(0.2 * RATES[..., None] ** order * np.sin(at), axis=1)


def _read(rate: np.ndarray, noise: tuple[float, float] = (1e-4, 1e-3)) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    return _motion(0) + rng.normal(0, noise[0], rate.shape), rate + rng.normal(0, noise[1], rate.shape)


STEEP = np.sqrt(np.mean(_motion(2) ** 2) / np.mean(_motion(1) ** 2))


@pytest.mark.parametrize(("times", "reported"), [(1.15, True), (0.85, False)])
def test_what_changes_a_rate_by_more_than_the_bound_is_reported(times, reported):
    share = times * MISREAD
    for which, rate in ((0, (1 + share) * _motion(1)), (1, _motion(1, share / STEEP)), (1, _motion(1, -share / STEEP))):
        assert timing(*_read(rate), DT).wrong == tuple(reported and i == which for i in range(2))


@pytest.mark.parametrize(("late", "mean"), [(3.5, 8), (-1.3, 1), (0.0, 6)])
def test_the_lag_is_that_which_was_made(late, mean):
    """In rows, of a mean over some rows."""
    rate = np.mean([_motion(1, late=DT * (late - (mean - 1) / 2 + k)) for k in range(mean)], axis=0)
    found = timing(*_read(rate, noise=(2e-4, 2e-3)), DT)
    assert abs(found.late / DT - late) < 0.05 and abs(found.scale - 1) < 2e-3


def test_a_difference_of_coarse_readings_is_half_a_row_late():
    """Codes of an encoder 1 mm apart, and the difference to the row before: noise of both is one."""
    x = np.round(_motion(0), 3)
    found = timing(x, np.diff(x, axis=1, prepend=x[:, :1]) / DT, DT)
    assert abs(found.late / DT - 0.5) < 0.1 and found.wrong[1]


def test_noise_gaps_and_too_little_data_show_no_lag():
    for noise in ((1e-4, 1.0), (0.02, 1e-3)):
        y, w = _read(_motion(1), noise)
        y[:, 50::7], w[:, 20::5] = np.nan, np.nan
        found = timing(y, w, DT)
        assert found is None or not any(found.wrong)
    y, w = _read(_motion(1))
    for logs in ((y[:1, :12], w[:1, :12]), (np.full((5, ROWS), np.nan), w), (y, np.ones((5, ROWS)))):
        assert timing(*logs, DT) is None


def test_the_sentence_has_the_later_one_and_what_to_do():
    later = "is 0.04 s (2 rows) later than"
    for late, start in ((0.0, "dx is the derivative of x, "), (0.04, f"dx {later} the"), (-0.04, f"x {later} dx; ")):
        y, valid = np.stack(_read(_motion(1, late)), axis=-1), np.ones((COUNT, ROWS), bool)
        (found,) = rates(RIG, Dataset(np.tile(T, (COUNT, 1)), np.zeros((COUNT, ROWS, 1)), y, valid))
        assert found.text.startswith(start)
        assert (f"take {'dx' if late > 0 else 'x'} out of [measurement] columns" in found.text) == bool(late)
