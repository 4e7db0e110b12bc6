"""Rates beside their coordinates, late, averaged or scaled on purpose: closed forms, from both sides of the bound."""

from collections.abc import Callable

import numpy as np
import pytest

from nnap_em.data.dataset import Dataset
from nnap_em.data.rig import Declared, Rig
from nnap_em.fit.rates import MISREAD, Timing, timing, timings

DT, ROWS, COUNT = 0.02, 401, 5
RIG = Rig("s", "slide", {"m": Declared(1.0, 0.0)}, True, ("u",), (1,), DT, "sequence", ("x", "dx"), {}, {})
RATES = np.random.default_rng(1).uniform([1.0], [4.0], (COUNT, 4))
PHASES = np.random.default_rng(2).uniform(0, 6.3, (COUNT, 4))
T = DT * np.arange(ROWS)


def _motion(order: int, late: float = 0.0, mean: float = 0.0) -> np.ndarray:
    """Derivative of sums of sinusoids, some time ago, averaged over the time `mean` about it."""
    at = RATES[..., None] * (T - late) + PHASES[..., None] + order * np.pi / 2
    return np.sum(0.2 * RATES[..., None] ** order * np.sinc(RATES[..., None] * mean / 2 / np.pi) * np.sin(at), axis=1)


def _read(rate: np.ndarray, noise: tuple[float, float] = (1e-4, 1e-3)) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    return _motion(0) + rng.normal(0, noise[0], rate.shape), rate + rng.normal(0, noise[1], rate.shape)


def _timing(rate: np.ndarray, **noise) -> Timing:
    found = timing(*_read(rate, **noise), DT)
    assert found is not None
    return found


STEEP, BENT = (np.sqrt(np.mean(_motion(order) ** 2) / np.mean(_motion(1) ** 2)) for order in (2, 3))
CASES: dict[str, tuple[int, Callable[[float], np.ndarray]]] = {
    "scale": (0, lambda share: (1 + share) * _motion(1)),
    "late": (1, lambda share: _motion(1, late=share / STEEP)),
    "early": (1, lambda share: _motion(1, late=-share / STEEP)),
    "mean": (2, lambda share: _motion(1, mean=np.sqrt(24 * share / BENT))),
}


@pytest.mark.parametrize(("times", "reported"), [(1.15, True), (0.85, False)])
@pytest.mark.parametrize("case", CASES)
def test_what_changes_a_rate_by_more_than_the_bound_is_reported(case, times, reported):
    which, rate = CASES[case]
    assert _timing(rate(times * MISREAD)).wrong == tuple(reported and i == which for i in range(3))


@pytest.mark.parametrize(("late", "mean"), [(3.5, 8), (0.5, 1), (-1.3, 1), (0.0, 6)])
def test_lag_and_averaging_are_those_that_were_made(late, mean):
    """In rows; a mean over n rows has the second moment (n^2 - 1) / 12."""
    rate = np.mean([_motion(1, late=DT * (late - (mean - 1) / 2 + k)) for k in range(mean)], axis=0)
    found = _timing(rate, noise=(2e-4, 2e-3))
    assert abs(found.late / DT - late) < 0.05
    assert abs(found.scale - 1) < 2e-3
    assert abs(np.sign(found.width) * (found.width / DT) ** 2 - (mean**2 - 1)) < 3


def test_a_difference_of_coarse_readings_is_half_a_row_late():
    """Codes of an encoder 1 mm apart, and the difference to the row before: noise of both is one."""
    x = np.round(_motion(0), 3)
    found = timing(x, np.diff(x, axis=1, prepend=x[:, :1]) / DT, DT)
    assert found is not None
    assert abs(found.late / DT - 0.5) < 0.1
    assert found.wrong[1]


@pytest.mark.parametrize("noise", [(1e-4, 1.0), (0.02, 1e-3)])
def test_noise_and_gaps_show_no_lag(noise):
    y, w = _read(_motion(1), noise)
    y[:, 50::7], w[:, 20::5] = np.nan, np.nan
    found = timing(y, w, DT)
    assert found is None or not any(found.wrong)


def test_too_little_data_show_nothing():
    y, w = _read(_motion(1))
    assert timing(y[:1, :12], w[:1, :12], DT) is None
    assert timing(np.zeros((5, ROWS)), np.zeros((5, ROWS)), DT) is None
    assert timing(np.full((5, ROWS), np.nan), _motion(1), DT) is None
    assert timing(_motion(0), np.ones((5, ROWS)), DT) is None


def test_the_sentence_has_the_later_one_and_what_to_do():
    def text(late: float) -> str:
        y, valid = np.stack(_read(_motion(1, late)), axis=-1), np.ones((COUNT, ROWS), bool)
        data = Dataset(np.tile(T, (COUNT, 1)), np.zeros((COUNT, ROWS, 1)), y, valid)
        ((_, sentence),) = timings(RIG, data)
        return sentence

    assert text(0.0).startswith("dx is the derivative of x, ")
    assert "dx is 0.04 s (2 rows) later than the derivative of x; " in text(0.04)
    assert "take dx out of [measurement] columns" in text(0.04)
    assert "x is 0.04 s (2 rows) later than dx; " in text(-0.04)
    assert "take x out of [measurement] columns" in text(-0.04)
